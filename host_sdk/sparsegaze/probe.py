# SPDX-License-Identifier: Apache-2.0
"""Who sees whom: every sensor's light from every emitter alone, and what that says of the wiring.

An LED that was soldered to another's place changes a row and a column of the 6 x 6 matrix together, so the
permutation of LEDs that brings the matrix nearest to a reference names it. Parts differ in brightness and in
sensitivity: a factor for each row and each column is always free.
"""

import itertools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import faults
from .errors import RecordingError, SceneError, SparsegazeError
from .wire import lib

LEDS = 6
SWAP_LEAST = 0.12  # octaves rms: a matrix that is as near as this to its reference is not permuted
SWAP_GAIN = 0.5  # a permutation must leave at most this share of the misfit
GONE, GONE_PARTS = 2.0, 3.0  # octaves below: dead or covered; the same against a simulated reference
NO_LIGHT = 4.0  # octaves below the weakest that was seen: what "too little" is taken as


class Diagnosis(NamedTuple):
    """What a probe shows against its reference.

    place [6]      which place's LED is on each pin: 0..5 in order when nothing is swapped
    sensor, emitter [6]   brightness of each as a sensor and as an emitter against the reference, octaves
    misfit_octaves rms of what no swap and no brightness explains
    findings       [(text, remedy)], one line each; empty when all is well
    """

    place: tuple
    sensor: np.ndarray
    emitter: np.ndarray
    misfit_octaves: float
    findings: list


def measure(device, repeats=3, progress=None):
    """Probe an open device: float64 [sensor, emitter], log2 photocurrent; NaN where too little came."""
    if device.settings().wiring != lib.SG_WIRING_LEDS:
        raise SparsegazeError(
            "only LEDs that sense and emit can be told by who sees whom",
            "this board is set to photodiodes: `sparsegaze status` names those that are at fault",
        )
    faults.refuse_board(device)
    found = np.full((repeats, LEDS, LEDS), np.nan)
    for k in range(repeats):
        for emitter in range(LEDS):
            octaves = device.probe(emitter).octaves
            found[k, :, emitter] = [np.nan if value is None else value for value in octaves]
            if progress:
                progress("probe", k * LEDS + emitter + 1, repeats * LEDS)
    seen = np.isfinite(found).sum(axis=0) > repeats // 2
    with np.errstate(all="ignore"):
        out = np.where(seen, np.nanmedian(np.where(np.isfinite(found), found, np.nan), axis=0), np.nan)
    np.fill_diagonal(out, np.nan)
    return out


def simulated(headset=None, person=0):
    """The matrix [sensor, emitter] of a simulated person who looks ahead, octaves; NaN on the diagonal.

    headset   path of a description, None: the LED2Gaze ring;  person   seed. Raises SceneError.
    """
    from .maps import compute_map

    if headset is None:
        headset = Path(__file__).resolve().parent.parent.parent / "headsets" / "led2gaze.toml"
        if not headset.is_file():
            raise SceneError("no headset to compare with", "name one: --headset FILE, or --reference FILE")
    made = compute_map(headset, person, half_angle_deg=1.0, grid=3, tol=1e-2)
    response = made.response[0, :, :, 1, 1].copy()
    if response.shape != (LEDS, LEDS):
        raise RecordingError(
            f"this headset has {response.shape[0]} sensors and {response.shape[1]} emitters, not {LEDS}",
            "probe against a stored matrix: --reference FILE",
        )
    np.fill_diagonal(response, np.nan)
    with np.errstate(all="ignore"):
        return np.where(response > 0, np.log2(response), np.nan)


def compare(measured, reference, stored=True):
    """Diagnosis of a measured matrix [6, 6] by a reference; both octaves up to a constant, NaN: too little.

    stored   True: the reference is of this very headset and person;  False: of other parts and another face
    """
    measured, reference = (np.array(m, float) for m in (measured, reference))
    limit = GONE if stored else GONE_PARTS
    if not np.isfinite(measured).any():
        return Diagnosis(
            tuple(range(LEDS)),
            np.full(LEDS, -np.inf),
            np.full(LEDS, -np.inf),
            np.inf,
            [
                (
                    "no sensor receives anything from any emitter",
                    "check the common wire of all cathodes and its +2.5 V; put the headset on",
                )
            ],
        )
    dead_sensor, dead_emitter = _dead(measured, reference, limit)
    alive = np.ix_(~dead_sensor, ~dead_emitter)
    known = np.zeros((LEDS, LEDS), bool)
    known[alive] = True
    known &= np.isfinite(measured) & np.isfinite(reference)
    best, place = _misfit(measured - reference, known), tuple(range(LEDS))
    own = best
    if np.isfinite(own) and own > SWAP_LEAST * (1 if stored else 3):
        whole = ~(dead_sensor | dead_emitter)
        for order in itertools.permutations(range(LEDS)):
            moved = np.array(order)
            if order == tuple(range(LEDS)) or not whole[moved != np.arange(LEDS)].all():
                continue
            permuted = reference[np.ix_(moved, moved)]
            rest = _misfit(measured - permuted, known & np.isfinite(permuted))
            # The simplest explanation: more LEDs out of place must be worth it.
            if rest < best * (1 - 0.1 * (np.sum(moved != np.arange(LEDS)) - 2)) and rest < SWAP_GAIN * own:
                best, place = rest, order
    moved = np.array(place)
    sensor, emitter = _parts(measured - reference[np.ix_(moved, moved)])
    findings = _swapped(place) + _gone(dead_sensor, dead_emitter, sensor, emitter)
    return Diagnosis(place, sensor, emitter, float(best), findings)


def save(path, octaves):
    """Write a matrix as JSON. Raises RecordingError."""
    values = [[None if v != v else round(float(v), 4) for v in row] for row in octaves]
    try:
        with open(path, "w", encoding="utf-8") as file:
            json.dump({"probe": values}, file)
            file.write("\n")
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror}", "choose another place with --save"
        ) from None


def load(path):
    """The matrix that `save` or `sparsegaze calibrate --save` (report.json) wrote. Raises RecordingError."""
    remedy = "name a file of `sparsegaze probe --save`, or the report.json of a calibration"
    try:
        with open(path, encoding="utf-8") as file:
            rows = json.load(file)["probe"]
        matrix = np.array([[np.nan if v is None else float(v) for v in row] for row in rows], float)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}", remedy) from None
    except (ValueError, KeyError, TypeError, UnicodeDecodeError):
        raise RecordingError(f"{path} holds no probe", remedy) from None
    if matrix.shape != (LEDS, LEDS):
        raise RecordingError(f"{path} holds a matrix of {matrix.shape}, not {LEDS} x {LEDS}", remedy)
    return matrix


def _off_diagonal():
    return ~np.eye(LEDS, dtype=bool)


def _filled(measured, reference):
    """measured - reference; where too little came, as if it were far below the weakest that was seen."""
    floor = np.nanmin(measured)
    filled = np.where(np.isfinite(measured), measured, floor - NO_LIGHT)
    return np.where(np.isfinite(reference) & _off_diagonal(), filled - reference, np.nan)


def _parts(difference):
    """(sensor [6], emitter [6]) of difference ~ sensor + emitter, by medians; about the median of all."""
    rest = difference - np.nanmedian(difference)
    sensor, emitter = np.zeros(LEDS), np.zeros(LEDS)
    with np.errstate(all="ignore"):
        for _ in range(10):
            step = np.nan_to_num(np.nanmedian(rest, axis=1))
            sensor, rest = sensor + step, rest - step[:, None]
            step = np.nan_to_num(np.nanmedian(rest, axis=0))
            emitter, rest = emitter + step, rest - step[None, :]
    shift = np.median(sensor)
    return sensor - shift, emitter + shift


def _dead(measured, reference, limit):
    """(sensors, emitters) bool [6] that are far below what the others let expect."""
    sensor, emitter = _parts(_filled(measured, reference))
    return sensor < -limit, emitter - np.median(emitter) < -limit


def _misfit(difference, known):
    """Rms of what is left of difference when a free factor of each row and each column is taken off."""
    rows, columns = np.nonzero(known)
    if len(rows) < 12:
        return np.inf
    design = np.zeros((len(rows), 2 * LEDS))
    design[np.arange(len(rows)), rows] = 1
    design[np.arange(len(rows)), LEDS + columns] = 1
    values = difference[rows, columns]
    rest = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    spare = max(len(rows) - np.linalg.matrix_rank(design), 1)
    return float(np.sqrt(rest @ rest / spare))


def _swapped(place):
    found, seen = [], set()
    for pin, home in enumerate(place):
        if home == pin or pin in seen:
            continue
        ring, at = [pin], home
        while at != pin:
            ring.append(at)
            at = place[at]
        seen.update(ring)
        joint = " and " if len(ring) == 2 else ", "
        names, pins = (joint.join(f"{name}{led}" for led in ring) for name in ("LED ", "A"))
        found.append(
            (
                f"{names} are in each other's places",
                f"exchange the wires at {pins}; or leave them and calibrate: the model does not mind",
            )
        )
    return found


def _gone(dead_sensor, dead_emitter, sensor, emitter):
    found = []
    for led in range(LEDS):
        if dead_sensor[led] and dead_emitter[led]:
            found.append(
                (
                    f"LED {led} neither senses nor emits: dead, not connected, or covered",
                    f"uncover it; check its joints and the wire to A{led}",
                )
            )
        elif dead_emitter[led]:
            found.append(
                (f"LED {led} senses, but hardly emits", f"check its series resistor at A{led}, or replace it")
            )
        elif dead_sensor[led]:
            found.append((f"LED {led} emits, but hardly senses", "clean its lens, or replace it"))
    return found
