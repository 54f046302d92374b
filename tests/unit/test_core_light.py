# SPDX-License-Identifier: Apache-2.0
"""sg_light against a float64 model of nodes, pairs and converter: charge, noise, ambient light.

Hard cases are in test_core_light_adverse.py.
"""
import numpy as np
import pytest

from light_reference import (BRIGHT_ROOM_NA, CAPS, LIT_RAIL_V, NOISE_LSB, PAIRS, RAIL_V, ROOM_NA, Board,
                             Light, collected_pc, feature_noise, node_pc, read, settle, true_feature)
from sparsegaze._core import ffi, lib

UNIT_PC = node_pc(1e-3) / 1e-3              # a code at rest
FULL_PC = node_pc(1024)
GOAL_CODE = 922
WIRINGS = {"leds": lib.SG_WIRING_LEDS, "photodiodes": lib.SG_WIRING_PHOTODIODES}
SECONDS = {wiring: [second for _, second in pairs] for wiring, pairs in PAIRS.items()}


def charges(codes, exposure=1000, wiring=lib.SG_WIRING_PHOTODIODES, curve=None):
    """Signals of one cycle, pC, from (lit, unlit) codes [6, 2]. Photodiodes' emitters spare the rail."""
    light = Light(wiring=wiring, curve=curve)
    lib.sg_light_add(light.state, ffi.new("struct sg_reading *", {
        "lit_code": [int(lit) for lit, _ in codes], "unlit_code": [int(unlit) for _, unlit in codes],
        "exposure_cycles": [exposure] * 6}))
    return np.array([channel.sum_q5 for channel in light.state.channel]) / 32 * UNIT_PC


def test_charge_is_that_of_the_junction_to_2e_4_of_full_scale():
    first, worst = 0, {GOAL_CODE: 0.0, 950: 0.0, 999: 0.0}
    for unlit in range(0, 1000, 13):
        for lit in range(unlit, 1000, 7):
            codes = [(0, 0)] * 6
            codes[first] = (lit, unlit)
            error = abs(charges(codes)[first] - (node_pc(lit) - node_pc(unlit))) / FULL_PC
            for top in worst:
                if lit <= top:
                    worst[top] = max(worst[top], error)
    errors = ", ".join(f"{error:.1e} up to code {top}" for top, error in worst.items())
    print(f"worst charge error, of full scale: {errors}; bounds 2e-4, 2e-4, 3.2e-4")
    assert worst[GOAL_CODE] <= 2e-4 and worst[950] <= 2e-4 and worst[999] <= 3.2e-4


@pytest.mark.parametrize("wiring", WIRINGS)
def test_the_second_of_a_pair_is_free_of_what_the_sample_capacitor_brought(wiring):
    rng, worst = np.random.default_rng(1), 0.0
    for _ in range(300):
        codes = np.sort(rng.integers(0, 930, (6, 2)), axis=1)[:, ::-1]
        got = charges(codes, wiring=WIRINGS[wiring])
        for first, second in PAIRS[WIRINGS[wiring]]:
            rail = LIT_RAIL_V if wiring == "leds" else RAIL_V
            for i, before in ((first, (0, 0)), (second, codes[first])):
                exact = node_pc(codes[i, 0], before[0], rail) - node_pc(codes[i, 1], before[1])
                worst = max(worst, abs(got[i] - exact) / FULL_PC)
    bound = 6e-4 if wiring == "leds" else 2.5e-4      # the rail's share is two powers of two
    print(f"worst {worst:.1e} of full scale, bound {bound:.1e}")
    assert worst <= bound


def test_what_the_capacitor_held_before_the_first_sample_is_subtracted():
    board = Board(150, exposure=[1000] * 6)
    light = Light(board)
    settle(board, light)
    dark, _ = light.frame(board.cycle())
    for held in (1, 50, 190, 700, 999):
        got, flags = light.frame(board.cycle(held=held))
        bound = 4096 / np.log(2) * 1.5 / read(collected_pc(150, 1000))
        assert flags == 0 and np.abs(got - dark).max() <= bound
        light.frame(board.cycle())


@pytest.mark.parametrize("curve", [-60, -10, 10, 60])
def test_curve_is_what_the_wire_says(curve):
    for lit, unlit in ((900, 0), (500, 100), (300, 290)):
        codes = [(lit, unlit)] + [(0, 0)] * 5
        more = (charges(codes, curve=[curve] * 6) - charges(codes))[0] / UNIT_PC
        assert more == pytest.approx(curve / 1024 * (lit ** 2 - unlit ** 2) / 1024, abs=0.08)


def test_feature_is_4096_log2_of_the_current_over_62_5_pa():
    for current_na, exposure in ((62.5, 2544), (125, 1656), (500, 600), (2000, 200)):
        board = Board(current_na, exposure=[exposure] * 6)
        got, flags = Light(board).run(board, 40)
        half_code = 4096 / np.log(2) * 0.7 / read(collected_pc(current_na, exposure))
        assert not flags.any() and np.abs(got[-1] - true_feature(current_na)).max() <= 6 + half_code


def test_log2_is_within_1_5_steps_and_rises():
    exposures = np.unique(np.geomspace(250, 5216, 60).astype(int))
    light, worst, last = Light(), 0.0, None
    for exposure in exposures:
        reading = ffi.new("struct sg_reading *", {"lit_code": [500] * 6,
                                                  "exposure_cycles": [int(exposure)] * 6})
        got, _ = light.frame(reading)
        exact = 4096 * np.log2(1 / exposure)
        difference = got[5] - exact
        last = difference if last is None else last
        worst = max(worst, abs(difference - last))
    print(f"feature over exposures 250..5216: constant within {worst:.2f} steps, bound 3")
    assert worst <= 3


def test_feature_rises_with_every_lit_code_and_falls_with_every_unlit_code():
    light, before = Light(), None
    for lit in range(10, 1000):
        got = light.frame(ffi.new("struct sg_reading *", {"lit_code": [0] * 5 + [lit],
                                                          "exposure_cycles": [1000] * 6}))[0][5]
        assert before is None or got > before
        before = got
    before = None
    for unlit in range(0, 900, 3):
        got = charges([(950, unlit)] + [(0, 0)] * 5)[0]
        assert before is None or got < before
        before = got


@pytest.mark.parametrize("ambient_na", [0, ROOM_NA, BRIGHT_ROOM_NA])
def test_feature_does_not_depend_on_the_exposure_within_a_thousandth(ambient_na):
    found = []
    for exposure in (400, 700, 1000, 1400):
        board = Board(90, ambient_na, exposure=[exposure] * 6, noise_lsb=NOISE_LSB, seed=exposure)
        light = Light(board)
        settle(board, light)
        found.append(light.run(board, 1500)[0].mean(axis=0))
    spread = np.ptp(found, axis=0).max() * np.log(2) / 4096
    print(f"ambient {ambient_na} nA: {spread:.2e} of the current over exposures 400..1400 cycles; "
          "bound 1e-3 or 0.15 code")
    shortest = read(collected_pc(90 + ambient_na, 400)) - read(collected_pc(ambient_na, 400))
    assert spread <= max(1e-3, 0.15 / shortest)     # of its few codes 0.15 is the error


@pytest.mark.parametrize("repeats", [1, 4, 16])
def test_frames_of_several_cycles_average_the_current_before_the_logarithm(repeats):
    board = Board(lambda k: np.full(6, 60.0 if k % 2 else 180.0), exposure=[1000] * 6)
    light = Light(board)
    got = light.run(board, 6, repeats=repeats)[0][-1]
    mean, bound = (120.0, 60) if repeats > 1 else (60.0, 80)
    assert np.abs(got - true_feature(mean)).max() <= bound


LIGHT_LEVELS = [("dim", 0.375), ("nominal", 1.0), ("bright", 3.0)]
AMBIENT_LEVELS = [("dark", 0.0, 1 / 31), ("room", ROOM_NA, 1 / 31), ("bright room", BRIGHT_ROOM_NA, 1 / 31)]


@pytest.mark.parametrize("name,light_level", LIGHT_LEVELS)
@pytest.mark.parametrize("around,ambient_na,share", AMBIENT_LEVELS)
def test_noise_of_the_feature_is_what_the_converter_s_noise_makes(
        name, light_level, around, ambient_na, share):
    signal = 120.0 * light_level
    exposure = np.array([CAPS[1], CAPS[0], CAPS[0], CAPS[1], CAPS[1], CAPS[0]])
    load = read(collected_pc(ambient_na + 2 * signal, 1000)) / 1000
    exposure = np.minimum(exposure, int(0.9 * 1024 / load))
    board = Board(signal, ambient_na, exposure=exposure, noise_lsb=NOISE_LSB, offset_lsb=2.0)
    light = Light(board)
    settle(board, light, 100)
    got = light.run(board, 2500)[0].std(axis=0)
    expected = []
    for i in range(6):
        second = i in SECONDS[board.wiring]
        code = read(collected_pc(signal + ambient_na, exposure[i]))
        expected.append(feature_noise(signal, code, share, exposure[i], second))
    print(f"{name} {around}: feature noise {got.round(1)} steps, expected {np.round(expected, 1)} "
          f"({got.mean() * np.log(2) / 40.96:.3f} % of the current)")
    assert got == pytest.approx(np.array(expected), rel=0.08)


# ---- ambient light


def lamp(mean_na, amplitude_na, hz, phase=0.0):
    """Ambient current as a function of time."""
    return lambda t: np.full(6, mean_na + amplitude_na * np.sin(2 * np.pi * hz * t + phase))


@pytest.mark.parametrize("period", [15984, 18000, 20480, 25000, 31986])
@pytest.mark.parametrize("hz,bound", [(110, 0.012), (100, 0.030), (120, 0.030)])
def test_flicker_at_100_110_and_120_hz_is_rejected_at_every_period(hz, bound, period):
    signal, amplitude = 150.0, 75.0
    board = Board(signal, lamp(100.0, amplitude, hz), exposure=[900] * 6, period=period)
    light = Light(board)
    settle(board, light)
    got = light.run(board, 400)[0]
    left = (2 ** ((got - true_feature(signal)) / 4096) - 1) * signal
    left = (left - left.mean(axis=0)).std(axis=0).max() * np.sqrt(2) / amplitude
    alone = 2 * np.sin(np.pi * hz * 3 / 18 * period / 16e6)
    bound *= (period / 15984) ** 2
    print(f"{hz} Hz, period {period}: {left:.4f} of the amplitude is left, bound {bound:.3f}; "
          f"the difference of both codes alone leaves {alone:.3f}")
    assert left <= max(bound, 0.012) and left < alone / 2


@pytest.mark.parametrize("hz", [100.0, 120.0, 100.3, 119.6])
def test_flicker_of_half_the_signal_costs_no_more_than_interpolation_does(hz):
    signal = 150.0
    still, flickering = (Board(signal, light, exposure=[900] * 6, noise_lsb=NOISE_LSB, offset_lsb=2.0)
                         for light in (75.0, lamp(75.0, 37.5, hz)))
    noise = []
    for board in (still, flickering):
        light = Light(board)
        settle(board, light, 100)
        noise.append(light.run(board, 1500)[0].std(axis=0).mean())
    print(f"{hz} Hz: noise {noise[1]:.1f} steps, {noise[1] / noise[0]:.2f} times that of steady light; "
          "bound 1.45")
    assert noise[1] <= 1.45 * noise[0]


def test_flicker_beating_with_the_frame_rate_does_not_come_through():
    signal = 150.0      # 16 cycles a frame: 62.5625 Hz; the lamp's 2nd multiple beats at 0.4 Hz
    board = Board(signal, lamp(60.0, 30.0, 125.525), exposure=[900] * 6, noise_lsb=NOISE_LSB, offset_lsb=2.0)
    light = Light(board)
    light.run(board, 20, repeats=16)
    got = light.run(board, 150, repeats=16)[0]
    slow = got.reshape(15, 10, 6).mean(axis=1)
    print(f"beat: slow part {slow.std(axis=0).max():.1f} steps rms, bound 6 (0.1 %)")
    assert slow.std(axis=0).max() <= 6


def test_weak_flicker_is_followed_and_rest_is_averaged_without_hunting():
    signal, small = 150.0, 6.0
    board = Board(signal, 40.0, exposure=[1656] * 6, noise_lsb=NOISE_LSB, offset_lsb=2.0)
    light = Light(board)
    settle(board, light, 200)
    moving = []
    rest = light.run(board, 600)[0]
    for _ in range(1500):
        light.frame(board.cycle())
        moving.append(bool(light.state.state & 4))
    assert np.mean(moving) < 0.01
    board.ambient = lamp(40.0, small, 100)
    settle(board, light, 40)
    weak = light.run(board, 600)[0]
    assert light.state.state & 4
    print(f"rest {rest.std(axis=0).mean():.1f} steps, 6 nA at 100 Hz {weak.std(axis=0).mean():.1f}; "
          f"unfollowed it would be {4096 / np.log(2) * small / signal / np.sqrt(2):.0f}")
    assert weak.std(axis=0).mean() <= 1.45 * rest.std(axis=0).mean()
    board.ambient = 40.0
    back = light.run(board, 60)[0]
    shift = np.abs(back.mean(axis=0) - rest.mean(axis=0)).max()
    assert shift <= rest.std(axis=0).max(), shift       # and no step when it ends


def test_after_a_gap_no_older_code_is_a_neighbour_in_time():
    board = Board(150, lamp(100.0, 50.0, 100), exposure=[900] * 6)
    light = Light(board)
    settle(board, light)
    board.start += 0.0043                       # another phase of the lamp
    lib.sg_light_gap(light.state)
    wrong, _ = light.frame(board.cycle())
    alone = 2 * np.pi * 100 * 3 / 18 * board.period / 16e6 * 50
    assert np.abs(2 ** (wrong / 4096) * 0.0625 - 150).max() <= alone * 1.1
