# SPDX-License-Identifier: Apache-2.0
"""Power-ons are sessions: behaviour and noise differ between them and repeat by number; parts stay."""

import pytest

from board import QUIET, Board, firmware
from test_leds import exposure

TARGETS = ((100000, 10, 5), (600000, -12, 8), (1100000, 3, -15))


@pytest.fixture(scope="module")
def bumpy_map(tmp_path_factory):
    from sparsegaze import mapfile

    return mapfile.synthetic_map(tmp_path_factory.mktemp("map") / "bumps.sgmap")


def session(state, bumpy_map, seed=7):
    """One power-on over a state folder: (its number, what the device sent, the eye's true path)."""
    with Board(app=firmware("stream"), seed=seed, map=bumpy_map, ambient="room", state=state) as board:
        path = board.folder / "truth.csv"
        board.command(f"truth {path}")
        for at, az, el in TARGETS:
            board.command(f"target {at} {az} {el}")
        data = board.run(1500000)
        board.command("truth off")
        return board.counters()["session"], data, path.read_text()


def test_two_power_ons_over_one_state_folder_differ_in_truth_and_counts(tmp_path, bumpy_map):
    first, second = session(tmp_path / "a", bumpy_map), session(tmp_path / "a", bumpy_map)
    assert (first[0], second[0]) == (0, 1)
    assert first[1] != second[1]
    rows = [[line.split(",") for line in text.splitlines()[1:]] for text in (first[2], second[2])]
    for column in (1, 2, 3):                    # azimuth, elevation, pupil: from the first row on
        same = [a[column] == b[column] for a, b in zip(*rows)]
        assert not same[0] and sum(same) < 0.01 * len(same)
    assert [row[5:] for row in rows[0]] == [row[5:] for row in rows[1]]         # targets are the schedule's


def test_same_seed_and_session_number_repeat_byte_for_byte(tmp_path, bumpy_map):
    runs = [[session(tmp_path / name, bumpy_map) for _ in range(2)] for name in ("a", "b")]
    assert runs[0] == runs[1]
    assert session(tmp_path / "c", bumpy_map, seed=8)[1] != runs[0][0][1]


def test_parts_are_the_same_in_every_session_and_noise_is_not(tmp_path):
    parts = dict(QUIET, **{"photocurrent.part_spread": 0.3, "node.leakage_spread": 1, "node.leakage_na": 1,
                           "adc.inl_lsb": 0.5, "adc.offset_lsb": 2, "adc.gain_error": 0.005,
                           "clock.error": 0.01})
    held = {}
    for name, constants in (("parts", parts), ("noise", dict(parts, rail_noise_mv=5))):
        for _ in range(2):
            with Board(app=firmware("adc"), constants=constants, state=tmp_path / name) as board:
                board.command("motion 0")
                board.command("set ambient sun_gap")
                held.setdefault(name, []).append((exposure(board, ticks=300), board.command("state")))
    assert held["parts"][0] == held["parts"][1]
    assert held["noise"][0][0][3] != held["noise"][1][0][3]
    assert held["noise"][0][1] == held["noise"][1][1]                           # the mean pupil is a trait


def test_mains_flicker_begins_each_session_at_a_phase_of_its_own(tmp_path):
    held = []
    for _ in range(4):
        with Board(app=firmware("adc"), constants=QUIET, ambient="bright_room",
                   state=tmp_path / "a") as board:
            held.append(round(exposure(board, ticks=2000)[3], 6))
    assert len(set(held)) == 4


def test_reset_is_not_a_power_on_but_power_on_is(tmp_path):
    with Board(app=firmware("stream"), state=tmp_path / "a") as board:
        board.run(10000)
        board.command("reset")
        board.run(10000)
        board.send(b"w")                        # the watchdog bites
        board.run(200000)
        assert board.counters()["wdt_resets"] >= 1 and board.counters()["session"] == 0
        board.command("power off")
        board.command("power on")
        assert board.counters()["session"] == 1
        board.command(f"cut {board.cycle + 1000}")
        board.run(10000)
        board.command("power on")
        assert board.counters()["session"] == 2
    with Board(app=firmware("stream"), state=tmp_path / "a") as board:
        assert board.counters()["session"] == 3


def test_power_cycle_within_a_run_draws_another_path_without_a_jump(tmp_path):
    paths = []
    for cycled in (False, True):
        with Board(app=firmware("stream"), seed=3) as board:
            log = board.folder / "truth.csv"
            board.command(f"truth {log}")
            board.run(300000)
            if cycled:
                board.command("power off")
                board.command("power on")
            board.run(300000)
            board.command("truth off")
            paths.append([[float(w) for w in line.split(",")] for line in log.read_text().splitlines()[1:]])
    plain, cycled = paths
    assert plain[:300] == cycled[:300] and plain[600][1:4] != cycled[600][1:4]
    assert max(abs(b[3] - a[3]) for a, b in zip(cycled, cycled[1:])) < 0.02


def test_killed_board_has_used_its_session_up(tmp_path):
    board = Board(app=firmware("stream"), state=tmp_path / "a")
    board.__enter__()
    board.process.kill()
    board.process.wait()
    with pytest.raises(AssertionError):
        board.__exit__()
    assert [path.name for path in (tmp_path / "a").iterdir() if ".bin." in path.name] == []
    with Board(app=firmware("stream"), state=tmp_path / "a") as again:
        assert again.counters()["session"] == 1


@pytest.mark.parametrize("content", [b"", b"1", b"123456789"])
def test_damaged_session_count_is_refused_with_a_remedy(tmp_path, content):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "power_ons.bin").write_bytes(content)
    with pytest.raises(RuntimeError, match="power_ons.bin is not an image of 8 bytes: remove it"):
        Board(app=firmware("stream"), state=tmp_path / "a").__enter__()
