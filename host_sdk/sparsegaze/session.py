# SPDX-License-Identifier: Apache-2.0
"""One run of targets in front of a streaming device: who was shown what when, and what the device sent.

Everything is in device time: the plan is laid out on the device's clock, frames carry it, onsets are reported
in it. The run is driven by the frames themselves, so on an unpaced virtual Nano it is a pure function of the
seed.
"""

from dataclasses import dataclass, field
from typing import Optional

import numpy as np

from . import faults
from .errors import CalibrationError
from .replay import AFFINE, DEG_Q7

LEAD_S = 0.3  # between the decision to start and the first target
CALM_S = 0.5  # this long without a change of exposure counts as settled
CALM_LIMIT_S = 6.0
FRAME_TIMEOUT_S = 2.0


class FrameLog:
    """Frames as they arrive; arrays on request. Frames without a raw part only count in `torn`."""

    def __init__(self):
        self._rows = []
        self.torn = 0

    def __len__(self):
        return len(self._rows)

    def add(self, frame):
        """Append a device.Frame."""
        raw, gaze = frame.raw, frame.gaze
        if raw is None:
            self.torn += 1
            return
        self._rows.append(
            (
                frame.seq,
                frame.t_us,
                frame.host_time,
                *raw.feature,
                raw.flags,
                raw.span_us,
                raw.model_crc,
                *raw.recentre.offset_deg_q7,
                *raw.recentre.gain_q9,
                gaze is not None,
                *(
                    (
                        gaze.azimuth_deg_q7,
                        gaze.elevation_deg_q7,
                        gaze.flags,
                        gaze.sigma_log2_q4,
                        gaze.infer_us,
                    )
                    if gaze is not None
                    else (0, 0, 0, 0, 0)
                ),
            )
        )

    def arrays(self, begin=0):
        """Frames from index `begin` on, as a numpy record array (fields of FRAME)."""
        return np.array(self._rows[begin:], FRAME_FLAT).view(FRAME)


FRAME_FLAT = np.dtype(
    [("seq", "i8"), ("t_us", "i8"), ("host_s", "f8")]
    + [(f"s{i}", "u2") for i in range(6)]
    + [
        ("raw_flags", "u1"),
        ("span_us", "u2"),
        ("model_crc", "u4"),
        ("recentre_az_q7", "i2"),
        ("recentre_el_q7", "i2"),
    ]
    + [(f"recentre_gain{i}", "i1") for i in range(4)]
    + [
        ("has_gaze", "?"),
        ("azimuth_q7", "i2"),
        ("elevation_q7", "i2"),
        ("gaze_flags", "u1"),
        ("gaze_sigma", "u1"),
        ("infer_us", "u2"),
    ]
)
# The same bytes with the arrays as arrays.
FRAME = np.dtype(
    [
        ("seq", "i8"),
        ("t_us", "i8"),
        ("host_s", "f8"),
        ("features", "u2", (6,)),
        ("raw_flags", "u1"),
        ("span_us", "u2"),
        ("model_crc", "u4"),
        ("recentre", AFFINE),
        ("has_gaze", "?"),
        ("gaze_q7", "i2", (2,)),
        ("gaze_flags", "u1"),
        ("gaze_sigma", "u1"),
        ("infer_us", "u2"),
    ]
)
assert FRAME.itemsize == FRAME_FLAT.itemsize


@dataclass
class Run:
    """A finished (or cut) run.

    frames          record array [n] of FRAME: seq, t_us, host_s, features, raw_flags, span_us (mean sample
                    time to last sample), model_crc, recentre, has_gaze, gaze_q7 (azimuth, elevation in 1/128
                    deg), gaze_flags, gaze_sigma, infer_us
    onset_us        int64 [k], device time at which each target really appeared; k < n_targets when cut
    target_index    int64 [n], which target was up; -1 outside the plan
    lost, torn, bad frames missing by sequence number; with a part missing; with a bad CRC
    offset_us       device time minus the virtual Nano's time, or None
    """

    plan: object
    frames: np.ndarray
    onset_us: np.ndarray
    target_index: np.ndarray
    lost: int = 0
    torn: int = 0
    bad: int = 0
    offset_us: Optional[int] = None
    notes: list = field(default_factory=list)

    @property
    def target_deg(self):
        """Target of every frame, float64 [n, 2]; NaN outside the plan."""
        inside = self.target_index >= 0
        out = np.full((len(self.frames), 2), np.nan)
        out[inside] = self.plan.target_deg[self.target_index[inside]]
        return out

    @property
    def settled(self):
        """bool [n]: from settle_s after its target's onset to the next onset."""
        inside = self.target_index >= 0
        since = np.zeros(len(self.frames), np.int64)
        since[inside] = self.frames["t_us"][inside] - self.onset_us[self.target_index[inside]]
        return inside & (since >= int(round(self.plan.settle_s * 1e6)))

    @property
    def gaze_deg(self):
        """float64 [n, 2] as the device sent it, valid or not; NaN where no gaze came."""
        return np.where(self.frames["has_gaze"][:, None], self.frames["gaze_q7"] / DEG_Q7, np.nan)

    @property
    def seconds(self):
        """Device time between first and last frame of the plan."""
        t = self.frames["t_us"][self.target_index >= 0]
        return float(t[-1] - t[0]) * 1e-6 if len(t) > 1 else 0.0

    @property
    def rate_hz(self):
        """Frames received per second of device time, over the plan."""
        n = int(np.sum(self.target_index >= 0))
        return (n - 1) / self.seconds if n > 1 and self.seconds > 0 else 0.0


def index_targets(t_us, onset_us, dwell_s):
    """Which target is up at each time: int64 [n]; -1 before the first onset and one dwell after the last."""
    t_us, onset_us = np.asarray(t_us, np.int64), np.asarray(onset_us, np.int64)
    index = np.searchsorted(onset_us, t_us, side="right") - 1
    if len(onset_us):
        index[t_us >= onset_us[-1] + int(round(dwell_s * 1e6))] = -1
    return index


def run(device, screen, plan, gaze=False, progress=None, on_frame=None, on_target=None, cut=None):
    """Show every target of `plan` and keep every frame.

    device     open Device; screen: see screen.py (opened here, closed by its owner); gaze: stream the gaze
               too
    progress   called as progress(stage, done, total), stage "exposures" (s), then "targets"
    on_frame   called with every device.Frame, also those before the first target
    on_target  called with (index, Run so far of that target's frames) when a target's time is over
    cut        a list that receives the Run when the run is interrupted by any exception
    Returns Run. Raises PortError, NoDeviceError, CalibrationError; KeyboardInterrupt from the screen.
    """
    log, notes = FrameLog(), []
    screen.open(device)
    lost0, bad0 = 0, device.bad
    onset_start, done, began = None, 0, 0

    def so_far(begin=0):
        frames = log.arrays(begin)
        onsets = np.array(screen.onsets_us() if onset_start is not None else [], np.int64)
        index = index_targets(frames["t_us"], onsets, plan.dwell_s)
        return Run(
            plan,
            frames,
            onsets,
            index,
            device.lost - lost0,
            log.torn,
            device.bad - bad0,
            getattr(screen, "offset_us", None),
            notes,
        )

    device.set_stream(raw=True, gaze=gaze)
    try:
        stream = device.frames(timeout_s=FRAME_TIMEOUT_S)
        notes += _wait_for_calm(device, stream, screen, on_frame, progress)
        faults.refuse(device)
        lost0 = device.lost
        end_us = None
        for frame in stream:
            if onset_start is None:
                onset_start = frame.t_us + int(LEAD_S * 1e6)
                end_us = onset_start + int(round(plan.seconds * 1e6))
                screen.start(plan.target_deg, plan.onsets_us(onset_start), plan.dwell_s)
            screen.tick(frame.t_us)
            log.add(frame)
            if on_frame:
                on_frame(frame)
            passed = int((frame.t_us - onset_start) / (plan.dwell_s * 1e6)) if frame.t_us > onset_start else 0
            if passed > done:
                # A late onset on a real display shifts the end of its target by less than a refresh.
                if on_target:
                    on_target(done, so_far(began))
                done, began = min(passed, len(plan)), len(log)
                if progress:
                    progress("targets", done, len(plan))
            if frame.t_us >= end_us:
                break
        result = so_far()
    except BaseException:
        if cut is not None:
            cut.append(so_far())
        raise
    device.set_stream()
    return result


def _wait_for_calm(device, stream, screen, on_frame, progress):
    """Look at the centre until no exposure has changed for CALM_S. Returns notes."""
    from ._core import lib

    first = last_change = None
    trouble = 0
    for frame in stream:
        if first is None:
            first = last_change = frame.t_us
            screen.look((0.0, 0.0), frame.t_us)
            if progress:
                progress("exposures", 0, 1)
        screen.tick(frame.t_us)
        if on_frame:
            on_frame(frame)
        flags = frame.raw.flags if frame.raw is not None else 0
        if flags & lib.SG_FLAG_EXPOSURE:
            last_change = frame.t_us
        trouble = flags & (lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED)
        calm = frame.t_us - last_change >= CALM_S * 1e6
        late = frame.t_us - first >= CALM_LIMIT_S * 1e6
        if calm and not trouble:
            return []
        if late and not trouble:
            return ["the exposures were still changing when the targets began"]
        if late and calm:
            faults.refuse(device)
            too = "much" if trouble & lib.SG_FLAG_SATURATED else "little"
            raise CalibrationError(
                f"an LED collects too {too} light to be read",
                "check that the headset sits in front of an open eye, away from sunlight, and that "
                "every LED is wired; `sparsegaze status PORT` shows the exposures",
            )
        if late:
            return ["some readings were saturated or starved when the targets began"]
    return []
