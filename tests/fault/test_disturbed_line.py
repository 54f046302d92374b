# SPDX-License-Identifier: Apache-2.0
"""Lost, flipped, doubled and late bytes between host and device."""

import numpy as np
import pytest
from fake_board import FakeBoard

from sparsegaze import device as device_module
from sparsegaze import exchange, wire
from sparsegaze.device import Device
from sparsegaze.errors import DeviceError, NoDeviceError, ProtocolError
from sparsegaze.wire import lib


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    monkeypatch.setattr(device_module, "BOOT_WAIT_S", 0.0)
    monkeypatch.setattr(exchange, "TRY_TIMEOUTS_S", (0.3, 0.3, 0.3))


def packets():
    bodies = [b"", b"\0", b"\0" * 64, bytes(range(64)),
              wire.body("struct sg_gaze", t_us=1234567, azimuth_deg_q7=-5)]
    return [wire.encode(0x40 + i, 1000 + i, body) for i, body in enumerate(bodies)]


@pytest.mark.parametrize("fault", ["drop", "flip", "double", "zero", "insert zero"])
def test_every_single_byte_fault_at_every_offset_is_over_within_one_frame(fault):
    frames = packets() + [wire.encode(lib.SG_MSG_GAZE, 7, b"end")]
    line = b"".join(frames)
    good = wire.Decoder().feed(line)
    assert len(good) == len(frames)
    for at in range(len(line) - len(frames[-1])):
        broken = {"drop": line[:at] + line[at + 1:],
                  "flip": line[:at] + bytes([line[at] ^ 0x10]) + line[at + 1:],
                  "double": line[:at + 1] + line[at:], "zero": line[:at] + b"\0" + line[at + 1:],
                  "insert zero": line[:at] + b"\0" + line[at:]}[fault]
        hit = line[:at].count(b"\0")
        # A damaged delimiter joins two frames; no other frame may suffer, and nothing may arrive that was
        # not sent.
        harmed = good[hit:hit + 2] if line[at] == 0 else good[hit:hit + 1]
        seen = wire.Decoder().feed(broken)
        intact = [packet for packet in good if packet not in harmed]
        assert [packet for packet in seen if packet not in harmed] == intact


def test_feeding_byte_by_byte_equals_feeding_at_once():
    line = b"noise\0" + b"".join(packets()) + b"x" * 500 + b"\0" + b"".join(packets())
    whole, single = wire.Decoder(), wire.Decoder()
    expected = whole.feed(line)
    assert [packet for i in range(len(line)) for packet in single.feed(line[i:i + 1])] == expected
    assert (single.good, single.bad) == (whole.good, whole.bad) == (10, 2)


def test_lost_requests_are_sent_again_with_the_same_number():
    with FakeBoard() as board, Device(board.port) as device:
        board.deaf_first = len(board.requests) + 2
        device.model_info()
        last = board.requests[-3:]
        assert {packet.type for packet in last} == {lib.SG_MSG_MODEL_INFO}
        assert len({packet.seq for packet in last}) == 1


def test_a_device_that_falls_silent_is_given_up_after_three_tries():
    with FakeBoard() as board, Device(board.port) as device:
        board.deaf_first = 10 ** 9
        before = len(board.requests)
        with pytest.raises(NoDeviceError, match="no longer answers"):
            device.model_info()
        assert len(board.requests) - before == 3


def test_an_answer_with_any_bit_flipped_is_counted_and_asked_for_again():
    def disturb(data, number):
        broken = bytearray(data)
        if number % 2:
            broken[number % len(data)] ^= 0x04
        return bytes(broken)

    with FakeBoard() as board, Device(board.port) as device:
        board.answers, board.disturb = 0, disturb
        for _ in range(8):
            assert device.model_info().active == lib.SG_SLOT_NONE
        assert board.answers == 16 and device.bad >= 8


def test_a_doubled_answer_is_stale_not_the_next_one():
    with FakeBoard(disturb=lambda data, number: data + data) as board, Device(board.port) as device:
        device.ping()
        device.model_info()
        device.ping()
        assert device.stale >= 2


def test_a_refusal_carries_its_code_and_an_explanation():
    with FakeBoard() as board, Device(board.port) as device:
        with pytest.raises(DeviceError) as caught:
            device.status()
        assert caught.value.code == lib.SG_E_UNKNOWN
        assert "does not know the request" in caught.value.message
        assert "sparsegaze flash" in caught.value.remedy


def test_a_short_answer_is_a_protocol_error_not_garbage():
    class Short(FakeBoard):
        def _model_info(self):
            return super()._model_info()[:20]

    with Short() as board, Device(board.port) as device:
        with pytest.raises(ProtocolError, match="20 bytes where ModelInfo takes 36"):
            device.model_info()


def test_features_of_the_wrong_shape_or_range_never_reach_the_line():
    with FakeBoard() as board, Device(board.port) as device:
        before = len(board.requests)
        for features in (np.zeros((3, 5), int), [[0, 0, 0, 0, 0, -1]], [[0, 0, 0, 0, 0, 65536]]):
            with pytest.raises(ValueError):
                device.infer(features)
        assert len(device.infer(np.zeros((0, 6), int)).flags) == 0
        assert len(board.requests) == before


def test_pipelined_inference_keeps_the_order_when_answers_are_lost_busy_or_swapped():
    class Inferring(FakeBoard):
        held = None

        def _application(self, packet):
            if packet.type != lib.SG_MSG_INFER:
                return super()._application(packet)
            self.requests.append(packet)
            n = len(self.requests)
            if n % 7 == 0:
                return None
            if n % 5 == 0:
                return self.say(wire.encode(lib.SG_MSG_ERROR, packet.seq,
                                            wire.body("struct sg_error", error=lib.SG_E_BUSY,
                                                      type=packet.type)))
            first = packet.body[0] | packet.body[1] << 8
            answer = wire.encode(packet.type | lib.SG_REPLY, packet.seq,
                                 wire.body("struct sg_gaze", azimuth_deg_q7=first, elevation_deg_q7=-first,
                                           flags=1))
            if n % 3 == 0 and self.held is None:
                self.held = answer
                return None
            self.say(answer + (self.held or b""))
            self.held = None

    with Inferring() as board, Device(board.port) as device:
        features = np.zeros((40, 6), np.uint16)
        features[:, 0] = np.arange(40) * 128
        gaze = device.infer(features)
        assert gaze.azimuth_deg.tolist() == list(range(40))
        assert gaze.elevation_deg.tolist() == [-i for i in range(40)]
        assert (gaze.flags == 1).all()
