# SPDX-License-Identifier: Apache-2.0
"""Conversions one after another as the firmware makes them: prescaler 64, Timer1, ground between."""

import struct

import pytest

from board import QUIET, Board, firmware
from test_leds import SAMPLER, charge_pc, volts_of

GROUND, BANDGAP_CHANNEL, DIVIDER, FULL = 0xC0 | 15, 0xC0 | 14, 0xC0 | 7, 0xC0
CLOCK = 64


def bandgap_volts(board):
    """The part's own reference, by measuring it against the 5 V of a quiet supply many times, V."""
    codes = []
    for _ in range(9):
        board.send(bytes([ord("C"), 0x40 | 14]))
        board.run(400)
        codes.append(board.node(0)[3])
    return sum(codes) / len(codes)


def began(board):
    """Cycle at which the program started its timer, or None: two cycles after its mark."""
    board.command("time")       # the log is complete up to the answer
    rows = [line.split(",") for line in board.log.read_text().splitlines()]
    return next((int(cycle) + 2 for name, cycle in rows if name == "release"), None)


def slots(board, *admux, slot=888):
    """Codes of a row of conversions, one every `slot` cycles; the nodes float all the while."""
    board.log = board.folder / "frames.csv"
    board.command(f"frames on {board.log}")
    board.send(b"Q" + struct.pack("<BH", len(admux), slot) + bytes(admux))
    codes = struct.unpack(f"<{len(admux)}H", board.run(3000))
    return codes, began(board)


@pytest.fixture
def board():
    with Board(app=firmware("adc"), constants=QUIET) as running:
        running.run(1000)
        yield running


@pytest.mark.parametrize("slot", [888, 1001, 1777])
def test_sample_is_132_cycles_after_the_match_at_prescaler_64(board, slot):
    for n in range(1, 5):
        _, start = slots(board, *[FULL | 2] * n, slot=slot)
        assert board.node(2)[2] == start + n * slot + 132
        assert 132 == 1 + 3 + 2 * CLOCK             # flag, synchronisation, two ADC clocks


@pytest.mark.parametrize("before,after", [(0, 0), (1, 1)])
def test_result_is_there_868_cycles_after_the_match(before, after):
    """13.5 ADC clocks from the synchronised edge: the program's poll sees it then and not a loop earlier."""
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(1000)
        done = board.counters()["conversions"]
        board.send(b"Q" + struct.pack("<BH", 1, 30000) + bytes([GROUND]))
        board.log = board.folder / "frames.csv"
        board.command(f"frames on {board.log}")
        while not began(board):
            board.run(50)
        end = began(board) + 30000 + 868
        board.run((end - 16 - board.cycle) // 16)
        assert board.cycle < end - 4 and board.counters()["conversions"] == done
        board.run(2)
        assert board.cycle >= end and board.counters()["conversions"] == done + 1


def test_ground_empties_the_sampler_and_the_next_node_shares_from_nothing(board):
    slots(board, BANDGAP_CHANNEL, FULL | 1)
    assert board.node(1)[3] > 0.2
    slots(board, BANDGAP_CHANNEL, GROUND, FULL | 1)
    assert board.node(1)[3] == pytest.approx(0, abs=1e-12)


def test_second_of_a_pair_shares_with_what_the_first_left_on_the_sampler():
    """The charge of the sampler comes along: what sg_light takes off again."""
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(1000)
        slots(board, BANDGAP_CHANNEL, FULL | 1)
        shared = board.node(1)[3]
        assert board.node(1)[0] == pytest.approx(shared, abs=1e-12)     # apart again, both keep that voltage
        total = charge_pc(shared, SAMPLER)
        slots(board, BANDGAP_CHANNEL)
        bandgap = board.node(0)[3]
        assert 0.98 < bandgap < 1.22
        assert total == pytest.approx(SAMPLER * bandgap, rel=5e-3)      # the bandgap has noise of its own
        assert shared == pytest.approx(volts_of(SAMPLER * bandgap, SAMPLER), rel=5e-3)


def test_every_conversion_after_ground_takes_its_share_of_a_node_away(board):
    """An empty sampler, again and again: the node's charge and the sampler's are what there was before."""
    slots(board, BANDGAP_CHANNEL, FULL | 1)
    before = board.node(1)[0]
    slots(board, BANDGAP_CHANNEL, FULL | 1, GROUND, FULL | 1, GROUND, FULL | 1)
    after = board.node(1)[0]
    expected = before
    for _ in range(2):
        expected = volts_of(charge_pc(expected), SAMPLER)
    assert after == pytest.approx(expected, rel=5e-3) and after < 0.6 * before   # the bandgap has noise


def test_supply_divider_reads_a_twenty_fifth_of_the_supply_and_follows_it(board):
    for volts in (5.0, 4.2, 5.5):
        board.command(f"set supply_volts {volts}")
        slots(board, GROUND, DIVIDER)
        assert board.node(0)[3] == pytest.approx(0.04 * volts, abs=1e-12)


@pytest.mark.parametrize("pin,held", [("A6", 0.2), ("none", 0.0)])
def test_pin_without_a_divider_keeps_what_the_sampler_had(pin, held):
    with Board(app=firmware("adc"), constants=QUIET, supply_pin=pin) as board:
        board.run(1000)
        slots(board, GROUND, 0xC0 | 6)
        assert board.node(0)[3] == pytest.approx(held, abs=1e-12)
        slots(board, GROUND, 0xC0 | 7)
        assert board.node(0)[3] == 0


def test_bandgap_reference_differs_from_part_to_part_within_ten_percent_and_has_noise():
    full, spreads = [], []
    for seed in range(1, 13):
        with Board(app=firmware("adc"), constants=QUIET, seed=seed) as board:
            board.run(1000)
            full.append(bandgap_volts(board))
            seen = []
            for _ in range(40):                     # the divider's 0.2 V against the bandgap: code and dither
                codes, _ = slots(board, GROUND, BANDGAP_CHANNEL)
                seen.append(board.node(0)[3])
            mean = sum(seen) / len(seen)
            spreads.append((sum((v - mean) ** 2 for v in seen) / (len(seen) - 1)) ** 0.5)
            code = slots(board, GROUND, DIVIDER)[0][1]
            assert abs(code - 0.2 / full[-1] * 1024) <= 1
    assert 0.99 <= min(full) < 1.06 and 1.14 < max(full) <= 1.21
    assert 0.17e-3 < sum(spreads) / len(spreads) < 0.23e-3


def test_noise_of_the_bandgap_reference_reaches_the_codes():
    """0.2 mV of 1.1 V are 0.19 LSB at full scale: a node that reads half between two codes sees it."""
    seen = set()
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(1000)
        for volts in (4.2 + 0.01 * i for i in range(60)):
            board.command(f"set supply_volts {volts:.3f}")
            codes = {slots(board, DIVIDER)[0][0] for _ in range(4)}
            seen.add(len(codes))
    assert seen >= {1, 2}
