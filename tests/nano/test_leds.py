# SPDX-License-Identifier: Apache-2.0
"""LEDs as sensors: charging against closed form and integrator, charge sharing, rail, ceiling, light."""

import struct

import numpy
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from board import QUIET, Board, firmware

C0, PIN, SAMPLER, VOLTS, RAIL = 40.0, 6.0, 14.0, 5.0, 1.8      # pF, V: nominal constants; the board's rail
HIGH_SAMPLER, DARK, QUICK, BANDGAP = 2, 4, 8, 16               # flags of the bench program
JOINED_S = 2 * 128 / 16e6                                      # the sampler hangs on the node for that long


def capacitance_pf(volts, extra_pf=0.0, rail=RAIL):
    """Of a node at `volts`: junction, pin and sampler, pF."""
    return C0 / (1 + (rail - volts) / 0.7) ** 0.4 + PIN + extra_pf


def charge_pc(volts, extra_pf=0.0, rail=RAIL):
    """Charge collected from 0 V on, pC: the integral of capacitance_pf()."""
    junction = ((1 + rail / 0.7) ** 0.6 - (1 + (rail - volts) / 0.7) ** 0.6) * C0 * 0.7 / 0.6
    return junction + (PIN + extra_pf) * volts


def volts_of(charge, extra_pf=0.0, rail=RAIL):
    """Inverse of charge_pc(), V; never above the ceiling."""
    top = rail + 0.25
    if charge >= charge_pc(top, extra_pf, rail):
        return top
    return brentq(lambda volts: charge_pc(volts, extra_pf, rail) - charge, -1.0, top, xtol=1e-13, rtol=1e-14)


def integrated(pieces, volts=0.0, extra_pf=0.0):
    """The node after pieces of (current nA as a function of seconds, begin s, end s), by an integrator, V."""
    for current, begin, end in pieces:
        found = solve_ivp(lambda t, v: current(t) * 1e-9 / (capacitance_pf(v[0], extra_pf) * 1e-12),
                          (begin, end), [volts], method="DOP853", rtol=1e-12, atol=1e-13)
        volts = found.y[0, -1]
    return volts


def exposure(board, lit=0, flags=0, ticks=1000, dark=0):
    """One exposure of LED 0: (code, seconds of floating, seconds until lights out, volts held)."""
    if not board.cycle:
        board.run(1000)                     # the program is not listening yet
    board.log = board.folder / "frames.csv"
    board.command(f"frames on {board.log}")
    board.send(b"X" + struct.pack("<BBHH", lit, flags, ticks, dark))
    code, = struct.unpack("<H", board.run(6000))
    _, _, sampled, held = board.node(0)
    rows = dict(line.split(",") for line in board.log.read_text().splitlines()[1:])
    released = int(rows["release"]) - 1     # the mark is the OUT after the one that lets the pin float
    dark_s = (int(rows["sample"]) - 1 - released) / 16e6 if flags & 4 else None
    return code, (sampled - released) / 16e6, dark_s, held


def lit_cycles(board):
    """Cycles from lights on to lights out of the last exposure with DARK."""
    rows = (line.split(",") for line in board.log.read_text().splitlines())
    marks = [int(cycle) for name, cycle in rows if name == "sample"]
    return marks[1] - marks[0]


def bench(**constants):
    return Board(app=firmware("adc"), constants=dict(QUIET, **constants))


@pytest.mark.parametrize("ticks", [20, 100, 200, 300])
def test_constant_current_charges_as_the_closed_form_and_the_integrator(ticks):
    with bench() as board:
        board.command("set ambient sun_gap")        # 2 uA, steady
        code, seconds, _, held = exposure(board, ticks=ticks)
    # a sampler at 0 V when the node was: it is as if it had hung on the node all the time
    assert abs(held - volts_of(2000e-9 * seconds * 1e12, SAMPLER)) < 1e-9
    assert abs(held - integrated([(lambda t: 2000.0, 0.0, seconds)], extra_pf=SAMPLER)) < 1e-9
    assert code == int(held / VOLTS * 1024 + 0.5)


def test_charge_of_the_node_is_the_integral_of_its_capacitance():
    assert integrated([(lambda t: 250.0, 0.0, 1e-4)]) == pytest.approx(volts_of(25.0), abs=1e-10)
    assert 0.5 < volts_of(25.0) < 1.1               # full scale of the internal reference is in reach


def test_sampler_of_another_channel_takes_its_share():
    with bench() as board:
        board.command("set ambient_na 400")
        _, seconds, _, alone = exposure(board, ticks=1000)
        board.command("fault 1 open")               # an open LED's pin is just high: 5 V on the sampler
        _, again, _, held = exposure(board, flags=HIGH_SAMPLER, ticks=1000)
    assert seconds == again
    node = charge_pc(volts_of(0.4e-6 * (seconds - JOINED_S) * 1e12)) + SAMPLER * VOLTS
    assert abs(held - volts_of(node + 0.4e-6 * JOINED_S * 1e12, SAMPLER)) < 1e-9
    assert held > alone + 1.0                       # not a small effect


def test_dark_node_without_leakage_keeps_its_charge():
    with bench() as board:
        code, _, _, held = exposure(board, ticks=30000)
    assert abs(held) < 1e-9 and code == 0


def test_leakage_is_one_nanoampere_and_doubles_in_ten_kelvin():
    with bench(**{"node.leakage_na": 1}) as board:
        for warmer, leakage in ((0, 1e-9), (10, 2e-9)):
            board.command(f"set warmer_k {warmer}")
            _, seconds, _, held = exposure(board, ticks=40000)
            assert charge_pc(held, SAMPLER) == pytest.approx(leakage * seconds * 1e12, rel=1e-6)


@pytest.mark.parametrize("lit", [0, 0b000010, 0b111110])
def test_supply_does_not_reach_what_the_bandgap_measures(lit):
    with bench(**{"supply.source_ohm": 0.5, "supply.ripple_mv": 5}) as board:
        board.command("set ambient_na 500")
        seen = {exposure(board, lit=lit, flags=BANDGAP, ticks=800)[3] for _ in range(5)}
    assert len(seen) == 1 and 0.1 < seen.pop() < 1.1


def test_reference_of_each_bit_is_that_of_its_moment():
    # Five emitters pull the supply to 4.95 V; lights out just after the sample: the reference is back at 5 V.
    # Their current through source_ohm comes from what it leaves over 1.8 + 1.2 V.
    codes = []
    with bench(**{"supply.source_ohm": 5}) as board:
        board.command("set ambient_na 2000")
        for dark in (1000 + 256 + 20, 60000):
            flags = DARK if dark < 60000 else 0
            code, _, _, held = exposure(board, lit=0b111110, flags=flags, ticks=1000, dark=dark)
            codes.append((code, held))
    loaded = 5 - 5 * 5 * 0.020 / (1 + 5 * 5 * 0.020 / 2)
    assert codes[0][1] == pytest.approx(codes[1][1], abs=1e-9)
    assert codes[0][0] == int(codes[0][1] / 5 * 1024 + 0.5)
    assert codes[1][0] == int(codes[1][1] / loaded * 1024 + 0.5) > codes[0][0] + 20


def test_rail_noise_is_independent_between_release_and_sample():
    with bench(rail_noise_mv=50) as board:
        held = [exposure(board, ticks=400)[3] for _ in range(150)]
        quiet = [exposure(board, ticks=400)[3] for _ in range(3)]
    # The junction's share of all capacitance, at 0 V and with the sampler, twice in quadrature.
    share = (capacitance_pf(0) - PIN) / capacitance_pf(0, SAMPLER)
    assert numpy.std(held) == pytest.approx(50e-3 * share * 2 ** 0.5, rel=0.15)
    assert abs(numpy.mean(held)) < 4 * 50e-3 * share * 2 ** 0.5 / 150 ** 0.5
    assert len(set(quiet)) == 3


def test_rail_rises_with_the_current_sent_into_it(flat_map):
    # Lights out after the release: the rail falls by 0.3 ohm times five LEDs, and the node with it.
    held = []
    for ohm in (0, 0.3):
        with Board(app=firmware("adc"), constants=dict(QUIET, rail_ohm=ohm)) as board:
            held.append(exposure(board, lit=0b111110, flags=DARK, ticks=600, dark=100)[3])
    fall = 0.3 * 5 * 0.020 / (1 + 0.3 * 5 * 0.020 / 2)
    share = (capacitance_pf(0) - PIN) / capacitance_pf(0, SAMPLER)
    assert held[0] == pytest.approx(0, abs=1e-9)
    assert held[1] == pytest.approx(-share * fall, rel=0.01)


def test_pull_up_left_on_drowns_the_photocurrent():
    with bench() as board:
        code, _, _, held = exposure(board, flags=1, ticks=2000)
    assert held == pytest.approx(RAIL + 0.25, abs=1e-3) and code > 410


def test_node_at_the_ceiling_shares_with_the_sampler():
    # The node stops at the rail plus 0.25 V; the sampler, at 0 V, joins two ADC clocks before the sample.
    with bench() as board:
        board.command("set ambient_na 500")
        code, _, _, held = exposure(board, ticks=16000)
        board.run(1000)
        after = board.node(0)[0]
    assert abs(held - volts_of(charge_pc(RAIL + 0.25) + 0.5e-6 * JOINED_S * 1e12, SAMPLER)) < 1e-9
    assert after == pytest.approx(RAIL + 0.25, abs=1e-9) and code > 300


@pytest.mark.parametrize("rail", [2.0, 3.0])
def test_rail_of_the_board_is_that_of_the_configuration(rail):
    with Board(app=firmware("adc"), constants=dict(QUIET, rail_volts=rail)) as board:
        board.command("set ambient_na 800")
        _, seconds, _, held = exposure(board, ticks=600)
    assert abs(held - volts_of(800e-9 * seconds * 1e12, SAMPLER, rail)) < 1e-9


def test_part_spread_and_seed_change_the_photocurrent():
    held = []
    for seed in (1, 1, 2):
        with Board(app=firmware("adc"), seed=seed,
                   constants=dict(QUIET, **{"photocurrent.part_spread": 0.3})) as board:
            board.command("set ambient sun_gap")
            held.append(exposure(board, ticks=300)[3])
    assert held[0] == held[1] != held[2]


@pytest.mark.parametrize("lit", [0b000010, 0b010100, 0b111110])
def test_photocurrent_is_the_sum_over_lit_emitters(flat_map, lit):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map) as board:
        _, seconds, _, held = exposure(board, lit=lit, ticks=3000)
    collected = charge_pc(held, SAMPLER)
    assert collected == pytest.approx(200e-9 / 5 * bin(lit).count("1") * seconds * 1e12, rel=1e-6)


def test_lights_out_in_the_middle_stops_the_collection(flat_map):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map) as board:
        _, seconds, lit_s, held = exposure(board, lit=0b111110, flags=DARK, ticks=4000, dark=1500)
    collected = charge_pc(held, SAMPLER)
    assert lit_s < 0.5 * seconds
    assert collected == pytest.approx(200e-9 * lit_s * 1e12, rel=1e-6)


@pytest.mark.parametrize("light,na", [("dim", 75), ("nominal", 200), ("bright", 600)])
def test_light_levels(flat_map, light, na):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map, light=light) as board:
        _, seconds, _, held = exposure(board, lit=0b111110, ticks=1500)
    collected = charge_pc(held, SAMPLER)
    assert collected == pytest.approx(na * 1e-9 * seconds * 1e12, rel=1e-6)


def test_emitters_weaken_when_warm(flat_map):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map) as board:
        board.command("set warmer_k 10")
        _, seconds, _, held = exposure(board, lit=0b111110, ticks=3000)
    collected = charge_pc(held, SAMPLER)
    assert collected == pytest.approx(0.95 * 200e-9 * seconds * 1e12, rel=1e-6)


@pytest.mark.parametrize("ambient,mean_na,share", [("room", 20, 0.3), ("bright_room", 200, 0.5)])
def test_ambient_light_flickers_with_the_mains(ambient, mean_na, share):
    currents = []
    with bench() as board:
        board.command(f"set ambient {ambient}")
        for _ in range(100):
            _, seconds, _, held = exposure(board, ticks=2000)
            collected = charge_pc(held, SAMPLER)
            currents.append(collected * 1e-3 / seconds)
            board.run(137)                  # so that the samples sweep the phase of 100 or 120 Hz
    assert min(currents) == pytest.approx(mean_na * (1 - share), rel=0.05)
    assert max(currents) == pytest.approx(mean_na * (1 + share), rel=0.05)
