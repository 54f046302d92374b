# SPDX-License-Identifier: Apache-2.0
"""Curves and the converter's zero, by least squares, from exposures that alternated before a resting light.

Charge goes by code (1 + c code / 1024), with a c of its own for every sensor. A pair's second starts from
what the sample capacitor brought from the first, which is linear: its own light is what is left of it. A
converter that would read less than 0 at 0 V has its zero z below 0: in the dark it reads |z| codes too few
lit, and 0 unlit. One converter reads all six sensors, so z is one number, told by unlit codes
(converter.py); where none of them comes up from 0, by what remains of the curves.

The converter's own non-linearity, half a code of any shape, is no curve. An offset beside each curve keeps
the long exposures, all others' reference, from weighing more than these: what remains is least over all
levels.
"""

from typing import NamedTuple

import numpy as np

from . import converter
from .converter import SHARE
from .errors import CalibrationError

CHANNELS = 6
STEP_OCTAVES = 0.015, 0.05  # between two long exposures 80 ms apart: always drift; always a blink, a saccade
STEP_TIMES = 8.0  # between these, this many times the usual
STEADY_SHARE = 0.5  # of the short exposures that must be usable
CURVE_STEPS = 127
CURVE_SD = 0.03  # of parts, as far as they are known: curves that the data do not tell stay small
ZERO_SD = 2.0  # codes, likewise
STATIC_OCTAVES = 0.0015  # of a level, by the converter's non-linearity
NOMINAL = 0.05  # the curve that the firmware takes off for every part, to first order
ALONE = (-1,) * CHANNELS


class Hold(NamedTuple):
    """Frames with one set of exposures; arrays [6] of each channel's mean.

    t_us mid time; octaves log2 photocurrent; lit, unlit codes; exposure_us; full: the long exposures; frames
    """

    t_us: float
    octaves: np.ndarray
    lit: np.ndarray
    unlit: np.ndarray
    exposure_us: np.ndarray
    full: bool
    frames: int = 16


class Fit(NamedTuple):
    """What alternating exposures tell.

    curve [6]; zero_codes, 0 or less
    shift_octaves [6]  of a quarter of the exposure against all of it, under curve and zero that were in force
    noise_octaves [6]  standard error of that;  used, given: short exposures
    left_octaves [6]   what `curve` and `zero_codes` would have left of the shift
    """

    curve: np.ndarray
    zero_codes: float
    shift_octaves: np.ndarray
    noise_octaves: np.ndarray
    used: int
    given: int
    left_octaves: np.ndarray


def fit(holds, curve, zero_codes, dark=(), before=ALONE, wanted=None):
    """Fit of Holds that were measured with `curve` [6] and zero_codes in force.

    A short exposure lies between two long ones; d = log2 of its photocurrent over theirs, interpolated to its
    time. True curves and zero would have left nothing of d but noise.
    dark     further Holds, of which only unlit codes count: of long exposures
    before   [6] channel sampled right before each, -1: none
    wanted   (curve, zero codes) to judge by left_octaves instead of those found
    Raises CalibrationError when too few of the exposures are usable.
    """
    pair = _Pair(holds, np.asarray(curve, float), zero_codes, dark, np.asarray(before))
    pair.try_zeros(pair.zeros[min(range(len(pair.zeros)), key=pair.cost)] + converter.FINER)
    zero = min(range(len(pair.zeros)), key=pair.cost)
    found = [pair.solve(i, zero)[0] for i in range(CHANNELS)]
    steps = np.clip(np.round(1024 * np.array(found)), -CURVE_STEPS, CURVE_STEPS) / 1024
    zero_codes = min(round(4 * pair.zeros[zero]) / 4, 0.0)  # as the device keeps it
    shift, noise = pair.quarter(pair.d)
    left, _ = pair.quarter(pair.with_others(zero, *(wanted or (steps, zero_codes))))
    return Fit(steps, zero_codes, shift, noise, len(pair.d), pair.given, left)


class _Side:
    """Short exposures, or the long ones around them: lit, unlit codes, exposure_us [n, 6]."""

    def __init__(self, lit, unlit, exposure_us, before):
        self.lit, self.unlit, self.exposure_us = lit, unlit, exposure_us
        self.x = (lit + unlit) / 1024
        self.before, self.first, self.second = before, np.maximum(before, 0), before >= 0

    def levels(self, zero, rate):
        """Unlit codes as they would be if codes went below 0."""
        made = converter.levels(zero, rate, self.exposure_us, self.before)
        return np.where(made < converter.PLAIN_CODES, np.minimum(made, self.unlit + 1.0), self.unlit)

    def charge(self, i, levels, curve):
        """(charge [n] of channel i's own light in codes, its slope by the curve) for unlit levels [n, 6]."""
        ours = self.lit[:, i] - levels[:, i]
        first = self.first[i]
        brought = SHARE * (self.lit[:, first] - levels[:, first]) if self.second[i] else 0.0
        charge = np.maximum(ours * (1 + (NOMINAL + curve) * self.x[:, i]) - brought, 1.0)
        return charge, ours * self.x[:, i]


class _Pair:
    """Short exposures [n, 6] against the long ones around them, and what curves and a zero make of them."""

    def __init__(self, holds, curve, zero, dark, before):
        threes = zip(holds, holds[1:], holds[2:])
        triples = [(a, b, c) for a, b, c in threes if a.full and c.full and not b.full]
        if not triples:
            raise CalibrationError("the device did not change its exposures", "restart it and try again")
        self.given = len(triples)
        triples = [triple for triple, good in zip(triples, _usable(triples)) if good]
        share = np.array([(b.t_us - a.t_us) / (c.t_us - a.t_us) for a, b, c in triples])[:, None]

        def of(name):
            """(short, long) [n, 6] of a field of Hold."""
            first, short, last = (np.array([getattr(t[i], name) for t in triples]) for i in range(3))
            return short, (1 - share) * first + share * last

        fields = {name: of(name) for name in ("octaves", "lit", "unlit", "exposure_us")}
        self.d = fields["octaves"][0] - fields["octaves"][1]
        self.sides = [
            _Side(*(fields[name][k] for name in ("lit", "unlit", "exposure_us")), before) for k in range(2)
        ]
        self.ratio = fields["exposure_us"][0] / fields["exposure_us"][1]
        self.rung = np.unique(np.round(np.median(self.ratio, axis=1), 2), return_inverse=True)[1]
        self.old, self.zero = curve, zero
        every = [*holds, *dark]
        self.seen = (
            np.array([hold.exposure_us for hold in every]),
            np.array([hold.unlit for hold in every]),
            [hold.frames for hold in every],
            before,
        )
        self.try_zeros(converter.ZEROS)
        self.reads = {}
        self.spread = np.ones(CHANNELS)
        start = int(self.unlit.cost.argmin())
        rest = [self.solve(i, start)[1] for i in range(CHANNELS)]
        self.spread = np.array([max(1.4826 * np.median(np.abs(r - np.median(r))), 1e-5) for r in rest])

    def try_zeros(self, zeros):
        """Zeros that indices mean from now on."""
        self.zeros, self.unlit = zeros, converter.unlit(*self.seen, zeros)

    def levels(self, zero):
        """[2] of unlit levels [n, 6], short and long, if the true zero is zeros[zero]."""
        return [side.levels(self.zeros[zero], self.unlit.rate[zero]) for side in self.sides]

    def taken(self, levels, zero_codes):
        """What the device takes levels for with zero_codes in force."""
        if zero_codes not in self.reads:
            self.reads[zero_codes] = converter.device_reads(zero_codes)
        near = np.interp(levels, converter.LEVELS, self.reads[zero_codes])
        return np.where(levels < converter.LEVELS[-1], near, levels)

    def made(self, i, zero, curve, zero_codes):
        """log2 of short over long light [n] of channel i, as the device makes it with these in force."""
        return self._octaves(i, [self.taken(level, zero_codes) for level in self.levels(zero)], curve)[0]

    def _octaves(self, i, levels, curve):
        """(log2 of short over long charge [n], its slope by the curve)."""
        short, long = (side.charge(i, level, curve) for side, level in zip(self.sides, levels))
        slope = (short[1] / short[0] - long[1] / long[0]) / np.log(2)
        return np.log2(short[0] / long[0]), slope

    def solve(self, i, zero):
        """(curve, what it leaves [n]) of one channel for zeros[zero]; outliers weigh less."""
        d = self.d[:, i] - self.made(i, zero, self.old[i], self.zero)
        levels, c, offset = self.levels(zero), self.old[i], 0.0
        whole = len(d) / (self.rung.max() + 1) / self.spread[i] ** 2  # the long exposures are a rung too
        for _ in range(6):
            octaves, slope = self._octaves(i, levels, c)
            rest = d + octaves
            weight = 1 / np.maximum(1.0, np.abs(rest - offset) / (2 * self.spread[i])) / self.spread[i] ** 2
            a = np.array([
                [(weight * slope) @ slope + CURVE_SD**-2, -(weight @ slope)],
                [-(weight @ slope), weight.sum() + whole],
            ])
            off = rest - offset
            b = [(weight * slope) @ off + c / CURVE_SD**2, whole * offset - weight @ off]
            push = np.linalg.solve(a, b)
            c, offset = float(np.clip(c - push[0], -0.25, 0.25)), float(offset - push[1])
        return c, d + self._octaves(i, levels, c)[0]

    def cost(self, zero):
        """Misfit of zeros[zero] and the best curves, in deviations squared."""
        total = self.unlit.cost[zero] + ((min(self.zeros[zero], 0.0) - self.zero) / ZERO_SD) ** 2
        if total > self.unlit.cost.min() + 100:
            return total
        for i in range(CHANNELS):
            curve, rest = self.solve(i, zero)
            total += (curve / CURVE_SD) ** 2
            for k in range(self.rung.max() + 1):
                rows = rest[self.rung == k]
                deviation2 = STATIC_OCTAVES**2 + 1.57 * self.spread[i] ** 2 / len(rows)
                total += np.median(rows) ** 2 / deviation2 / CHANNELS  # one converter: they err alike
        return float(total)

    def with_others(self, zero, curve, zero_codes):
        """d [n, 6] as another curve [6] and zero in force would have made it; zeros[zero] is the true one."""
        change = [
            self.made(i, zero, curve[i], zero_codes) - self.made(i, zero, self.old[i], self.zero)
            for i in range(CHANNELS)
        ]
        return self.d + np.array(change).T

    def quarter(self, d):
        """(median of d over the shortest exposures, standard error), [6] each."""
        rows = np.abs(self.ratio - self.ratio.min(axis=0)) < 0.08
        shift = np.array([np.median(d[use, i]) for i, use in enumerate(rows.T)])
        spread = [np.median(np.abs(d[use, i] - shift[i])) for i, use in enumerate(rows.T)]
        return shift, 1.2533 * 1.4826 * np.array(spread) / np.sqrt(rows.sum(axis=0))


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
