# SPDX-License-Identifier: Apache-2.0
"""COBS and CRC-16 of sg_wire: known vectors, every length, hostile bytes."""
import binascii

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparsegaze._core import ffi, lib

BODIES = {
    "all zeros": lambda n: bytes(n), "no zero": lambda n: bytes(1 + i % 255 for i in range(n)),
    "ends in zero": lambda n: (b"\x07" * n)[:-1] + b"\0" * (n > 0),
    "starts with zero": lambda n: b"\0" * (n > 0) + b"\xff" * (n - 1),
    "alternating": lambda n: bytes(i & 1 for i in range(n)), "all 0xff": lambda n: b"\xff" * n,
}


def encode(body, seq=0x0102, kind=0x41, flags=0):
    head, out = ffi.new("struct sg_head *", [seq, kind, flags]), ffi.new("uint8_t[80]", b"\xAA" * 80)
    n = lib.sg_wire_encode(head, body, len(body), out)
    if n < 0:
        return n
    assert bytes(ffi.buffer(out))[n:] == b"\xAA" * (80 - n)
    return bytes(ffi.buffer(out, n))


def decode(frame):
    """(body, seq, type, flags), or the error."""
    head, body = ffi.new("struct sg_head *"), ffi.new("uint8_t[64]")
    n = lib.sg_wire_decode(ffi.new("uint8_t[]", frame), len(frame), head, body)
    return n if n < 0 else (bytes(ffi.buffer(body, n)), head.seq, head.type, head.flags)


def stuffed(packet):
    """COBS by its definition: split at zeros, prefix each piece with its length + 1."""
    return b"".join(bytes([len(piece) + 1]) + piece for piece in packet.split(b"\0"))


def test_crc16_check_value_and_binascii():
    assert lib.sg_wire_crc16(0xFFFF, b"123456789", 9) == 0x29B1
    assert lib.sg_wire_crc16(0xFFFF, b"", 0) == 0xFFFF
    for n in range(0, 300, 7):
        data = bytes((i * 37 + n) & 255 for i in range(n))
        assert lib.sg_wire_crc16(0xFFFF, data, n) == binascii.crc_hqx(data, 0xFFFF)
        half = lib.sg_wire_crc16(0xFFFF, data[:n // 2], n // 2)
        assert lib.sg_wire_crc16(half, data[n // 2:], n - n // 2) == binascii.crc_hqx(data, 0xFFFF)


@pytest.mark.parametrize("kind", BODIES)
def test_round_trip_for_every_length(kind):
    for n in range(lib.SG_WIRE_BODY_MAX + 1):
        body = BODIES[kind](n)
        assert len(body) == n
        frame = encode(body, seq=n << 8, kind=0, flags=0)
        assert frame[-1] == 0 and 0 not in frame[:-1] and len(frame) == n + 8 <= lib.SG_WIRE_FRAME_MAX
        assert decode(frame[:-1]) == (body, n << 8, 0, 0)


def test_bytes_on_the_wire_are_cobs_of_head_body_crc():
    for body in (b"", b"\0", b"\x01\0\x02", bytes(64), bytes(range(64))):
        packet = b"\x02\x01\x41\x00" + body
        packet += binascii.crc_hqx(packet, 0xFFFF).to_bytes(2, "little")
        assert encode(body) == stuffed(packet) + b"\0"


def test_encode_refuses_a_body_of_65_bytes_and_writes_nothing_beyond_72():
    assert encode(bytes(65)) == lib.SG_E_BOUNDS
    head, out = ffi.new("struct sg_head *"), ffi.new("uint8_t[80]", b"\xAA" * 80)
    assert lib.sg_wire_encode(head, b"\xff" * 64, 64, out) == 72
    assert bytes(out)[72:] == b"\xAA" * 8


@pytest.mark.parametrize("kind", BODIES)
def test_a_packet_in_a_ring_is_the_same_bytes_wherever_it_begins(kind):
    for n in (0, 1, 12, 64):
        body, head = BODIES[kind](n), ffi.new("struct sg_head *", [0x0102, 0x41, 0])
        for at in range(80):
            ring = ffi.new("uint8_t[90]", b"\xAA" * 90)
            end = lib.sg_wire_encode_ring(head, body, n, ring, 80, at)
            assert end == (at + n + 8) % 80 and bytes(ring)[80:] == b"\xAA" * 10
            turned = bytes(ring)[at:80] + bytes(ring)[:at]
            assert turned == encode(body) + b"\xAA" * (80 - n - 8)


@given(st.binary(max_size=64), st.integers(0, 65535), st.integers(0, 255), st.integers(0, 255))
@settings(max_examples=300, deadline=None)
def test_round_trip_of_any_packet(body, seq, kind, flags):
    assert decode(encode(body, seq, kind, flags)[:-1]) == (body, seq, kind, flags)


@given(st.binary(max_size=100))
@settings(max_examples=500, deadline=None)
def test_any_bytes_decode_to_an_error_or_to_what_encodes_back(frame):
    got = decode(frame)
    if isinstance(got, int):
        assert got in (lib.SG_E_SHORT, lib.SG_E_BOUNDS, lib.SG_E_CRC)
    else:
        assert encode(*got)[:-1] == frame


def test_wrong_frames_and_their_errors():
    good = encode(b"hello")[:-1]
    assert decode(b"") == lib.SG_E_SHORT
    assert decode(good[:-1]) == lib.SG_E_SHORT
    assert decode(b"\0" + good) == lib.SG_E_BOUNDS
    assert decode(good + b"\0") == lib.SG_E_BOUNDS
    assert decode(stuffed(bytes(5))) == lib.SG_E_SHORT                      # shorter than head and CRC
    packet = b"\x01\x01\x01\x01" + bytes(65)
    packet += binascii.crc_hqx(packet, 0xFFFF).to_bytes(2, "little")
    assert decode(stuffed(packet)) == lib.SG_E_BOUNDS                       # a perfect frame of 71 bytes
    assert decode(b"\xff" + b"\x01" * 254) == lib.SG_E_BOUNDS
    assert decode(good[:-1] + bytes([good[-1] ^ 0x10])) == lib.SG_E_CRC


def test_a_failed_decode_leaves_head_and_body_alone():
    frame = bytearray(encode(b"hello")[:-1])
    frame[-1] ^= 1
    head, body = ffi.new("struct sg_head *", [7, 7, 7]), ffi.new("uint8_t[64]", b"\x55" * 64)
    assert lib.sg_wire_decode(ffi.new("uint8_t[]", bytes(frame)), len(frame), head, body) == lib.SG_E_CRC
    assert (head.seq, head.type, head.flags) == (7, 7, 7) and bytes(body) == b"\x55" * 64


def test_every_single_bit_flip_is_refused():
    for body in (b"", bytes(12), bytes(range(28)), bytes(64)):
        frame = encode(body)[:-1]
        for bit in range(8 * len(frame)):
            bad = bytearray(frame)
            bad[bit // 8] ^= 1 << bit % 8
            assert isinstance(decode(bytes(bad)), int), bit
