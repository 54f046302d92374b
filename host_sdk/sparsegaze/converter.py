# SPDX-License-Identifier: Apache-2.0
"""The converter's zero, from unlit codes at several exposures.

Unlit codes grow in proportion to the exposure (leakage, light around) from the code z of 0 V on. A
converter whose zero is below 0 reads 0 there, but its noise now and then lifts a code; the mean of such
codes is a known function of the level behind them. Where one sensor gets a few codes in its longest
exposure, z is where its line begins, whatever the lit codes do: curvature and the converter's non-linearity
have no part in it.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import erfc

ZEROS = np.arange(-8.0, 6.1, 0.25)  # codes, tried first; the device knows none above 0: unlit codes tell all
FINER = np.arange(-5, 6) * 0.05  # about the best of these
CODE_MOST = 40.0  # above, curvature and non-linearity bend the line by more than noise does
NOISE_CODES = 0.755  # of one conversion at 250 kHz, as in firmware/core/make_tables.py
SOME_CODES, BENT_SHARE = 0.05, 0.004  # of a mean, beside its noise: non-linearity, curvature
RATES = np.concatenate([[0.0], np.geomspace(1e-3, 16.0, 40)])  # codes a microsecond, tried first
REFINE = np.linspace(0.0, 1.0, 33)
SHARE = 0.318  # of the sample capacitor in a node: what a pair's second keeps of its first
PLAIN_CODES = 1.5  # a mean above is its level
DEVICE_PLAIN = 1.25  # a mean above which the device takes for its level
DEVICE_LEAST = -1.56  # what it takes a mean of 0 for, if its zero is below
HOLDS, HOLD_CYCLES, SKIP_CYCLES, FAST_CYCLES = 200, 40, 6, 16  # simulated: fast after a change
LEVELS = np.arange(-8.0, PLAIN_CODES + 0.6, 0.05)


class Unlit(NamedTuple):
    """What unlit codes tell: cost [zeros] in deviations squared, rate [zeros, 6] codes a microsecond."""

    cost: np.ndarray
    rate: np.ndarray


def rectified(level):
    """Mean of whole codes, none below 0, of levels under the converter's noise; any shape."""
    level = np.asarray(level, float)
    steps = np.arange(1, 14).reshape(-1, *[1] * level.ndim)
    low = 0.5 * erfc((steps - 0.5 - level) / NOISE_CODES / np.sqrt(2)).sum(axis=0)
    return np.where(level > 8.0, level, low)


_MEANS = rectified(LEVELS)


def levels(zero, rate, exposure_us, before):
    """Unlit codes [n, 6] if codes went below 0: rate [6] codes a microsecond and what a pair's first brings.

    before   [6] channel sampled right before each, -1: none
    """
    own = rate * exposure_us
    return zero + own + np.where(before >= 0, SHARE * own[:, np.maximum(before, 0)], 0.0)


def unlit(exposure_us, mean, frames, before, zeros=ZEROS):
    """Unlit of mean unlit codes [n, 6] in exposures [n, 6], each of frames [n] frames, for these zeros.

    A rate is inf where codes are too many to tell a zero.
    """
    cost, rate = np.zeros(len(zeros)), np.full((len(zeros), mean.shape[1]), np.inf)
    rows, frames = np.arange(len(zeros)), np.asarray(frames, float)
    for i in np.argsort(before):  # a pair's first before its second
        use, first = mean[:, i] < CODE_MOST, before[i]
        if not use.any() or (first >= 0 and np.isinf(rate[0, first])):
            continue
        t, m, n = exposure_us[use, i], mean[use, i], frames[use]
        with_t = t if first < 0 else np.stack([t, exposure_us[use, first]], axis=1)
        _, where = np.unique(np.round(16 * with_t), axis=0, return_inverse=True)
        n_at = np.bincount(where.ravel(), n)
        m_at, t_at = (np.bincount(where.ravel(), n * value) / n_at for value in (m, t))
        start = zeros[:, None]
        if first >= 0:
            first_at = np.bincount(where.ravel(), n * exposure_us[use, first]) / n_at
            start = start + SHARE * rate[:, first, None] * first_at
        deviation2 = NOISE_CODES**2 / n_at + SOME_CODES**2 + (BENT_SHARE * m_at) ** 2
        tried = np.tile(RATES, (len(zeros), 1))
        for finer in (REFINE, REFINE, None):
            level = start[:, None] + tried[:, :, None] * t_at
            made = np.where(level > PLAIN_CODES, level, np.interp(level, LEVELS, _MEANS))
            each = ((made - m_at) ** 2 / deviation2).sum(axis=2)
            best = each.argmin(axis=1)
            low, high = (tried[rows, np.clip(best + k, 0, tried.shape[1] - 1)][:, None] for k in (-1, 1))
            found, tried = tried[rows, best], None if finer is None else low + (high - low) * finer
        cost += each[rows, best]
        rate[:, i] = found
    return Unlit(cost, rate)


def device_reads(zero):
    """What the device takes unlit LEVELS for, mean over a hold: as sg_light does, not below `zero` codes.

    The level of a mean of clipped codes is not proportional to it, so it is simulated.
    """
    rng = np.random.default_rng(1)
    taken = np.maximum(np.interp(np.arange(41) / 32, _MEANS, LEVELS), DEVICE_LEAST)
    taken = np.maximum(taken, min(zero, 0.0))
    low = LEVELS < PLAIN_CODES + 0.5
    level = np.tile(LEVELS[low], (HOLDS, 1))
    mean, total = None, 0.0
    for k in range(HOLD_CYCLES):
        code = np.maximum(np.round(level + rng.normal(0, NOISE_CODES, level.shape)), 0).astype(int)
        if mean is None:
            mean = 32 * code
        elif k < FAST_CYCLES:
            mean += (32 * code - mean + 2) >> 2
        else:
            mean += (32 * code - mean + 7 * k % 16) >> 4
        if k >= SKIP_CYCLES:
            total = total + np.where(mean < 32 * DEVICE_PLAIN, taken[np.minimum(mean, 40)], mean / 32)
    found = LEVELS.copy()
    found[low] = total.mean(axis=0) / (HOLD_CYCLES - SKIP_CYCLES)
    return found
