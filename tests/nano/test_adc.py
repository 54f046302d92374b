# SPDX-License-Identifier: Apache-2.0
"""When the converter samples, what it converts, and its flags (ATmega328P datasheet, chapter 23)."""

import struct

import pytest

from board import QUIET, Board, firmware

CLOCK = 128     # cycles of an ADC clock at prescaler 128


@pytest.fixture
def board():
    with Board(app=firmware("adc"), constants=QUIET) as running:
        running.run(1000)
        yield running


def marks(board, event):
    """Cycles of a frame event since the log was opened."""
    board.command("time")       # the log is complete up to the answer
    rows = (line.split(",") for line in board.log.read_text().splitlines()[1:])
    return [int(cycle) for name, cycle in rows if name == event]


def log_frames(board):
    board.log = board.folder / "frames.csv"
    board.command(f"frames on {board.log}")


@pytest.mark.parametrize("ticks", [1, 500, 1000, 1001, 12345, 65535])
def test_auto_trigger_samples_at_an_exact_cycle(board, ticks):
    log_frames(board)
    board.send(b"T" + struct.pack("<H", ticks))
    code, = struct.unpack("<H", board.run(8000))
    mark, = marks(board, "release")
    # STS ends two cycles after the mark and starts the count at 0; the flag rises one cycle after the match;
    # three cycles of synchronisation; two ADC clocks to sample and hold.
    assert board.node(0)[2] == mark + 2 + ticks + 1 + 3 + 2 * CLOCK
    assert code < 2


def test_software_start_waits_for_the_running_prescaler(board):
    log_frames(board)
    durations, samples = [], []
    for step in range(40):
        board.send(b"P")
        durations.append(struct.unpack("<H", board.run(200 + step % 7))[0])
        samples.append(board.node(0)[2])
    # 13 to 14 ADC clocks, seen through a polling loop of at most 8 cycles
    assert 13 * CLOCK < min(durations) <= 13 * CLOCK + 30
    assert 14 * CLOCK - 30 < max(durations) <= 14 * CLOCK + 16
    assert len({cycle % CLOCK for cycle in samples}) == 1


def test_first_conversion_takes_25_clocks():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        while board.counters()["conversions"] == 0:
            board.run(1)
        ended = board.cycle
    # 25 ADC clocks, up to one to the edge, a few hundred cycles of start-up code, steps of 16 cycles
    assert 25 * CLOCK < ended < 27 * CLOCK + 300


def test_channel_is_latched_at_the_start(board):
    board.command("fault 0 open")           # its pin, high, is not loaded: 5 V
    board.send(b"L")
    high, low = struct.unpack("<HH", board.run(2000))
    assert high == 1023 and low == 0


def test_adif_is_set_and_cleared_by_writing_one(board):
    board.send(b"F")
    assert list(board.run(2000)) == [0x10, 0]


def test_trigger_is_an_edge_of_ocf1b(board):
    board.send(b"E")
    assert list(board.run(3000)) == [0, 1]


def test_free_running_interrupts_every_13_clocks(board):
    board.send(b"I")
    assert list(board.run(3000)) == [10]


def test_noise_offset_and_bandgap_have_the_stated_size():
    offsets, spreads = [], []
    for seed in range(1, 9):
        constants = dict(QUIET, **{"adc.noise_lsb": 0.7, "adc.offset_lsb": 2.0})
        with Board(app=firmware("adc"), constants=constants, seed=seed) as board:
            board.run(1000)
            codes = []
            for _ in range(60):
                # 2 uA onto the node: a voltage away from both ends, the same every time
                board.command("set ambient sun_gap")
                board.send(b"X" + struct.pack("<BBHH", 0, 0, 300, 0))
                codes.append(struct.unpack("<H", board.run(700))[0])
        mean = sum(codes) / len(codes)
        offsets.append(mean)
        spreads.append((sum((code - mean) ** 2 for code in codes) / (len(codes) - 1)) ** 0.5)
    spread = sum(spreads) / len(spreads)
    assert 0.6 < spread < 0.95          # 0.7 and quantisation (0.29) in quadrature: 0.76
    low, high = min(offsets), max(offsets)
    assert 3.5 < high - low < 4.5       # minus and plus 2
