# SPDX-License-Identifier: Apache-2.0
"""Every constant of physics.toml acts, or the README says that it does not; the scale of the response map."""

import struct

import pytest

from board import FOLDER, QUIET, Board, firmware, physics, uniform_map
from test_leds import SAMPLER, charge_pc, exposure

# Read and checked, but the board does nothing with them: README.md, "Where each constant acts".
UNUSED = ("comparator.offset_mv", "comparator.noise_mv", "comparator.delay_ns", "eye.lid_follow_gain")

# key: (another value, the conditions under which it acts)
CHANGED = {
    "photocurrent.nominal_na": (100, {}), "photocurrent.dim_na": (50, {"light": "dim"}),
    "photocurrent.bright_na": (300, {"light": "bright"}), "photocurrent.part_spread": (0.1, {}),
    "photocurrent.heat_per_k": (-0.02, {}),
    "node.junction_pf": (50, {}), "node.pin_pf": (9, {}), "node.sample_hold_pf": (10, {}),
    "node.leakage_na": (3, {}), "node.leakage_spread": (0.2, {}),
    "adc.noise_lsb": (9, {}), "adc.inl_lsb": (20, {}), "adc.offset_lsb": (20, {}),
    "adc.gain_error": (0.05, {}),
    "adc.bandgap_v": (1.3, {}),
    "supply.volts": (4.5, {}), "supply.source_ohm": (5, {}), "supply.ripple_mv": (50, {}),
    "clock.error": (0.1, {"ambient": "bright_room"}),
    "ambient.room_na": (60, {"ambient": "room"}), "ambient.bright_room_na": (90, {"ambient": "bright_room"}),
    "ambient.sun_gap_na": (900, {"ambient": "sun_gap"}), "ambient.dark_na": (50, {}),
    "eye.fixation_bias_deg": (1, {}), "eye.fixation_drift_deg": (0.3, {}), "eye.pupil_mm": (4.5, {}),
    "eye.blinks_per_min": (100, {}),
    "comparator.offset_mv": (100, {}), "comparator.noise_mv": (10, {}), "comparator.delay_ns": (9000, {}),
    "eye.lid_follow_gain": (0.2, {}),
}


@pytest.fixture(scope="module")
def bumpy_map(tmp_path_factory):
    from sparsegaze import mapfile

    return mapfile.synthetic_map(tmp_path_factory.mktemp("map") / "bumps.sgmap")


def fingerprint(bumpy_map, constants, conditions):
    """What a board measures and what its person does: (codes and node volts, states of the eye)."""
    with Board(app=firmware("adc"), seed=3, map=bumpy_map, constants=constants, **conditions) as board:
        board.command("set warmer_k 10")
        board.command("target 0 8 -4")
        measured = [exposure(board, lit=0b111110, ticks=800) for _ in range(4)]
        for admux in (0x40 | 14, 0xC0 | 7):         # the bandgap against the supply, the divider against it
            board.send(bytes([ord("C"), admux]))
            measured.append(struct.unpack("<H", board.run(6000)))
        board.command("power off")              # the person lives on
        eye = []
        for _ in range(100):
            board.run(50000)
            eye.append(board.command("state")[1:])
    return measured, eye


@pytest.fixture(scope="module")
def usual(bumpy_map):
    known = {}

    def of(conditions):
        key = tuple(conditions.items())
        if key not in known:
            known[key] = fingerprint(bumpy_map, {}, conditions)
        return known[key]
    return of


def test_no_constant_is_forgotten_here():
    assert sorted(CHANGED) == sorted(physics())


def test_same_constants_give_the_same_fingerprint(bumpy_map, usual):
    assert fingerprint(bumpy_map, {}, {}) == usual({})


@pytest.mark.parametrize("key", [key for key in CHANGED if key not in UNUSED])
def test_changing_a_constant_changes_what_it_is_about(bumpy_map, usual, key):
    value, conditions = CHANGED[key]
    assert value != float(physics()[key])
    measured, eye = fingerprint(bumpy_map, {key: value}, conditions)
    measured_before, eye_before = usual(conditions)
    if key.startswith("eye."):
        assert eye != eye_before
    else:
        assert measured != measured_before and eye == eye_before


@pytest.mark.parametrize("key", UNUSED)
def test_constants_said_to_do_nothing_do_nothing(bumpy_map, usual, key):
    value, conditions = CHANGED[key]
    assert fingerprint(bumpy_map, {key: value}, conditions) == usual(conditions)
    line = next(row for row in (FOLDER / "README.md").read_text().splitlines()
                if row.startswith((f"| {key} ", f"| {key.split('.')[0]}.* ")))
    assert "| nothing" in line


def test_lid_follow_gain_reaches_the_simulated_person_and_the_unit_of_light_the_board(monkeypatch, bumpy_map):
    from sparsegaze import simulate, virtual

    people, configs = [], []
    begin = virtual._start

    def recorded(binary, config, errors):
        configs.append(dict(line.split(" ", 1) for line in config.read_text().splitlines()))
        return begin(binary, config, errors)

    monkeypatch.setattr(simulate, "response_map",
                        lambda headset, person, progress=None: people.append(person) or bumpy_map)
    monkeypatch.setattr(virtual, "_start", recorded)
    for changes in ({}, {"eye.lid_follow_gain": 0.5}):
        virtual.VirtualNano(unpaced=True, physics=changes).stop()
    virtual.VirtualNano(unpaced=True, map=bumpy_map).stop()
    assert [person.lid_upper_follow for person in people] == [0.9, 0.5]
    assert [float(c["map_reference"]) for c in configs[:2]] == [simulate.REFERENCE_MEAN] * 2
    assert "map_reference" not in configs[2]    # a map that is given is its own reference


@pytest.mark.parametrize("light,na", [("dim", 75), ("nominal", 200), ("bright", 600)])
@pytest.mark.parametrize("level,reference,factor", [
    (1.0, None, 1), (0.25, None, 1), (1.0, 5.0, 1), (0.25, 5.0, 0.25), (2e-6, 2e-5, 0.5)])
def test_map_reference_is_the_mean_that_gives_the_nominal_current(tmp_path, light, na, level, reference,
                                                                  factor):
    keys = {} if reference is None else {"map_reference": reference}
    path = uniform_map(tmp_path / "flat.sgmap", level)
    with Board(app=firmware("adc"), constants=QUIET, map=path, light=light, **keys) as board:
        _, seconds, _, held = exposure(board, lit=0b111110, ticks=1000)
    collected = charge_pc(held, SAMPLER)
    assert collected == pytest.approx(factor * na * 1e-9 * seconds * 1e12, rel=1e-6)


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "", "1x"])
def test_impossible_map_reference_is_refused(value):
    with pytest.raises(RuntimeError, match="bad value for `map_reference`"):
        Board(app=firmware("adc"), map_reference=value).__enter__()
