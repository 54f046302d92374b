# SPDX-License-Identifier: Apache-2.0
"""A look at one known point, or at a few, puts right what a shifted headset put wrong: no new calibration.

One point moves the offset alone. Three to nine points fit offset and gain (correction.py), and are refused
where leaving out each of them in turn says that they would not help.
"""

import contextlib
from typing import NamedTuple, Optional

import numpy as np

from . import correction
from .errors import CalibrationError
from .sensing import wait_stored

SETTLE_S = 0.6  # for the eye to get there
COLLECT_S = 0.7
LIMIT_S = 6.0  # in all, for eyes that blink
LEAST_FRAMES = 60
SPREAD_LIMIT_DEG = 2.0  # a gaze that wanders more was not resting on the point
OFFSET_LIMIT_DEG = 30.0
NO_GAIN = ((0.0, 0.0), (0.0, 0.0))


class RecentreReport(NamedTuple):
    """Degrees, (azimuth, elevation) each: offset in force before and after, gaze before (offset included).

    Of several points, gaze_deg, error_deg and frames are means and sums over the used ones.
    """

    before_deg: tuple
    after_deg: tuple
    gaze_deg: tuple
    error_deg: float  # of that gaze to the target, before
    frames: int
    before_gain: tuple = NO_GAIN  # 2 x 2 by rows, degrees per degree
    after_gain: tuple = NO_GAIN
    applied: str = "offset"  # or "affine", or "none": what was in force is better, and stays
    predicted_error_deg: Optional[float] = None  # by leave-one-out; None of one point
    offset_error_deg: Optional[float] = None  # the same for an offset alone
    points: tuple = ()  # of each: dict target_deg, gaze_deg (None: not used), error_deg, reason


def run(device, screen, target_deg=(0.0, 0.0), progress=None):
    """Show one target, take the median of the valid gaze on it, set the offset so that it lies on the target.

    device  open Device with a model; screen see screen.py. The new offset is kept by the device over power
            cycles, and a gain in force stays.
    Returns RecentreReport. Raises CalibrationError when there is no steady valid gaze; the old offset then
    stays.
    """
    before = _begin(device, screen)
    tell = None if progress is None else lambda part: progress("recentre", part, 1.0)
    with _gazes(device) as gazes:
        middle, frames = _rest(gazes, screen, target_deg, tell)
    error = np.asarray(target_deg, float) - middle
    offset = np.array(before.offset_deg) + error
    _check_offset(offset)
    after = keep(device, (float(offset[0]), float(offset[1])), before.gain).affine
    return RecentreReport(
        before.offset_deg,
        after.offset_deg,
        (float(middle[0]), float(middle[1])),
        float(np.hypot(*error)),
        frames,
        before.gain,
        after.gain,
    )


def run_points(device, screen, n_points, progress=None):
    """Show n_points targets (3 to 9), fit offset and gain to the gaze on them, set them if that helps.

    A point without a steady valid gaze is left out. Arguments, and what is kept, as for `run`.
    Returns RecentreReport. Raises CalibrationError when fewer than 3 points are left, or when the correction
    is none that a shifted headset could ask for; what was in force then stays.
    """
    before = _begin(device, screen)
    targets = correction.points(n_points, screen.reach_deg())
    rows, used = [], 0
    with _gazes(device) as gazes:
        for k, target in enumerate(targets):
            tell = None if progress is None else lambda part, k=k: progress("recentre", k + part, n_points)
            row = {"target_deg": tuple(target.tolist()), "gaze_deg": None, "error_deg": None, "reason": None}
            try:
                middle, n = _rest(gazes, screen, row["target_deg"], tell)
                row.update(gaze_deg=tuple(middle.tolist()), error_deg=float(np.hypot(*(target - middle))))
                used += n
            except CalibrationError as error:
                row["reason"] = error.message
            rows.append(row)
    good = [row for row in rows if row["gaze_deg"] is not None]
    if len(good) < correction.POINTS_LEAST:
        raise CalibrationError(
            f"only {len(good)} of {n_points} points had a steady valid gaze ({_reasons(rows)}); the "
            "correction stays as it was",
            "look at each dot with open eyes; if it goes on, put the headset on anew or calibrate again",
        )
    gaze = np.array([row["gaze_deg"] for row in good])
    found = correction.fit(
        correction.undo(gaze, before.offset_deg, before.gain),
        [row["target_deg"] for row in good],
        before.offset_deg,
        before.gain,
    )
    after = before
    if found.kind != "none":
        _check_offset(np.array(found.offset_deg))
        after = keep(device, found.offset_deg, found.gain).affine
    return RecentreReport(
        before.offset_deg,
        after.offset_deg,
        tuple(gaze.mean(axis=0).tolist()),
        found.before_deg,
        used,
        before.gain,
        after.gain,
        found.kind,
        found.predicted_deg,
        found.offset_error_deg,
        tuple(rows),
    )


def keep(device, offset_deg=None, gain=None):
    """Set the correction (offset_deg None: none) and wait until the device has stored it.

    offset_deg   azimuth and elevation;  gain  2 x 2, None: no gain
    The device writes its live state byte by byte beside its other work; a reset meanwhile would lose it.
    Returns the Recentre in force.
    """
    written = device.status().eeprom_writes
    after = device.recentre(offset_deg, gain, clear=offset_deg is None)
    wait_stored(device, written)
    return after


def _begin(device, screen):
    """Open the screen; returns the correction in force (wire.Affine)."""
    screen.open(device)
    before = device.recentre().affine
    if device.model_info().active > 2:
        raise CalibrationError(
            "the device has no model, so there is no gaze to recentre",
            "calibrate first: `sparsegaze calibrate PORT`",
        )
    return before


@contextlib.contextmanager
def _gazes(device):
    """The stream of frames. A device that has gone away is not asked to turn it off."""
    device.set_stream(gaze=True)
    try:
        yield device.frames()
    except CalibrationError:
        device.set_stream()
        raise
    device.set_stream()


def _rest(frames, screen, target_deg, tell=None):
    """Show a target. Returns (median of the valid gaze on it, float64 [2] degrees; number of frames)."""
    kept, begin, seen = [], None, 0
    for frame in frames:
        if begin is None:
            begin = frame.t_us
            screen.look(target_deg, frame.t_us)
        screen.tick(frame.t_us)
        age_s = (frame.t_us - begin) * 1e-6
        if tell:
            tell(min(age_s / (SETTLE_S + COLLECT_S), 1.0))
        if age_s < SETTLE_S:
            continue
        seen += 1
        if frame.gaze is not None and frame.gaze.valid:
            kept.append((frame.gaze.azimuth_deg, frame.gaze.elevation_deg))
        if age_s >= SETTLE_S + COLLECT_S and len(kept) >= LEAST_FRAMES and 2 * len(kept) >= seen:
            break
        if age_s >= LIMIT_S:
            break
    if len(kept) < LEAST_FRAMES:
        raise CalibrationError(
            f"only {len(kept)} of {seen} frames had a valid gaze; the offset stays as it was",
            "look at the dot with open eyes; if it goes on, put the headset on anew or calibrate again",
        )
    gaze = np.array(kept)
    middle = np.median(gaze, axis=0)
    spread = 1.4826 * np.median(np.hypot(*(gaze - middle).T))
    if spread > SPREAD_LIMIT_DEG:
        raise CalibrationError(
            f"the gaze wandered by {spread:.1f} deg; the offset stays as it was",
            "look at the dot until it is done",
        )
    return middle, len(kept)


def _check_offset(offset):
    if np.abs(offset).max() > OFFSET_LIMIT_DEG:
        raise CalibrationError(
            f"an offset of {np.abs(offset).max():.0f} deg is no headset shift; the old one stays",
            "calibrate again: `sparsegaze calibrate PORT`",
        )


def _reasons(rows):
    return "; ".join(sorted({row["reason"].split(";")[0] for row in rows if row["reason"]}))
