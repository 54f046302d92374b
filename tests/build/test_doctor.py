# SPDX-License-Identifier: Apache-2.0
"""The doctor finds what is missing, says how to get it, and never falls over."""

import socket
import sys

import pytest

from sparsegaze import doctor, virtual


def test_everything_that_setup_installs_is_found():
    failing = [
        check
        for check in doctor.examine()
        if not check.ok and check.name not in ("ports", "serial permission")
    ]
    assert failing == []


def test_every_check_that_fails_has_a_remedy_and_none_raises_on_an_empty_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "PACKAGE", tmp_path)
    monkeypatch.setattr(doctor, "SOURCE_TREE", tmp_path)
    monkeypatch.setattr(virtual, "BOOTLOADER_FOLDERS", (str(tmp_path),))
    for variable in ("SPARSEGAZE_OPTIBOOT", "SPARSEGAZE_ATMEGABOOT", "SPARSEGAZE_VHEADSET"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(doctor, "PYTHON_MIN", (99, 0))
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "_version", lambda name: None)
    for module in ("sparsegaze._core", "sparsegaze._sim", "sparsegaze.registry"):
        monkeypatch.setitem(sys.modules, module, None)  # its import raises ImportError
    checks = doctor.examine()
    assert [check.name for check in checks if check.ok and check.name != "serial permission"] == []
    assert [check.name for check in checks if check.ok is False] == [
        "Python",
        "Python packages",
        "C core",
        "firmware",
        "ports",
    ]
    for check in checks:
        assert check.found and "\n" not in check.found + check.remedy
        assert bool(check.remedy) == (check.ok is not True), check


def test_a_port_that_this_user_may_not_open_is_reported(monkeypatch):
    monkeypatch.setattr(doctor.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    monkeypatch.setattr(doctor, "_serial_ports", lambda: ["/dev/ttyUSB0"])
    check = doctor.serial_permission()
    assert check.ok is False and "/dev/ttyUSB0" in check.found and "dialout" in check.remedy


def test_a_virtual_nano_whose_library_has_gone_is_not_called_there(monkeypatch, tmp_path):
    program = tmp_path / "tools" / "vheadset" / "vheadset"
    program.parent.mkdir(parents=True)
    program.write_text(
        "#!/bin/sh\necho 'error while loading shared libraries: libsimavr.so.2' >&2\nexit 127\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(doctor, "SOURCE_TREE", tmp_path)
    check = doctor.virtual_nano()
    assert check.ok is None and "libsimavr" in check.found


def test_the_network_is_out_of_reach_of_tests():
    with pytest.raises(AssertionError, match="network"):
        socket.create_connection(("192.0.2.1", 80), timeout=1)
