# SPDX-License-Identifier: Apache-2.0
"""Changes at exact cycles, in the middle of an exposure: against an integrator of the node."""

import struct

import numpy
import pytest
from scipy.integrate import quad
from scipy.optimize import least_squares

from board import QUIET, Board, firmware
from test_leds import SAMPLER, charge_pc, exposure, integrated, volts_of

ALL, TICKS = 0b111110, 1500


class Bench:
    """Exposures whose release and sample are known beforehand: lockstep repeats itself to the cycle."""

    def __init__(self, lit=0, **keys):
        self.lit, self.keys = lit, keys
        with self.board() as board:
            self.released, self.sampled, _ = self.expose(board)

    def board(self):
        return Board(app=firmware("adc"), constants=QUIET, **self.keys)

    def expose(self, board, at=()):
        """Release and sample (cycles), volts held of an exposure; `at`: (cycle, key, value) set before."""
        board.run(1000)
        board.log = board.folder / "frames.csv"
        board.command(f"frames on {board.log}")
        for cycle, key, value in at:
            board.command(f"set_at {cycle} {key} {value}")
        board.send(b"X" + struct.pack("<BBHH", self.lit, 0, TICKS, 0))
        self.code, = struct.unpack("<H", board.run(6000))
        rows = dict(line.split(",") for line in board.log.read_text().splitlines()[1:])
        return int(rows["release"]) - 1, board.node(0)[2], board.node(0)[3]

    def held(self, *at):
        """Volts held after changes `at` cycles from the release: (cycles, key, value)."""
        with self.board() as board:
            released, sampled, held = self.expose(board, [(self.released + c, k, v) for c, k, v in at])
        assert (released, sampled) == (self.released, self.sampled)
        return held

    @property
    def seconds(self):
        return (self.sampled - self.released) / 16e6


@pytest.fixture(scope="module")
def dark():
    return Bench()


@pytest.fixture(scope="module")
def lit(flat_map):
    return Bench(lit=ALL, map=flat_map)


@pytest.mark.parametrize("cycles", [-1000, -1, 0, 1, 2, 3, 7, 777, 778, 779, 780, 1501, 1700])
def test_ambient_step_in_the_middle_of_an_exposure_is_integrated_exactly(dark, cycles):
    held = dark.held((-1500, "ambient_na", 30), (cycles, "ambient_na", 600))
    turn = max(cycles, 0) / 16e6
    assert abs(held - volts_of((30 * turn + 600 * (dark.seconds - turn)) * 1e-3 * 1e6, SAMPLER)) < 1e-9
    # the sampler, at 0 V, joins late; it is as if it had hung there from the release on
    pieces = [(lambda t: 30.0, 0.0, turn)] * (turn > 0) + [(lambda t: 600.0, turn, dark.seconds)]
    assert abs(held - integrated(pieces, extra_pf=SAMPLER)) < 1e-9


@pytest.mark.parametrize("late", [0, 1, 100])
def test_step_at_or_after_the_sample_comes_too_late(dark, late):
    after = dark.sampled - dark.released + late
    assert dark.held((after, "ambient_na", 1e5)) == pytest.approx(0, abs=1e-12)
    assert dark.held((after - late - 1, "ambient_na", 1e5)) > 0.05      # 6 pC in the last cycle


@pytest.mark.parametrize("bits", range(11))
@pytest.mark.parametrize("supply", [4.3, 5.5])
def test_reference_that_steps_during_the_approximation_counts_for_the_bits_after(dark, bits, supply):
    step = dark.sampled - dark.released + 128 * bits + 64
    held = dark.held((-500, "ambient_na", 200), (step, "supply_volts", supply))
    expected = 0
    for n in range(10):                                 # bit n is decided 128 (n + 1) cycles after the sample
        trial = expected | 512 >> n
        reference = 5.0 if n + 1 <= bits else supply
        if held >= (trial - 0.5) / 1024 * reference:
            expected = trial
    assert dark.code == expected


def test_many_steps_in_one_exposure(dark):
    steps = [(97 * k, 40.0 * (k * 7 % 5)) for k in range(18)]
    held = dark.held(*((cycles, "ambient_na", na) for cycles, na in steps))
    ends = [cycles for cycles, _ in steps[1:]] + [dark.sampled - dark.released]
    pieces = [(lambda t, na=na: na, cycles / 16e6, end / 16e6) for (cycles, na), end in zip(steps, ends)]
    assert abs(held - integrated(pieces, extra_pf=SAMPLER)) < 1e-9


def test_of_one_cycle_the_later_given_wins(dark):
    assert dark.held((0, "ambient_na", 9000), (0, "ambient_na", 50)) == pytest.approx(
        volts_of(50e-9 * dark.seconds * 1e12, SAMPLER), abs=1e-9)


@pytest.mark.parametrize("key,value,ratio", [
    ("light", "dim", 75 / 200), ("light", "bright", 3), ("warmer_k", 20, 0.9), ("supply_volts", 4.3, 0.65),
    ("supply_volts", 5.4, 1.2), ("fault_1", "open", 0.8), ("fault_0", "covered", 0.01)])
def test_step_of_what_lights_the_node(lit, key, value, ratio):
    cycles = 803
    collected = charge_pc(lit.held((cycles, key, value)), SAMPLER)
    first = cycles / 16e6
    expected = 200e-9 * (first + ratio * (lit.seconds - first)) * 1e12
    assert collected == pytest.approx(expected, rel=1e-6)


def test_light_goes_out_where_the_supply_leaves_nothing(flat_map):
    with Board(app=firmware("adc"), constants=dict(QUIET, rail_volts=3.3), map=flat_map) as board:
        board.command("set supply_volts 4.4")               # 3.3 + 1.2 V are more
        assert exposure(board, lit=ALL)[3] == pytest.approx(0, abs=1e-12)


def test_flicker_is_integrated_and_another_frequency_goes_on_where_the_wave_is():
    """Depth and frequencies as set; the phase, the session's, is fitted to half of the first exposures."""
    rows = []
    with Board(app=firmware("adc"), constants=QUIET) as board:
        for line in ("ambient_na 400", "ambient_flicker 0.7", "flicker_hz 433"):
            board.command("set " + line)
        for n in range(18):
            _, seconds, _, held = exposure(board, ticks=TICKS)
            end = board.node(0)[2] / 16e6
            rows.append((end - seconds, end, charge_pc(held, SAMPLER) * 1e-3 / seconds))
            board.run(317)
            if n == 11:
                turn = board.cycle + 1000
                board.command(f"set_at {turn} flicker_hz 611")

    def angle(t, phase):
        before, after = min(t, turn / 16e6), max(t - turn / 16e6, 0)
        return 2 * numpy.pi * (433 * before + 611 * after) + phase

    def misses(phase, rows):
        return [quad(lambda t: 400 * (1 - 0.7 * numpy.cos(angle(t, phase))), begin, end, epsrel=1e-12)[0]
                / (end - begin) - na for begin, end, na in rows]

    phase = min((least_squares(lambda p: misses(p[0], rows[:12:2]), [guess]) for guess in (0, 2, 4)),
                key=lambda fit: fit.cost).x[0]
    assert max(abs(numpy.array(misses(phase, rows[1:12:2] + rows[12:])))) < 1e-3
    assert max(row[2] for row in rows) > 500 and min(row[2] for row in rows) < 300


def test_named_ambient_ends_the_numbers_and_numbers_scale_with_light(dark):
    assert dark.held((-900, "ambient_na", 5000), (-800, "ambient_flicker", 1), (-700, "ambient", "sun_gap")) \
        == pytest.approx(dark.held((-800, "ambient", "sun_gap")), abs=1e-12)
    seconds = dark.seconds
    for light, factor in (("dim", 75 / 200), ("bright", 3)):
        held = dark.held((-900, "ambient_na", 80), (-800, "light", light))
        assert charge_pc(held, SAMPLER) == pytest.approx(80e-9 * factor * seconds * 1e12, rel=1e-9)


def test_cutting_the_advances_changes_nothing(dark):
    whole = dark.held((500, "ambient_na", 800))
    with dark.board() as board:
        board.run(1000)
        board.command(f"set_at {dark.released + 500} ambient_na 800")
        board.send(b"X" + struct.pack("<BBHH", 0, 0, TICKS, 0))
        for _ in range(600):
            board.run(1)
            board.node(0)
        board.run(5400)
        assert board.node(0)[2:] == (dark.sampled, whole)


def test_settings_wait_through_a_reset_and_while_the_power_is_off():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(500)
        board.command(f"set_at {board.cycle + 16000} supply_volts 4.5")
        board.command("reset")
        board.run(900)
        assert float(board.command("lamps")[2]) == 5
        board.run(200)
        assert float(board.command("lamps")[2]) == 4.5
        board.command(f"set_at {board.cycle + 1600} supply_volts 4.8")
        board.command("power off")
        board.run(200)
        board.command("power on")
        board.run(10)
        assert float(board.command("lamps")[2]) == 4.8


def test_set_at_clear_forgets():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(500)
        board.command(f"set_at {board.cycle + 1600} supply_volts 4.5")
        board.command("set_at clear")
        board.run(500)
        assert float(board.command("lamps")[2]) == 5


@pytest.mark.parametrize("line,what", [
    ("set_at", "a cycle, a key"), ("set_at 99999 light", "a cycle, a key"),
    ("set_at x light dim", "a cycle, a key"),
    ("set_at 5 light dim", "past"), ("set_at 99999999 light dimm", "nominal, dim or bright"),
    ("set_at 99999999 colour red", "the keys are"), ("set ambient_na -1", "0 to 1e+06"),
    ("set ambient_na nan", "0 to 1e+06"), ("set ambient_flicker 1.1", "0 to 1"),
    ("set flicker_hz 0", "0.1 to"),
    ("set supply_volts 4.1", "4.2 to 5.5"), ("set supply_volts 5.6", "4.2 to 5.5"),
    ("set supply_volts", "a key and"),
    ("set ambient noon", "dark, room"), ("set lid wide", "or auto"), ("set microsaccades 0.5", "0 to 1"),
    ("counters all", "nothing or clear")])
def test_what_cannot_be_set_is_refused_with_a_reason(line, what):
    with Board(app=firmware("adc"), constants=QUIET) as board:
        board.run(100)
        answer = board.ask(line)
        assert answer.startswith("err ") and what in answer


def test_too_many_waiting_settings_are_refused():
    with Board(app=firmware("adc"), constants=QUIET) as board:
        for i in range(1024):
            board.command(f"set_at {10**9 + i * 7919 % 1024} ambient_na {i}")
        assert "too many" in board.ask("set_at 1000000000 ambient_na 1")
        board.command("set_at clear")
        board.command("set_at 1000000000 ambient_na 1")
