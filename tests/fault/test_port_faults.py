# SPDX-License-Identifier: Apache-2.0
"""Ports that are not there, not ours, or go away; and names of other systems."""

import os
import threading

import pytest
import serial
from fake_board import PtyPeer

from sparsegaze import registry
from sparsegaze.device import Device
from sparsegaze.errors import DisconnectedError, PortError
from sparsegaze.flash import flash_hex
from sparsegaze.transport import SerialLink, open_link


@pytest.mark.parametrize("port", ["/dev/does-not-exist", "/dev/pts/99999", "COM77", "/dev/cu.usbserial-0001"])
def test_no_such_port_names_it_and_points_to_the_list(port):
    with pytest.raises(PortError) as caught:
        open_link(port)
    assert port in caught.value.message and "sparsegaze list" in caught.value.remedy


def test_a_file_and_a_null_device_are_not_serial_ports(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("no port")
    for port in (str(path), os.devnull, str(tmp_path)):
        with pytest.raises(PortError) as caught:
            open_link(port)
        assert port in str(caught.value) and "\n" not in str(caught.value)


def test_port_held_by_another_program_is_refused_not_shared():
    with PtyPeer() as peer, open_link(peer.port):
        with pytest.raises(PortError, match="in use by another program"):
            open_link(peer.port)


def test_unknown_url_scheme_is_a_port_error():
    with pytest.raises(PortError):
        open_link("nonsense://port")


def test_windows_and_macos_names_reach_pyserial_unchanged(monkeypatch):
    seen = []

    class Handle:
        timeout = write_timeout = baudrate = exclusive = None

        def open(self):
            pass

        def close(self):
            pass

    def opened(name, **options):
        seen.append(name)
        return Handle()
    monkeypatch.setattr(serial, "serial_for_url", opened)
    for name in ("COM3", r"\\.\COM12", "/dev/cu.usbserial-1420", "/dev/tty.wchusbserial1410"):
        open_link(name).close()
    assert seen == ["COM3", r"\\.\COM12", "/dev/cu.usbserial-1420", "/dev/tty.wchusbserial1410"]


def test_loopback_url_carries_every_byte_value():
    with open_link("loop://") as link:
        link.write(bytes(range(256)))
        data = b""
        while len(data) < 256:
            data += link.read(256, 5.0)
        assert data == bytes(range(256))
        assert link.read(1, 0.0) == b""


def test_socket_url_works_and_its_end_is_a_disconnection():
    import socket
    server = socket.create_server(("127.0.0.1", 0))
    with open_link(f"socket://127.0.0.1:{server.getsockname()[1]}") as link:
        peer, _ = server.accept()
        peer.sendall(b"hello")
        data = b""
        while len(data) < 5:
            data += link.read(5 - len(data), 5.0)
        assert data == b"hello"
        peer.close()
        with pytest.raises(DisconnectedError):
            for _ in range(100):
                link.read(1, 0.1)
    server.close()


def test_read_returns_the_bytes_there_are_without_waiting_for_more():
    with PtyPeer() as peer, open_link(peer.port) as link:
        peer.say(b"abc")
        assert link.read(4096, 60.0) in (b"a", b"ab", b"abc")


def test_pulled_cable_during_a_read_is_a_disconnection_with_a_remedy():
    peer = PtyPeer()
    with open_link(peer.port) as link:
        threading.Timer(0.05, peer.close).start()
        with pytest.raises(DisconnectedError) as caught:
            link.read(1, 60.0)
        assert peer.port in caught.value.message and "cable" in caught.value.remedy


def test_pulled_cable_is_noticed_by_every_operation():
    for operation in (lambda link: link.write(b"x" * 64), lambda link: link.read(1, 0.1),
                      lambda link: link.set_baud(57600),
                      lambda link: link.flush_input(), lambda link: link.reset()):
        peer = PtyPeer()
        link = open_link(peer.port)
        peer.close()
        with pytest.raises(PortError):
            operation(link)
        link.close()


def test_use_after_close_is_an_error_of_ours():
    with PtyPeer() as peer:
        link = open_link(peer.port)
        link.close()
        link.close()
        for operation in (lambda: link.read(1, 0.1), lambda: link.write(b"x"), link.flush_input):
            with pytest.raises(DisconnectedError):
                operation()


def test_reset_over_a_pty_without_modem_lines_reopens_it():
    with PtyPeer() as peer, open_link(peer.port) as link:
        before = link.reset_s
        assert link.reset() is True
        assert link.reset_s > before
        peer.say(b"still here")
        assert link.read(1, 5.0) == b"s"


def test_commands_fail_before_the_port_is_touched_when_it_does_not_exist(program):
    with pytest.raises(PortError):
        Device("/dev/does-not-exist")
    with pytest.raises(PortError):
        flash_hex("/dev/does-not-exist", program[0])


def test_registry_forgets_dead_simulators_and_survives_garbage(tmp_path):
    folder = registry.directory()
    (folder / "1.json").write_text("{ not json")
    (folder / "2.json").write_text('{"port": 5}')
    dead = registry.Entry("/dev/pts/99999", None, str(tmp_path / "control"), 2 ** 22 - 1, True, 1, 1,
                          "x.toml", True)
    registry.register(dead)
    assert registry.entries() == []
    assert list(folder.glob("*.json")) == []


def test_registry_finds_a_virtual_port_by_its_link_and_lists_it(tmp_path):
    with PtyPeer() as peer:
        control, link = tmp_path / "control", tmp_path / "nano"
        control.touch()
        link.symlink_to(peer.port)
        entry = registry.Entry(peer.port, str(link), str(control), os.getpid(), False, 3, 4,
                               "headsets/ring.toml", False)
        registry.register(entry)
        try:
            assert registry.find(str(link)) == entry == registry.find(peer.port)
            assert registry.find("loop://") is None and registry.find("COM3") is None
            row = registry.ports()[0]
            assert row.kind == "virtual" and row.port == str(link)
            assert "person 4" in row.description and "no auto-reset" in row.description
        finally:
            registry.unregister(os.getpid())
        assert registry.find(peer.port) is None


def test_registry_refuses_a_directory_that_others_can_write(tmp_path, monkeypatch):
    from sparsegaze.errors import VirtualError

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    planted = tmp_path / f"sparsegaze-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    with pytest.raises(VirtualError, match="not a private directory"):
        registry.entries()


def test_serial_link_is_what_a_foreign_port_gets():
    with PtyPeer() as peer, open_link(peer.port) as link:
        assert type(link) is SerialLink and link.control is None
