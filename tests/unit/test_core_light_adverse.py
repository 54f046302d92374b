# SPDX-License-Identifier: Apache-2.0
"""sg_light's hard cases: darkness, full sun, full channels, steps, late releases, clipped codes, any code."""
import numpy as np
import pytest

from light_reference import (NOISE_LSB, PAIRS, SUN_NA, Board, Light, collected_pc, feature_noise, read,
                             settle, true_feature)
from sparsegaze._core import ffi, lib

SATURATED, STARVED = lib.SG_FLAG_SATURATED, lib.SG_FLAG_STARVED


def test_pitch_dark_is_starved_and_says_so_for_every_channel():
    board = Board(0.0, 0.0, noise_lsb=NOISE_LSB)
    light = Light(board)
    got, flags = light.run(board, 200)
    assert (flags == STARVED).all()
    assert all(channel.flags == STARVED for channel in light.state.channel)
    assert np.ptp(got, axis=0).max() == 0       # a bound: it does not jump about


def test_all_leds_dead_in_a_lit_room_is_starved():
    board = Board(0.0, 100.0, exposure=[900] * 6, noise_lsb=NOISE_LSB)
    light = Light(board)
    settle(board, light)
    assert (light.run(board, 300)[1] == STARVED).all()


def test_full_sun_is_measured_at_short_exposures_and_saturated_at_long_ones():
    board = Board(120.0, SUN_NA, exposure=[200] * 6, noise_lsb=NOISE_LSB)
    light = Light(board)
    settle(board, light)
    got, flags = light.run(board, 800)
    assert not flags.any()
    error = np.abs(2 ** ((got.mean(axis=0) - true_feature(120.0)) / 4096) - 1).max()
    rms = got.std(axis=0).mean() * np.log(2) / 40.96
    print(f"full sun: mean current within {100 * error:.2f} %, one frame {rms:.1f} % rms")
    assert error <= 0.01
    board.exposure[:] = 1000
    _, flags = light.run(board, 5)
    assert (flags & SATURATED).all()


def test_one_led_ten_times_brighter_than_the_rest():
    signal = np.array([100.0, 100, 1000, 100, 100, 100])
    exposure = np.array([1000, 1000, 300, 1000, 1000, 1000])
    board = Board(signal, 20.0, exposure=exposure)
    light = Light(board)
    settle(board, light)
    got, flags = light.run(board, 50)
    half_a_code = 4096 / np.log(2) * 1.0 / read(collected_pc(100.0, 1000))
    assert not flags.any() and np.abs(got[-1] - true_feature(signal)).max() <= 14 + half_a_code


@pytest.mark.parametrize("exposure,signal", [(64, 4000.0), (5216, 40.0)])
def test_exposure_at_both_limits(exposure, signal):
    board = Board(signal, 0.0, exposure=[exposure] * 6, period=31986)
    got, flags = Light(board).run(board, 50)
    assert not flags.any() and np.abs(got[-1] - min(true_feature(signal), 65535)).max() <= 25


def test_a_channel_that_is_full_spoils_the_one_sampled_after_it_and_no_other():
    for first, second in PAIRS[lib.SG_WIRING_LEDS]:
        for kind in ("lit_code", "unlit_code"):
            light = Light()
            codes = {"lit_code": [400] * 6, "unlit_code": [20] * 6, "exposure_cycles": [1000] * 6}
            codes[kind] = [1000 if i == first else code for i, code in enumerate(codes[kind])]
            light.frame(ffi.new("struct sg_reading *", codes))
            flagged = [i for i in range(6) if light.state.channel[i].flags & SATURATED]
            assert flagged == sorted((first, second))


@pytest.mark.parametrize("between", ["before the lit exposure", "between lit and unlit"])
def test_a_step_in_the_middle_of_a_cycle_costs_one_flagged_frame(between):
    board = Board(150, 2.0, exposure=[900] * 6, noise_lsb=NOISE_LSB)
    light = Light(board)
    settle(board, light, 100)
    slot = board.period / 18 / 16e6
    edge = board.start + (0 if between.startswith("before") else 1.5) * slot
    board.ambient = lambda t: np.full(6, 200.0 if t > edge else 2.0)
    got, flags = light.run(board, 12)
    assert flags[0] & STARVED and not flags[1:].any()
    error = np.abs(got[1:] - true_feature(150))
    print(f"step {between}: errors of the next frames {error.max(axis=1).round()} steps")
    assert error.max() <= 6 * feature_noise(150, 600, 1.0, 900, True) + 15
    later = light.run(board, 100)[0][-60:]
    assert np.abs(later.mean(axis=0) - true_feature(150)).max() <= 15


@pytest.mark.parametrize("late", [1, 20, 100, 254])
def test_late_releases_are_made_up_for(late):
    board = Board(120, 60.0, exposure=[1200] * 6)
    light = Light(board)
    settle(board, light)
    good, _ = light.frame(board.cycle())
    bound = 14 + 4096 / np.log(2) * 1.5 / read(collected_pc(120, 1200))
    for kind in ("late_lit", "late_unlit"):
        for which in range(6):
            cycles = np.zeros(6, int)
            cycles[which] = late
            got, flags = light.frame(board.cycle(**{kind: cycles}))
            assert flags == 0 and np.abs(got - good).max() <= bound, (kind, which, got - good)
    for both in range(3):
        got, flags = light.frame(board.cycle(late_lit=late, late_unlit=late - both if late > 2 else late))
        assert flags == 0 and np.abs(got - good).max() <= 2 * bound


@pytest.mark.parametrize("late", [1, 8, 22])
def test_late_releases_in_full_sun_are_made_up_for(late):
    board = Board(120, SUN_NA, exposure=[250, 220, 220, 250, 250, 220])
    light = Light(board)
    settle(board, light)
    good, _ = light.frame(board.cycle())
    one_code = 4096 / np.log(2) / (read(collected_pc(120 + SUN_NA, 220)) - read(collected_pc(SUN_NA, 220)))
    for which in range(6):
        for kind in ("late_lit", "late_unlit"):
            cycles = np.zeros(6, int)
            cycles[which] = late
            got, flags = light.frame(board.cycle(**{kind: cycles}))
            assert flags == 0, (kind, which)
            assert np.abs(got - good).max() <= 1.6 * one_code, (kind, which, got - good, one_code)
            settle(board, light, 20)


def test_a_release_too_late_to_make_up_for_is_starved_not_wild():
    board = Board(120, 60.0, exposure=[400] * 6)
    light = Light(board)
    settle(board, light)
    for late in (200, 254, 255, 300):
        cycles = np.array([0, 0, late, 0, 0, 0])
        _, flags = light.frame(board.cycle(late_lit=cycles))
        assert flags == STARVED
        assert [i for i in range(6) if light.state.channel[i].flags] == [2]
    assert light.frame(board.cycle())[1] == 0


@pytest.mark.parametrize("offset,ambient_codes", [
    (-2.0, 0.0), (-2.0, 0.8), (-1.0, 0.0), (-2.0, 1.5), (2.0, 0.0), (0.0, 0.0)])
def test_codes_clipped_at_0_by_a_negative_offset(offset, ambient_codes):
    exposure = 1656
    ambient = ambient_codes / read(collected_pc(1.0, exposure))
    errors = {}
    for name, zero_q2 in (("zero known", round(4 * min(offset, 0))), ("zero unknown", 0)):
        board = Board(150, ambient, exposure=[exposure] * 6, noise_lsb=NOISE_LSB, offset_lsb=offset)
        light = Light(board, zero_q2=zero_q2)
        settle(board, light, 200)
        got = light.run(board, 1500)[0]
        signal_code = read(collected_pc(150, exposure))
        errors[name] = abs(got[:, 5].mean() - true_feature(150)) * np.log(2) / 4096 * signal_code
        noise = got[:, 5].std() / feature_noise(150, signal_code, 1 / 31, exposure)
    off = ", ".join(f"{name} {error:.2f} codes off" for name, error in errors.items())
    print(f"offset {offset:+}, ambient {ambient_codes} codes: {off}; noise {noise:.2f} of expected")
    assert errors["zero known"] <= 0.75 and errors["zero unknown"] <= 2.2
    assert noise <= 1.2


def test_exposures_that_change_in_the_middle_of_a_frame_leave_a_good_mean():
    board = Board(100, 30.0, exposure=[600] * 6)
    light = Light(board)
    settle(board, light)
    before = [board.cycle() for _ in range(2)]
    board.exposure[:] = 1500
    got, flags = light.frame(*before, *(board.cycle() for _ in range(2)))
    assert flags == 0 and np.abs(got - true_feature(100)).max() <= 30


def test_an_exposure_change_alone_moves_a_feature_less_than_its_noise():
    board = Board(120, 20.0, exposure=[900] * 6, noise_lsb=NOISE_LSB, offset_lsb=2.0)
    light = Light(board)
    settle(board, light, 100)
    one = light.run(board, 1200)[0]
    board.exposure[:] = 1500
    first = np.mean([light.run(board, 1)[0][0]], axis=0)
    settle(board, light, 60)
    two = light.run(board, 1200)[0]
    shift = np.abs(two.mean(axis=0) - one.mean(axis=0))
    print(f"shift {shift.round(1)} steps, noise {one.std(axis=0).round(1)}")
    assert (shift <= 0.5 * one.std(axis=0)).all()
    assert (np.abs(first - one.mean(axis=0)) <= 6 * one.std(axis=0)).all()


def test_channels_without_a_cycle_keep_feature_and_flags():
    light = Light()
    full = ffi.new("struct sg_reading *", {"lit_code": [1023] * 6, "exposure_cycles": [1000] * 6})
    got, flags = light.frame(full)
    again, same = light.frame()
    assert flags == same == SATURATED and (got == again).all()


def test_any_reading_is_legal():
    rng, light = np.random.default_rng(9), Light()
    for _ in range(5000):
        high = int(rng.choice([4, 1024, 1024]))
        reading = ffi.new("struct sg_reading *", {
            "lit_code": rng.integers(0, high, 6).tolist(), "unlit_code": rng.integers(0, high, 6).tolist(),
            "exposure_cycles": rng.choice([0, 1, 64, 900, 5216, 65535], 6).tolist(),
            "late_lit_cycles": rng.choice([0, 0, 0, 1, 255], 6).tolist(),
            "late_unlit_cycles": rng.choice([0, 0, 0, 130, 254], 6).tolist(),
            "held_code": int(rng.choice([0, 0, 1023]))})
        got, flags = light.frame(*[reading] * int(rng.integers(1, 4)))
        assert flags & ~(SATURATED | STARVED) == 0 and ((got >= 0) & (got <= 65535)).all()
