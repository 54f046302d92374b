# SPDX-License-Identifier: Apache-2.0
"""LEDs as sensors: discharge against the closed form, charge sharing, supply, floor, piecewise light."""

import struct

import pytest

from board import QUIET, Board, firmware

C0, PIN, SAMPLER, VOLTS = 40.0, 6.0, 14.0, 5.0      # pF, V: nominal constants of physics.toml


def charge_pc(volts, extra_pf=0.0):
    """Charge of a node, pC: the integral of C0 / (1 + v/0.7)^0.4, pin and sampler."""
    return C0 * 0.7 / 0.6 * ((1 + volts / 0.7) ** 0.6 - 1) + (PIN + extra_pf) * volts


def volts_of(charge, extra_pf=0.0):
    """Inverse of charge_pc by bisection, V."""
    low, high = -0.3, 6.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if charge_pc(middle, extra_pf) < charge else (low, middle)
    return low


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
    released = int(rows["release"]) - 1     # the mark is the OUT after the one that ends the pull-up
    dark_s = (int(rows["sample"]) - 1 - released) / 16e6 if flags & 4 else None
    return code, (sampled - released) / 16e6, dark_s, held


def bench(**constants):
    return Board(app=firmware("adc"), constants=dict(QUIET, **constants))


@pytest.mark.parametrize("ticks", [20, 200, 500, 900])
def test_constant_current_discharges_as_the_closed_form_to_a_nanovolt(ticks):
    with bench() as board:
        board.command("set ambient sun_gap")        # 2 uA, steady
        code, seconds, _, held = exposure(board, ticks=ticks)
    collected = 2000e-9 * seconds * 1e12
    # precharged sampler: it is as if it had hung on the node all the time
    expected = volts_of(charge_pc(VOLTS, SAMPLER) - collected, SAMPLER)
    assert abs(held - expected) < 1e-9
    assert code == int(expected / VOLTS * 1024 + 0.5)


def test_sampler_of_another_channel_takes_its_share():
    with bench() as board:
        _, _, _, held = exposure(board, flags=2)
    expected = volts_of(charge_pc(VOLTS), SAMPLER)   # 0 V on the sampler before
    assert abs(held - expected) < 1e-9
    assert held < 0.75 * VOLTS                       # not a small effect


def test_dark_node_without_leakage_keeps_its_charge():
    with bench() as board:
        code, _, _, held = exposure(board, ticks=30000)
    assert abs(held - VOLTS) < 1e-9 and code == 1023


def test_leakage_is_one_nanoampere_and_doubles_in_ten_kelvin():
    with bench(**{"node.leakage_na": 1}) as board:
        for warmer, leakage in ((0, 1e-9), (10, 2e-9)):
            board.command(f"set warmer_k {warmer}")
            _, seconds, _, held = exposure(board, ticks=40000)
            collected = charge_pc(VOLTS, SAMPLER) - charge_pc(held, SAMPLER)
            assert collected == pytest.approx(leakage * seconds * 1e12, rel=1e-6)


@pytest.mark.parametrize("lit", [0, 0b000010, 0b111110])
def test_lit_emitters_pull_the_supply_down(lit):
    count = bin(lit).count("1")
    with bench(**{"supply.source_ohm": 0.5, "node.sample_hold_pf": 0}) as board:
        code, _, _, held = exposure(board, lit=lit)
    assert held == pytest.approx(VOLTS - 0.5 * 0.020 * count, abs=1e-9)
    assert code == 1023                              # the reference sags with it


def test_reference_of_each_bit_is_that_of_its_moment():
    # Lights out just after the sample: the node was charged to 4.95 V, the reference is back at 5 V.
    with bench(**{"supply.source_ohm": 0.5, "node.sample_hold_pf": 0}) as board:
        code, _, _, held = exposure(board, lit=0b111110, flags=4, ticks=1000, dark=1000 + 256 + 20)
    assert held == pytest.approx(4.95, abs=1e-9)
    assert code == int(4.95 / 5 * 1024 + 0.5)


def test_ripple_is_independent_between_release_and_reference():
    with bench(**{"supply.ripple_mv": 5}) as board:
        held, codes = [], []
        for _ in range(80):
            code, _, _, volts = exposure(board)
            held.append(volts)
            codes.append(code)
    mean = sum(held) / len(held)
    spread = (sum((v - mean) ** 2 for v in held) / (len(held) - 1)) ** 0.5
    # Node (23.5 pF at 5 V) and sampler (14 pF) are charged at different moments: weights 0.63 and 0.37
    assert 2.5e-3 < spread < 5e-3
    assert len(set(codes)) > 1


def test_pull_up_left_on_drowns_the_photocurrent():
    with bench() as board:
        board.command("set ambient sun_gap")
        code, *_ = exposure(board, flags=1, ticks=2000)
    assert code >= 1005


def test_node_at_the_floor_reads_what_the_charged_sampler_leaves():
    # The node stops at -0.25 V; the sampler, charged to 5 V, joins two ADC clocks before the sample, and 2 uA
    # discharge both for those 16 us. A channel that ran into its floor does not read zero.
    with bench() as board:
        board.command("set ambient sun_gap")
        code, _, _, held = exposure(board, ticks=16000)
    joined = charge_pc(-0.25) + SAMPLER * VOLTS
    assert abs(held - volts_of(joined - 2e-6 * 256 / 16e6 * 1e12, SAMPLER)) < 1e-9
    assert code == int(held / VOLTS * 1024 + 0.5) > 50


def test_grounded_sampler_reads_zero_at_the_floor():
    with bench() as board:
        board.command("set ambient sun_gap")
        code, _, _, held = exposure(board, flags=2, ticks=16000)
    assert code == 0 and held == pytest.approx(-0.25, abs=1e-9)


def test_part_spread_and_seed_change_the_photocurrent():
    held = []
    for seed in (1, 1, 2):
        with Board(app=firmware("adc"), seed=seed,
                   constants=dict(QUIET, **{"photocurrent.part_spread": 0.3})) as board:
            board.command("set ambient sun_gap")
            held.append(exposure(board, ticks=300)[3])
    assert held[0] == held[1] != held[2]


@pytest.fixture(scope="module")
def flat_map(tmp_path_factory):
    """A map on which every emitter gives every sensor the same, whatever the eye does."""
    import numpy

    from sparsegaze import mapfile

    path = tmp_path_factory.mktemp("map") / "flat.sgmap"
    gaze = numpy.linspace(-30.0, 30.0, 4)
    mapfile.write_map(path, pupil_mm=3.5, lid_opening=1.0, slip_mm=(0.0, 0.0, 0.0), elevation_deg=gaze,
                      azimuth_deg=gaze, smooth=numpy.ones((1, 1, 1, 1, 1, 4, 4, 6, 6)), glint_lid_opening=1.0,
                      glint_elevation_deg=gaze, glint_azimuth_deg=gaze,
                      glint=numpy.zeros((1, 1, 1, 1, 4, 4, 6, 6)))
    return path


@pytest.mark.parametrize("lit", [0b000010, 0b010100, 0b111110])
def test_photocurrent_is_the_sum_over_lit_emitters(flat_map, lit):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map) as board:
        _, seconds, _, held = exposure(board, lit=lit, ticks=3000)
    collected = charge_pc(VOLTS, SAMPLER) - charge_pc(held, SAMPLER)
    assert collected == pytest.approx(200e-9 / 5 * bin(lit).count("1") * seconds * 1e12, rel=1e-9)


def test_lights_out_in_the_middle_stops_the_collection(flat_map):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map) as board:
        _, seconds, lit_s, held = exposure(board, lit=0b111110, flags=4, ticks=4000, dark=1500)
    collected = charge_pc(VOLTS, SAMPLER) - charge_pc(held, SAMPLER)
    assert lit_s < 0.5 * seconds
    assert collected == pytest.approx(200e-9 * lit_s * 1e12, rel=1e-9)


@pytest.mark.parametrize("light,na", [("dim", 75), ("nominal", 200), ("bright", 600)])
def test_light_levels(flat_map, light, na):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map, light=light) as board:
        _, seconds, _, held = exposure(board, lit=0b111110, ticks=1500)
    collected = charge_pc(VOLTS, SAMPLER) - charge_pc(held, SAMPLER)
    assert collected == pytest.approx(na * 1e-9 * seconds * 1e12, rel=1e-9)


def test_emitters_weaken_when_warm(flat_map):
    with Board(app=firmware("adc"), constants=QUIET, map=flat_map) as board:
        board.command("set warmer_k 10")
        _, seconds, _, held = exposure(board, lit=0b111110, ticks=3000)
    collected = charge_pc(VOLTS, SAMPLER) - charge_pc(held, SAMPLER)
    assert collected == pytest.approx(0.95 * 200e-9 * seconds * 1e12, rel=1e-9)


@pytest.mark.parametrize("ambient,mean_na,share", [("room", 20, 0.3), ("bright_room", 200, 0.5)])
def test_ambient_light_flickers_with_the_mains(ambient, mean_na, share):
    currents = []
    with bench() as board:
        board.command(f"set ambient {ambient}")
        for _ in range(100):
            _, seconds, _, held = exposure(board, ticks=2000)
            collected = charge_pc(VOLTS, SAMPLER) - charge_pc(held, SAMPLER)
            currents.append(collected * 1e-3 / seconds)
            board.run(137)                  # so that the samples sweep the phase of 100 or 120 Hz
    assert min(currents) == pytest.approx(mean_na * (1 - share), rel=0.05)
    assert max(currents) == pytest.approx(mean_na * (1 + share), rel=0.05)
