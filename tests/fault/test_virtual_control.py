# SPDX-License-Identifier: Apache-2.0
"""Starting, naming, controlling and ending virtual Nanos; what can go wrong with each."""

import os
import signal

import pytest

from sparsegaze import registry, virtual
from sparsegaze.errors import DisconnectedError, VirtualError
from sparsegaze.transport import open_link
from sparsegaze.virtual import VirtualControl, VirtualNano


def test_a_running_one_is_listed_by_port_and_link_and_gone_when_stopped(virtual_nano, tmp_path):
    link = tmp_path / "nano"
    nano = virtual_nano(map=False, unpaced=True, link=link, person=5, seed=6)
    assert os.path.realpath(link) == os.path.realpath(nano.port)
    entry = registry.find(str(link))
    assert entry == nano.entry and (entry.person, entry.seed, entry.unpaced) == (5, 6, True)
    folder = os.path.dirname(nano.control.path)
    nano.stop()
    nano.stop()
    assert not nano.alive and registry.find(nano.port) is None
    assert not os.path.exists(folder) and not os.path.islink(link)


def test_a_killed_one_disappears_from_the_list_by_itself(virtual_nano):
    nano = virtual_nano(map=False)
    os.kill(nano.pid, signal.SIGKILL)
    assert nano.wait(10.0) == -signal.SIGKILL
    assert nano.pid not in [entry.pid for entry in registry.entries()]


def test_given_state_directory_is_kept_and_a_temporary_one_is_not(virtual_nano, tmp_path, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex, state_dir=tmp_path / "state")
    nano.stop()
    assert (tmp_path / "state" / "flash.bin").stat().st_size == 32768


def test_errors_of_starting_are_one_line_with_a_remedy(monkeypatch, tmp_path):
    bad_hex = tmp_path / "bad.hex"
    bad_hex.write_text("not a hex file\n")
    for options, text in (
            ({"bootloader": "nonsense"}, "no such bootloader"),
            ({"physics": {"node.flux": 1}}, "no physical constant node.flux"),
            ({"app": bad_hex}, "did not start"),
            ({"app": tmp_path / "missing.hex"}, "did not start"),
            ({"map": bad_hex}, "did not start"),
            ({"ambient": "moonlight"}, "did not start"),
            ({"state_dir": tmp_path / "a#b"}, "cannot take the path")):
        with pytest.raises(VirtualError) as caught:
            VirtualNano(**{"map": False, **options})
        assert text in caught.value.message and "\n" not in str(caught.value)
    monkeypatch.setenv("SPARSEGAZE_VHEADSET", str(tmp_path / "missing"))
    with pytest.raises(VirtualError, match="SPARSEGAZE_VHEADSET"):
        VirtualNano(map=False)


def test_a_program_that_is_not_the_simulator_is_noticed(monkeypatch, tmp_path):
    monkeypatch.setattr(virtual, "READY_TIMEOUT_S", 0.2)
    for script, text in (
            ("exit 0", "ended without a word"), ("echo hello; exec sleep 60", "instead of its port"),
            ("exec sleep 60", "silent for 0.2 s"), ("echo boom >&2; exit 1", "boom")):
        program = tmp_path / "vheadset"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setenv("SPARSEGAZE_VHEADSET", str(program))
        with pytest.raises(VirtualError, match=text):
            VirtualNano(map=False)


def test_bootloaders_are_found_by_name_and_by_variable(monkeypatch, tmp_path):
    assert virtual.locate_bootloader("optiboot")[0] == 0x7E00
    assert virtual.locate_bootloader("ATmegaBOOT")[0] == 0x7800
    other = tmp_path / "other.hex"
    other.write_text(":00000001FF\n")
    assert virtual.locate_bootloader(other, 0x7000) == (0x7000, other)
    monkeypatch.setenv("SPARSEGAZE_OPTIBOOT", str(other))
    assert virtual.locate_bootloader() == (0x7E00, other)
    monkeypatch.setenv("SPARSEGAZE_OPTIBOOT", str(tmp_path / "missing"))
    with pytest.raises(VirtualError, match="SPARSEGAZE_OPTIBOOT"):
        virtual.locate_bootloader()


def test_refused_commands_and_a_vanished_simulator_are_errors_of_ours(virtual_nano):
    nano = virtual_nano(map=False, unpaced=True)
    for command in ("nonsense", "advance 1", "target a b c", "set lid 7x"):
        with pytest.raises(VirtualError, match="refused"):
            nano.control.command(command)
    with pytest.raises(VirtualError, match="one line"):
        nano.control.command("time\nquit")
    assert nano.control.time().us >= 0          # the connection outlives refusals
    with VirtualControl(nano.control.path) as second:
        assert second.time() == nano.control.time()
    nano.kill()
    with pytest.raises(DisconnectedError, match="is gone"):
        nano.control.time()


def test_quit_ends_it_in_order(virtual_nano):
    nano = virtual_nano(map=False)
    nano.control.quit()
    assert nano.wait(10.0) == 0


def test_the_person_looks_where_and_when_it_was_told(virtual_nano):
    nano = virtual_nano(map=False, unpaced=True)
    with open_link(nano.port) as link:
        nano.control.motion(False)
        nano.control.follow(False)
        nano.control.target(100000, 12.0, -7.0)
        link.sleep(0.05)
        before = nano.control.state()
        link.sleep(0.10)
        after = nano.control.state()
        assert (before.azimuth_deg, before.elevation_deg) != (12.0, -7.0)
        assert (after.azimuth_deg, after.elevation_deg) == pytest.approx((12.0, -7.0), abs=1e-6)
        assert after.target_azimuth_deg == 12.0
        nano.control.targets_clear()
