# SPDX-License-Identifier: Apache-2.0
"""Every request of the wire against the firmware in a virtual Nano, and everything that is not a request."""

import random

import pytest

from conftest import exchange, random_model
from sparsegaze import wire
from sparsegaze.device import Device
from sparsegaze.wire import lib

SHORTEST = {                        # request: bytes of its struct
    lib.SG_MSG_HELLO: 0, lib.SG_MSG_STATUS: 0, lib.SG_MSG_MODEL_INFO: 0,
    lib.SG_MSG_PING: 4, lib.SG_MSG_MODE: 1, lib.SG_MSG_TRIAL_USE: 1, lib.SG_MSG_REBOOT: 1, lib.SG_MSG_BAUD: 1,
    lib.SG_MSG_INFER: 12, lib.SG_MSG_MODEL_READ: 4, lib.SG_MSG_MODEL_VERIFY: 4, lib.SG_MSG_TRIAL_WRITE: 4,
    lib.SG_MSG_EXPOSURE: 14, lib.SG_MSG_RECENTRE: 10, lib.SG_MSG_SETTINGS: 14, lib.SG_MSG_CURVE: 8,
    lib.SG_MSG_PROBE: 1,
}
HARMLESS = {                        # bodies that change nothing but are legal
    lib.SG_MSG_PING: b"abcd", lib.SG_MSG_MODE: b"\0", lib.SG_MSG_TRIAL_USE: b"\0", lib.SG_MSG_BAUD: b"\0",
    lib.SG_MSG_INFER: bytes(12), lib.SG_MSG_MODEL_READ: b"\0\0\0\1", lib.SG_MSG_MODEL_VERIFY: bytes(4),
    lib.SG_MSG_TRIAL_WRITE: b"\0\0\2\1x", lib.SG_MSG_EXPOSURE: bytes(14), lib.SG_MSG_RECENTRE: bytes(10),
    lib.SG_MSG_SETTINGS: bytes(14), lib.SG_MSG_CURVE: bytes(8), lib.SG_MSG_PROBE: b"\0",
}


def refusals(packets):
    return [wire.parse_error(packet.body) for packet in packets if packet.type == lib.SG_MSG_ERROR]


def test_hello_says_what_the_board_is(board):
    _, device = board()
    hello = device.hello
    assert (hello.wire_version, hello.model_version) == (lib.SG_WIRE_VERSION, lib.SG_MODEL_VERSION)
    assert hello.board == lib.SG_BOARD_NANO328P and hello.channels == 6 and hello.cpu_hz == 16_000_000
    assert hello.slot_base == (0x6C00, 0x7200) and hello.slot_bytes == 1536
    assert hello.page_bytes == 128 and hello.frame_period_us == 999
    assert hello.trial_bytes == 0
    assert 0 < hello.exposure_min_us < hello.exposure_max_us <= 326


def test_ping_stamps_arrival_before_answer_in_device_time(board):
    _, device = board()
    first, second = device.ping(), None
    device.link.sleep(0.5)
    second = device.ping()
    assert first.rx_us <= first.tx_us < first.rx_us + 5000
    assert 500_000 <= second.rx_us - first.rx_us < 510_000


def test_status_of_a_fresh_board_counts_nothing_bad(board):
    _, device = board()
    device.link.sleep(0.2)
    status = device.status()
    assert status.frames > 50 and status.boot_count == 1
    assert (status.late_frames, status.late_slots, status.tx_dropped, status.rx_overrun) == (0, 0, 0, 0)
    assert status.rx_bad == 0 and status.rx_rejected == 0
    assert status.active == lib.SG_SLOT_NONE and status.exposure_auto == 1 and status.stream == 0


@pytest.mark.parametrize("kind", sorted(SHORTEST), ids=lambda kind: f"{kind:02x}")
def test_truncated_body_is_refused_and_answered_once(board, kind):
    _, device = board()
    whole = SHORTEST[kind]
    for n in {0, whole - 1} - {-1, whole}:
        packets = exchange(device, wire.encode(kind, 77, bytes(n)))
        assert [(p.type, p.seq) for p in packets] == [(lib.SG_MSG_ERROR, 77)]
        assert refusals(packets) == [(lib.SG_E_SHORT, kind)]
    assert device.status().rx_rejected == len({0, whole - 1} - {-1, whole})


@pytest.mark.parametrize("kind", sorted(set(SHORTEST) - {lib.SG_MSG_REBOOT}), ids=lambda kind: f"{kind:02x}")
def test_longer_body_is_accepted_and_its_excess_ignored(board, kind):
    _, device = board()
    body = HARMLESS.get(kind, b"")
    short = exchange(device, wire.encode(kind, 5, body))
    long = exchange(device, wire.encode(kind, 5, body + b"\xaa" * (64 - len(body))))
    assert [p.type for p in long] == [p.type for p in short] and len(long) == 1
    assert len(long[0].body) == len(short[0].body)


@pytest.mark.parametrize("kind, body, error", [
    (lib.SG_MSG_MODE, b"\x08", lib.SG_E_ARG),
    (lib.SG_MSG_REBOOT, b"\xa4", lib.SG_E_ARG),
    (lib.SG_MSG_BAUD, b"\x02", lib.SG_E_ARG),
    (lib.SG_MSG_TRIAL_USE, b"\x02", lib.SG_E_ARG),
    (lib.SG_MSG_EXPOSURE, bytes(12) + b"\x05\0", lib.SG_E_ARG),
    (lib.SG_MSG_RECENTRE, bytes(8) + b"\x03\0", lib.SG_E_ARG),
    (lib.SG_MSG_CURVE, bytes(7) + b"\x02", lib.SG_E_ARG),
    (lib.SG_MSG_CURVE, bytes(6) + b"\1\1", lib.SG_E_ARG),
    (lib.SG_MSG_SETTINGS, bytes(8) + b"\x02" + bytes(5), lib.SG_E_ARG),
    (lib.SG_MSG_PROBE, b"\x06", lib.SG_E_ARG),
    (lib.SG_MSG_RECENTRE, bytes(8) + b"\x01\0", lib.SG_E_STATE),
    (lib.SG_MSG_MODEL_VERIFY, b"\0\0\x03\0", lib.SG_E_ARG),
    (lib.SG_MSG_MODEL_READ, b"\0\0\x03\1", lib.SG_E_ARG),
    (lib.SG_MSG_MODEL_READ, b"\0\0\x00\0", lib.SG_E_ARG),
    (lib.SG_MSG_MODEL_READ, b"\0\0\x00\x31", lib.SG_E_ARG),
    (lib.SG_MSG_MODEL_READ, b"\xd1\x05\x00\x30", lib.SG_E_BOUNDS),      # 1489 + 48 > 1536
    (lib.SG_MSG_MODEL_READ, b"\xff\xff\x00\x01", lib.SG_E_BOUNDS),
    (lib.SG_MSG_MODEL_READ, b"\x80\x02\x02\x01", lib.SG_E_BOUNDS),      # no room for a trial
    (lib.SG_MSG_TRIAL_WRITE, b"\x80\x02\x02\x01x", lib.SG_E_BOUNDS),
    (lib.SG_MSG_TRIAL_WRITE, b"\xff\xff\x02\x01x", lib.SG_E_BOUNDS),
    (lib.SG_MSG_TRIAL_WRITE, b"\0\0\x00\x01x", lib.SG_E_ARG),           # flash is not written by requests
    (lib.SG_MSG_TRIAL_WRITE, b"\0\0\x02\x00", lib.SG_E_ARG),
    (lib.SG_MSG_TRIAL_WRITE, b"\0\0\x02\x31" + bytes(49), lib.SG_E_ARG),
    (lib.SG_MSG_TRIAL_WRITE, b"\0\0\x02\x02x", lib.SG_E_SHORT),         # announces more than it brings
    (0x00, b"", lib.SG_E_UNKNOWN), (0x12, b"", lib.SG_E_UNKNOWN), (0x40, bytes(28), lib.SG_E_UNKNOWN),
    (0x7F, bytes(2), lib.SG_E_UNKNOWN), (0x81, b"", lib.SG_E_UNKNOWN), (0xFF, b"", lib.SG_E_UNKNOWN),
])
def test_bad_argument_is_refused_with_its_reason(board, kind, body, error):
    _, device = board()
    packets = exchange(device, wire.encode(kind, 9, body))
    assert len(packets) == 1 and packets[0].seq == 9 and refusals(packets) == [(error, kind)]
    assert device.status().rx_rejected == 1


def test_damaged_packets_are_counted_and_have_no_other_effect(board):
    _, device = board()
    good = wire.encode(lib.SG_MSG_MODE, 3, b"\x07")
    for at in range(len(good) - 1):
        broken = bytearray(good)
        broken[at] = broken[at] % 255 + 1           # never the delimiter
        assert exchange(device, bytes(broken), 0.01) == []
    too_long = b"\x01" * 200 + b"\0"
    assert exchange(device, too_long, 0.01) == []
    status = device.status()
    assert status.rx_bad == len(good) and status.stream == 0 and status.rx_rejected == 0


def test_noise_of_every_byte_value_leaves_the_device_answering(board):
    _, device = board()
    noise = random.Random(4)
    for _ in range(20):
        device.link.write(noise.randbytes(100))
        device.link.sleep(0.002)
    device.link.write(b"\0")
    device.link.sleep(0.01)
    device.link.flush_input()
    assert Device(device.link).hello == device.hello
    assert device.status().rx_bad > 0


def test_exposures_set_held_released_and_clipped(board):
    _, device = board()
    low, high = device.hello.exposure_min_us, device.hello.exposure_max_us
    now = device.exposure(us=[100, 33.25, 0, 4000, 50, 60])
    # Sensor 2 is the first of its pair; 3 the second, which has three slots of 55.5 us less 7.5 us.
    assert now.exposure_us == (100, 33.25, low, 159, 50, 60) and not now.automatic and high > 159
    device.link.sleep(1.0)
    assert device.exposure() == now
    assert device.status().exposure_us == now.exposure_us
    assert device.exposure(auto=True).automatic
    device.link.sleep(1.0)
    assert device.exposure().exposure_us != now.exposure_us
    held = device.exposure(auto=False)
    device.link.sleep(0.5)
    assert device.exposure().exposure_us == held.exposure_us


def test_half_a_megabaud_until_the_next_reset(board):
    _, device = board()
    device.set_baud(500_000)
    assert device.status().frames > 0
    device.set_baud(1_000_000)
    assert device.status().rx_bad == 0
    device.set_baud(500_000)
    device.link.reset()
    device.connect()
    assert device.link.baud == 1_000_000


def test_no_request_writes_to_flash(board):
    nano, device = board(models={0: random_model(64).image})
    for kind in SHORTEST:
        if kind != lib.SG_MSG_REBOOT:
            exchange(device, wire.encode(kind, 1, HARMLESS.get(kind, b"")), 0.02)
    assert nano.control.counters()["spm_denied"] == 0
    assert device.read_model() == random_model(64).image


def test_answers_survive_a_flood_and_dropped_frames_are_counted(board):
    """The line is full of answers: stream frames give way whole, and every gap is in the counter."""
    _, device = board()
    device.set_baud(500_000)
    device.set_stream(raw=True, gaze=True, counts=True)
    link, decoder = device.link, wire.Decoder()
    request = {}
    answered, streamed = set(), []
    start = link.now()
    while link.now() - start < 1.0:
        while len(request) - len(answered) < 6 and len(request) < 600:
            seq = 1000 + len(request)
            request[seq] = link.now()
            link.write(wire.encode(lib.SG_MSG_STATUS, seq))
        for packet in decoder.feed(link.read(4096, 0.001)):
            if packet.type == lib.SG_MSG_STATUS | lib.SG_REPLY:
                answered.add(packet.seq)
            elif packet.type in (lib.SG_MSG_RAW, lib.SG_MSG_GAZE, lib.SG_MSG_COUNTS):
                streamed.append(packet)
    link.sleep(0.05)
    decoder.feed(link.read(4096, 0.01))
    # The streams leave a ninth of the line to answers, 80 a second, and give way a little; all are answered.
    assert decoder.bad <= 1 and len(answered) > 100         # it began to listen in the middle of a frame
    assert len(request) - len(answered) <= 6
    by_kind = {kind: [p.seq for p in streamed if p.type == kind]
               for kind in (lib.SG_MSG_RAW, lib.SG_MSG_GAZE, lib.SG_MSG_COUNTS)}
    sensed = max(seqs[-1] for seqs in by_kind.values()) - min(seqs[0] for seqs in by_kind.values()) + 1
    missing = 3 * sensed - len(streamed)
    status = device.status()
    assert status.tx_dropped > 0 and status.rx_overrun == 0
    # Frames at both ends of the observation may be counted and not seen; those never taken up count as late.
    assert -3 * status.late_frames <= status.tx_dropped - missing <= 3 * 30


def test_a_second_verification_at_once_is_refused_busy_and_the_first_answered(board):
    _, device = board(models={0: random_model(100).image})
    body = wire.body("struct sg_model_at", slot=0)
    kind = lib.SG_MSG_MODEL_VERIFY
    packets = exchange(device, wire.encode(kind, 1, body) + wire.encode(kind, 2, body), 0.6)
    assert {(p.type, p.seq) for p in packets} == {(lib.SG_MSG_ERROR, 2), (kind | lib.SG_REPLY, 1)}
    assert refusals(packets) == [(lib.SG_E_BUSY, kind)]
