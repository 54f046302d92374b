# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of linearity: the same light must give the same photocurrent, however long the exposure.

A node's capacitance changes with its voltage, so charge is not quite proportional to the converter's code:
charge = code (1 + c code / 1024), with a c of its own for every part; and a converter that would read less
than 0 at 0 V reads too few codes lit and cannot say so unlit. Unlit codes of long exposures tell that zero.
Exposures alternate quickly between long ones and fractions of these; a short one lies between two long ones,
whose readings are interpolated to its time, so that light which drifts (an eye, a pupil) cancels. What is
left comes from c, which is fitted by least squares.
"""

import contextlib
from typing import NamedTuple

import numpy as np

from . import curvefit, faults
from .curvefit import Hold
from .errors import CalibrationError, SparsegazeError
from .sensing import EXPOSURE_REST_S, wait_stored
from .wire import lib

OCTAVE = 4096.0  # feature steps
FRACTIONS = (0.25, 0.5, 0.35, 0.71)  # of the long exposures
HOLD_US = 40_000  # one exposure; four waves of 100 Hz flicker
SKIP_FRAMES = 3  # after a change: ambient light is interpolated from earlier cycles
FRAMES_LEAST = 4
ROUNDS, VERIFY_ROUNDS, CHECK_ROUNDS = 48, 16, 16  # through all fractions: 15 s, 5 s, 5 s
EARLY_HOLDS = 50  # the first 2 s: light that will not do is told then
DARK_FRACTIONS, DARK_ROUNDS = (1.0, 0.6, 0.35, 0.2), 8  # of the longest exposures, for unlit codes: 1.3 s
BEFORE = {  # channel sampled right before each, by enum sg_wiring; -1: ground
    lib.SG_WIRING_LEDS: (5, -1, -1, 2, 1, -1),
    lib.SG_WIRING_PHOTODIODES: (-1, -1, -1, 0, 1, 2),
}
CODE_LEAST = 120  # of our light, at the long exposure: below, a quarter of it says nothing
CALM_US, CALM_LIMIT_US = 500_000, 6_000_000
RATE_HZ = 500
CODE_WANTED = 600.0  # lit, at the long exposures: automatic ones hardly read more, blinks apart
LOOK_US = 150_000
REACHED = 0.8  # of CODE_WANTED lit: the exposures are as long as light lets them be
DROWNED = 0.5  # of a lit code comes from outside; light that falls below so much of itself comes and goes
AMBIENT_MOVE = 0.15  # of our own light: more, and the light was not steady
BETTER_SHARE = 0.9  # a second measurement must find at most this much of the shift, or only noise


class Linearity(NamedTuple):
    """What a self-calibration did: arrays [6].

    before, after   measured shifts, octaves; noise of each, octaves
    old, curve      the curves before and now; kept: the new ones are stored (False: they were no better)
    codes           of our light at the long exposures
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
    """Find the curves of an open device's channels, verify, store them, measure again. Returns Linearity.

    The light need not be known, only steady: an eye that looks straight ahead, or a sheet of paper. Curves
    are stored only once exposures that had no part in finding them agree; and taken back if the device's own
    features then do not. Exposures and settings are afterwards what they were. A cable that is pulled
    meanwhile leaves RATE_HZ; a program that is killed leaves exposures held, too.
    progress  called as progress(stage, done, total)
    Raises CalibrationError, with nothing changed, when a channel is at fault, the light too weak or unsteady.
    """
    faults.refuse(device)
    settings, exposure, stored = device.settings(), device.exposure(), device.curve()
    changed = False
    # Frames enough in HOLD_US, however slowly the device is set to sense; both streams must fit on the line.
    device.settings(rate_hz=RATE_HZ, repeats=1, rolling=False, power="normal")
    try:
        device.set_stream(raw=True, counts=True)
        before = BEFORE[settings.wiring]
        whole = ROUNDS + VERIFY_ROUNDS + CHECK_ROUNDS
        say = (lambda part: progress("linearity", part, whole)) if progress else (lambda part: None)
        long_us = _settle(device, progress)
        dark = measure_dark(device)

        def look(done, rounds, now, wanted=None):
            holds = measure(device, long_us, rounds, lambda part: say(done + part), check_light)
            check_light(holds)
            check_steady(holds)
            return holds, curvefit.fit(holds, now.curve, now.zero_codes, dark, before, wanted)

        holds, first = look(0, ROUNDS, stored)
        found = first.curve, first.zero_codes
        _, second = look(ROUNDS, VERIFY_ROUNDS, stored, found)
        noise, after = np.hypot(first.noise_octaves, second.noise_octaves), second.left_octaves
        kept = _better(first.shift_octaves, after, noise)
        if kept:
            changed = True
            now = device.curve(*found)
            _, second = look(ROUNDS + VERIFY_ROUNDS, CHECK_ROUNDS, now)
            noise, after = np.hypot(first.noise_octaves, second.noise_octaves), second.shift_octaves
            kept = _better(first.shift_octaves, after, noise)
            changed = not kept
    except BaseException:
        with contextlib.suppress(SparsegazeError):  # what went wrong first is what is told
            _give_back(device, settings, exposure, stored if changed else None)
        raise
    _give_back(device, settings, exposure, stored if changed else None)
    codes = np.mean([hold.lit - hold.unlit for hold in holds if hold.full], axis=0)
    old = np.array(stored.curve)
    curve, zero = found if kept else (old, stored.zero_codes)
    return Linearity(first.shift_octaves, after, noise, old, curve, kept, codes, stored.zero_codes, zero)


def _give_back(device, settings, exposure, curve):
    """Settings, exposures and, if not None, curves as they were; returns once they are stored."""
    written = device.status().eeprom_writes
    if curve is not None:
        device.curve(curve.curve, curve.zero_codes)
    if exposure.automatic:
        device.exposure(auto=True)
    else:
        device.exposure(us=exposure.exposure_us)
    device.set_stream()
    device.settings_back(settings)
    device.link.sleep(EXPOSURE_REST_S)
    wait_stored(device, written)


def _better(before, after, noise):
    """True when the shifts [6] after are smaller than before, or nothing but noise."""
    before, after, noise = (float(np.sqrt(np.mean(np.square(v)))) for v in (before, after, noise))
    return after <= max(BETTER_SHARE * before, 3 * noise)


def measure(device, long_us, rounds, say=lambda part: None, early=lambda holds: None):
    """Alternate between exposures of long_us [6] and fractions of them. Returns the Holds, in order.

    device streams raw and counts; say(rounds done) is called as it goes on, early(the first of the Holds)
    once after EARLY_HOLDS, if there are more.
    """
    plan = [share for _ in range(rounds) for fraction in FRACTIONS for share in (1.0, fraction)] + [1.0]
    long_us = np.asarray(long_us, float)
    return _alternate(device, long_us, plan, lambda left: say(rounds - left // (2 * len(FRACTIONS))), early)


def measure_dark(device):
    """Holds of the longest exposures and fractions of these, for their unlit codes; lit ones may be full."""
    longest_us = device.exposure(us=[device.hello.exposure_max_us] * 6).exposure_us
    return _alternate(device, np.array(longest_us, float), DARK_FRACTIONS * DARK_ROUNDS)


def _alternate(device, long_us, plan, say=lambda left: None, early=lambda holds: None):
    """Holds of long_us times every share of `plan`; say(shares left) and early() as in measure()."""
    plan, least_us = list(plan), device.hello.exposure_min_us
    rows, until, early_at = [], None, len(plan) - EARLY_HOLDS
    for frame in device.frames():
        if until is None or frame.t_us >= until:
            if not plan:
                break
            if len(plan) == early_at:
                early(_holds(rows, long_us))
            device.exposure(us=np.maximum(long_us * plan.pop(0), least_us))
            until = frame.t_us + HOLD_US
            say(len(plan))
        if frame.raw is not None and frame.counts is not None:
            rows.append(frame)
    return _holds(rows, long_us)


def check_light(holds):
    """Raise CalibrationError when our light was too weak, or drowned by the light around."""
    long = [hold for hold in holds if hold.full]
    if sum(hold.frames for hold in long) < 4 * FRAMES_LEAST:  # one Hold alone: none shorter is possible
        remedy = "check the cable; `sparsegaze status` names what is wrong"
        raise CalibrationError("too few frames came", remedy)
    lit, unlit = (np.median([getattr(hold, name) for hold in long], axis=0) for name in ("lit", "unlit"))
    ours = np.median([hold.lit - hold.unlit for hold in long], axis=0)
    weak = ours < CODE_LEAST
    drowned = weak & (lit > REACHED * CODE_WANTED) & (unlit > DROWNED * lit)
    if drowned.any():
        low, high = _around(long)
        if (low < DROWNED * high)[drowned].any():
            check_steady(holds)  # light that came after exposures were found drowns ours, too
        codes = [f"sensor {i} ({unlit[i]:.0f} of {lit[i]:.0f} codes)" for i in np.flatnonzero(drowned)]
        raise CalibrationError(
            f"too much light from outside: {', '.join(codes)}",
            "shade the headset, or go away from the sun, the window or the lamp, and try again",
        )
    if weak.any():
        where = ", ".join(f"sensor {i} ({ours[i]:.0f} of 1023 codes)" for i in np.flatnonzero(weak))
        raise CalibrationError(
            f"too little light to tell a curve: {where}",
            "put the headset on, or hold a sheet of white paper some centimetres before it",
        )


def _around(holds):
    """(lowest, highest) light around, codes a microsecond [6]; extremes apart."""
    return np.quantile([hold.unlit / hold.exposure_us for hold in holds], [0.02, 0.98], axis=0)


def check_steady(holds):
    """Raise CalibrationError when the light around was not steady."""
    long = [hold for hold in holds if hold.full]
    own = np.maximum(np.median([(hold.lit - hold.unlit) / hold.exposure_us for hold in long], axis=0), 0.1)
    low, high = _around(long)
    move = (high - low) / own
    if move.max() > AMBIENT_MOVE:
        raise CalibrationError(
            f"the light around was not steady: it moved by {100 * move.max():.0f} % of the LEDs' own",
            "switch off or cover what flickers or moves, stay in one place, and try again",
        )


def _settle(device, progress):
    """Exposures, us [6], at which sensors read about CODE_WANTED, as far as they go; held from now on."""
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
    # Set, not held: what is set goes to EEPROM only once it has rested, which it does not while this runs.
    long_us = np.array(device.exposure(us=device.exposure().exposure_us).exposure_us)
    for _ in range(2):  # automatic exposure is content with much less
        lit = _lit_codes(device)
        long_us = np.array(device.exposure(us=long_us * np.clip(CODE_WANTED / lit, 0.25, 4.0)).exposure_us)
    return long_us


def _lit_codes(device):
    """Mean lit code [6] of LOOK_US; at least 1."""
    codes, until = [], None
    for frame in device.frames():
        until = frame.t_us + LOOK_US if until is None else until
        if frame.counts is not None:
            codes.append(frame.counts.lit_code)
        if frame.t_us >= until and codes:
            break
    return np.maximum(np.median(codes[len(codes) // 4:], axis=0), 1.0)


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
                        len(kept),
                    )
                )
            run = []
        if frame is not None:
            run.append(frame)
    return found
