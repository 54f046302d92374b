# SPDX-License-Identifier: Apache-2.0
"""sg_link: a byte stream with every single fault is back in step within one frame."""
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparsegaze._core import ffi, lib
from test_core_wire import encode

MESSAGES = [b"", b"\0" * 12, bytes(range(28)), b"\xff" * 64, b"\x01"]


def receive(stream, rx=None):
    """[(seq, body)] and the receiver after a stream, byte by byte."""
    rx = rx or ffi.new("struct sg_link_rx *")
    head, body = ffi.new("struct sg_head *"), ffi.new("uint8_t[64]")
    got, dropped = [], 0
    for byte in stream:
        n = lib.sg_link_receive(rx, byte, head, body)
        if n >= 0:
            got.append((head.seq, bytes(ffi.buffer(body, n))))
        elif n != lib.SG_E_BUSY:
            dropped += 1
    assert rx.bad_crc + rx.bad_length == dropped
    return got, rx


def train():
    """Five frames with different lengths and zero patterns, and what a receiver should make of them."""
    return [encode(body, seq) for seq, body in enumerate(MESSAGES)], list(enumerate(MESSAGES))


def test_clean_stream_counts_nothing():
    frames, expected = train()
    got, rx = receive(b"".join(frames))
    assert got == expected and rx.bad_crc == rx.bad_length == 0


def check_fault(frames, expected, hit, stream):
    """All but the hit frame and at most one neighbour arrive, in order, and nothing wrong does."""
    got, _ = receive(stream)
    assert all(item in expected for item in got), got
    assert got == sorted(got, key=lambda item: item[0])
    before, after = expected[:hit], expected[hit + 2:]
    assert [g for g in got if g in before] == before
    assert [g for g in got if g in after] == after
    return got


@pytest.mark.parametrize("hit", range(len(MESSAGES) - 1))
def test_dropping_any_byte_ends_resynchronised_within_one_frame(hit):
    frames, expected = train()
    for at in range(len(frames[hit])):
        bad = frames[hit][:at] + frames[hit][at + 1:]
        got = check_fault(frames, expected, hit, b"".join(frames[:hit] + [bad] + frames[hit + 1:]))
        if at < len(frames[hit]) - 1:      # the delimiter survived: the neighbour must too
            assert got == expected[:hit] + expected[hit + 1:]


@pytest.mark.parametrize("hit", range(len(MESSAGES) - 1))
def test_flipping_any_bit_ends_resynchronised_within_one_frame(hit):
    frames, expected = train()
    for bit in range(8 * len(frames[hit])):
        bad = bytearray(frames[hit])
        bad[bit // 8] ^= 1 << bit % 8
        got = check_fault(frames, expected, hit, b"".join(frames[:hit] + [bytes(bad)] + frames[hit + 1:]))
        assert expected[hit] not in got


@pytest.mark.parametrize("hit", range(len(MESSAGES) - 1))
def test_duplicating_any_byte_costs_at_most_that_frame(hit):
    frames, expected = train()
    for at in range(len(frames[hit])):
        bad = frames[hit][:at + 1] + frames[hit][at:]
        got = check_fault(frames, expected, hit, b"".join(frames[:hit] + [bad] + frames[hit + 1:]))
        if at == len(frames[hit]) - 1:     # a second delimiter is an empty frame, not an error
            assert got == expected
        else:
            assert got == expected[:hit] + expected[hit + 1:]


@pytest.mark.parametrize("hit", range(len(MESSAGES) - 1))
def test_inserting_any_byte_value_costs_at_most_that_frame(hit):
    frames, expected = train()
    for at in range(len(frames[hit])):
        for value in (0, 1, 2, 0x41, 0xFF):
            bad = frames[hit][:at] + bytes([value]) + frames[hit][at:]
            got, _ = receive(b"".join(frames[:hit] + [bad] + frames[hit + 1:]))
            assert [g for g in got if g[0] != hit] == expected[:hit] + expected[hit + 1:]
            assert all(item in expected for item in got)


@pytest.mark.parametrize("length", [71, 72, 73, 255, 256, 257, 5000])
def test_a_run_without_delimiter_of_any_length_is_one_bad_frame(length):
    frames, expected = train()
    got, rx = receive(b"\x01" * length + b"\0" + b"".join(frames))
    assert got == expected and rx.bad_length + rx.bad_crc == 1


def test_joining_mid_frame_loses_that_frame_only():
    frames, expected = train()
    for cut in range(1, len(frames[2])):
        got, _ = receive(frames[2][cut:] + frames[3] + frames[4])
        assert got == expected[3:]


def test_counters_stop_at_65535():
    rx = ffi.new("struct sg_link_rx *")
    rx.bad_length = rx.bad_crc = 65534
    head, body = ffi.new("struct sg_head *"), ffi.new("uint8_t[64]")
    for _ in range(3):
        lib.sg_link_receive(rx, 5, head, body)
        assert lib.sg_link_receive(rx, 0, head, body) == lib.SG_E_SHORT
    assert (rx.bad_length, rx.bad_crc) == (65535, 65534)


@given(st.lists(st.binary(max_size=90), max_size=8), st.binary(max_size=64))
@settings(max_examples=200, deadline=None)
def test_whatever_came_before_one_delimiter_later_a_frame_arrives(noise, body):
    _, rx = receive(b"\0".join(noise))
    before = rx.bad_crc + rx.bad_length
    got, rx = receive_quietly(b"\0" + encode(body, 77), rx)
    assert got[-1] == (77, body)
    assert rx.bad_crc + rx.bad_length <= before + 1


def receive_quietly(stream, rx):
    """As receive, without the check of its counters."""
    head, body, used = ffi.new("struct sg_head *"), ffi.new("uint8_t[64]"), ffi.new("size_t *")
    got = []
    while stream:
        n = lib.sg_link_feed(rx, stream, len(stream), used, head, body)
        assert 0 < used[0] <= len(stream)
        assert n != lib.SG_E_BUSY or used[0] == len(stream)
        if n >= 0:
            got.append((head.seq, bytes(ffi.buffer(body, n))))
        stream = stream[used[0]:]
    return got, rx


def test_feeding_chunks_equals_feeding_bytes():
    frames, expected = train()
    stream = b"".join(frames[:2]) + b"\x09\x09\0" + b"".join(frames[2:])
    for size in (1, 2, 3, 7, 50, len(stream)):
        rx, got = ffi.new("struct sg_link_rx *"), []
        for at in range(0, len(stream), size):
            got += receive_quietly(stream[at:at + size], rx)[0]
        assert got == expected and rx.bad_length == 1
