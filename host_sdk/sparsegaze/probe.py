# SPDX-License-Identifier: Apache-2.0
"""Who sees whom: every sensor's light from every emitter alone, and what that says of the wiring.

An LED that was soldered to another's place changes a row and a column of the 6 x 6 matrix together, so the
permutation of LEDs that brings the matrix nearest to a reference names it. Parts differ in brightness and in
sensitivity: a factor for each row and each column is always free.
"""

import functools
import itertools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import faults
from .errors import RecordingError, SceneError, SparsegazeError
from .wire import lib

LEDS = 6
# (sensor, emitter) that say nothing: the emitter's own pin, high, is converted just before the sensor's (they
# are a pair in the sensing cycle), and what the sample capacitor holds then goes into the reading.
UNKNOWN = ((0, 5), (4, 1), (3, 2))
KNOWN = ~np.eye(LEDS, dtype=bool)
KNOWN[tuple(zip(*UNKNOWN))] = False
SWAP_LEAST, SWAP_LEAST_PARTS = 0.12, 0.4  # octaves rms: as near as this to the reference, nothing is swapped;
# the same for a simulated reference of other parts and another face
SWAP_GAIN = {6: 0.6, 5: 0.45, 4: 0.3}  # an exchange must leave at most this share, by how many LEDs live
DEARER = 0.15  # and so much less for each LED beyond two
GONE, GONE_PARTS = 2.0, 2.5  # octaves below the others: dead or covered
SEEN_LEAST = 1  # partners; with fewer, nothing is known of an LED
FAINTER = 0.5  # octaves below the faintest that was seen: where the unseen is taken to be


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
    """Probe an open device: float64 [sensor, emitter], log2 photocurrent; NaN: too little, or UNKNOWN."""
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
    out = np.where(seen, np.nanmedian(np.where(seen, found, 0.0), axis=0), np.nan)
    return np.where(KNOWN, out, np.nan)


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
                    "check the common wire of all cathodes and the voltage there; put the headset on",
                )
            ],
        )
    depth = np.nanmedian(measured) - np.nanmin(measured) + FAINTER
    measured_full, reference = _levelled(measured, depth), _levelled(_completed(reference), depth)
    seen = np.isfinite(measured)
    whole = (seen.sum(axis=1) > SEEN_LEAST) & (seen.sum(axis=0) > SEEN_LEAST)
    place = _place(measured_full, reference, whole, SWAP_LEAST if stored else SWAP_LEAST_PARTS)
    moved = np.array(place)
    difference = np.where(KNOWN, measured_full - reference[np.ix_(moved, moved)], np.nan)
    sensor, emitter = _parts(difference)
    gone = (
        (sensor - np.median(sensor) < -limit) | (seen.sum(axis=1) == 0),
        (emitter - np.median(emitter) < -limit) | (seen.sum(axis=0) == 0),
    )
    findings = _swapped(place) + _gone(*gone)
    return Diagnosis(place, sensor, emitter, _misfit(difference, whole), findings)


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


def _levelled(matrix, depth):
    """The matrix with everything faint, or not seen at all, at one level: `depth` below its median."""
    floor = np.nanmedian(matrix) - depth
    return np.where(np.isfinite(matrix), np.maximum(matrix, floor), floor)


def _completed(matrix):
    """The matrix with UNKNOWN entries from their mirrors: light goes both ways alike, parts do not."""
    out = matrix.copy()
    rows, columns = np.nonzero(np.isfinite(matrix + matrix.T) & KNOWN & KNOWN.T)
    design = np.zeros((len(rows), LEDS))
    design[np.arange(len(rows)), rows] += 1
    design[np.arange(len(rows)), columns] -= 1
    part = np.linalg.pinv(design) @ (matrix - matrix.T)[rows, columns] if len(rows) else np.zeros(LEDS)
    for sensor, emitter in UNKNOWN:
        if not np.isfinite(out[sensor, emitter]):
            out[sensor, emitter] = matrix[emitter, sensor] + part[sensor] - part[emitter]
    return out


def _place(measured, reference, whole, least):
    """The order of LEDs that brings the reference nearest to what was measured; of those that are `whole`."""
    order = tuple(range(LEDS))
    best = own = _misfit(measured - reference, whole)
    gain = SWAP_GAIN.get(int(whole.sum()))
    if gain is None or own <= least:
        return order
    for candidate in itertools.permutations(range(LEDS)):
        moved = np.array(candidate)
        out = moved != np.arange(LEDS)
        if not out.any() or not whole[out].all():
            continue
        rest = _misfit(measured - reference[np.ix_(moved, moved)], whole)
        # The simplest explanation: each further LED out of place must be worth it.
        if rest * (1 + DEARER * (out.sum() - 2)) < min(best, gain * own):
            best, order = rest * (1 + DEARER * (out.sum() - 2)), candidate
    return order


def _parts(difference):
    """(sensor [6], emitter [6]) of difference ~ sensor + emitter, by medians; NaN where nothing is known."""
    rest = difference.copy()
    sensor, emitter = np.zeros(LEDS), np.zeros(LEDS)
    for _ in range(10):
        for axis, part in ((1, sensor), (0, emitter)):
            step = np.nanmedian(rest, axis=axis)
            part += step
            rest -= step[:, None] if axis else step[None, :]
    shift = np.median(sensor)
    return sensor - shift, emitter + shift


def _misfit(difference, whole):
    """Rms of what is left of difference without a factor of each row and column; of `whole` LEDs."""
    n = int(whole.sum())
    if n < 4:
        return 0.0  # three LEDs: six pairs, six factors
    rows, columns, projection = _projection(tuple(whole))
    values = difference[rows, columns]
    rest = values - projection @ values
    return float(np.sqrt(rest @ rest / (len(rows) - 2 * n + 1)))


@functools.lru_cache(maxsize=None)
def _projection(whole):
    """(rows, columns, projection onto sums of a row and a column factor) of what is known of `whole` LEDs."""
    rows, columns = np.nonzero(KNOWN & np.outer(whole, whole))
    design = np.zeros((len(rows), 2 * LEDS))
    design[np.arange(len(rows)), rows] = 1
    design[np.arange(len(rows)), LEDS + columns] = 1
    return rows, columns, design @ np.linalg.pinv(design)


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


def _gone(dead_sensor, dead_emitter):
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
