# SPDX-License-Identifier: Apache-2.0
"""Target plans: where the person is asked to look, and for how long.

A plan is data only: Fick azimuth (+ right) and elevation (+ up) in degrees, and the time each target stays,
in seconds of *device* time. Nothing here knows a screen or a device. Plans are a pure function of their
arguments, so a run can be repeated from its seed.
"""

from dataclasses import dataclass

import numpy as np

CALIBRATION_RANGE_DEG = (
    22.0  # a little beyond the range that is judged, so that no judged gaze is extrapolated
)
VALIDATION_RANGE_DEG = 20.0
SETTLE_S = 0.5  # saccade latency 0.2 s + a 40 degree saccade 0.11 s + a corrective one, with margin
DWELL_S = 1.0
HELD_OUT_DEG = 1.0  # a validation target keeps at least this distance from every calibration target

_GOLDEN_2D = 1.32471795724474602596  # root of x^3 = x + 1: the R2 low-discrepancy sequence


@dataclass(frozen=True)
class Plan:
    """A sequence of fixation targets.

    target_deg   float64 [n, 2], azimuth and elevation in degrees, in the order shown
    dwell_s      how long each target stays, seconds
    settle_s     how much of that is discarded while the eye travels, seconds
    name         what the plan is for, one word
    """

    target_deg: np.ndarray
    dwell_s: float = DWELL_S
    settle_s: float = SETTLE_S
    name: str = "calibration"

    def __len__(self):
        return len(self.target_deg)

    @property
    def seconds(self):
        """Whole length of the plan, seconds."""
        return len(self) * self.dwell_s

    def onsets_us(self, start_us):
        """Scheduled onset of every target, int64 [n], when the plan begins at device time start_us."""
        return start_us + np.round(np.arange(len(self)) * self.dwell_s * 1e6).astype(np.int64)


def _reach(reach_deg, range_deg):
    """Half ranges (azimuth, elevation) that both the plan and the screen allow, degrees."""
    if reach_deg is None:
        return range_deg, range_deg
    return min(range_deg, float(reach_deg[0])), min(range_deg, float(reach_deg[1]))


def _check(n, least, dwell_s, settle_s):
    if n < least:
        raise ValueError(f"a plan needs at least {least} targets, not {n}")
    if not 0.0 <= settle_s < dwell_s:
        raise ValueError("the settling time must be shorter than the time a target stays")


def calibration_plan(
    n=120, seed=0, range_deg=CALIBRATION_RANGE_DEG, reach_deg=None, dwell_s=DWELL_S, settle_s=SETTLE_S
):
    """Targets to calibrate with: a jittered low-discrepancy cover, the edges, and the centre again and again.

    n           number of targets, at least 9
    range_deg   half width of the square they cover, degrees; reach_deg (azimuth, elevation) shrinks it to a
                screen
    Every half minute or so the plan returns to the centre, which shows how far the signals wandered (pupil,
    slip).
    """
    _check(n, 9, dwell_s, settle_s)
    rng = np.random.default_rng([0xCA11, seed, n])
    centres = max(1, n // 30)
    edges = max(4, n // 5)
    inner = n - centres - edges

    step = np.array([1.0 / _GOLDEN_2D, 1.0 / _GOLDEN_2D**2])
    unit = (rng.random(2) + step * np.arange(1, inner + 1)[:, None]) % 1.0
    jitter = rng.uniform(-0.25, 0.25, (inner, 2)) / np.sqrt(inner)
    cover = np.clip(2.0 * (unit + jitter) - 1.0, -0.97, 0.97)

    along = (
        (np.arange(edges) + rng.uniform(0.25, 0.75)) / edges * 8.0
    )  # position on the perimeter of [-1, 1]^2
    along[: min(4, edges)] = [0.0, 2.0, 4.0, 6.0][: min(4, edges)]  # the four corners always
    side, t = np.divmod(along, 2.0)
    t = t - 1.0
    rim = np.choose(
        side.astype(int)[:, None] % 4,
        [
            np.c_[t, -np.ones_like(t)],
            np.c_[np.ones_like(t), t],
            np.c_[-t, np.ones_like(t)],
            np.c_[-np.ones_like(t), -t],
        ],
    )

    around = rng.permutation(np.vstack([cover, rim])) * _reach(reach_deg, range_deg)
    at = np.round(np.linspace(0, len(around), centres + 1)[:centres]).astype(int)
    return Plan(np.insert(around, at, 0.0, axis=0), dwell_s, settle_s, "calibration")


def validation_plan(
    n=25,
    seed=0,
    range_deg=VALIDATION_RANGE_DEG,
    reach_deg=None,
    avoid_deg=None,
    dwell_s=DWELL_S,
    settle_s=SETTLE_S,
):
    """Held-out targets: spread evenly, none within HELD_OUT_DEG of a calibration target.

    n          number of targets, at least 1
    avoid_deg  float [m, 2], the calibration targets to keep away from; None: those of
               calibration_plan(seed=seed)
    """
    _check(n, 1, dwell_s, settle_s)
    half = np.array(_reach(reach_deg, range_deg))
    if avoid_deg is None:
        avoid_deg = calibration_plan(seed=seed, reach_deg=reach_deg).target_deg
    rng = np.random.default_rng([0x7E57, seed, n])
    # Random order over a grid of at least n cells, one target per cell, drawn until it is held out.
    columns = int(np.ceil(np.sqrt(n)))
    rows = int(np.ceil(n / columns))
    cells = rng.permutation(columns * rows)[:n]
    low = np.c_[cells % columns / columns, cells // columns / rows]
    size = np.array([1.0 / columns, 1.0 / rows])
    targets = np.empty((n, 2))
    for i in range(n):
        best, distance = None, -1.0
        for _ in range(200):
            point = (2.0 * (low[i] + size * rng.random(2)) - 1.0) * half
            nearest = (
                np.min(np.hypot(*(np.asarray(avoid_deg, float) - point).T)) if len(avoid_deg) else np.inf
            )
            if nearest > distance:
                best, distance = point, nearest
            if distance >= HELD_OUT_DEG:
                break
        targets[i] = best  # the farthest of 200 where a cell is too crowded to do better
    return Plan(targets, dwell_s, settle_s, "validation")
