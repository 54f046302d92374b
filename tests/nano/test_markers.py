# SPDX-License-Identifier: Apache-2.0
"""Cycle counts by GPIOR0, with and without interrupts; the frame log."""

from board import QUIET, Board, firmware


def sections(board):
    """{name: (count, least, mean, most)}"""
    found = {}
    for item in board.command("markers")[0].split(";"):
        name, count, least, mean, most = item.split(":")
        found[name] = (int(count), int(least), float(mean), int(most))
    return found


def test_sections_are_counted_to_the_cycle_with_and_without_interrupts():
    with Board(app=firmware("markers"), constants=QUIET) as board:
        board.run(1000)
        found = sections(board)
        board.command("markers clear")
        assert board.command("markers") == []
    assert found["0"] == found["0n"] == (3, 0, 0.0, 0)
    assert found["1"] == found["1n"] == (3, 10, 10.0, 10)
    interrupt = 4 + 3 + 2 + 5 + 2 + 4       # entry, vector, marker, nops, marker, reti
    assert found["2"] == (3, 10 + interrupt, float(10 + interrupt), 10 + interrupt)
    assert found["2n"] == (3, 10, 10.0, 10)
    assert found["3"] == found["3n"] == (3, 5, 5.0, 5)


def test_frame_log_has_marks_and_the_stop_bit_of_every_zero():
    with Board(app=firmware("markers"), constants=QUIET) as board:
        path = board.folder / "frames.csv"
        board.command(f"frames on {path}")
        assert board.run(1000) == b"\x07\x00"
        board.command("frames off")
        rows = [line.split(",") for line in path.read_text().splitlines()]
    assert [row[0] for row in rows] == ["event", "release", "sample", "delimiter"]
    release, sample, delimiter = (int(row[1]) for row in rows[1:])
    assert sample - release == 1599 + 2     # LDI and OUT
    assert 320 < delimiter - sample < 320 + 40
