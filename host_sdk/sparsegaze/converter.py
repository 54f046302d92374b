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

ZEROS = np.arange(-8.0, 6.1, 0.25)  # codes; the device knows none above 0, where unlit codes tell all
CODE_MOST = 40.0  # above, curvature and non-linearity bend the line by more than noise does
NOISE_CODES = 0.755  # of one conversion at 250 kHz, as in firmware/core/make_tables.py
SOME_CODES, BENT_SHARE = 0.05, 0.004  # of a mean, beside its noise: non-linearity, curvature
RATES = np.concatenate([[0.0], np.geomspace(1e-3, 16.0, 40)])  # codes a microsecond, tried first
REFINE = np.linspace(0.0, 1.0, 33)
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


def unlit(exposure_us, mean, frames):
    """Unlit of mean unlit codes [n, 6] in exposures [n, 6], each of frames [n] frames."""
    cost, rate = np.zeros(len(ZEROS)), np.zeros((len(ZEROS), mean.shape[1]))
    for i in range(mean.shape[1]):
        use = mean[:, i] < CODE_MOST
        if not use.any():
            rate[:, i] = np.inf
            continue
        t, m, n = exposure_us[use, i], mean[use, i], np.asarray(frames, float)[use]
        at, where = np.unique(np.round(16 * t), return_inverse=True)
        n_at = np.bincount(where, n)
        m_at = np.bincount(where, n * m) / n_at
        deviation2 = NOISE_CODES**2 / n_at + SOME_CODES**2 + (BENT_SHARE * m_at) ** 2
        tried, rows = np.tile(RATES, (len(ZEROS), 1)), np.arange(len(ZEROS))
        for finer in (REFINE, REFINE, None):
            level = ZEROS[:, None, None] + tried[:, :, None] * (at / 16)
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
