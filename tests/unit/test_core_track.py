# SPDX-License-Identifier: Apache-2.0
"""sg_track: the frame that leaves the pipeline, and when it may be called valid."""
import itertools

import numpy as np
import pytest

from core_models import Parts, View, features_near, random_parts, scaled, twin
from sparsegaze._core import ffi, lib

RAW_FLAGS = (lib.SG_FLAG_SATURATED, lib.SG_FLAG_STARVED, lib.SG_FLAG_EXPOSURE, lib.SG_FLAG_FAULT,
             lib.SG_FLAG_RECOVERING)
BAD_FLAGS = (lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED | lib.SG_FLAG_EXPOSURE | lib.SG_FLAG_FAULT |
             lib.SG_FLAG_RECOVERING)


def plain(bias_deg_q7=(0, 0)):
    """One vector of weight 0: the gaze is the bias."""
    return Parts(offset=np.full(6, 100), gain_q12=np.full(6, 4096), bias=np.array(bias_deg_q7) << 10,
                 trend=np.zeros((2, 6), int), centre=np.zeros((1, 6), int), weight=np.zeros((1, 2), int),
                 weight_frac_bits=5, sigma=np.full((2, 2), 120))


def infer(view, feature, raw_flags=0, recentre=(0, 0), gain=(0, 0, 0, 0)):
    out, affine = ffi.new("struct sg_gaze *"), ffi.new("struct sg_affine *", (list(recentre), list(gain)))
    ffi.memmove(out, b"\xAA" * 12, 12)
    result = lib.sg_track_infer(view, [int(x) for x in feature], raw_flags, affine, out)
    assert out.t_us == out.infer_us == 0    # nothing of the old frame is left
    if view == ffi.NULL:
        assert out.sigma_log2_q4 == 0
    elif out.flags & lib.SG_FLAG_OUT_OF_RANGE:
        assert out.sigma_log2_q4 == 255
    return result, (out.azimuth_deg_q7, out.elevation_deg_q7), out.flags


def test_no_model_is_zero_with_its_flag_and_never_valid():
    for raw in range(256):
        result, gaze, flags = infer(ffi.NULL, [65535] * 6, raw, (30000, -30000))
        assert (result, gaze) == (lib.SG_OK, (0, 0))
        assert flags == lib.SG_FLAG_NO_MODEL | (raw & sum(RAW_FLAGS))


@pytest.mark.parametrize("inside", [True, False])
def test_valid_for_exactly_the_right_flags(inside):
    view = View(plain((128, -256)).image())
    feature = [200] * 6 if inside else [99] + [200] * 5
    for chosen in itertools.product((0, 1), repeat=5):
        raw = sum(flag for flag, on in zip(RAW_FLAGS, chosen) if on)
        result, gaze, flags = infer(view.view, feature, raw | lib.SG_FLAG_VALID | lib.SG_FLAG_NO_MODEL)
        good = inside and not raw & BAD_FLAGS
        expected = raw | (lib.SG_FLAG_VALID if good else 0) | (0 if inside else lib.SG_FLAG_OUT_OF_RANGE)
        assert (result, gaze, flags) == (lib.SG_OK, (128, -256), expected)


@pytest.mark.parametrize("bias,recentre,sums,saturates", [
    ((1000, -1000), (24, 26), (1024, -974), False), ((32000, 0), (767, 0), (32767, 0), False),
    ((32000, 0), (768, 5), (32767, 5), True), ((0, -32000), (0, -768), (0, -32768), False),
    ((0, -32000), (3, -769), (3, -32768), True), ((32767, -32768), (32767, -32768), (32767, -32768), True)])
def test_recentre_adds_and_saturates_without_wrapping(bias, recentre, sums, saturates):
    result, gaze, flags = infer(View(plain(bias).image()).view, [200] * 6, 0, recentre)
    assert gaze == sums and result == (lib.SG_E_RANGE if saturates else lib.SG_OK)
    assert flags == (lib.SG_FLAG_OUT_OF_RANGE if saturates else lib.SG_FLAG_VALID)


@pytest.mark.parametrize(
    "gaze", [(0, 0), (1, -1), (2560, -2560), (32767, -32768), (-32768, -32768), (-3, 255)])
def test_gain_is_rounded_half_up_from_exact_integers_and_saturates(gaze):
    rng = np.random.default_rng(8)
    view = View(plain(gaze).image()).view
    corners = list(itertools.product((-128, 127), repeat=4))
    others = rng.integers(-128, 128, (200, 4)).tolist()
    for gain in [(0, 0, 0, 0), (1, 0, 0, -1), (0, 1, 1, 0), *corners, *others]:
        offset = rng.integers(-32768, 32768, 2).tolist() if gain[0] % 3 == 0 else [0, 0]
        exact = [gaze[i] + offset[i] + (gain[2 * i] * gaze[0] + gain[2 * i + 1] * gaze[1] + 256) // 512
                 for i in range(2)]
        expected = tuple(min(max(value, -32768), 32767) for value in exact)
        result, found, flags = infer(view, [200] * 6, 0, offset, gain)
        assert found == expected, (gain, offset)
        assert (result == lib.SG_E_RANGE) == (list(expected) != exact) == (flags == lib.SG_FLAG_OUT_OF_RANGE)


def test_batch_equals_single_frames_and_the_twin():
    rng = np.random.default_rng(5)
    parts = random_parts(rng, 40, guards=1)
    feature = features_near(rng, parts, 200)
    raw = rng.choice([0, 8, 16, 32, 64, 128], 200).astype(np.uint8)
    view, out = View(parts.image()), ffi.new("struct sg_gaze[200]")
    recentre = ffi.new("struct sg_affine *", ([100, -50], [0] * 4))
    lib.sg_batch_infer(view.view, ffi.from_buffer("uint16_t[]", feature), ffi.from_buffer("uint8_t[]", raw),
                       recentre, out, 200)
    deg, outside, _, sigma = twin(parts, feature)
    assert not scaled(parts, feature)[1].all()
    for i in range(200):
        single = infer(view.view, feature[i], int(raw[i]), (100, -50))
        assert single[1:] == ((out[i].azimuth_deg_q7, out[i].elevation_deg_q7), out[i].flags)
        assert out[i].sigma_log2_q4 == (255 if out[i].flags & lib.SG_FLAG_OUT_OF_RANGE else sigma[i])
        expected = np.clip(np.clip(deg[i], -32768, 32767) + [100, -50], -32768, 32767)
        assert list(single[1]) == list(expected)
        assert bool(single[2] & lib.SG_FLAG_VALID) == (
            not outside[i] and not raw[i] & BAD_FLAGS and single[0] == lib.SG_OK)


def test_the_calibrated_range_is_what_the_model_says_channel_by_channel():
    rng = np.random.default_rng(6)
    parts = random_parts(rng, 10, guards=1)
    view, sight = View(parts.image()), ffi.new("struct sg_health_sight *")
    for channel in range(6):
        lib.sg_track_range(view.view, channel, sight)
        assert (sight.offset, sight.gain_q12) == (parts.offset[channel], parts.gain_q12[channel])
    lib.sg_track_range(ffi.NULL, 3, sight)
    assert (sight.offset, sight.gain_q12) == (0, 0)
