# SPDX-License-Identifier: Apache-2.0
"""sg_expose: features against the node's charge balance in float64, and the automatic exposure."""
import numpy as np
import pytest

from sparsegaze._core import ffi, lib

C0_PF, JUNCTION_V, POWER, LINEAR_PF, VCC = 40.0, 0.7, 0.4, 20.0, 5.0
MIN, MAX, START = lib.SG_EXPOSE_MIN_CYCLES, lib.SG_EXPOSE_MAX_CYCLES, lib.SG_EXPOSE_START_CYCLES
CYCLES_PER_US = 16
GAZE_SWING = 1.9


def charge_pc(volts):
    """F(V) = Qj(V) + (C_pin + C_sh) V, pC."""
    junction = C0_PF * JUNCTION_V / (1 - POWER) * ((1 + volts / JUNCTION_V) ** (1 - POWER) - 1)
    return junction + LINEAR_PF * volts


def true_feature(code_q2, cycles):
    """4096 log2(I / 62.5 pA) of what was collected, float64; the reading is the sum of four codes."""
    current_a = (charge_pc(VCC) - charge_pc(VCC * code_q2 / 4096)) * 1e-12 / (cycles / 16e6)
    return 4096 * np.log2(current_a / 62.5e-12)


def sampled_code(current_na, cycles):
    """Sum of four codes for a steady photocurrent: nearest level, the node empty at 0."""
    left = charge_pc(VCC) - current_na * 1e-3 * cycles / CYCLES_PER_US
    if left <= 0:
        return 0
    low, high = 0.0, VCC
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if charge_pc(middle) < left else (low, middle)
    return min(4092, int(round(low / VCC * 4096)))


def feature(code, cycles):
    """(feature, flags) of the core."""
    out = ffi.new("uint16_t *")
    return (lambda flags: (out[0], flags))(lib.sg_expose_feature(int(code), int(cycles), out))


def features(codes, cycles):
    """Arrays of features and flags."""
    codes, cycles = np.broadcast_arrays(np.asarray(codes, np.uint16), np.asarray(cycles, np.uint16))
    codes, cycles = np.ascontiguousarray(codes), np.ascontiguousarray(cycles)
    out, flags = np.zeros(codes.shape, np.uint16), np.zeros(codes.shape, np.uint8)
    lib.sg_batch_feature(ffi.from_buffer("uint16_t[]", codes), ffi.from_buffer("uint16_t[]", cycles),
                         ffi.from_buffer("uint16_t[]", out), ffi.from_buffer("uint8_t[]", flags), codes.size)
    return out.astype(np.int64), flags


def test_every_code_and_exposure_within_a_thousandth_of_an_octave():
    worst = 0.0
    codes = np.arange(lib.SG_EXPOSE_SATURATED_Q2 + 1, 4096 - lib.SG_EXPOSE_STARVED_Q2 + 1)
    for cycles in sorted({*range(MIN, MAX + 1, 61), *(2 ** i for i in range(7, 13)), MAX, 4095, 4097}):
        got, flags = features(codes, cycles)
        assert not flags.any()
        worst = max(worst, np.abs(got - np.clip(true_feature(codes, cycles), 0, 65535)).max())
    print(f"worst feature error {worst:.2f} LSB = {worst / 4096:.6f} octave; bound 4 LSB (0.001 octave)")
    assert worst <= 4.0


def test_feature_units_at_62_5_pa_and_one_octave_up():
    for na, units in ((62.5, 1000), (125.0, 2000), (500.0, 8000)):
        expected = 4096 * np.log2(units)
        code = sampled_code(na, MAX)
        got, _ = feature(code, MAX)
        lsb = abs(true_feature(code, MAX) - true_feature(code - 1, MAX))
        assert abs(got - expected) <= 4 + lsb


def test_feature_falls_with_every_code_and_never_rises_with_exposure():
    got, _ = features(np.arange(0, 4093, 4), 1000)
    assert (np.diff(got) < 0).all()
    got, _ = features(np.arange(4093), 1000)
    assert (np.diff(got) <= 0).all()
    got, _ = features(2000, np.arange(MIN, MAX + 1))
    assert (np.diff(got) <= 0).all()


@pytest.mark.parametrize("current_na", [40, 75, 200, 600, 1500, 3500])
def test_feature_does_not_depend_on_the_exposure_but_for_the_rounding_of_the_code(current_na):
    for cycles in range(MIN, MAX + 1, 64):
        code = sampled_code(current_na, cycles)
        got, flags = feature(code, cycles)
        if flags:
            continue
        half_lsb = max(abs(true_feature(code, cycles) - true_feature(code + h, cycles)) for h in (-0.5, 0.5))
        assert abs(got - 4096 * np.log2(current_na / 0.0625)) <= 4 + half_lsb


def test_flags_at_their_thresholds():
    for code in range(4097):
        _, flags = feature(code, 1000)
        if code <= lib.SG_EXPOSE_SATURATED_Q2:
            assert flags == lib.SG_FLAG_SATURATED
        elif 4096 - code < lib.SG_EXPOSE_STARVED_Q2:
            assert flags == lib.SG_FLAG_STARVED
        else:
            assert flags == 0


def test_any_16_bit_code_and_exposure_is_legal_and_clamped():
    assert feature(0, 0) == feature(0, 1) == (65535, lib.SG_FLAG_SATURATED)
    assert feature(65535, MAX) == feature(4093, MAX) == feature(4092, MAX)
    assert feature(2000, 65535) == feature(2000, 32768) == feature(2000, 32767)
    assert feature(1185, 1)[0] == 65535                 # more than 4.096 uA is all the field can say
    values = [0, 1, 2, 1183, 1184, 1185, 2048, 4064, 4065, 4091, 4092, 4093, 4096, 32767, 32768, 65535]
    for code in values:
        for cycles in values:
            got, _ = feature(code, cycles)
            truth = true_feature(min(code, 4092), min(max(cycles, 1), 32767))
            assert abs(got - np.clip(truth, 0, 65535)) <= 5


def test_quarter_microseconds_convert_exactly_and_clip():
    assert lib.sg_expose_from_us_q2(0) == lib.sg_expose_from_us_q2(63) == MIN
    assert lib.sg_expose_from_us_q2(1217) == lib.sg_expose_from_us_q2(65535) == MAX
    for us_q2 in range(64, 1217):
        cycles = lib.sg_expose_from_us_q2(us_q2)
        assert cycles == 4 * us_q2 and lib.sg_expose_to_us_q2(cycles) == us_q2


class Led:
    """One LED under automatic exposure; `lag` frames pass from a correction to the exposure it changes."""

    def __init__(self, start=START, lag=0):
        self.state = ffi.new("struct sg_expose_led *")
        lib.sg_expose_start(self.state, start)
        self.waiting = [self.state.exposure_cycles] * lag
        self.changes = 0

    def frame(self, current_na):
        """Expose and step; returns (code, flags of the sample, changed)."""
        self.waiting.append(self.state.exposure_cycles)
        cycles = self.waiting.pop(0)
        code = sampled_code(current_na, cycles)
        changed = lib.sg_expose_step(self.state, code, cycles)
        assert MIN <= self.state.exposure_cycles <= MAX
        self.changes += changed
        return code, feature(code, cycles)[1], changed

    def run(self, current_na, frames):
        """frames of steady light; returns the list of changes by frame."""
        return [self.frame(current_na)[2] for _ in range(frames)]


@pytest.mark.parametrize("lag", [0, 1, 2])
@pytest.mark.parametrize("current_na", [0, 0.5, 5, 20, 75, 200, 600, 1500, 2600, 4000, 8000])
@pytest.mark.parametrize("start", [MIN, START, MAX])
def test_converges_from_any_start_within_a_few_frames_from_dark_to_sun(start, current_na, lag):
    led = Led(start, lag)
    changes = led.run(current_na, 40)
    settled = max((i for i, c in enumerate(changes) if c), default=-1) + 1
    assert settled <= 4 * (1 + lag), changes
    code, flags, _ = led.frame(current_na)
    assert not flags & lib.SG_FLAG_SATURATED
    exposure = led.state.exposure_cycles
    if current_na <= 5:
        assert exposure == MAX
    elif 20 <= current_na <= 4000:
        assert not flags
    goal_pc = charge_pc(VCC) * 0.30
    wanted = goal_pc / (current_na * 1e-3) * CYCLES_PER_US if current_na else MAX
    assert exposure == pytest.approx(np.clip(wanted, MIN, MAX), rel=0.09)


@pytest.mark.parametrize("before,after", [(0, 2600), (75, 2600), (150, 690), (2600, 75), (2600, 0),
                                          (600, 40)])
def test_a_step_of_light_is_followed_with_the_stated_patience(before, after):
    led = Led()
    led.run(before, 20)
    old = led.state.exposure_cycles
    saturated = sum(bool(led.frame(after)[1] & lib.SG_FLAG_SATURATED) for _ in range(4))
    assert saturated <= 2
    changes = led.run(after, 200)
    last = 4 + max((i for i, c in enumerate(changes) if c), default=-1)
    limit = lib.SG_EXPOSE_PATIENCE_DIM if after < before else lib.SG_EXPOSE_PATIENCE_BRIGHT
    assert last <= limit + 4
    assert led.state.exposure_cycles != old
    assert not led.frame(after)[1] & lib.SG_FLAG_SATURATED


@pytest.mark.parametrize("dimmest_na", [60, 100, 200, 350, 900, 2000])
@pytest.mark.parametrize("first", ["dimmest", "brightest", "middle"])
def test_gaze_swing_neither_hunts_nor_saturates_wherever_it_began(dimmest_na, first):
    rng = np.random.default_rng(3)
    led = Led()
    led.run(dimmest_na * {"dimmest": 1, "brightest": GAZE_SWING, "middle": GAZE_SWING ** 0.5}[first], 10)
    settled, flags = led.changes, 0
    for _ in range(40):                         # fixations of up to two seconds anywhere in the range
        current = dimmest_na * GAZE_SWING ** rng.random() if rng.random() < 0.6 else \
            dimmest_na * rng.choice([1, GAZE_SWING])
        for _ in range(int(rng.integers(20, 560))):
            noisy = current * (1 + 0.005 * rng.standard_normal())
            flags |= led.frame(noisy)[1]
    assert led.changes == settled and flags == 0


def test_a_blink_of_400_ms_that_dims_changes_nothing_and_a_bright_one_never_saturates_for_long():
    led = Led()
    led.run(900, 20)
    settled = led.changes
    led.run(150, 110)                           # 420 ms at 3.84 ms
    led.run(900, 50)
    assert led.changes == settled
    saturated = sum(bool(led.frame(3500)[1] & lib.SG_FLAG_SATURATED) for _ in range(60))
    assert saturated <= 2


def test_alternating_bright_and_dim_samples_do_not_add_up():
    led = Led()
    led.run(900, 20)
    settled = led.changes
    for _ in range(400):
        led.frame(900 * 2.15)
        led.frame(900 / 2.5)
    assert led.changes == settled


def test_a_late_sample_of_the_old_exposure_does_not_correct_twice():
    for current in (0.3, 20, 5000):
        led = Led()
        code = sampled_code(current, START)
        lib.sg_expose_step(led.state, code, START)
        once = led.state.exposure_cycles
        for _ in range(5):
            lib.sg_expose_step(led.state, code, START)
        assert led.state.exposure_cycles == once


def test_start_clips_and_any_sample_keeps_the_limits():
    rng = np.random.default_rng(1)
    led = ffi.new("struct sg_expose_led *")
    for start, expected in ((0, MIN), (MIN - 1, MIN), (MAX + 1, MAX), (65535, MAX), (777, 777)):
        lib.sg_expose_start(led, start)
        assert (led.exposure_cycles, led.tracking, led.streak) == (expected, 0, 0)
    for code, cycles in rng.integers(0, 65536, (20000, 2)) % [[4400, 65536]]:
        old = led.exposure_cycles
        changed = lib.sg_expose_step(led, int(code), int(cycles))
        assert MIN <= led.exposure_cycles <= MAX and changed == (led.exposure_cycles != old)
