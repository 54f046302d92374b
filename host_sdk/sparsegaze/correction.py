# SPDX-License-Identifier: Apache-2.0
"""Affine correction of a model's output, from a few points that were looked at: gaze = g + offset + G g.

With few noisy points a gain is mostly noise, so it is shrunken: ridge regression with a flat prior on the
offset and a normal one of mean 0 and standard deviation GAIN_SIGMA on each entry of G, points having errors
of POINT_SIGMA_DEG in each axis. With X = [1, g] the solution of each axis is (X'X + L)^-1 X' r, r = target -
g and L = diag(0, q, q), q = (POINT_SIGMA_DEG / GAIN_SIGMA)^2; the leave-one-out residual is r_i - x_i b over
1 - h_i, h the diagonal of X (X'X + L)^-1 X' (Rasmussen and Williams 2006, section 2.1.1 and equation 5.12).
"""

from typing import NamedTuple

import numpy as np

from .wire import GAIN_STEPS_MAX

# What a fixation is off in each axis, a person's own bias and the bend of the slip together, and what a slip
# of half a millimetre makes of the gain: rms on simulated persons, tools/bench/recentre_slip.py.
POINT_SIGMA_DEG = 0.8
GAIN_SIGMA = 0.1
POINTS_LEAST, POINTS_MOST = 3, 9
GAIN_STEP = 1 / 512
GAIN_LIMIT = GAIN_STEPS_MAX * GAIN_STEP
# A gain has to be better than the offset alone by so much, a correction better than none; and by more than
# the device's own rounding may explain.
WORTH, WORTH_DEG = 0.95, 0.05


class Correction(NamedTuple):
    """What to set, and what it is expected to be worth.

    offset_deg  (azimuth, elevation);  gain  2 x 2, multiples of 1/512
    kind        "affine", "offset" or "none": neither helps, and offset and gain are those in force
    before_deg  mean error of the gaze in force on the points
    offset_error_deg, affine_error_deg   mean leave-one-out errors of an offset alone and of offset with gain
    """

    offset_deg: tuple
    gain: tuple
    kind: str
    before_deg: float
    offset_error_deg: float
    affine_error_deg: float

    @property
    def predicted_deg(self):
        """Mean error to expect of what is to be set."""
        left_out = {"affine": self.affine_error_deg, "offset": self.offset_error_deg}
        return left_out.get(self.kind, self.before_deg)


def undo(gaze_deg, offset_deg, gain):
    """The model's output g of gazes [n, 2] that were corrected with this offset and gain (rounding aside)."""
    # |G| < 1/4: I + G is never singular.
    moved = np.asarray(gaze_deg, float) - np.asarray(offset_deg, float)
    return np.linalg.solve(np.eye(2) + np.asarray(gain, float), moved.T).T


def fit(model_deg, target_deg, offset_deg=(0.0, 0.0), gain=((0.0, 0.0), (0.0, 0.0))):
    """Correction from k points.

    model_deg    float [k, 2], the model's output at each, uncorrected; k is 3 to 9
    target_deg   float [k, 2], where the person was asked to look
    offset_deg, gain   in force now: what a correction has to beat
    Raises ValueError for fewer than 3 points or numbers that are not finite.
    """
    g, target = np.asarray(model_deg, float), np.asarray(target_deg, float)
    if g.ndim != 2 or g.shape[1:] != (2,) or g.shape != target.shape or len(g) < POINTS_LEAST:
        raise ValueError(f"a correction takes at least {POINTS_LEAST} points")
    if not (np.isfinite(g).all() and np.isfinite(target).all()):
        raise ValueError("a point is not finite")
    miss = target - g
    before = _mean(miss - np.asarray(offset_deg, float) - g @ np.asarray(gain, float).T)
    alone = _mean((miss - miss.mean(axis=0)) * len(g) / (len(g) - 1))
    shrunken, affine = _ridge(g, miss)
    steps = np.clip(np.round(shrunken / GAIN_STEP), -GAIN_STEPS_MAX, GAIN_STEPS_MAX)
    kind = "affine" if affine < WORTH * alone else "offset"
    if min(affine, alone) > min(WORTH * before, before - WORTH_DEG):
        return Correction(tuple(offset_deg), _rows(gain), "none", before, alone, affine)
    # The best offset for the gain as it is rounded.
    rounded = steps * GAIN_STEP if kind == "affine" else np.zeros((2, 2))
    offset = (miss - g @ rounded.T).mean(axis=0)
    return Correction(tuple(offset.tolist()), _rows(rounded), kind, before, alone, affine)


def points(n, reach_deg=None):
    """n targets (1, or 3 to 9) to look at, float64 [n, 2] degrees; the centre is first where it is one.

    reach_deg   (azimuth, elevation) of the screen, None: no limit
    """
    radius = np.full(2, RADIUS_DEG) if reach_deg is None else np.minimum(RADIUS_DEG, reach_deg)
    if n == 1:
        return np.zeros((1, 2))
    if not POINTS_LEAST <= n <= POINTS_MOST:
        raise ValueError(f"a correction takes 1 point, or {POINTS_LEAST} to {POINTS_MOST}, not {n}")
    centre = n >= 5
    around = n - centre
    angle = 2 * np.pi * (np.arange(around) + 0.5) / around + np.pi / 2
    ring = np.column_stack([np.cos(angle), np.sin(angle)]) * radius
    return np.vstack([np.zeros((int(centre), 2)), ring])


RADIUS_DEG = 15.0  # of the ring of points: far out a gain shows best, and lids and edges still leave it alone


def _ridge(g, miss):
    """(gain [2, 2], mean leave-one-out error) of the shrunken fit."""
    x = np.column_stack([np.ones(len(g)), g])
    normal = x.T @ x + np.diag([0.0, 1.0, 1.0]) * (POINT_SIGMA_DEG / GAIN_SIGMA) ** 2
    factor = np.linalg.cholesky(normal)
    whitened = np.linalg.solve(factor, x.T)  # [3, k]
    fitted = np.linalg.solve(factor.T, whitened @ miss)  # [3, axis]
    leverage = (whitened**2).sum(axis=0)
    return fitted[1:].T, _mean((miss - x @ fitted) / (1.0 - leverage)[:, None])


def _mean(miss):
    return float(np.hypot(*miss.T).mean())


def _rows(gain):
    return tuple(tuple(float(v) for v in row) for row in gain)
