# SPDX-License-Identifier: Apache-2.0
"""sg_gp against an integer twin, against real numbers with the stated bound, and at its edges."""
import hashlib
import itertools
import zlib

import numpy as np
import pytest

from core_models import Parts, View, bound_deg, features_near, random_parts, real_mean_deg, scaled, twin
from sparsegaze._core import ffi, lib

GOLDEN_CRC = 0x8E84C0DF     # see test_golden_crc_of_64_predictions
EXTREMES = (0, 1, 2, 0x7FFF, 0x8000, 0xFFFE, 0xFFFF)


def saturated(deg_q7):
    return np.clip(deg_q7, -32768, 32767)


def agree(parts, feature):
    """Assert that core and twin agree to the bit, flags and return values included."""
    view = View(parts.image())
    assert view.verdict == lib.SG_OK
    deg, flags, results = view.predict(feature)
    expected, outside = twin(parts, feature)
    over = (saturated(expected) != expected).any(axis=1)
    np.testing.assert_array_equal(deg, saturated(expected))
    np.testing.assert_array_equal(results, np.where(over, lib.SG_E_RANGE, lib.SG_OK))
    np.testing.assert_array_equal(flags, np.where(outside | over, lib.SG_FLAG_OUT_OF_RANGE, 0))
    return deg


@pytest.mark.parametrize("d", range(1, 7))
@pytest.mark.parametrize("n", [1, 2, 63, 64, 216])
@pytest.mark.parametrize("bits", [6, 9, 10])
def test_equals_integer_twin_for_every_dimension_and_size(d, n, bits):
    rng = np.random.default_rng(1000 * d + n + bits)
    parts = random_parts(rng, n, d, guards=n % 9, weight_frac_bits=bits)
    near, wild = features_near(rng, parts, 60), rng.integers(0, 65536, (40, 6)).astype(np.uint16)
    agree(parts, np.concatenate([near, wild]))


@pytest.mark.parametrize("seed", range(4))
def test_every_corner_of_the_box(seed):
    rng = np.random.default_rng(seed)
    parts = random_parts(rng, 64, weight_frac_bits=6 + seed)
    low, high = parts.offset, parts.offset + (4095 * 4096 + 4095) // parts.gain_q12
    corners = np.array([[(low, high)[b][j] for j, b in enumerate(bits)] for bits in
                        itertools.product((0, 1), repeat=6)])
    s, clamped = scaled(parts, corners)
    assert set(np.unique(s)) <= {0} | set(range(4090, 4096)) and not clamped.any()
    agree(parts, corners.astype(np.uint16))


def test_every_pair_of_extreme_features_and_parameters():
    rng = np.random.default_rng(7)
    feature = np.array(list(itertools.product(EXTREMES, repeat=2)), np.uint16)
    feature = np.hstack([feature, rng.choice(EXTREMES, (len(feature), 4))]).astype(np.uint16)
    for offset, gain in itertools.product((0, 1, 0xFFFF), (0, 1, 4096, 0xFFFF)):
        parts = random_parts(rng, 5)
        parts.offset[:], parts.gain_q12[:] = offset, gain
        agree(parts, feature)


@pytest.mark.parametrize("centre,s", [(0, 0), (0, 4095), (255, 0), (255, 4095)])
@pytest.mark.parametrize("half_c2", [0, 8 * 6 * 255 ** 2, 2 ** 22 - 1])
def test_distance_at_both_ends_of_24_bits(centre, s, half_c2):
    parts = Parts(offset=np.zeros(6, int), gain_q12=np.full(6, 4096), bias=np.zeros(2, int),
                  trend=np.zeros((2, 6), int), centre=np.full((3, 6), centre),
                  weight=np.array([[32767, -32768]] * 3),
                  half_c2=np.full(3, half_c2))
    agree(parts, np.full((1, 6), s, np.uint16))


def test_distance_zero_and_last_table_entry_and_first_zero_kernel():
    # One channel, centre 0: T = (s^2 >> 5) + half_c2 walks over 0, 2^20 - 1, 2^20.
    for t in (0, 1, 1023, 1024, 2 ** 20 - 1024, 2 ** 20 - 1, 2 ** 20, 2 ** 20 + 1):
        parts = Parts(offset=np.zeros(1, int), gain_q12=np.full(1, 4096), bias=np.zeros(2, int),
                      trend=np.zeros((2, 1), int), centre=np.zeros((1, 1), int),
                      weight=np.array([[32767, 1]]),
                      weight_frac_bits=6, half_c2=np.array([t]))
        agree(parts, np.zeros((1, 6), np.uint16))


def test_kernel_falls_monotonically_without_a_step_up():
    parts = Parts(offset=np.zeros(1, int), gain_q12=np.full(1, 256), bias=np.zeros(2, int),
                  trend=np.zeros((2, 1), int), centre=np.zeros((1, 1), int),
                  weight=np.array([[32767, -32768]]),
                  weight_frac_bits=6)
    feature = np.zeros((8192, 6), np.uint16)
    feature[:, 0] = np.arange(8192) * 8
    deg = agree(parts, feature)
    assert (np.diff(deg[:, 0]) <= 0).all() and (np.diff(deg[:, 1]) >= 0).all()
    assert deg[0, 0] == 32767 and deg[-1, 0] > 0


def test_rounds_half_up_at_both_signs():
    for frac in (6, 10):
        half = 1 << (frac + 8)
        for bias, expected in ((half, 1), (half - 1, 0), (-half, 0), (-half - 1, -1), (0, 0)):
            parts = Parts(offset=np.zeros(1, int), gain_q12=np.ones(1, int), bias=np.array([bias, -bias]),
                          trend=np.zeros((2, 1), int), centre=np.zeros((1, 1), int),
                          weight=np.zeros((1, 2), int),
                          weight_frac_bits=frac)
            deg = agree(parts, np.zeros((1, 6), np.uint16))
            assert deg[0, 0] == expected


def test_saturates_at_both_ends_and_says_so():
    for bias, expected in ((2 ** 31 - 1, 32767), (-2 ** 31, -32768), (32767 << 15, 32767),
                           (-32768 << 15, -32768)):
        parts = Parts(offset=np.zeros(1, int), gain_q12=np.ones(1, int), bias=np.array([bias, 0]),
                      trend=np.zeros((2, 1), int), centre=np.zeros((1, 1), int), weight=np.zeros((1, 2), int),
                      weight_frac_bits=6)
        deg = agree(parts, np.zeros((1, 6), np.uint16))
        assert deg[0, 0] == expected


@pytest.mark.parametrize("seed", range(8))
def test_permuting_vectors_is_an_equality(seed):
    rng = np.random.default_rng(seed)
    parts = random_parts(rng, 64, d=1 + seed % 6)
    feature = features_near(rng, parts, 50)
    order = rng.permutation(64)
    shuffled = Parts(parts.offset, parts.gain_q12, parts.bias, parts.trend, parts.centre[order],
                     parts.weight[order], parts.weight_frac_bits, parts.guard)
    np.testing.assert_array_equal(View(parts.image()).predict(feature)[0],
                                  View(shuffled.image()).predict(feature)[0])


@pytest.mark.parametrize("seed", range(6))
def test_real_number_mean_within_the_stated_bound(seed):
    rng = np.random.default_rng(seed)
    n = (1, 16, 64, 64, 128, 216)[seed]
    parts = random_parts(rng, n, weight_frac_bits=8, guards=0)
    parts.weight = rng.integers(-32768, 32768, (n, 2)) // max(1, n // 16)
    # Near a centre, where kernels are not all zero.
    pick = rng.integers(0, n, 400)
    s = np.clip(parts.centre[pick] * 16 + rng.normal(0, 400, (400, 6)), 0, 4095).astype(np.int64)
    feature = (parts.offset + (s * 4096 + 2048) // parts.gain_q12).clip(0, 65535).astype(np.uint16)
    deg, flags, _ = View(parts.image()).predict(feature)
    real = real_mean_deg(parts, feature)
    whole = 2.0 ** 32 * 2.0 ** -(parts.weight_frac_bits + 16)
    usable = (np.abs(real) < whole / 2 - 1).all(axis=1)
    assert usable.sum() > 200
    worst = np.abs(deg / 128 - real)[usable].max(axis=0)
    bound = bound_deg(parts)
    print(f"n={n}: worst error {worst.max():.5f} deg, bound {bound.max():.5f} deg")
    assert (worst <= bound).all()


def test_guard_rows_hold_at_their_limits_and_fail_one_step_beyond():
    row = np.array([1, -1, 127, -128, 0, 3])
    s = np.array([4095, 1, 4095, 0, 7, 4095])
    projection = int(row @ s)
    for low, high, flagged in ((projection, projection, False), (projection + 1, projection + 9, True),
                               (projection - 9, projection - 1, True), (-2 ** 31, 2 ** 31 - 1, False),
                               (-2 ** 31, -2 ** 31, True), (2 ** 31 - 1, 2 ** 31 - 1, True)):
        parts = Parts(offset=np.zeros(6, int), gain_q12=np.full(6, 4096), bias=np.zeros(2, int),
                      trend=np.zeros((2, 6), int), centre=np.zeros((1, 6), int), weight=np.zeros((1, 2), int),
                      guard=[(-2 ** 31, 2 ** 31 - 1, np.zeros(6, int)), (low, high, row)])
        view = View(parts.image())
        _, flags, _ = view.predict(s[None].astype(np.uint16))
        assert flags[0] == (lib.SG_FLAG_OUT_OF_RANGE if flagged else 0)
        agree(parts, s[None].astype(np.uint16))


class FrozenDraws:
    """integers() of numpy's Generator from SHAKE-256: no library version moves the golden vectors."""

    def __init__(self, seed):
        self.bytes, self.at = hashlib.shake_256(bytes([seed])).digest(1 << 16), 0

    def integers(self, low, high, shape):
        count = int(np.prod(shape))
        raw = np.frombuffer(self.bytes, "<u4", count, self.at).astype(np.int64)
        self.at += 4 * count
        return (low + raw % (high - low)).reshape(shape)


def golden_case():
    """The fixed model and its 64 features: 48 at growing distances around a vector each, 16 anywhere. The
    guards are tight enough that each of them decides about some."""
    draws = FrozenDraws(20)
    parts = random_parts(draws, 64)
    limits = ((0, 500000), (-200000, 200000), (-600000, 0))
    parts.guard = [(low, high, row) for (low, high), (_, _, row) in zip(limits, parts.guard)]
    near = parts.centre[:48] * 16 + draws.integers(-64, 65, (48, 6)) * (np.arange(48)[:, None] // 4)
    near = (parts.offset + (near.clip(0, 4095) * 4096 + 2048) // parts.gain_q12).clip(0, 65535)
    return parts, np.concatenate([near, draws.integers(0, 65536, (16, 6))]).astype(np.uint16)


def golden_crc(core_ffi=ffi, core_lib=lib):
    """CRC-32 over struct sg_gaze of the 64 predictions: what every target must reproduce."""
    parts, feature = golden_case()
    image = core_ffi.new("uint8_t[]", parts.image())
    view, out = core_ffi.new("struct sg_model_view *"), core_ffi.new("struct sg_gaze[64]")
    assert core_lib.sg_model_open(view, image, len(image), 0) == 0
    core_lib.sg_batch_infer(view, core_ffi.from_buffer("uint16_t[]", np.ascontiguousarray(feature)),
                            core_ffi.NULL,
                            core_ffi.new("struct sg_affine *"), out, 64)
    return zlib.crc32(bytes(core_ffi.buffer(out)))


def test_golden_crc_of_64_predictions():
    crc = golden_crc()
    print(f"golden CRC-32 over 64 predictions: {crc:08x}")
    assert crc == GOLDEN_CRC


def test_golden_case_exercises_every_guard_and_every_size_of_kernel():
    parts, feature = golden_case()
    s, clamped = scaled(parts, feature)
    broken = np.array([(s @ row < low) | (s @ row > high) for low, high, row in parts.guard])
    alone = broken & (broken.sum(axis=0) == 1) & ~clamped
    assert alone.any(axis=1).all() and (~broken.any(axis=0) & ~clamped).any()
    t = ((s * s).sum(axis=1) >> 5)[:, None] + parts.half_c2 - s @ parts.centre.T
    assert (t < 1024).any() and (t >= 1 << 20).any() and len(np.unique((t[t < 1 << 20]) >> 16)) == 16
