# SPDX-License-Identifier: Apache-2.0
"""Behind the port stands nothing, something foreign, or another protocol version."""

import time

import pytest
from fake_board import FakeBoard, Printer, PtyPeer

from sparsegaze import device as device_module
from sparsegaze import wire
from sparsegaze.device import BOOT_WAIT_S, Device
from sparsegaze.errors import NoDeviceError, ProtocolError
from sparsegaze.wire import lib


@pytest.fixture(autouse=True)
def _impatient(monkeypatch, request):
    if "stays_silent" not in request.node.name:
        monkeypatch.setattr(device_module, "BOOT_WAIT_S", 0.1)


def test_nothing_behind_the_port_says_so_and_how_to_go_on():
    with PtyPeer() as peer:
        with pytest.raises(NoDeviceError) as caught:
            Device(peer.port, timeout_s=1.0)
    assert caught.value.message == f"nothing answers on {peer.port}"
    assert "cable" in caught.value.remedy and f"sparsegaze flash {peer.port}" in caught.value.remedy


def test_nothing_behind_the_port_is_tried_at_both_speeds():
    class Listener(PtyPeer):
        speeds = ()

        def heard(self, data, speed):
            self.speeds += (speed,)

    import termios
    with Listener() as peer:
        with pytest.raises(NoDeviceError):
            Device(peer.port, timeout_s=3.1)
        assert set(peer.speeds) == {termios.B1000000, termios.B500000}
        assert peer.speeds[0] == termios.B1000000
        # polite: about four a second
        assert 4 <= len(peer.speeds) <= 3.0 / 0.25 + 1


def test_foreign_firmware_is_told_from_silence_and_its_bytes_are_shown():
    with Printer(b"Hello from a blink sketch\r\n") as peer:
        with pytest.raises(NoDeviceError) as caught:
            Device(peer.port, timeout_s=1.0)
    assert "not in sparsegaze's protocol" in caught.value.message and "b'Hello" in caught.value.message
    assert f"sparsegaze flash {peer.port}" in caught.value.remedy
    assert "\n" not in str(caught.value)


def test_foreign_firmware_that_sends_delimiters_and_noise_is_foreign():
    with Printer(bytes(range(256)) * 3) as peer:
        with pytest.raises(NoDeviceError, match="not in sparsegaze's protocol"):
            Device(peer.port, timeout_s=1.0)


def test_an_echoing_peer_is_not_taken_for_a_device():
    class Echo(PtyPeer):
        def heard(self, data, speed):
            self.say(data)

    with Echo() as peer:
        with pytest.raises(NoDeviceError):
            Device(peer.port, timeout_s=1.0)


def test_a_device_that_streams_but_does_not_hear_us_points_to_the_wire():
    class Deaf(PtyPeer):
        def idle(self):
            self.say(wire.encode(lib.SG_MSG_GAZE, 1, wire.body("struct sg_gaze", t_us=1)))

    with Deaf() as peer:
        with pytest.raises(NoDeviceError) as caught:
            Device(peer.port, timeout_s=1.0)
    assert "answers no request" in caught.value.message and "D0" in caught.value.remedy


def test_older_protocol_names_both_versions_and_the_remedy():
    newer = lib.SG_WIRE_VERSION + 3
    for version in (0, newer):
        with FakeBoard(hello={"wire_version": version, "firmware": 0x000401}) as board:
            with pytest.raises(ProtocolError) as caught:
                Device(board.port)
        assert caught.value.message == (f"device speaks protocol {version} (firmware 0.4.1), "
                                        f"this SDK speaks {lib.SG_WIRE_VERSION}")
        assert f"`sparsegaze flash {board.port}`" in caught.value.remedy
        assert ("update this SDK" in caught.value.remedy) == (version == newer)


def test_hello_shorter_than_any_version_known_is_an_old_protocol_not_a_crash():
    class Old(FakeBoard):
        def _application(self, packet):
            self._answer(packet, b"\x01\x02\x00\x00")

    with Old() as board:
        with pytest.raises(ProtocolError, match=r"protocol 0 \(firmware 0.2.1\)"):
            Device(board.port)


def test_hello_longer_than_ours_is_accepted():
    class Longer(FakeBoard):
        def _application(self, packet):
            self._answer(packet, wire.body("struct sg_hello", **self.hello) + b"more to come")

    with Longer() as board, Device(board.port) as device:
        assert device.hello.channels == 6 and device.hello.board_text == "Arduino Nano (ATmega328P)"


def test_connection_stays_silent_while_a_bootloader_listens():
    class Timed(FakeBoard):
        first_s = None

        def heard(self, data, speed):
            self.first_s = self.first_s or time.monotonic()
            super().heard(data, speed)

    with Timed() as board:
        start = time.monotonic()
        with Device(board.port):
            pass
        assert board.first_s - start >= BOOT_WAIT_S
