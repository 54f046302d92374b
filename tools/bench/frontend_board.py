# SPDX-License-Identifier: Apache-2.0
"""A calibrated virtual Nano with the shipped firmware: whose eye goes where it is told, whose stream is an
array.

Calibrations are kept by the hash of what makes them: firmware, virtual Nano, map, physics and the SDK's
fitting.
"""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np

from sparsegaze import calibrate, linearity, metrics, store, targets
from sparsegaze.device import Device
from sparsegaze.fit import fit_recording
from sparsegaze.screen import VirtualScreen
from sparsegaze.virtual import VirtualNano, locate_vheadset
from sparsegaze.wire import lib

ROOT = Path(__file__).resolve().parents[2]
FIRMWARE = ROOT / "host_sdk" / "sparsegaze" / "data" / "firmware.hex"
SOURCES = (
    "linearity",
    "curvefit",
    "converter",
    "calibrate",
    "capture",
    "session",
    "selection",
    "fit",
    "distil",
    "gp",
    "choose",
    "trustfit",
    "rounding",
)
CALIBRATION_TARGETS, RATE_HZ = 120, 1000
LEAST_VECTORS, FEWER = 12, 3  # when the model of calibrate's choice makes fewer frames than RATE_HZ
GRID_DEG = (-20.0, -10.0, 0.0, 10.0, 20.0)
DWELL_S, SKIP_S = (
    0.25,
    0.07,
)  # a grid's target; what of it is not looked at, because exposures follow the jump
LEAD_US = 20_000
FRAME = np.dtype(
    [("seq", "i8"), ("t_us", "i8"), ("gaze_deg", "f8", (2,)), ("flags", "u1"), ("features", "u2", (6,))]
    + [("infer_us", "u2")]
)


class Board:
    """A powered virtual Nano and the Device on it, in lockstep; a context manager.

    state   folder of flash and EEPROM;  options   further arguments of VirtualNano
    """

    def __init__(self, seed, state, **options):
        self.nano = VirtualNano(person=seed, unpaced=True, state_dir=state, **options)
        try:
            self.control = self.nano.control
            self.device = Device(self.nano.port)
            self._screen = VirtualScreen(self.control)
            self._screen.open(self.device)
        except BaseException:
            self.nano.stop()
            raise
        self._streams = None

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.device.close()
        self.nano.stop()

    @property
    def offset_us(self):
        """Device time minus the virtual Nano's."""
        return self._screen.offset_us

    def still(self):
        """The eye does nothing by itself, and is where it is told at once."""
        self.control.motion(False)
        self.control.follow(False)

    def now_us(self):
        """Virtual time."""
        return self.control.time().us

    def frames(self, seconds, gaze=True, raw=False):
        """The stream of so much device time from now on, as an array of FRAME; without gaze nan.

        With both streams a frame that lacks one, because the line was full, is left out.
        """
        if self._streams != (gaze, raw):
            self.device.set_stream(gaze=gaze, raw=raw)
            self._streams = gaze, raw
        rows, begin = [], self.now_us() + self.offset_us
        for frame in self.device.frames(5.0):
            if frame.t_us < begin or (gaze and not frame.gaze) or (raw and not frame.raw):
                continue
            found, features = frame.gaze, frame.raw.feature if frame.raw else (0,) * 6
            place = (found.azimuth_deg, found.elevation_deg) if found else (np.nan, np.nan)
            flags = (found or frame.raw).flags
            infer_us = found.infer_us if found else 0
            rows.append((frame.seq, frame.t_us, place, flags, tuple(features), infer_us))
            if frame.t_us - begin >= seconds * 1e6:
                return np.array(rows, FRAME)
        return np.array(rows, FRAME)

    def resume(self):
        """The streams have been switched off behind our back."""
        self._streams = None

    def look(self, azimuth_deg, elevation_deg):
        """One target, from now on."""
        self.control.targets_clear()
        self.control.target(self.now_us(), azimuth_deg, elevation_deg)

    def grid(self, places=None, dwell_s=DWELL_S, skip_s=SKIP_S, gaze=True, raw=False):
        """Frames over places [k, 2] (the grid within +-20 degrees), one after the other, with their
        targets.

        Returns (frames, target_deg [n, 2], index [n]); index -1 while a place is new.
        """
        places = grid_places() if places is None else np.asarray(places, float)
        start = self.now_us() + LEAD_US
        self.control.targets_clear()
        for k, (azimuth, elevation) in enumerate(places):
            self.control.target(int(start + k * dwell_s * 1e6), azimuth, elevation)
        frames = self.frames(LEAD_US * 1e-6 + len(places) * dwell_s, gaze, raw)
        since = (frames["t_us"] - self.offset_us - start) * 1e-6
        index = np.floor(since / dwell_s).astype(int)
        within = since - index * dwell_s
        inside = (index >= 0) & (index < len(places))
        target = np.where(inside[:, None], places[np.clip(index, 0, len(places) - 1)], np.nan)
        return frames, target, np.where(inside & (within >= skip_s), index, -1)


def grid_places():
    """[25, 2] degrees."""
    return np.array([(a, e) for e in GRID_DEG for a in GRID_DEG])


def valid(frames):
    """bool [n]: a gaze that the device calls one."""
    return (frames["flags"] & lib.SG_FLAG_VALID) != 0


def error_deg(frames, target_deg):
    """Angle between gaze and target, [n]; nan where the device calls it no gaze."""
    found = metrics.frame_errors_deg(*frames["gaze_deg"].T, *np.asarray(target_deg, float).T)
    return np.where(valid(frames), found, np.nan)


def key_of(seed, light):
    """What a calibration depends on, as a hash."""
    digest = hashlib.sha256(repr((seed, light, CALIBRATION_TARGETS, RATE_HZ)).encode())
    package = ROOT / "host_sdk" / "sparsegaze"
    paths = [FIRMWARE, Path(locate_vheadset()), ROOT / "headsets" / "led2gaze.toml"]
    for path in paths + [package / f"{name}.py" for name in SOURCES] + [Path(__file__)]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:20]


def calibrated(seed, light, folder, say):
    """(state folder of a Nano that holds firmware and model of this person at this light, dict of what it
    took)."""
    key = key_of(seed, light)
    place = folder / f"{seed}-{light}-{key}"
    known = place / "calibration.json"
    if not known.is_file():
        for stale in folder.glob(f"{seed}-{light}-*"):
            shutil.rmtree(stale, ignore_errors=True)
        made = _calibrate(seed, light, place, say)
        known.write_text(json.dumps(made) + "\n", encoding="utf-8")
    return place / "state", json.loads(known.read_text(encoding="utf-8"))


def _calibrate(seed, light, place, say):
    """The product's calibration; the model of its choice, or the largest that still makes RATE_HZ."""
    state = place / "state"
    with VirtualNano(person=seed, unpaced=True, state_dir=state, light=light, app=FIRMWARE) as nano:
        say(f"person {seed}, {light}: linearity, then {CALIBRATION_TARGETS} targets")
        with Device(nano.port) as device:
            nano.control.motion(False)
            nano.control.set("light", "bright")  # a sheet of white paper, which throws back more than an eye
            curves = linearity.run(device).report()
            nano.control.set("light", light)
            nano.control.motion(True)
        options = {"n_targets": CALIBRATION_TARGETS, "seed": seed, "n_validation": 0}
        done = calibrate.run(nano.port, **options)
    fitted, wished = done.fit, done.fit.model.vectors
    while True:
        vectors = fitted.model.vectors
        with Board(seed, state, light=light) as board:
            board.frames(0.05)  # the limit is that of the streams that are on
            limit = board.device.settings().rate_limit_hz
            say(f"person {seed}, {light}: {vectors} vectors, {limit} Hz at most")
            if limit >= RATE_HZ or vectors <= LEAST_VECTORS:
                board.still()
                ratio = truth_ratio(board, fitted.gp)
                break
            fitted = fit_recording(done.capture.recording, n_vectors=vectors - FEWER)
            store.upload(board.device.link, fitted.model)
    return {
        "vectors": vectors,
        "vectors_wished": wished,
        "linearity": calibrate.plain(curves),
        "rate_limit_hz": limit,
        "truth_ratio": ratio,
        "used_targets": done.capture.selection.used_targets,
        "fit": calibrate.plain(fitted.report),
    }


def truth_ratio(board, process):
    """Mean error of the device's gaze over that of the full process on the same features, over the grid."""
    plan = targets.validation_plan(49, 1).target_deg
    frames, target, index = board.grid(plan, 0.15, 0.07, raw=True)
    rows = (index >= 0) & valid(frames)
    frames, target = frames[rows][::4], target[rows][::4]
    full = process.predict(frames["features"].astype(float))
    full = np.asarray(full[0] if isinstance(full, tuple) else full)
    theirs = metrics.frame_errors_deg(*full.T, *target.T).mean()
    ours = metrics.frame_errors_deg(*frames["gaze_deg"].T, *target.T).mean()
    return {"device_deg": float(ours), "process_deg": float(theirs), "ratio": float(ours / theirs)}
