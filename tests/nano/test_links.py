# SPDX-License-Identifier: Apache-2.0
"""VirtualNano and the link it makes: refuses what is not a link, removes only its own, even when killed."""

import os
import signal

import pytest

from sparsegaze.errors import VirtualError
from sparsegaze.virtual import VirtualNano


@pytest.fixture
def link(tmp_path, vheadset, monkeypatch):
    monkeypatch.setenv("SPARSEGAZE_VHEADSET", str(vheadset))
    return tmp_path / "port"


def nano(link, **options):
    return VirtualNano(map=False, unpaced=True, link=link, **options)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_is_not_a_link_is_refused_before_anything_starts(link, kind, monkeypatch):
    link.mkdir() if kind == "folder" else link.write_text("somebody's")
    monkeypatch.setattr("sparsegaze.virtual._start", None)      # would be a TypeError
    with pytest.raises(VirtualError) as caught:
        nano(link)
    assert "is not a symbolic link" in caught.value.message and "\n" not in str(caught.value)
    assert caught.value.remedy and (link.is_dir() or link.read_text() == "somebody's")


@pytest.mark.parametrize("how", ["stop", "kill", "killed from outside, then stop"])
def test_its_own_link_is_gone_after(link, how):
    virtual = nano(link)
    assert os.readlink(link) == virtual.port
    if how == "kill":
        virtual.kill()
        assert not os.path.lexists(link)
    elif how != "stop":
        os.kill(virtual.pid, signal.SIGKILL)
        virtual.wait(10.0)
        assert os.path.lexists(link)
    virtual.stop()
    assert not os.path.lexists(link)


@pytest.mark.parametrize("how", ["kill", "stop"])
@pytest.mark.parametrize("successor", ["file", "link elsewhere", "link of the same text"])
def test_what_came_after_its_link_stays(link, how, successor):
    virtual = nano(link)
    link.unlink()
    if successor == "file":
        link.write_text("somebody's")
    else:
        link.symlink_to("/dev/null" if successor == "link elsewhere" else virtual.port)
        os.utime(link, (1, 1), follow_symlinks=False)           # file systems count time in milliseconds
    if successor == "link of the same text" and how == "stop":
        os.kill(virtual.pid, signal.SIGKILL)                    # in order, the simulator takes it for its own
        virtual.wait(10.0)
    virtual.kill() if how == "kill" else virtual.stop()
    virtual.stop()
    assert os.path.lexists(link)


def test_stopping_a_killed_one_leaves_its_successor_s_link(link):
    first = nano(link)
    os.kill(first.pid, signal.SIGKILL)
    first.wait(10.0)
    with nano(link) as second:                                  # replaces the link the killed one left
        first.stop()
        assert os.readlink(link) == second.port
    assert not os.path.lexists(link)


def test_parts_repeat_and_sessions_count_over_one_state_folder(link, tmp_path):
    seen = []
    for _ in range(3):
        with nano(link, state_dir=tmp_path / "state", person=4) as virtual:
            virtual.control.lockstep(True)
            virtual.control.advance(100000, 0)
            seen.append((virtual.control.counters()["session"], virtual.control.state()))
    assert [number for number, _ in seen] == [0, 1, 2]
    assert len({state for _, state in seen}) == 3
