# SPDX-License-Identifier: Apache-2.0
"""sg_model: what it opens, and everything it must refuse."""
import binascii

import numpy as np
import pytest

from core_models import View, random_parts, seal
from sparsegaze._core import ffi, lib

HEAD = {name: field.offset for name, field in ffi.typeof("struct sg_model_head").fields}
TRUST = {name: 128 + field.offset for name, field in ffi.typeof("struct sg_model_trust").fields}
GUARD = {name: field.offset for name, field in ffi.typeof("struct sg_model_guard").fields}
GRID = 5 * 5 * 4    # bytes of random_parts' grid


def image(n=3, d=6, seed=0, **more):
    return random_parts(np.random.default_rng(seed), n, d, **more).image()


def verdict(data, room=None):
    """sg_model_open over a buffer of exactly the bytes given."""
    buffer = ffi.new(f"uint8_t[{max(len(data), 1)}]", bytes(data))
    view = ffi.new("struct sg_model_view *")
    view.vectors = 99
    result = lib.sg_model_open(view, buffer, len(data) if room is None else room, 0)
    assert (view.vectors == 99) == (result != 0)        # the view is written only on success
    return result


def changed(data, at, *values):
    """The image with bytes replaced and the CRC made to fit again."""
    data = bytearray(data)
    data[at:at + len(values)] = bytes(values)
    return seal(bytes(data))


def test_crc32_check_value_and_binascii_in_pieces():
    assert lib.sg_model_crc32(0, b"123456789", 9) == 0xCBF43926
    data = bytes((i * 91) & 255 for i in range(700))
    for cut in (0, 1, 350, 699, 700):
        crc = lib.sg_model_crc32(lib.sg_model_crc32(0, data[:cut], cut), data[cut:], 700 - cut)
        assert crc == binascii.crc32(data) == lib.sg_model_crc32_at(0, data, 700, 0)


@pytest.mark.parametrize("d", range(1, 7))
@pytest.mark.parametrize("n", [1, 64, 226])
@pytest.mark.parametrize("guards", [0, 3, 4])
def test_opens_and_describes_what_was_stored(n, d, guards):
    data = image(n, d, guards=guards, weight_frac_bits=7, generation=0xFFFFFFFE)
    view = View(data)
    assert view.verdict == lib.SG_OK
    v = view.view
    assert (v.vectors, v.channels, v.records, v.weight_frac_bits) == (n, d, 256 + GRID, 7)
    assert (v.generation, v.length, v.crc) == (0xFFFFFFFE, len(data), binascii.crc32(data[8:]))
    assert v.image == view.bytes
    assert lib.sg_model_length(view.bytes, len(data), 0) == len(data)


def test_more_room_than_the_image_is_fine_and_its_content_does_not_matter():
    data = image()
    assert verdict(data + b"\xff" * (3072 - len(data))) == verdict(data + bytes(7)) == lib.SG_OK


def test_every_single_bit_flip_of_a_small_model_is_refused():
    data = image(n=2, d=5, guards=2)
    refused = set()
    for bit in range(8 * len(data)):
        bad = bytearray(data)
        bad[bit // 8] ^= 1 << bit % 8
        result = verdict(bad)
        assert result < 0, bit
        refused.add(result)
    assert {lib.SG_E_MAGIC, lib.SG_E_VERSION, lib.SG_E_BOUNDS, lib.SG_E_CRC} <= refused


def test_every_truncation_is_refused_as_short():
    data = image(n=4)
    for n in range(len(data)):
        assert verdict(data[:n]) == lib.SG_E_SHORT, n


@pytest.mark.parametrize("fill", [b"\0", b"\xff", b"\xa5"])
def test_erased_and_blank_slots_are_no_model(fill):
    assert verdict(fill * 3072) == lib.SG_E_MAGIC
    assert verdict(b"") == lib.SG_E_SHORT


@pytest.mark.parametrize("version", [0, 1, 3, 0x0100, 0xFFFF])
def test_another_format_version_is_named_before_its_fields_are_judged(version):
    bad = changed(image(), HEAD["version"], version & 255, version >> 8, 250, 99)
    assert verdict(bad) == lib.SG_E_VERSION


@pytest.mark.parametrize("vectors", [0, 2, 4, 234, 255])
def test_a_vector_count_that_does_not_fit_the_length_is_refused(vectors):
    assert verdict(changed(image(n=3), HEAD["vectors"], vectors)) == lib.SG_E_BOUNDS


def test_a_model_longer_than_a_slot_is_refused_although_the_room_would_do():
    data = bytearray(image(n=226)) + bytes(12)
    assert verdict(bytes(data)) == lib.SG_OK
    data[HEAD["vectors"]] = 227
    data[HEAD["length"]:HEAD["length"] + 4] = len(data).to_bytes(4, "little")
    assert len(data) > 3072 and verdict(seal(bytes(data))) == lib.SG_E_BOUNDS


@pytest.mark.parametrize("length", [0, 255, 256, 0x10000 + 295, 0xFFFFFFFF])
def test_a_length_that_does_not_fit_the_vectors_is_refused(length):
    assert verdict(changed(image(n=3), HEAD["length"], *length.to_bytes(4, "little"))) == lib.SG_E_BOUNDS


@pytest.mark.parametrize("name,values", [
    ("channels", (0, 7, 255)), ("kernel", (1, 255)), ("weight_frac_bits", (0, 4, 10, 255)),
    ("pad", (1, 128))])
def test_a_head_field_outside_its_range_is_refused_under_a_good_crc(name, values):
    for value in values:
        assert verdict(changed(image(), HEAD[name], value)) == lib.SG_E_BOUNDS, value


@pytest.mark.parametrize("name,values", [
    ("guards", (5, 255)), ("scale", (0,)), ("nodes", (0, 1, 25, 255)), ("pad", (1, 128))])
def test_a_trust_field_outside_its_range_is_refused_under_a_good_crc(name, values):
    for value in values:
        assert verdict(changed(image(), TRUST[name], value)) == lib.SG_E_BOUNDS, value


def test_biases_origins_bases_and_rows_hold_at_their_limits_and_fail_one_step_beyond():
    data = image(guards=1)
    for at, size, limit in ((HEAD["bias"], 4, 1 << 30), (HEAD["bias"] + 4, 4, 1 << 30),
                            (TRUST["origin_deg_q7"], 2, 1 << 14), (TRUST["origin_deg_q7"] + 2, 2, 1 << 14),
                            (128 + GUARD["base"], 2, 14336)):
        for sign in (1, -1):
            for value, expected in ((limit, lib.SG_OK), (limit + 1, lib.SG_E_BOUNDS)):
                raw = (sign * value).to_bytes(size, "little", signed=True)
                assert verdict(changed(data, at, *raw)) == expected, (at, sign * value)
    for row, expected in (([63, 0, 0, 0, 0, 0], lib.SG_OK), ([0, 0, -63, 0, 0, 0], lib.SG_OK),
                          ([64, 0, 0, 0, 0, 0], lib.SG_E_BOUNDS),
                          ([-11, 11, -11, 11, -11, 9], lib.SG_E_BOUNDS),
                          ([-128] * 6, lib.SG_E_BOUNDS)):
        assert verdict(changed(data, 128 + GUARD["row"], *[v & 255 for v in row])) == expected, row


def test_every_pad_byte_unused_guard_and_expectation_must_be_zero():
    data = image(guards=2)
    for at in [*range(HEAD["pad"], 128), *range(128 + 2 * 12, 128 + 4 * 12), *range(TRUST["pad"], 256)]:
        assert verdict(changed(data, at, 1)) == lib.SG_E_BOUNDS, at
    for node in range(20):
        for at in (2, 3):       # expectations of guards that are not in use
            assert verdict(changed(data, 256 + 5 * node + at, 1)) == lib.SG_E_BOUNDS


def test_an_offset_without_gain_is_refused():
    data = changed(image(), HEAD["gain_q12"], 0, 0)
    assert verdict(data) == lib.SG_E_BOUNDS
    assert verdict(changed(data, HEAD["offset"], 0, 0)) == lib.SG_OK


@pytest.mark.parametrize("d", range(1, 6))
def test_every_byte_of_an_unused_channel_must_be_zero(d):
    data = image(n=2, d=d, guards=1)
    places = []
    for j in range(d, 6):
        places += [HEAD["offset"] + 2 * j, HEAD["gain_q12"] + 2 * j + 1, HEAD["trend"] + 2 * j,
                   HEAD["trend"] + 12 + 2 * j + 1, 128 + GUARD["row"] + j, 256 + GRID + 2 + j,
                   256 + GRID + 12 + 2 + j]
    for at in places:
        assert verdict(changed(data, at, 1)) == lib.SG_E_BOUNDS, at


def test_fewer_channels_than_the_image_uses_are_refused():
    for d in range(1, 6):
        assert verdict(changed(image(d=6), HEAD["channels"], d)) == lib.SG_E_BOUNDS


def test_more_channels_than_the_image_uses_are_only_silent_ones():
    data = changed(image(d=4), HEAD["channels"], 6)
    assert verdict(data) == lib.SG_OK


def test_guard_limits_are_compared_as_signed():
    data = image(guards=1)

    def with_limits(low, high):
        limits = low.to_bytes(2, "little", signed=True) + high.to_bytes(2, "little", signed=True)
        return changed(data, 128 + GUARD["low"], *limits)

    for low, high in ((-1, 0), (-2 ** 15, 2 ** 15 - 1), (5, 5), (-6, -5)):
        assert verdict(with_limits(low, high)) == lib.SG_OK
    for low, high in ((0, -1), (2 ** 15 - 1, -2 ** 15), (6, 5), (-5, -6)):
        assert verdict(with_limits(low, high)) == lib.SG_E_BOUNDS


def test_a_half_c2_that_is_not_its_centres_is_refused_in_any_record():
    data = image(n=3)
    for i in range(3):
        at = 256 + GRID + 12 * i
        half = int.from_bytes(data[at:at + 2], "little")
        for wrong in (half - 1, half + 1, 0, 0xFFFF):
            assert verdict(changed(data, at, *wrong.to_bytes(2, "little"))) == lib.SG_E_BOUNDS


def test_a_crc_made_in_pieces_opens_the_same_and_a_wrong_one_does_not():
    view = View(image())
    crc = lib.sg_model_crc32_at(0, view.bytes + 8, 100, 0)
    crc = lib.sg_model_crc32_at(crc, view.bytes + 108, view.view.length - 108, 0)
    again = ffi.new("struct sg_model_view *")
    assert lib.sg_model_open_checked(again, view.bytes, view.view.length, 0, crc, 0) == lib.SG_OK
    assert bytes(ffi.buffer(again)) == bytes(ffi.buffer(view.view))
    assert lib.sg_model_open_checked(again, view.bytes, view.view.length, 0, crc ^ 1, 0) == lib.SG_E_CRC
