# SPDX-License-Identifier: Apache-2.0
"""Curves and the converter's zero on hard boards: light_reference's charges, the core's features.

Nothing of the reference is a polynomial: the junction's closed form, a bandgap off by a tenth, a converter
whose zero is at -2 or +2 codes and that is bent by half a code, leakage as parts come, noise. What is
judged is the purpose: after the fit, how far an exposure change alone moves the device's features.
"""

import numpy as np
import pytest
from light_reference import NOISE_LSB, PAIRS, REFERENCE_V, Board, Light

from sparsegaze import converter, curvefit, linearity
from sparsegaze._core import lib

NA = np.array([420.0, 300.0, 380.0, 500.0, 260.0, 340.0])
LEAKY = (0.9, 0.1, 0.1, 0.3, 1.2, 2.5)  # nA
TIGHT = (0.02,) * 6  # no unlit code comes up from 0
BEFORE = linearity.BEFORE[lib.SG_WIRING_LEDS]
HOLD, SKIP = 40, 6  # cycles
INL = {  # phases of three sines
    "cup": (0.35, 5.8, 2.7),
    "wave": (2.9, 0.6, 4.4),
    "bow": (1.6, 3.6, 0.9),
}
CASES = {  # offset, share of the reference, bend, leakage, least zero found, most, steps rms that may be left
    "zero below, wave": (-2.0, 0.97, "wave", LEAKY, -2.25, -1.75, 8.0),
    "zero below, cup, bandgap +10 %": (-2.0, 1.1, "cup", LEAKY, -2.25, -1.75, 8.5),
    "zero above, bow, bandgap -10 %": (2.0, 0.9, "bow", LEAKY, 0.0, 0.0, 5.5),
    "zero above, cup": (2.0, 1.07, "cup", LEAKY, 0.0, 0.0, 4.5),
    "zero below that nothing shows": (-2.0, 1.0, "bow", TIGHT, -4.0, -1.0, 4.0),
}


def bent(phases, x):
    """Half a code at most, 0 at both ends of the range 0..1."""
    def shape(at):
        at = np.asarray(at, float)
        return sum(
            np.sin(np.pi * k * at + p) - np.sin(p) - at * (np.sin(np.pi * k + p) - np.sin(p))
            for k, p in enumerate(phases, 1)
        )
    return 0.5 * shape(x) / np.abs(shape(np.linspace(0, 1, 257))).max()


class HardBoard(Board):
    """A Board whose converter has a bandgap of its own and is not linear."""

    def __init__(self, offset, bandgap, inl, leakage_na, seed):
        super().__init__(NA, np.array(leakage_na), noise_lsb=NOISE_LSB, offset_lsb=offset, seed=seed)
        self.bandgap, self.phases = bandgap, INL[inl]

    def _seen(self, volts_code):
        code = np.asarray(volts_code) / self.bandgap
        return super()._seen(code + bent(self.phases, np.clip(code / 1024, 0, 1)))


def hold(board, light, cycles, full, n=HOLD):
    """Hold of n cycles in exposures of [6] timer cycles."""
    board.exposure = np.array(cycles, int)
    rows = []
    for _ in range(n):
        reading = board.cycle()
        rows.append((light.frame(reading)[0], list(reading.lit_code), list(reading.unlit_code)))
    feature, lit, unlit = (np.array([row[k] for row in rows[SKIP:]], float) for k in range(3))
    t_us = board.start * 1e6 - n * 500
    means = feature.mean(axis=0) / 4096, lit.mean(axis=0), unlit.mean(axis=0)
    return curvefit.Hold(t_us, *means, board.exposure / 16, full, n - SKIP)


def exposure_of(board, light, code):
    """Timer cycles [6] in which sensors read about `code`, lit, a few steps of proportion."""
    cycles = np.full(6, 500)
    for _ in range(5):
        seen = hold(board, light, cycles, True, 12).lit
        cycles = np.clip(cycles * code / np.maximum(seen, 1), 100, 2500).astype(int)
    return cycles


def calibrated(board, rounds=16):
    """(Fit, Light with what it found) of a board, as linearity.measure alternates."""
    light = Light(board)
    dark = [
        hold(board, light, np.array([2544, 1656, 1656, 2544, 2544, 1656]) * share, False)
        for share in linearity.DARK_FRACTIONS * 8
    ]
    long = exposure_of(board, light, linearity.CODE_WANTED)
    shares = [s for _ in range(rounds) for f in linearity.FRACTIONS for s in (1.0, f)] + [1.0]
    holds = [hold(board, light, long * share, share == 1.0) for share in shares]
    fit = curvefit.fit(holds, np.zeros(6), 0.0, dark, BEFORE)
    steps = [int(round(1024 * c)) for c in fit.curve]
    return fit, Light(board, curve=steps, zero_q2=int(round(4 * fit.zero_codes))), long


def shifts(board, light, codes, shares=(0.7, 0.4), n=400):
    """[shares, 6] feature steps by which shorter exposures than those of lit `codes` move the features."""
    long = exposure_of(board, light, codes)
    mean = [hold(board, light, long * share, False, n).octaves * 4096 for share in (1.0, *shares)]
    return np.array(mean[1:]) - mean[0]


@pytest.mark.parametrize("name", CASES)
def test_an_exposure_change_alone_hardly_moves_a_hard_board_s_features(name):
    """Codes 180 to 560, which automatic exposure uses; noise of a feature: 15 to 60 steps. What is left is
    half a code of non-linearity and, with the zero below, what clipped unlit codes hide from the core."""
    offset, bandgap, inl, leakage, least, most, left = CASES[name]
    board = HardBoard(offset, bandgap, inl, leakage, seed=7)
    fit, light, _ = calibrated(board)
    before = np.concatenate([shifts(board, Light(board), code) for code in (450, 560)])
    after = np.concatenate([shifts(board, light, code) for code in (450, 560)])
    size = [np.sqrt(np.mean(v**2)) for v in (before, after)]
    print(f"zero {fit.zero_codes}, curves {np.round(1024 * fit.curve)}, rms {size[0]:.1f} -> {size[1]:.1f},"
          f" worst {np.abs(before).max():.1f} -> {np.abs(after).max():.1f}")
    assert least <= fit.zero_codes <= most
    assert size[1] <= left and np.abs(after).max() <= 18.0 and size[1] < 0.8 * size[0]


def test_seconds_get_the_curve_of_their_firsts_when_parts_are_alike():
    """The junction is the same for all: so must be the curves, though a second's own light is only a part."""
    board = HardBoard(0.0, 1.1, "cup", LEAKY, seed=3)
    board._seen = lambda code: Board._seen(board, np.asarray(code) / board.bandgap)  # a straight converter
    fit, _, _ = calibrated(board)
    first, second = np.array(PAIRS[lib.SG_WIRING_LEDS]).T
    print(np.round(1024 * fit.curve, 1))
    assert np.abs(fit.curve[second] - fit.curve[first]).max() <= 0.0025
    # Full scale is a tenth more volts: the nominal curvature, 0.05, a tenth more.
    assert fit.curve == pytest.approx(np.full(6, 0.005), abs=0.002)


def test_what_another_curve_would_leave_is_what_it_leaves():
    board = HardBoard(-2.0, 1.05, "bow", LEAKY, seed=5)
    fit, _, long = calibrated(board)
    wrong = np.array([0.02, -0.02, 0.01, 0.0, -0.01, 0.03])
    shares = [s for _ in range(12) for f in linearity.FRACTIONS for s in (1.0, f)] + [1.0]
    light = Light(board)
    dark = [hold(board, light, np.full(6, 1650) * share, False) for share in linearity.DARK_FRACTIONS * 8]
    holds = [hold(board, light, long * share, share == 1.0) for share in shares]
    told = curvefit.fit(holds, np.zeros(6), 0.0, dark, BEFORE, (wrong, -1.0)).left_octaves
    light = Light(board, curve=[int(round(1024 * c)) for c in wrong], zero_q2=-4)
    holds = [hold(board, light, long * share, share == 1.0) for share in shares]
    seen = curvefit.fit(holds, wrong, -1.0, dark, BEFORE)
    print(np.round(told, 4), np.round(seen.shift_octaves, 4), np.round(seen.noise_octaves, 4))
    assert np.abs(told - seen.shift_octaves).max() < 0.004 < 0.01 < np.abs(told - fit.shift_octaves).max()


@pytest.mark.parametrize("zero", [-3.0, -2.0, -1.0, 0.0, 1.5])
def test_a_zero_is_found_from_unlit_codes_alone(zero):
    rng = np.random.default_rng(2)
    apart = [[90, 40, 50, 70, 30, 80], [40, 90, 50, 30, 80, 70]]  # a second's follow its own and its first's
    t = np.concatenate([np.full((2, 6), [[159.0], [56.0]]), apart])
    rate = 0.02 * np.array(LEAKY)
    level = zero + rate * t
    for first, second in PAIRS[lib.SG_WIRING_LEDS]:
        level[:, second] += 14 / 44 * rate[first] * t[:, first]
    codes = np.maximum(np.floor(level + rng.normal(0, NOISE_LSB, (160, 4, 6)) + 0.5), 0)
    told = converter.unlit(t, codes.mean(axis=0), np.full(4, 160), np.array(BEFORE))
    found = int(told.cost.argmin())
    assert converter.ZEROS[found] == pytest.approx(zero, abs=0.26)
    assert told.rate[found][[0, 4, 5]] == pytest.approx(rate[[0, 4, 5]], rel=0.15)


def test_unlit_codes_that_never_come_up_from_0_tell_only_that():
    t = np.full((3, 6), [[159.0], [90.0], [40.0]])
    told = converter.unlit(t, np.zeros((3, 6)), np.full(3, 160), np.array(BEFORE))
    deep = converter.ZEROS <= -1.5
    assert np.ptp(told.cost[deep]) < 1.0 and told.cost[converter.ZEROS >= 0].min() > 100


@pytest.mark.parametrize("zero", [0.0, -1.0, -2.0])
def test_what_the_device_takes_clipped_codes_for_is_the_core_s(zero):
    """A constant lit code and noisy unlit ones: the feature's charge says which unlit code the core meant."""
    levels, lit, exposure = np.array([-2.0, -1.3, -0.8, -0.3, 0.4, 1.0]), 200, 1000
    board = Board(0.0, exposure=exposure, wiring=lib.SG_WIRING_PHOTODIODES)
    rng, meant = np.random.default_rng(4), []
    for level in levels:
        seen = []
        for _ in range(60):
            light = Light(board, wiring=lib.SG_WIRING_PHOTODIODES, zero_q2=int(4 * zero))
            for k in range(HOLD):
                reading = board.cycle()
                unlit = np.maximum(np.floor(level + rng.normal(0, NOISE_LSB, 6) + 0.5), 0).astype(int)
                for i in range(6):
                    reading.lit_code[i], reading.unlit_code[i] = lit, unlit[i]
                lib.sg_light_add(light.state, reading)
                if k >= SKIP:
                    seen.append(light.state.channel[0].sum_q5 / 32)
                lib.sg_light_features(light.state, light.feature)
        # 200 codes are so much charge; a code less of unlit is a code more, to 1 %.
        meant.append(np.mean(seen))
    whole = Light(board, wiring=lib.SG_WIRING_PHOTODIODES)
    reading = board.cycle()
    for i in range(6):
        reading.lit_code[i], reading.unlit_code[i] = lit, 2
    lib.sg_light_add(whole.state, reading)
    taken = 2 - (np.array(meant) - whole.state.channel[0].sum_q5 / 32)
    told = np.interp(levels, converter.LEVELS, converter.device_reads(zero))
    print(np.round(taken, 2), np.round(told, 2))
    assert np.abs(taken - told).max() <= 0.12
