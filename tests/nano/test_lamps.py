# SPDX-License-Identifier: Apache-2.0
"""Currents of the emitters, what they do to supply and rail, the tally for eye safety; both wirings."""

import numpy
import pytest
from scipy.optimize import fsolve

from board import QUIET, Board, firmware, uniform_map
from test_leds import DARK, RAIL, SAMPLER, charge_pc, exposure, lit_cycles

ALL, ON_PORT_D, TICKS = 0b111110, 32, 1500


def circuit(lit, supply=5.0, source_ohm=0.5, rail_ohm=0.3, rail=RAIL):
    """(amperes of each, supply V, rail V) by solving the circuit's equations, not in closed form."""
    series = (5.0 - 1.2 - rail) / 0.020

    def misses(x):
        volts, end, each = x
        return [volts - (supply - source_ohm * lit * each), end - (rail + rail_ohm * lit * each),
                each * 1e3 - max(volts - 1.2 - end, 0) / series * 1e3]

    volts, end, each = fsolve(misses, [supply, rail, 0.02], xtol=1e-14)
    return each, volts, end


def lamps(board):
    """(emitters lit, amperes, supply V, rail V) now."""
    mask, amperes, supply, rail = board.command("lamps")
    return int(mask), float(amperes), float(supply), float(rail)


def while_lit(board, lit):
    """What lamps() says in the middle of an exposure; the pins stay so until the next one."""
    seen = []
    board.run(1000)
    board.send(b"X" + bytes([lit, 0]) + (40000).to_bytes(2, "little") + bytes(2))
    for _ in range(40):
        board.run(50)
        seen.append(lamps(board))
    board.run(4000)
    return max(seen, key=lambda row: row[0]), lamps(board)


@pytest.mark.parametrize("lit", [0b000010, 0b011110, ALL])
@pytest.mark.parametrize("supply", [4.2, 5.0, 5.5])
def test_current_supply_and_rail_are_those_of_the_circuit(lit, supply):
    constants = dict(QUIET, **{"supply.source_ohm": 0.5, "rail_ohm": 0.3})
    with Board(app=firmware("adc"), constants=constants) as board:
        board.command(f"set supply_volts {supply}")
        on, off = while_lit(board, lit)
    count = bin(lit).count("1")
    each, volts, rail = circuit(count, supply)
    assert on[0] == lit and off == (0, 0, supply, RAIL)
    assert on[1:] == pytest.approx((count * each, volts, rail), rel=1e-8)
    if supply == 4.2:
        assert each < 0.0121                # 1.2 of 2 V are left


def test_light_is_the_current_of_the_loaded_circuit(flat_map):
    constants = dict(QUIET, **{"supply.source_ohm": 0.5, "rail_ohm": 0.3})
    for supply in (4.4, 5.0, 5.5):
        for lit in (0b000010, 0b011110):
            with Board(app=firmware("adc"), constants=constants, map=flat_map) as board:
                board.command(f"set supply_volts {supply}")
                _, seconds, _, held = exposure(board, lit=lit, ticks=1200)
            count = bin(lit).count("1")
            each, _, rail = circuit(count, supply)
            # the lights stay on: the node is read against the same rail it was let go with
            collected = charge_pc(held, SAMPLER, rail)
            assert collected == pytest.approx(40e-9 * count * each / 0.020 * seconds * 1e12, rel=1e-6)


def test_tally_counts_pulses_to_the_cycle():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(1000)
        board.command("counters clear")
        assert board.counters()["longest_pulse_cycles"] == board.counters()["most_lit"] == 0
        pulses = []
        for lit, dark in ((0b000110, 300), (0b000010, 900), (0b111010, 500)):
            exposure(board, lit=lit, flags=DARK, ticks=TICKS, dark=dark)
            pulses.append((lit, lit_cycles(board)))
        seen = board.counters()
    for i in range(6):
        assert seen[f"lit_cycles_{i}"] == sum(cycles for lit, cycles in pulses if lit >> i & 1)
    assert seen["longest_pulse_cycles"] == max(cycles for _, cycles in pulses) > 900
    assert seen["most_lit"] == 4
    nanocoulomb = sum(bin(lit).count("1") * cycles for lit, cycles in pulses) / 16e6 * 0.020 * 1e9
    assert seen["led_charge_nc"] == pytest.approx(nanocoulomb, abs=1)


def test_pulse_under_way_counts_and_clear_begins_anew():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(1000)
        board.send(b"X" + bytes([0b000010, 0]) + (60000).to_bytes(2, "little") + bytes(2))
        board.run(1500)
        first = board.counters()
        board.run(1000)
        second = board.counters()
        board.command("counters clear")
        cleared = board.counters()
        board.run(100)
        third = board.counters()
    assert 0 < first["lit_cycles_1"] == first["longest_pulse_cycles"]
    assert abs(second["longest_pulse_cycles"] - first["longest_pulse_cycles"] - 16000) < 8
    assert cleared["lit_cycles_1"] == cleared["longest_pulse_cycles"] == cleared["led_charge_nc"] == 0
    assert cleared["most_lit"] == 1         # still lit
    assert abs(third["longest_pulse_cycles"] - 1600) < 8


def test_a_reset_ends_the_light():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(1000)
        board.send(b"X" + bytes([ALL, 0]) + (60000).to_bytes(2, "little") + bytes(2))
        board.run(1500)
        assert lamps(board)[0] == ALL
        board.command("reset")
        assert lamps(board) == (0, 0, 5, RAIL)


def test_sleep_is_counted():
    with Board(app=firmware("interrupts"), constants=QUIET) as board:
        board.run(3000)
        asleep = board.counters()["asleep_cycles"]
        board.command("counters clear")
        assert board.counters()["asleep_cycles"] == 0
    assert 150 < asleep <= 201              # of the 200 that the program waits for its timer


@pytest.mark.parametrize("emitters", [0b001, 0b010, 0b110, 0b111])
def test_photodiodes_see_their_emitters_on_d2_to_d4(photodiode_map, emitters):
    with Board(app=firmware("adc"), constants=QUIET, map=photodiode_map, wiring="photodiodes",
               map_reference=5.0) as board:
        board.run(1000)
        board.command("counters clear")
        _, seconds, _, held = exposure(board, lit=emitters << 2, flags=ON_PORT_D, ticks=1000)
        seen = board.counters()
    # a map of ones whose nominal mean is that of five emitters: 40 nA each
    expected = 40e-9 * bin(emitters).count("1") * seconds * 1e12
    assert charge_pc(held, SAMPLER) == pytest.approx(expected, rel=1e-6)
    assert [seen[f"lit_cycles_{i}"] > 0 for i in range(6)] == [bool(emitters >> i & 1) for i in range(6)]
    assert seen["most_lit"] == bin(emitters).count("1")


def test_photodiodes_never_emit_and_are_just_driven(photodiode_map):
    with Board(app=firmware("adc"), constants=QUIET, map=photodiode_map, wiring="photodiodes") as board:
        board.run(1000)
        board.command("counters clear")
        assert exposure(board, lit=ALL, ticks=1000)[3] == pytest.approx(0, abs=1e-9)
        seen = board.counters()
        assert seen["most_lit"] == seen["led_charge_nc"] == 0
        board.send(b"L")                    # PC0 high, converted: nothing loads it
        assert board.run(2000)[:2] == b"\xff\x03"


def test_other_pins_of_port_d_light_nothing(photodiode_map):
    with Board(app=firmware("adc"), constants=QUIET, map=photodiode_map, wiring="photodiodes") as board:
        assert exposure(board, lit=0b11100000, flags=ON_PORT_D, ticks=1000)[3] == pytest.approx(0, abs=1e-9)
    with Board(app=firmware("adc"), constants=QUIET) as board:
        exposure(board, lit=0b11111100, flags=ON_PORT_D, ticks=1000)     # wiring leds: nothing there
        assert board.counters()["most_lit"] == 0


def test_photodiode_emitters_do_not_load_the_rail(photodiode_map):
    constants = dict(QUIET, **{"supply.source_ohm": 0.5, "rail_ohm": 0.3})
    with Board(app=firmware("adc"), constants=constants, wiring="photodiodes") as board:
        board.run(1000)
        board.send(b"X" + bytes([0b11100, ON_PORT_D]) + (60000).to_bytes(2, "little") + bytes(2))
        board.run(1000)
        on = lamps(board)
    each = 0.020 / (1 + 0.5 * 3 * 0.020 / 3.8)
    assert on[0] == 0b111 and on[3] == RAIL
    assert on[1:3] == pytest.approx((3 * each, 5 - 0.5 * 3 * each), rel=1e-9)


def test_map_must_have_the_emitters_of_the_wiring(flat_map, photodiode_map):
    for path, wiring, what in ((flat_map, "photodiodes", "6 sensors and 3 emitters"),
                               (photodiode_map, "leds", "6 sensors and 6 emitters")):
        with pytest.raises(RuntimeError, match=what):
            Board(app=firmware("adc"), map=path, wiring=wiring).__enter__()


@pytest.mark.parametrize("key,value,what", [
    ("wiring", "resistors", "bad value for `wiring`"), ("rail_volts", "0", "bad value for `rail_volts`"),
    ("rail_volts", "x", "bad value"), ("rail_ohm", "-1", "bad value"), ("rail_noise_mv", "1e9", "bad value"),
    ("supply_pin", "A5", "bad value for `supply_pin`"), ("rail_colour", "1", "unknown key"),
    ("supply.volts", "3.0", "no room over rail_volts")])
def test_impossible_boards_are_refused(key, value, what):
    with pytest.raises(RuntimeError, match=what):
        Board(app=firmware("adc"), **{key: value}).__enter__()


def test_emitters_of_both_wirings_have_spreads_of_their_own(tmp_path):
    """Each emitter's light by seed, log-normal; sensors the same in both wirings."""
    ratios = []
    for wiring, lits, flags, emitters in (("leds", (0b10, 0b100), 0, 6),
                                          ("photodiodes", (0b100, 0b1000), ON_PORT_D, 3)):
        path = uniform_map(tmp_path / f"{wiring}.sgmap", emitters=emitters)
        constants = dict(QUIET, **{"photocurrent.part_spread": 0.3})
        with Board(app=firmware("adc"), constants=constants, map=path, wiring=wiring) as board:
            light = [charge_pc(exposure(board, lit=lit, flags=flags, ticks=1000)[3], SAMPLER) for lit in lits]
        ratios.append(light[1] / light[0])
    assert all(abs(numpy.log(ratio)) > 1e-3 for ratio in ratios)


def currents(flat_map, ticks, count, ripple_mv=50, **keys):
    """Photocurrents relative to the quiet one, of `count` exposures: the ripple's share of the light."""
    constants = dict(QUIET, **{"supply.ripple_mv": ripple_mv})
    with Board(app=firmware("adc"), constants=constants, map=flat_map, **keys) as board:
        board.command("motion 0")
        seen = []
        for _ in range(count):
            _, seconds, _, held = exposure(board, lit=ALL, ticks=ticks)
            seen.append(charge_pc(held, SAMPLER) * 1e-3 / seconds / 200)
    return numpy.array(seen), seconds


@pytest.mark.parametrize("ticks", [100, 1400])
def test_ripple_of_the_supply_is_in_the_light_and_averages_over_ten_microseconds(flat_map, ticks):
    seen, seconds = currents(flat_map, ticks, 250)
    # independent draws of 10 us each, of 50 mV in 2 V: the variance of their mean over the exposure, in which
    # the draws at both ends count in part (its phase against their grid is anything)
    n = seconds / 10e-6
    assert n > 2
    expected = 50e-3 / 2.0 * (1 / n - 1 / (3 * n * n)) ** 0.5
    assert numpy.std(seen) == pytest.approx(expected, rel=0.15)
    assert abs(numpy.mean(seen) - 1) < 4 * expected / 250 ** 0.5


def test_ripple_repeats_with_the_seed_and_not_otherwise(flat_map):
    first, again, other = (currents(flat_map, 400, 3, seed=seed)[0] for seed in (4, 4, 5))
    assert list(first) == list(again) != list(other)


def test_ripple_counts_more_where_the_supply_leaves_less(flat_map):
    spread = []
    for rail in (1.0, 3.0):
        seen, _ = currents(flat_map, 400, 120, ripple_mv=20, rail_volts=rail)
        spread.append(numpy.std(seen / numpy.mean(seen)))
    assert spread[1] / spread[0] == pytest.approx(2.8 / 0.8, rel=0.02)      # the same draws


def test_frame_log_has_the_electrical_moments():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        _, seconds, lit_s, _ = exposure(board, lit=0b000110, flags=DARK, ticks=1500, dark=700)
        sampled = board.node(0)[2]
        rows = [line.split(",") for line in board.log.read_text().splitlines()[1:]]
    at = {}
    for name, cycle in rows:
        at.setdefault(name, []).append(int(cycle))
    release, = at["release"]
    on, off = at["sample"]
    assert at["lit:6"] == [on - 1] and at["lit:0"] == [off - 1]
    assert at["drive0:3"] == [release - 1] == [sampled - round(seconds * 16e6)]
    assert at["drive1:1"] == at["drive2:1"] == at["lit:6"] and at["drive1:0"][-1] == at["lit:0"][0]
    assert at["adc:0"] == [sampled] and len(at["adc:15"]) == 1
    assert [int(cycle) for _, cycle in rows] == sorted(int(cycle) for _, cycle in rows)
