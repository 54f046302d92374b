# SPDX-License-Identifier: Apache-2.0
"""What is broken on the headset: each fault's electrical face, parts exchanged, what is refused."""

import numpy
import pytest

from board import QUIET, Board, firmware, uniform_map
from test_leds import DARK, HIGH_SAMPLER, PIN, RAIL, SAMPLER, VOLTS, charge_pc, exposure, lit_cycles

ALL, TICKS = 0b111110, 900
OHM = (5 - 1.2 - RAIL) / 0.020          # what is in series with each LED: 20 mA at 5 V


def current_na(board, lit=ALL, **options):
    """Photocurrent of LED 0 in one exposure, nA."""
    _, seconds, _, held = exposure(board, lit=lit, ticks=TICKS, **options)
    return charge_pc(held, SAMPLER) * 1e-3 / seconds


def bench(map, **keys):
    return Board(app=firmware("adc"), constants=dict(QUIET), map=map, **keys)


@pytest.mark.parametrize("part,kind,na", [
    (0, "none", 200), (3, "open", 160), (3, "short", 160), (3, "short_ground", 160), (3, "covered", 160.4),
    (0, "covered", 2), (0, "finger", 1200), (3, "finger", 200)])
def test_light_of_a_fault(flat_map, part, kind, na):
    with bench(flat_map) as board:
        board.command(f"fault {part} {kind}")
        assert current_na(board) == pytest.approx(na, rel=1e-6)
        board.command(f"fault {part} none")
        assert current_na(board) == pytest.approx(200, rel=1e-6)


@pytest.mark.parametrize("kind,share", [("none", 1), ("covered", 0.01), ("finger", 0.1), ("open", 0)])
def test_ambient_light_of_a_fault(flat_map, kind, share):
    with bench(flat_map) as board:
        board.command("set ambient_na 300")
        board.command(f"set fault_0 {kind}")
        assert current_na(board, lit=0) == pytest.approx(300 * share, abs=1e-6)


def test_finger_reflects_only_what_is_lit(flat_map):
    with bench(flat_map) as board:
        board.command("fault 0 finger")
        assert current_na(board, lit=0) == pytest.approx(0, abs=1e-9)
        assert current_na(board, lit=0b000110) == pytest.approx(0.4 * 1200, rel=1e-6)


def test_open_sensor_is_the_pin_alone(flat_map):
    with Board(app=firmware("adc"), constants=dict(QUIET, **{"node.leakage_na": 500}), map=flat_map) as board:
        board.command("fault 0 open")
        board.command("fault 1 open")       # its pin, high, puts 5 V on the sampler and lights nothing
        code, _, _, held = exposure(board, lit=ALL)
        assert held == pytest.approx(0, abs=1e-12) and code == 0
        _, _, _, held = exposure(board, lit=0, flags=HIGH_SAMPLER)
    assert held == pytest.approx(SAMPLER * VOLTS / (SAMPLER + PIN), abs=1e-12)


@pytest.mark.parametrize("kind,volts,amperes", [
    ("short", RAIL, (VOLTS - RAIL) / OHM), ("short_ground", 0, VOLTS / OHM), ("none", None, 0.020)])
def test_shorted_part_is_stiff_and_conducts_without_light(flat_map, kind, volts, amperes):
    with bench(flat_map) as board:
        board.command("fault 0 " + kind)
        if volts is not None:
            code, _, _, held = exposure(board, lit=ALL, flags=HIGH_SAMPLER)
            assert held == pytest.approx(volts, abs=1e-12) and code == int(volts / 5 * 1024 + 0.5)
            assert board.node(0)[0] == pytest.approx(volts, abs=1e-12)
        board.command("fault 0 none")
        board.command("fault 1 " + kind)
        board.command("counters clear")
        exposure(board, lit=0b000010, flags=DARK, dark=500)
        seen, cycles = board.counters(), lit_cycles(board)
    assert (seen["lit_cycles_1"] > 0) == (seen["most_lit"] > 0) == (kind == "none")
    assert seen["led_charge_nc"] == pytest.approx(amperes * cycles / 16e6 * 1e9, abs=1)


def test_rail_noise_is_what_a_shorted_sensor_shows():
    with Board(app=firmware("adc"), constants=dict(QUIET, rail_noise_mv=2)) as board:
        board.command("fault 0 short")
        held = [exposure(board, ticks=200)[3] for _ in range(120)]
    assert numpy.mean(held) == pytest.approx(RAIL, abs=1e-3)
    assert numpy.std(held) == pytest.approx(2e-3, rel=0.25)


@pytest.fixture(scope="module")
def told_apart(tmp_path_factory):
    """A map on which every pair gives another light."""
    pattern = numpy.arange(36.0).reshape(6, 6) + 1
    return pattern, uniform_map(tmp_path_factory.mktemp("map") / "apart.sgmap", pattern=pattern)


@pytest.mark.parametrize("swaps", [(), ((0, 4),), ((1, 2),), ((0, 3), (0, 5)), ((2, 1), (1, 2))])
def test_exchanged_parts_sense_and_emit_from_each_other_s_places(told_apart, swaps):
    pattern, path = told_apart
    at = list(range(6))
    with bench(path, map_reference=1e3) as board:
        for a, b in swaps:
            board.command(f"swap {a} {b}")
            at[a], at[b] = at[b], at[a]
        for lit in (0b000010, 0b010100, ALL):
            expected = sum(pattern[at[0], at[e]] for e in range(6) if lit >> e & 1) * 200 / 1e3
            assert current_na(board, lit=lit) == pytest.approx(expected, rel=1e-6)


def test_fault_moves_with_the_part(flat_map):
    with bench(flat_map) as board:
        board.command("fault 3 covered")
        board.command("swap 0 3")
        assert current_na(board) == pytest.approx(2, rel=1e-6)
        board.command("swap 3 0")
        assert current_na(board) == pytest.approx(160.4, rel=1e-6)


def test_opened_while_it_floats_it_keeps_its_voltage(flat_map):
    with bench(flat_map) as board:
        board.command("set ambient_na 100")
        exposure(board, ticks=2000)
        before = board.node(0)[0]
        board.command("fault 0 open")
        assert board.node(0)[0] == pytest.approx(before, abs=1e-12)
        board.run(1000)
        assert board.node(0)[0] == pytest.approx(before, abs=1e-12)     # nothing charges it


@pytest.mark.parametrize("line,what", [
    ("fault 6 open", "LEDs 0..5"), ("fault -1 open", "LEDs 0..5"), ("fault 00 open", "LEDs 0..5"),
    ("fault 0 broken", "fault is none, open"), ("fault 0", "part and a kind"), ("fault", "part and a kind"),
    ("swap 1 1", "two different pins"), ("swap 0 6", "two different pins"), ("swap 0", "two different pins"),
    ("set fault_7 open", "LEDs 0..5"), ("set fault_ open", "LEDs 0..5"),
    ("set fault_0 bad", "fault is none")])
def test_what_is_no_fault_is_refused_with_a_reason(line, what):
    with Board(app=firmware("adc"), constants=QUIET) as board:
        answer = board.ask(line)
        assert answer.startswith("err ") and what in answer


def test_faults_of_photodiodes_and_of_their_emitters(photodiode_map):
    with bench(photodiode_map, wiring="photodiodes") as board:
        def now():
            return current_na(board, lit=0b1100, flags=32)     # D2 and D3

        each = now() / 2
        board.command("fault 0 covered")
        assert now() == pytest.approx(0.02 * each, rel=1e-6)
        board.command("fault 0 none")
        board.command("fault 6 covered")                        # D2
        assert now() == pytest.approx(1.01 * each, rel=1e-6)
        board.command("fault 6 open")
        assert now() == pytest.approx(each, rel=1e-6)
        board.command("fault 8 open")                           # D4 was dark anyway
        assert now() == pytest.approx(each, rel=1e-6)
        for line in ("fault 9 open", "fault 7 short", "fault 7 finger"):
            assert board.ask(line).startswith("err ")
