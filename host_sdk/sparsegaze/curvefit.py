# SPDX-License-Identifier: Apache-2.0
"""Curves and the converter's zero, by least squares, from exposures that alternated before a resting light.

Charge goes by code (1 + c code / 1024), with a c of its own for every sensor. A converter that would read less
than 0 at 0 V has its zero z below 0: in the dark it reads |z| codes too few lit, and 0 unlit, which tells
nothing. One converter reads all six sensors, so z is one number; what it costs a sensor also depends on how
much comes unlit.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from .errors import CalibrationError

CHANNELS = 6
STEP_OCTAVES = 0.015, 0.05  # between two long exposures 80 ms apart: always drift; always a blink, a saccade
STEP_TIMES = 8.0  # between these, this many times the usual
STEADY_SHARE = 0.5  # of the short exposures that must be usable
CURVE_STEPS = 127
CURVE_SD = 0.03  # of parts, as far as they are known: curves that the data do not tell stay small
ZERO_SD = 2.0  # codes, likewise
ZEROS = -np.arange(0.0, 8.1, 0.25)
NOMINAL = 0.05  # the curve that the firmware takes off for every part, to first order
NOISE_CODES, HIDDEN = 0.65, -1.0  # of one conversion; a level below that hardly shows in codes that stop at 0


class Hold(NamedTuple):
    """Frames with one set of exposures; arrays [6] of each channel's mean.

    t_us mid time; octaves log2 photocurrent; lit, unlit codes; exposure_us; full: the long exposures
    """

    t_us: float
    octaves: np.ndarray
    lit: np.ndarray
    unlit: np.ndarray
    exposure_us: np.ndarray
    full: bool


class Fit(NamedTuple):
    """What alternating exposures tell.

    curve [6]; zero_codes, 0 or less
    shift_octaves [6]  of a quarter of the exposure against all of it, under curve and zero that were in force
    noise_octaves [6]  standard error of that;  used, given: short exposures
    """

    curve: np.ndarray
    zero_codes: float
    shift_octaves: np.ndarray
    noise_octaves: np.ndarray
    used: int
    given: int


def fit(holds, curve, zero_codes):
    """Fit of Holds that were measured with `curve` [6] and zero_codes in force.

    A short exposure lies between two long ones; d = log2 of its photocurrent over theirs, interpolated to its
    time. True curves and zero would have left nothing of d but noise.
    Raises CalibrationError when too few of the exposures are usable.
    """
    triples = [(a, b, c) for a, b, c in zip(holds, holds[1:], holds[2:]) if a.full and c.full and not b.full]
    if not triples:
        raise CalibrationError("the device did not change its exposures", "restart it and try again")
    use = _usable(triples)
    triples = [triple for triple, good in zip(triples, use) if good]
    share = np.array([(b.t_us - a.t_us) / (c.t_us - a.t_us) for a, b, c in triples])[:, None]

    def of(name):
        """(short, long) [n, 6] of a field of Hold."""
        first, short, last = (np.array([getattr(t[i], name) for t in triples]) for i in range(3))
        return short, (1 - share) * first + share * last

    octaves, lit, unlit, exposure = (of(name) for name in ("octaves", "lit", "unlit", "exposure_us"))
    d = octaves[0] - octaves[1]
    pair = _Pair(d, lit, unlit, exposure, np.asarray(curve, float), zero_codes)
    best = min(ZEROS, key=pair.cost)
    found = np.array([pair.solve(i, best)[0] for i in range(CHANNELS)])
    steps = np.clip(np.round(1024 * found), -CURVE_STEPS, CURVE_STEPS)
    quarter = np.abs(pair.ratio - pair.ratio.min(axis=0)) < 0.08
    shift = np.array([np.median(d[rows, i]) for i, rows in enumerate(quarter.T)])
    spread = [np.median(np.abs(d[rows, i] - shift[i])) for i, rows in enumerate(quarter.T)]
    noise = 1.2533 * 1.4826 * np.array(spread) / np.sqrt(quarter.sum(axis=0))
    return Fit(steps / 1024, float(best), shift, noise, len(triples), len(use))


class _Pair:
    """Short exposures [n, 6] against the long ones around them, and what curves and a zero make of them."""

    def __init__(self, d, lit, unlit, exposure, curve, zero):
        self.d, self.old, self.zero = d, curve, zero
        self.x = [(a + b) / 1024 for a, b in zip(lit, unlit)]
        self.ours = [np.maximum(a - b, 1.0) for a, b in zip(lit, unlit)]
        self.ratio = exposure[0] / exposure[1]
        self.long_level = _level(unlit[1].mean(axis=0))
        self.level = np.empty_like(d)
        for i, fraction in enumerate(np.round(self.ratio.T, 1)):
            for value in np.unique(fraction):
                rows = fraction == value
                self.level[rows, i] = _level(unlit[0][rows, i].mean())
        self.spread = np.ones(CHANNELS)
        rest = [self.solve(i, zero)[1] for i in range(CHANNELS)]
        self.spread = np.array([max(1.4826 * np.median(np.abs(r - np.median(r))), 1e-5) for r in rest])

    def missing(self, i, zero):
        """log2 of what the device makes too little of short over long light, if the true zero is this."""
        long = max(self.long_level[i], zero)
        # Where the unlit code shows its level, that; else what comes unlit grows with the exposure.
        hidden = np.clip(zero + self.ratio[:, i] * (long - zero), zero, HIDDEN)
        short = np.where(self.level[:, i] > HIDDEN, np.maximum(self.level[:, i], zero), hidden)
        made = [
            np.log2(1 + np.maximum(self.zero - level, 0.0) / ours[:, i])
            for level, ours in zip((short, long), self.ours)
        ]
        return made[0] - made[1]

    def solve(self, i, zero):
        """(curve, what it leaves [n]) of one channel for a zero; outliers weigh less."""
        bend = [np.log2(1 + (NOMINAL + self.old[i]) * x[:, i]) for x in self.x]
        d = self.d[:, i] + self.missing(i, zero) - bend[0] + bend[1]
        c = NOMINAL + self.old[i]
        for _ in range(6):
            short, long = (x[:, i] for x in self.x)
            rest = d + np.log2(1 + c * short) - np.log2(1 + c * long)
            slope = (short / (1 + c * short) - long / (1 + c * long)) / np.log(2)
            weight = 1 / np.maximum(1.0, np.abs(rest) / (2 * self.spread[i])) / self.spread[i] ** 2
            push = (weight * slope) @ rest + (c - NOMINAL) / CURVE_SD**2
            c = float(np.clip(c - push / ((weight * slope) @ slope + CURVE_SD**-2), -0.2, 0.3))
        return c - NOMINAL, rest

    def cost(self, zero):
        """Misfit of the best curves for a zero, in deviations squared, outliers counted linearly."""
        total = ((zero - self.zero) / ZERO_SD) ** 2
        for i in range(CHANNELS):
            curve, rest = self.solve(i, zero)
            r = np.abs(rest) / self.spread[i]
            total += float(np.sum(np.where(r < 2, r**2, 4 * r - 4))) + (curve / CURVE_SD) ** 2
        return total


def _usable(triples):
    """Which short exposures lie between two long ones that agree: bool [n]."""
    octaves = np.array([[hold.octaves for hold in triple] for triple in triples])
    jump = np.abs(octaves[:, 2] - octaves[:, 0])
    with np.errstate(all="ignore"):
        limit = np.clip(STEP_TIMES * np.nanmedian(jump, axis=0), *STEP_OCTAVES)
    use = (jump <= limit).all(axis=1) & np.isfinite(octaves).all(axis=(1, 2))
    if use.mean() < STEADY_SHARE:
        raise CalibrationError(
            f"the light was not steady: only {int(use.sum())} of {len(use)} exposures could be compared",
            "look straight ahead and hold the headset still, or put white paper before it; then try again",
        )
    return use


def _level(mean):
    """What codes that stop at 0 are the mean of, below 0 as far as noise shows it; below HIDDEN: -100."""
    level = np.arange(-3.0, 12.0, 0.02)
    x = level / NOISE_CODES
    clipped = level * ndtr(x) + NOISE_CODES * np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    found = np.where(mean > 10, mean, np.interp(mean, clipped, level))
    return np.where(found < HIDDEN, -100.0, found)
