# SPDX-License-Identifier: Apache-2.0
"""sg_gp against an integer twin, against real numbers with the stated bound, and at its edges."""
import hashlib
import itertools
import zlib

import numpy as np
import pytest

from core_models import (LEVEL, Parts, View, bound_deg, features_near, random_parts, real_mean_deg, scaled,
                         twin)
from sparsegaze._core import ffi, lib

GOLDEN_CRC = 0xDB4265E1     # see test_golden_crc_of_64_predictions
EXTREMES = (0, 1, 2, 0x7FFF, 0x8000, 0xFFFE, 0xFFFF)


def saturated(deg_q7):
    return np.clip(deg_q7, -32768, 32767)


def agree(parts, feature):
    """Assert that core and twin agree to the bit: angles, flags, doubt, sigma and return values."""
    view = View(parts.image())
    assert view.verdict == lib.SG_OK
    deg, flags, results, doubt, sigma = view.predict(feature)
    expected, outside, expected_doubt, expected_sigma = twin(parts, feature)
    over = (saturated(expected) != expected).any(axis=1)
    np.testing.assert_array_equal(deg, saturated(expected))
    np.testing.assert_array_equal(results, np.where(over, lib.SG_E_RANGE, lib.SG_OK))
    np.testing.assert_array_equal(flags, np.where(outside | over, lib.SG_GP_OUT_OF_RANGE, 0))
    np.testing.assert_array_equal(doubt, expected_doubt)
    np.testing.assert_array_equal(sigma, np.where(over, lib.SG_GP_SIGMA_HUGE, expected_sigma))
    return deg


@pytest.mark.parametrize("d", range(1, 7))
@pytest.mark.parametrize("n", [1, 2, 63, 64, 220])
@pytest.mark.parametrize("bits", [5, 7, 9])
def test_equals_integer_twin_for_every_dimension_and_size(d, n, bits):
    rng = np.random.default_rng(1000 * d + n + bits)
    parts = random_parts(rng, n, d, guards=n % 9, weight_frac_bits=bits)
    near, wild = features_near(rng, parts, 60), rng.integers(0, 65536, (40, 6)).astype(np.uint16)
    agree(parts, np.concatenate([near, wild]))


@pytest.mark.parametrize("seed", range(4))
def test_every_corner_of_the_box(seed):
    rng = np.random.default_rng(seed)
    parts = random_parts(rng, 64, weight_frac_bits=5 + seed)
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
        parts.offset[:], parts.gain_q12[:] = offset if gain else 0, gain
        agree(parts, feature)


def one_channel(**more):
    """A model of one channel with s = feature, one vector at 0, weights at both ends."""
    more.setdefault("gain_q12", np.full(1, 4096))
    more.setdefault("bias", np.zeros(2, int))
    more.setdefault("weight", np.array([[32767, -32768]]))
    more.setdefault("weight_frac_bits", 5)
    return Parts(offset=np.zeros(1, int), trend=np.zeros((2, 1), int), centre=np.zeros((1, 1), int), **more)


@pytest.mark.parametrize("centre,s", [(0, 0), (0, 4095), (255, 0), (255, 4095)])
def test_distance_at_both_ends_of_its_range(centre, s):
    parts = Parts(offset=np.zeros(6, int), gain_q12=np.full(6, 4096), bias=np.zeros(2, int),
                  trend=np.zeros((2, 6), int), centre=np.full((3, 6), centre),
                  weight=np.array([[32767, -32768]] * 3))
    agree(parts, np.full((1, 6), s, np.uint16))


def test_every_step_of_the_distance_in_one_channel_and_in_six():
    feature = np.zeros((4096, 6), np.uint16)
    feature[:, 0] = np.arange(4096)
    agree(one_channel(), feature)
    parts = Parts(offset=np.zeros(6, int), gain_q12=np.full(6, 4096), bias=np.zeros(2, int),
                  trend=np.zeros((2, 6), int), centre=np.array([[0] * 6, [255] * 6, [128, 7, 255, 0, 77, 1]]),
                  weight=np.array([[32767, 1], [-32768, -1], [255, 256]]), weight_frac_bits=5)
    agree(parts, np.repeat(feature[:, :1], 6, axis=1))


def test_kernel_is_the_exponential_within_nine_steps_and_ends_in_zero():
    t = np.arange(1 << 21)
    level = LEVEL[np.minimum(t >> 10, 768)]
    k = level - (((level >> 8) * ((t >> 2) & 255)) >> 6)
    error = k - 65536 * np.exp(-t / 65536.0)
    print(f"kernel: {error.min():.2f} to {error.max():.2f} steps of 2^-16")
    assert np.abs(error).max() <= 9 and (k[t >= 12 << 16] == 0).all() and k[0] == 65535


def test_kernel_falls_with_distance_but_for_steps_of_its_own_rounding():
    feature = np.zeros((4096, 6), np.uint16)
    feature[:, 0] = np.arange(4096)
    deg = agree(one_channel(weight_frac_bits=9, weight=np.array([[16383, -16384]])), feature)
    assert (np.diff(deg[:, 0]) <= 1).all() and (np.diff(deg[:, 1]) >= -1).all()
    assert deg[0, 0] == 4095 and deg[-1, 0] == 1


def test_rounds_half_up_at_both_signs():
    for frac in (5, 9):
        half = 1 << (frac + 4)      # of 1/128 deg, in units of the bias
        for bias, expected in ((half, 1), (half - 1, 0), (-half, 0), (-half - 1, -1), (0, 0)):
            parts = one_channel(bias=np.array([bias, -bias]), weight=np.zeros((1, 2), int),
                                weight_frac_bits=frac)
            assert agree(parts, np.zeros((1, 6), np.uint16))[0, 0] == expected


def test_saturates_at_both_ends_and_says_so():
    for bias, expected in ((2 ** 26 - 1, 32767), (-2 ** 26, -32768),
                           (32767 << 10, 32767), (-32768 << 10, -32768)):
        parts = one_channel(bias=np.array([bias, 0]), weight=np.zeros((1, 2), int))
        assert agree(parts, np.zeros((1, 6), np.uint16))[0, 0] == expected


@pytest.mark.parametrize("seed", range(8))
def test_permuting_vectors_is_an_equality(seed):
    rng = np.random.default_rng(seed)
    parts = random_parts(rng, 64, d=1 + seed % 6)
    feature = features_near(rng, parts, 50)
    order = rng.permutation(64)
    shuffled = Parts(parts.offset, parts.gain_q12, parts.bias, parts.trend, parts.centre[order],
                     parts.weight[order], parts.weight_frac_bits, parts.guard, parts.expected, parts.sigma)
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
    deg = View(parts.image()).predict(feature)[0]
    real = real_mean_deg(parts, feature)
    whole = 2.0 ** 24 * 2.0 ** -(parts.weight_frac_bits + 8)
    usable = (np.abs(real) < whole / 2 - 1).all(axis=1)
    assert usable.sum() > 200
    worst = np.abs(deg / 128 - real)[usable].max(axis=0)
    bound = bound_deg(parts)
    print(f"n={n}: worst error {worst.max():.5f} deg, bound {bound.max():.5f} deg")
    assert (worst <= bound).all()


def judged(**more):
    """A model whose gaze is 0 deg everywhere, so that only trust is at work; s = feature."""
    return Parts(offset=np.zeros(6, int), gain_q12=np.full(6, 4096), bias=np.zeros(2, int),
                 trend=np.zeros((2, 6), int), centre=np.zeros((1, 6), int), weight=np.zeros((1, 2), int),
                 **more)


def test_guard_ranges_hold_at_their_limits_and_fail_one_step_beyond():
    row = np.array([1, -1, 20, -30, 0, 3])
    s = np.array([4095, 16, 4095, 0, 7, 4095])
    p = int(row @ (s >> 4))
    for low, high, flagged in ((p, p, False), (p + 1, p + 9, True), (p - 9, p - 1, True),
                               (-2 ** 15, 2 ** 15 - 1, False), (-2 ** 15, -2 ** 15, True),
                               (2 ** 15 - 1, 2 ** 15 - 1, True)):
        parts = judged(guard=[(0, -2 ** 15, 2 ** 15 - 1, np.zeros(6, int)), (0, low, high, row)])
        flags = View(parts.image()).predict(s[None].astype(np.uint16))[1]
        assert flags[0] == (lib.SG_GP_OUT_OF_RANGE if flagged else 0)
        agree(parts, s[None].astype(np.uint16))


@pytest.mark.parametrize("extreme", [[63, 0, 0, 0, 0, 0], [-63, 0, 0, 0, 0, 0], [-10, 11, -10, 11, -10, 11]])
@pytest.mark.parametrize("base", [-14336, 0, 14336])
def test_largest_projections_bases_and_expectations_do_not_wrap(extreme, base):
    guard = [(base, -2 ** 15, 2 ** 15 - 1, np.array(extreme))] * 4
    for value in (0, 255):
        parts = judged(guard=guard, expected=np.full((2, 2, 4), value), sigma=np.full((2, 2), 255),
                       sigma_gain=255)
        agree(parts, np.array(list(itertools.product((0, 4095), repeat=6)), np.uint16))


def test_doubt_at_its_limit_is_trusted_and_one_step_above_is_not():
    guard = [(0, -2 ** 15, 2 ** 15 - 1, np.array([1, 0, 0, 0, 0, 0]))]
    feature = np.array([[10 * 16, 0, 0, 0, 0, 0]], np.uint16)       # r = 10, m = 100
    for limit, flagged in ((100, 0), (99, 4)):
        view = View(judged(guard=guard, limit=limit, sigma=np.full((2, 2), 77)).image())
        _, flags, _, doubt, sigma = view.predict(feature)
        assert (flags[0], doubt[0], sigma[0]) == (flagged, 100, 255 if flagged else 77)


def test_every_place_of_the_grid_and_far_beyond_it():
    rng = np.random.default_rng(5)
    guard = [(0, -2 ** 15, 2 ** 15 - 1, np.array([3, 0, 0, 0, 0, 0]))]
    for nodes, scale, origin in (((2, 2), (1, 255), (-14000, 16384)), ((24, 3), (255, 20), (-16384, -900)),
                                 ((5, 7), (64, 64), (-1280, -1536))):
        parts = judged(guard=guard, expected=rng.integers(0, 256, (*nodes, 1)),
                       sigma=rng.integers(0, 256, nodes), origin=origin, scale=scale, limit=20000,
                       sigma_gain=9)
        parts.trend = np.array([[3000, 0, 0, 0, 0, 0], [0, 3000, 0, 0, 0, 0]])
        parts.bias = np.array([-6000 * 1024, -6000 * 1024])
        parts.weight_frac_bits = 5
        s = np.linspace(0, 4095, 60).astype(int)
        feature = np.zeros((3600, 6), np.uint16)
        feature[:, :2] = np.array(list(itertools.product(s, s)))
        deg = agree(parts, feature)
        assert np.ptp(deg[:, 0]) > 2000


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
    guards are tight enough that ranges and doubt decide about some each."""
    draws = FrozenDraws(20)
    parts = random_parts(draws, 64)
    parts.guard = [(base, low // 2, high // 2, row) for base, low, high, row in parts.guard]
    parts.limit = 40000
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
    agree(*golden_case())
    crc = golden_crc()
    print(f"golden CRC-32 over 64 predictions: {crc:08x}")
    assert crc == GOLDEN_CRC


def test_golden_case_exercises_ranges_doubt_and_every_size_of_kernel():
    parts, feature = golden_case()
    s, clamped = scaled(parts, feature)
    p = (s >> 4) @ np.array([row for *_, row in parts.guard]).T
    low, high = (np.array([guard[i] for guard in parts.guard]) for i in (1, 2))
    broken = ((p < low) | (p > high)).any(axis=1)
    doubtful = twin(parts, feature)[2] > parts.limit
    good = ~clamped & ~broken & ~doubtful
    assert (broken & ~clamped).any() and (doubtful & ~broken & ~clamped).any() and good.any()
    t = (((s * s).sum(axis=1) + 31) >> 5)[:, None] + 256 * parts.half_c2 - s @ parts.centre.T
    assert (t < 2048).any() and (t >= 12 << 16).any() and len(np.unique(t[t < 12 << 16] >> 16)) == 12
