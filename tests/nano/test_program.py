# SPDX-License-Identifier: Apache-2.0
"""The program around the board: constants, configuration, control socket, hostile input, clean end."""

import hashlib
import os
import pathlib
import random
import signal
import socket
import subprocess

import pytest

from board import PHYSICS, PROGRAM, QUIET, REPO, Board, firmware, physics


# The constants are fixed for the project: kinder ones are a change of this line too.
PHYSICS_SHA256 = "915aaea20fff0b1a9e962d54964a42b66aea92f4b2d2e86e00e41c90763344ee"


def test_constants_are_the_fixed_ones_and_equal_the_shared_file_where_there_is_one():
    assert hashlib.sha256(PHYSICS.read_bytes()).hexdigest() == PHYSICS_SHA256
    shared = REPO.parent / "shared" / "physics.toml"
    if shared.exists():
        assert PHYSICS.read_bytes() == shared.read_bytes()


def test_program_requires_exactly_the_keys_of_the_file():
    done = subprocess.run([PROGRAM, "--list-physics"], check=True, capture_output=True, text=True)
    assert sorted(done.stdout.split()) == sorted(physics())


def start(tmp_path, lines):
    config = tmp_path / "config"
    config.write_text("\n".join(lines) + "\n")
    return subprocess.run([PROGRAM, "--config", config], capture_output=True, text=True, timeout=30)


@pytest.fixture
def good(tmp_path):
    (tmp_path / "state").mkdir()
    return [f"state {tmp_path}/state", f"control {tmp_path}/c"] + [f"{k} {v}" for k, v in physics().items()]


@pytest.mark.parametrize("bad,message", [
    ("nonsense 1", "unknown key `nonsense`"), ("node.junction_pf -1", "bad value for `node.junction_pf`"),
    ("node.pin_pf nan", "bad value"), ("seed -3", "bad value"), ("unpaced 2", "bad value"),
    ("ambient moonlight", "bad value"), ("bootloader_start 0x7E01", "bad value"),
    ("map /nonexistent.sgmap", "/nonexistent.sgmap"),
    ("app /nonexistent.hex", "cannot read /nonexistent.hex"),
])
def test_bad_configuration_is_one_line_and_exit_1(tmp_path, good, bad, message):
    done = start(tmp_path, good + [bad])
    assert done.returncode == 1 and message in done.stderr and done.stderr.count("\n") == 1
    assert done.stdout == ""


def test_each_physics_key_is_required(tmp_path, good):
    for key in physics():
        done = start(tmp_path, [line for line in good if not line.startswith(key + " ")])
        assert done.returncode == 1 and f"missing key `{key}`" in done.stderr


@pytest.mark.parametrize("content", ["", ":00000001FE\n", ":10000000AA\n", ":020000000102\n", "garbage\n",
                                     ":02000000010203\n:00000001FF\n", ":0200000001\n", ":",
                                     ":0400000001020304F2\n"])
def test_damaged_hex_is_refused(tmp_path, good, content):
    path = tmp_path / "a.hex"
    path.write_text(content)
    done = start(tmp_path, good + [f"app {path}"])
    assert done.returncode == 1 and "cannot load" in done.stderr


def test_hex_that_reaches_past_the_flash_is_refused(tmp_path, good):
    path = tmp_path / "a.hex"
    path.write_text(":027FFF000102" + f"{(-(2 + 0x7F + 0xFF + 1 + 2)) & 0xFF:02X}" + "\n:00000001FF\n")
    done = start(tmp_path, good + [f"app {path}"])
    assert done.returncode == 1 and "does not fit" in done.stderr


def test_control_socket_survives_garbage():
    draws = random.Random(3)
    with Board(app=firmware("echo"), constants=QUIET) as board:
        assert board.ask("") == board.ask("fly") == "err unknown command"
        assert board.ask("x" * 5000) == "err line too long"
        for line in ("advance", "advance -1 0", "advance 1e9 0", "target 1 2", "target a b c",
                     "target 1 nan 0", "set lid 2", "set nothing 1", "set", "power", "cut x", "node 9",
                     "frames", "truth",
                     "lockstep 2", "markers x y", "truth /nonexistent/dir/file",
                     "advance 99999999999999999999 0"):
            assert board.ask(line).startswith(("err", "ok")), line
        for _ in range(50):
            blob = bytes(draws.randrange(1, 256) for _ in range(draws.randrange(1, 300))).replace(b"\n", b"?")
            board.control.sendall(blob + b"\n")
            assert board.replies.readline().startswith("err ")
        with socket.socket(socket.AF_UNIX) as rude:
            rude.connect(board.ready["control"])
            rude.sendall(b"time")                   # and leaves in the middle of a line
        others = []
        for _ in range(12):                         # more than it serves at once
            others.append(socket.socket(socket.AF_UNIX))
            others[-1].connect(board.ready["control"])
        assert board.command("time")[0] == "0"
        for other in others:
            other.close()
        board.run(1000)
        board.send(b"a")
        assert board.run(1000) == b"b"


@pytest.mark.parametrize("kind", ["file", "empty file", "folder", "fifo", "socket"])
def test_link_never_replaces_what_is_not_a_link(tmp_path, good, kind):
    path = tmp_path / "port"
    with socket.socket(socket.AF_UNIX) as bound:
        if kind == "folder":
            path.mkdir()
            (path / "kept").write_text("kept")
        elif kind == "fifo":
            os.mkfifo(path)
        elif kind == "socket":
            bound.bind(str(path))
        else:
            path.write_text("" if kind == "empty file" else "somebody's")
        before = path.lstat()
        done = start(tmp_path, good + [f"link {path}"])
    assert done.returncode == 1 and done.stdout == "" and done.stderr.count("\n") == 1
    assert f"{path} exists and is not a symbolic link: remove it" in done.stderr
    after = path.lstat()
    assert (before.st_ino, before.st_mode, before.st_size) == (after.st_ino, after.st_mode, after.st_size)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config", "port", "state"]
    if kind == "folder":
        assert (path / "kept").read_text() == "kept"


@pytest.mark.parametrize("old", ["target", "missing", "folder"])
def test_an_older_link_is_replaced_and_what_it_pointed_at_stays(tmp_path, old):
    (tmp_path / "target").write_text("kept")
    (tmp_path / "folder").mkdir()
    link = tmp_path / "port"
    link.symlink_to(tmp_path / old)
    with Board(app=firmware("echo"), link=link) as board:
        assert os.readlink(link) == board.ready["port"]
    assert not link.is_symlink()
    assert (tmp_path / "target").read_text() == "kept" and (tmp_path / "folder").is_dir()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "target"]


@pytest.mark.parametrize("successor", ["link", "file"])
def test_at_the_end_only_its_own_link_is_removed(tmp_path, successor):
    link = tmp_path / "port"
    with Board(app=firmware("echo"), link=link):
        link.unlink()
        if successor == "link":
            link.symlink_to("/dev/null")
        else:
            link.write_text("somebody's")
    assert link.is_symlink() if successor == "link" else link.read_text() == "somebody's"


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT, "quit"])
def test_clean_end_saves_and_removes_what_it_made(tmp_path, how):
    link = tmp_path / "port"
    with Board(app=firmware("echo"), link=link) as board:
        assert os.readlink(link) == board.ready["port"]
        if how == "quit":
            board.command("quit")
        else:
            board.process.send_signal(how)
        assert board.process.wait(20) == 0
        assert not link.is_symlink() and not pathlib.Path(board.ready["control"]).exists()
        assert (board.state / "flash.bin").stat().st_size == 32768


def test_signal_ends_a_long_free_run():
    with Board(app=firmware("echo"), unpaced=0) as board:
        board.process.terminate()
        assert board.process.wait(20) == 0
