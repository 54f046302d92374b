# SPDX-License-Identifier: Apache-2.0
"""One look at a known point puts right what a shifted headset put wrong: no new calibration."""

from typing import NamedTuple

import numpy as np

from .errors import CalibrationError

SETTLE_S = 0.6  # for the eye to get there
COLLECT_S = 0.7
LIMIT_S = 6.0  # in all, for eyes that blink
LEAST_FRAMES = 60
SPREAD_LIMIT_DEG = 2.0  # a gaze that wanders more was not resting on the point
OFFSET_LIMIT_DEG = 30.0
STORE_S, STORE_LIMIT_S = 0.25, 1.5  # one record in EEPROM takes about 0.2 s


class RecentreReport(NamedTuple):
    """Degrees, (azimuth, elevation) each: offset in force before and after, gaze before (offset included)."""

    before_deg: tuple
    after_deg: tuple
    gaze_deg: tuple
    error_deg: float  # of that gaze to the target, before
    frames: int


def run(device, screen, target_deg=(0.0, 0.0), progress=None):
    """Show one target, take the median of the valid gaze on it, set the offset so that it lies on the target.

    device  open Device with a model; screen see screen.py. The new offset is kept by the device over power
            cycles.
    Returns RecentreReport. Raises CalibrationError when there is no steady valid gaze; the old offset then
    stays.
    """
    screen.open(device)
    before = device.recentre()
    if device.model_info().active > 2:
        raise CalibrationError(
            "the device has no model, so there is no gaze to recentre",
            "calibrate first: `sparsegaze calibrate PORT`",
        )
    device.set_stream(gaze=True)
    kept, begin, seen = [], None, 0
    for frame in device.frames():
        if begin is None:
            begin = frame.t_us
            screen.look(target_deg, frame.t_us)
        screen.tick(frame.t_us)
        age_s = (frame.t_us - begin) * 1e-6
        if progress:
            progress("recentre", min(age_s, SETTLE_S + COLLECT_S), SETTLE_S + COLLECT_S)
        if age_s < SETTLE_S:
            continue
        seen += 1
        if frame.gaze is not None and frame.gaze.valid:
            kept.append((frame.gaze.azimuth_deg, frame.gaze.elevation_deg))
        if age_s >= SETTLE_S + COLLECT_S and len(kept) >= LEAST_FRAMES and 2 * len(kept) >= seen:
            break
        if age_s >= LIMIT_S:
            break
    device.set_stream()
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
    correction = np.asarray(target_deg, float) - middle
    offset = np.array([before.azimuth_deg, before.elevation_deg]) + correction
    if np.abs(offset).max() > OFFSET_LIMIT_DEG:
        raise CalibrationError(
            f"an offset of {np.abs(offset).max():.0f} deg is no headset shift; the old one stays",
            "calibrate again: `sparsegaze calibrate PORT`",
        )
    after = keep(device, (float(offset[0]), float(offset[1])))
    return RecentreReport(
        (before.azimuth_deg, before.elevation_deg),
        (after.azimuth_deg, after.elevation_deg),
        (float(middle[0]), float(middle[1])),
        float(np.hypot(*correction)),
        len(kept),
    )


def keep(device, offset_deg=None):
    """Set the offset (azimuth, elevation in degrees; None: none) and wait until the device has stored it.

    The device writes its live state byte by byte beside its other work; a reset meanwhile would lose it.
    Returns the Recentre in force.
    """
    written, link = device.status().eeprom_writes, device.link
    after = device.recentre(offset_deg, clear=offset_deg is None)
    deadline = link.now() + STORE_LIMIT_S
    while device.status().eeprom_writes == written and link.now() < deadline:
        link.sleep(0.02)
    link.sleep(STORE_S)  # the record counted may have been an earlier one, still under way
    return after
