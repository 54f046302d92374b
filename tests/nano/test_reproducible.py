# SPDX-License-Identifier: Apache-2.0
"""The same seed and the same advances give the same bytes; another seed does not; real time when paced."""

import hashlib
import random
import time

import pytest
import serial

from board import Board, firmware


@pytest.fixture(scope="module")
def bumpy_map(tmp_path_factory):
    from sparsegaze import mapfile

    return mapfile.synthetic_map(tmp_path_factory.mktemp("map") / "bumps.sgmap")


def run(seed, cuts, bumpy_map, jitter=0.0, **keys):
    """Two seconds with targets, bytes and full noise, cut into pieces by `cuts`; what came out."""
    draws = random.Random(5)
    with Board(app=firmware("stream"), seed=seed, map=bumpy_map, ambient="room", **keys) as board:
        for at, az, el in ((100000, 10, 5), (600000, -12, 8), (1100000, 3, -15)):
            board.command(f"target {at} {az} {el}")
        data, done = b"", 0
        for until in sorted(set(cuts) | {500000, 1500000, 2000000}):
            data += board.run(until - done)
            done = until
            if until in (500000, 1500000):
                board.send(b"p")
            if jitter:
                time.sleep(jitter * draws.random())
                board.command("state")          # looking does not disturb
                board.command("node 0")
                board.command("lamps")
                board.command("counters clear")
        end = board.command("state")
    return data, end


def test_two_lockstep_runs_are_byte_identical_however_they_are_cut(bumpy_map):
    whole, end = run(7, [], bumpy_map)
    assert len(whole) > 1900
    pieces, end_pieces = run(7, range(0, 2000000, 7777), bumpy_map, jitter=0.002)
    assert hashlib.sha256(pieces).hexdigest() == hashlib.sha256(whole).hexdigest()
    assert end_pieces == end


def test_another_seed_differs(bumpy_map):
    assert run(7, [], bumpy_map)[0] != run(8, [], bumpy_map)[0]


def test_nothing_happens_before_the_first_client():
    with Board(app=firmware("stream")) as board:
        time.sleep(0.2)
        assert board.cycle == 0
        with pytest.raises(AssertionError, match="did not arrive"):
            board.command("advance 100 1")


def test_watchdog_resets_into_the_program_and_lights_go_out(bumpy_map):
    with Board(app=firmware("stream"), map=bumpy_map) as board:
        board.run(50000)
        board.send(b"w")
        board.run(115000)
        assert board.counters()["wdt_resets"] == 0
        board.run(15000)
        assert board.counters()["wdt_resets"] == 1


def test_paced_board_does_not_run_ahead_of_true_time():
    with Board(app=firmware("stream"), unpaced=0, constants={"clock.error": 0.0}) as board:
        with serial.Serial(board.ready["port"], 1000000, timeout=5):
            start, first = time.monotonic(), board.cycle
            while time.monotonic() - start < 1.5:
                time.sleep(0.05)
            seconds = (board.cycle - first) / 16e6
            elapsed = time.monotonic() - start
    # It may lag behind on a busy machine and make up for at most a second of lag; unpaced it would be
    # tenfold.
    assert 0.2 * elapsed < seconds <= elapsed + 1.0


def test_lockstep_needs_an_unpaced_board():
    with Board(app=firmware("stream"), unpaced=0) as board:
        assert board.ask("lockstep 1").startswith("err ")
        assert board.ask("advance 10 0").startswith("err ")
