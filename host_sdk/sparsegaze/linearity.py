# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of linearity: the same light must give the same photocurrent, however long the exposure.

A node's capacitance changes with its voltage, so charge is not quite proportional to the converter's code:
charge = code (1 + c code / 1024), with a c of its own for every part; and a converter that would read less
than 0 at 0 V reads too few codes lit and cannot say so unlit. Exposures alternate quickly between the
automatic ones and fractions of these; a short one lies between two long ones, whose readings are interpolated
to its time, so that light which drifts (an eye, a pupil) cancels. What is left comes from c and from that
zero, which are fitted by least squares.
"""

from typing import NamedTuple

import numpy as np

from . import faults
from .errors import CalibrationError
from .wire import lib

CHANNELS = 6
OCTAVE = 4096.0  # feature steps
FRACTIONS = (0.25, 0.5, 0.35, 0.71)  # of the automatic exposures
SHORT = 0.25  # the fraction that the reported shift is about
HOLD_US = 40_000  # one exposure; four waves of 100 Hz flicker
SKIP_FRAMES = 3  # after a change: ambient light is interpolated from earlier cycles
FRAMES_LEAST = 4
ROUNDS, CHECK_ROUNDS = 36, 12  # through all fractions: 12 s, 4 s
CODE_LEAST = 160  # of our light, at the automatic exposure: below, a quarter of it says nothing
CALM_US, CALM_LIMIT_US = 500_000, 6_000_000
STEP_OCTAVES = 0.015, 0.05  # between two long exposures 80 ms apart: always drift; always a blink, a saccade
STEP_TIMES = 8.0  # between these, this many times the usual
STEADY_SHARE = 0.5  # of the short exposures that must be usable
AMBIENT_MOVE = 0.15  # of our own light: more, and the light was not steady
AGAIN_SHARE, AGAIN_CURVE = 0.3, 0.006  # a second measurement must find the curve again this well
CURVE_STEPS = 127
DARK_CODES = 2.0  # unlit: fewer, and the converter's zero may hide behind 0
NOMINAL = 0.05  # the curve that the firmware takes off for every part, to first order


class Hold(NamedTuple):
    """Frames with one set of exposures; arrays [6] of each channel's mean.

    t_us mid time; octaves log2 photocurrent; lit, unlit codes; exposure_us; full: the automatic exposures
    """

    t_us: float
    octaves: np.ndarray
    lit: np.ndarray
    unlit: np.ndarray
    exposure_us: np.ndarray
    full: bool


class Fit(NamedTuple):
    """curve [6]; offset_codes [6] that our light reads too much, whatever the exposure; shift_octaves [6]
    of a quarter of the exposure against all of it, with the curve that was in force, and its standard error
    noise_octaves [6]; used, given: short exposures."""

    curve: np.ndarray
    offset_codes: np.ndarray
    shift_octaves: np.ndarray
    noise_octaves: np.ndarray
    used: int
    given: int


class Linearity(NamedTuple):
    """What a self-calibration did: arrays [6].

    before, after   measured shifts, octaves; noise of each, octaves
    old, curve      the curves before and now; kept: the new ones are stored (False: they were no better)
    codes           of our light at the automatic exposures
    old_zero, zero  of the converter, codes, before and now; a number, 0 or less
    """

    before: np.ndarray
    after: np.ndarray
    noise: np.ndarray
    old: np.ndarray
    curve: np.ndarray
    kept: bool
    codes: np.ndarray
    old_zero: float
    zero: float

    def report(self):
        """Plain numbers."""
        return {
            "kept": self.kept,
            "curve": self.curve,
            "curve_before": self.old,
            "shift_octaves_before": self.before,
            "shift_octaves_after": self.after,
            "shift_percent_before": percent(self.before),
            "shift_percent_after": percent(self.after),
            "noise_octaves": self.noise,
            "codes": self.codes,
            "zero_codes_before": self.old_zero,
            "zero_codes": self.zero,
        }


def percent(octaves):
    """A ratio of light in octaves as percent more."""
    return 100.0 * (np.exp2(octaves) - 1.0)


def run(device, progress=None):
    """Measure the curves of an open device's channels, store them, measure again. Returns Linearity.

    The light need not be known, only steady: an eye that looks straight ahead, or a sheet of paper. Exposures
    and settings are afterwards what they were. progress  called as progress(stage, done, total)
    Raises CalibrationError, with nothing changed, when a channel is at fault, the light too weak or unsteady.
    """
    faults.refuse(device)
    settings, exposure = device.settings(), device.exposure()
    stored = device.curve()
    old, changed = np.array(stored.curve), False
    if settings.repeats != 1 or settings.rolling:
        device.settings(repeats=1, rolling=False)   # the counts are of a frame's last cycle
    try:
        device.set_stream(raw=True, counts=True)
        long_us = _settle(device, progress)
        whole = ROUNDS + CHECK_ROUNDS
        say = (lambda part: progress("linearity", part, whole)) if progress else (lambda part: None)
        holds = measure(device, long_us, ROUNDS, say)
        check_steady(holds)
        first = fit(holds, old)
        zero = _zero_of(first, holds, stored.zero_codes)
        device.curve(first.curve, zero)
        changed = True
        again = measure(device, long_us, CHECK_ROUNDS, lambda part: say(ROUNDS + part))
        check_steady(again)
        second = fit(again, np.array(device.curve().curve))
        noise = np.hypot(first.noise_octaves, second.noise_octaves)
        kept = _confirmed(first, second, old, noise)
        changed = not kept
        codes = np.mean([hold.lit - hold.unlit for hold in holds if hold.full], axis=0)
        shifts = first.shift_octaves, second.shift_octaves
        now = (first.curve, zero) if kept else (old, stored.zero_codes)
        return Linearity(*shifts, noise, old, now[0], kept, codes, stored.zero_codes, now[1])
    finally:
        if changed:
            device.curve(old, stored.zero_codes)
        if exposure.automatic:
            device.exposure(auto=True)
        else:
            device.exposure(us=exposure.exposure_us)
        if settings.repeats != 1 or settings.rolling:
            device.settings(repeats=settings.repeats, rolling=settings.rolling)
        device.set_stream()


def _zero_of(found, holds, old):
    """The converter's zero in quarters of a code, by sensors whose unlit codes stop at 0; else as it was."""
    unlit = np.mean([hold.unlit for hold in holds if hold.full], axis=0)
    dark = unlit < DARK_CODES
    if dark.sum() < 2:
        return old
    return float(np.clip(np.round(4 * (old + np.median(found.offset_codes[dark]))) / 4, -32.0, 0.0))


def _confirmed(first, second, old, noise):
    """True when a second measurement finds the curves again, and no larger a shift under them."""

    def rms(values):
        return float(np.sqrt(np.mean(np.square(values))))

    again = rms(second.curve - first.curve) <= max(AGAIN_SHARE * rms(first.curve - old), AGAIN_CURVE)
    return again and rms(second.shift_octaves) <= rms(first.shift_octaves) + 2 * rms(noise)


def measure(device, long_us, rounds, say=lambda part: None):
    """Alternate between exposures of long_us [6] and fractions of them. Returns the Holds, in order.

    device streams raw and counts; say(rounds done) is called as it goes on.
    """
    long_us = np.asarray(long_us, float)
    least_us = device.hello.exposure_min_us
    plan = [share for _ in range(rounds) for fraction in FRACTIONS for share in (1.0, fraction)] + [1.0]
    rows, until = [], None
    for frame in device.frames():
        if until is None or frame.t_us >= until:
            if not plan:
                break
            device.exposure(us=np.maximum(long_us * plan.pop(0), least_us))
            until = frame.t_us + HOLD_US
            say(rounds - len(plan) // (2 * len(FRACTIONS)))
        if frame.raw is not None and frame.counts is not None:
            rows.append(frame)
    return _holds(rows, long_us)


def fit(holds, curve):
    """Least-squares curve of every channel from Holds measured with `curve` [6] in force. Returns Fit.

    d = log2 of the short exposure's photocurrent over the long one's, which lies around it. The true curve c
    would have made nothing of it but noise: charge goes by 1 + c x, x = (lit + unlit) / 1024 codes. What the
    converter's zero takes away is a constant number of codes, which weighs most in short exposures.
    Raises CalibrationError when too few of the exposures are usable.
    """
    curve = np.asarray(curve, float)
    triples = [
        (a, b, c) for a, b, c in zip(holds, holds[1:], holds[2:]) if a.full and c.full and not b.full
    ]
    if not triples:
        raise CalibrationError("the device did not change its exposures", "restart it and try again")
    share = np.array([(b.t_us - a.t_us) / (c.t_us - a.t_us) for a, b, c in triples])[:, None]
    before, short, after = (np.array([getattr(t[i], "octaves") for t in triples]) for i in range(3))
    jump = np.abs(after - before)
    with np.errstate(all="ignore"):
        limit = np.clip(STEP_TIMES * np.nanmedian(jump, axis=0), *STEP_OCTAVES)
    use = (jump <= limit).all(axis=1)
    if use.mean() < STEADY_SHARE:
        raise CalibrationError(
            f"the light was not steady: only {int(use.sum())} of {len(use)} exposures could be compared",
            "look straight ahead and hold the headset still, or put white paper before it; then try again",
        )
    d = short - before + share * (before - after)
    x = np.array([[(hold.lit + hold.unlit) / 1024 for hold in triple] for triple in triples])
    x_long, x_short = (1 - share) * x[:, 0] + share * x[:, 2], x[:, 1]
    ratio = np.array([b.exposure_us / a.exposure_us for a, b, _ in triples])
    parts = np.array([[1 / np.maximum(hold.lit - hold.unlit, 1.0) for hold in triple] for triple in triples])
    part = parts[:, 1] - (1 - share) * parts[:, 0] - share * parts[:, 2]
    found, offset, shift, noise = (np.zeros(CHANNELS) for _ in range(4))
    for i in range(CHANNELS):
        rows = np.flatnonzero(use)
        of_channel = (values[rows, i] for values in (d, x_long, x_short, part))
        found[i], offset[i] = _curve_of(*of_channel, curve[i])
        quarter = rows[np.abs(ratio[rows, i] - ratio[rows, i].min()) < 0.08]
        values = d[quarter, i]
        shift[i] = np.median(values)
        noise[i] = 1.2533 * 1.4826 * np.median(np.abs(values - shift[i])) / np.sqrt(len(values))
    steps = np.clip(np.round(1024 * found), -CURVE_STEPS, CURVE_STEPS)
    return Fit(steps / 1024, offset, shift, noise, int(use.sum()), len(use))


def check_steady(holds):
    """Raise CalibrationError when our light was too weak, or the light around was not steady."""
    long = [hold for hold in holds if hold.full]
    if len(long) < 4:
        raise CalibrationError("too few frames came", "check the cable and `sparsegaze status PORT`")
    ours = np.median([hold.lit - hold.unlit for hold in long], axis=0)
    weak = np.flatnonzero(ours < CODE_LEAST)
    if len(weak):
        where = ", ".join(f"sensor {i} ({ours[i]:.0f} of 1023 codes)" for i in weak)
        raise CalibrationError(
            f"too little light to tell a curve: {where}",
            "put the headset on, or hold a sheet of white paper some centimetres before it",
        )
    rate = np.array([hold.unlit / hold.exposure_us for hold in long])
    own = np.median([(hold.lit - hold.unlit) / hold.exposure_us for hold in long], axis=0)
    low, high = np.quantile(rate, [0.02, 0.98], axis=0)
    move = (high - low) / own
    if move.max() > AMBIENT_MOVE:
        raise CalibrationError(
            f"the light around was not steady: it moved by {100 * move.max():.0f} % of the LEDs' own",
            "switch off or cover what flickers or moves, stay in one place, and try again",
        )


def _curve_of(d, x_long, x_short, part, old):
    """(curve, offset in codes) that leave least of d [n], by Gauss-Newton, outliers weighing less."""
    told = np.log2(1 + (NOMINAL + old) * x_short) - np.log2(1 + (NOMINAL + old) * x_long)
    c, offset = NOMINAL + old, 0.0
    for _ in range(8):
        rest = d - told + np.log2(1 + c * x_short) - np.log2(1 + c * x_long) - offset * part / np.log(2)
        slope = (x_short / (1 + c * x_short) - x_long / (1 + c * x_long)) / np.log(2)
        spread = max(1.4826 * float(np.median(np.abs(rest - np.median(rest)))), 1e-5)
        weight = np.sqrt(1 / np.maximum(1.0, np.abs(rest) / (2 * spread)))
        design = np.column_stack([slope, -part / np.log(2)]) * weight[:, None]
        step = np.linalg.lstsq(design, -rest * weight, rcond=1e-6)[0]
        c, offset = float(np.clip(c + step[0], NOMINAL - 0.25, NOMINAL + 0.25)), float(offset + step[1])
    return c - NOMINAL, offset


def _settle(device, progress):
    """Automatic exposures, us [6], once they rest."""
    device.exposure(auto=True)
    if progress:
        progress("exposures", 0, 1)
    first = change = None
    for frame in device.frames():
        first = frame.t_us if first is None else first
        moved = frame.raw is None or frame.raw.flags & lib.SG_FLAG_EXPOSURE
        change = frame.t_us if moved or change is None else change
        if frame.t_us - change >= CALM_US or frame.t_us - first >= CALM_LIMIT_US:
            break
    return np.array(device.exposure(auto=False).exposure_us)


def _holds(rows, long_us):
    """Holds of consecutive frames: one for every run of equal exposures that is long enough."""
    found, run = [], []
    for frame in [*rows, None]:
        if run and (frame is None or frame.counts.exposure_us_q4 != run[-1].counts.exposure_us_q4):
            kept = run[SKIP_FRAMES:]
            if len(kept) >= FRAMES_LEAST:
                exposure = np.array(kept[0].counts.exposure_us)
                features = np.array([frame.raw.feature for frame in kept])
                found.append(
                    Hold(
                        float(np.mean([frame.t_us for frame in kept])),
                        np.where((features > 0).all(axis=0), features.mean(axis=0), np.nan) / OCTAVE,
                        np.mean([frame.counts.lit_code for frame in kept], axis=0),
                        np.mean([frame.counts.unlit_code for frame in kept], axis=0),
                        exposure,
                        bool(np.median(exposure / long_us) > 0.85),
                    )
                )
            run = []
        if frame is not None:
            run.append(frame)
    return found
