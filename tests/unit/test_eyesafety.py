# SPDX-License-Identifier: Apache-2.0
"""Irradiance and radiance by hand, the limits of IEC 62471, and the headsets that we ship within them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sparsegaze import eyesafety, timing
from sparsegaze.errors import SceneError
from sparsegaze.eyesafety import COMMAND, FAULT, NORMAL
from sparsegaze.headset import Headset, Phase, Port, load_headset
from sparsegaze.person import draw_person, nominal_person
from sparsegaze.timing import Timing

AHEAD = (0.0, 0.0, 1.0)


def lamp(x=0.0, y=0.0, z=-20.0, **changes):
    known = dict(name="ir", intensity_mw_sr=15.0, wavelength_nm=940.0, source_diameter_mm=4.0)
    return Port((x, y, z), AHEAD, 8.5, 2.0, **{**known, **changes})


@pytest.fixture(scope="module")
def headsets(repo_root):
    """{name: Headset} of every file that is shipped."""
    return {path.stem: load_headset(path) for path in sorted((repo_root / "headsets").glob("*.toml"))}


def test_fifteen_milliwatts_a_steradian_at_twenty_millimetres_is_37_and_a_half_watts():
    one = eyesafety.irradiance([lamp()], [15.0], [[0, 0, 0]], on_axis=True)
    assert one == pytest.approx([37.5])


def test_five_such_on_one_point_all_the_time_are_188_watts_and_over_the_limit():
    five = eyesafety.irradiance([lamp()] * 5, [15.0] * 5, [[0, 0, 0]], on_axis=True)
    assert five == pytest.approx([187.5])
    assert five[0] > eyesafety.cornea_limit(2000.0)
    half = eyesafety.irradiance([lamp()] * 5, [7.5] * 5, [[0, 0, 0]], on_axis=True)
    assert half == pytest.approx([93.75]) and half[0] < eyesafety.cornea_limit(2000.0)


def test_light_from_two_sides_is_what_a_meter_reads_that_looks_between_them():
    across = [lamp(x=20.0, z=0.0), lamp(x=-20.0, z=0.0)]
    assert eyesafety.irradiance(across, [15.0] * 2, [[0, 0, 0]], True) == pytest.approx([0.0], abs=1e-9)
    square = [lamp(x=20.0, z=0.0), lamp(z=-20.0)]
    assert eyesafety.irradiance(square, [15.0] * 2, [[0, 0, 0]], True) == pytest.approx([37.5 * np.sqrt(2)])


def test_a_beam_as_aimed_falls_off_by_its_sigma_and_is_dark_behind():
    tangent = np.tan(np.radians(8.5))
    points = [[0, 0, 0], [20 * tangent, 0, 0], [0, 0, -40.0]]
    got = eyesafety.irradiance([lamp()], [15.0], points, on_axis=False)
    beside = 15e-3 / (20e-3**2 * (1 + tangent**2)) * np.exp(-0.5)
    assert got == pytest.approx([37.5, beside, 0.0])


@pytest.mark.parametrize(
    "seconds, limit",
    [(2000, 100), (1001, 100), (1000, 101.2), (100, 569.2), (10, 3200.9), (1, 18000), (0.1, 101220)],
)
def test_the_limits_at_the_cornea_are_those_of_the_standard(seconds, limit):
    assert eyesafety.cornea_limit(seconds) == pytest.approx(limit, rel=1e-3)


@pytest.mark.parametrize(
    "seconds, alpha, limit",
    [
        (100, 0.011, 545455),  # 545 mW/mm^2/sr, the figure that application notes give
        (100, 0.1, 60000),
        (100, 0.2, 60000),  # counts as 0.1
        (100, 0.001, 545455),  # counts as 0.011
        (100, 0.05, 120000),
        (1, 0.1, 500000),
        (0.0001, 0.1, 5e6),
    ],
)
def test_the_limits_at_the_retina_are_those_of_the_standard(seconds, alpha, limit):
    assert eyesafety.retina_limit(seconds, alpha) == pytest.approx(limit, rel=1e-3)


@pytest.mark.parametrize(
    "wavelength, burn", [(850, 0.501), (940, 0.331), (1050, 0.2), (1100, 0.2), (1175, 0.0632), (1300, 0.02)]
)
def test_burn_hazard_by_wavelength(wavelength, burn):
    assert eyesafety.burn_hazard(wavelength) == pytest.approx(burn, rel=2e-2)


def test_radiance_of_a_glowing_lens_and_of_a_bare_die_by_hand():
    # 15 mW/sr of a disc of 4 mm: 1194 W/m^2/sr, times 0.331; at 20 mm it fills 0.2 rad
    lens = eyesafety._radiance(lamp(), 15.0, 2000.0, 20.0, smallest=False)
    assert lens == pytest.approx((395.3, 60000.0), rel=1e-3)
    # of a die of 0.3 mm: 212 kW/m^2/sr, times 0.331; 0.015 rad
    die = eyesafety._radiance(lamp(), 15.0, 2000.0, 20.0, smallest=True)
    assert die == pytest.approx((70264.0, 400000.0), rel=1e-3)


def test_the_cornea_is_where_eyes_have_it():
    person = replace(nominal_person(), eye_position_mm=(1.0, -2.0, 0.5))
    points = eyesafety.cornea_points(person, 0.0)
    from_centre = np.linalg.norm(points - person.eye_position_mm, axis=1)
    assert from_centre.max() == pytest.approx(13.1, abs=0.05), "the apex, as headset files say"
    assert from_centre.min() == pytest.approx(person.globe_radius_mm, rel=1e-6), "the limbus, on the globe"
    turned = eyesafety.cornea_points(person, 25.0) - person.eye_position_mm
    assert np.linalg.norm(turned, axis=1).max() == pytest.approx(from_centre.max())
    assert np.abs(turned[:, :2]).max() > np.abs(points - person.eye_position_mm)[:, :2].max() + 3


def ring(intensity, count=5, distance=20.0):
    """A headset of emitters close together, that far before the nominal cornea's apex."""
    apex = eyesafety.cornea_points(nominal_person(), 0.0)[:, 2].min()
    ports = tuple(
        lamp(x=0.01 * k, z=apex - distance, intensity_mw_sr=intensity, name="ir%d" % k) for k in range(count)
    )
    return Headset("ring", ports, ports)


def test_a_headset_lit_half_of_the_time_is_what_its_duty_says():
    made = ring(15.0, 4)
    headset = replace(made, phases=tuple(Phase((0,), (0, 1, 2, 3)) for _ in range(3)))
    report = eyesafety.examine(headset)
    duty = 3 * Timing().phase_duty()
    assert duty == pytest.approx(0.5060, abs=1e-4)
    assert report.of(NORMAL).value == pytest.approx(4 * 37.5 * duty, rel=2e-2)


def test_twice_the_intensity_is_twice_the_light_and_half_the_margin(headsets):
    one = headsets["led2gaze"]
    stronger = tuple(replace(p, intensity_mw_sr=2 * p.intensity_mw_sr) for p in one.emitters)
    before, after = (eyesafety.examine(h) for h in (one, replace(one, emitters=stronger)))
    for a, b in zip(before.rows, after.rows):
        assert b.value == pytest.approx(2 * a.value) and b.limit == a.limit
    assert before.ok and not after.ok and after.margin == pytest.approx(before.margin / 2)
    assert (after.worst.case, after.worst.quantity) == (FAULT, "cornea, average, supply")


def test_every_shipped_headset_is_exempt_in_every_case(headsets):
    assert set(headsets) >= {"led2gaze", "nextgaze_nano"}
    for name, headset in headsets.items():
        report = eyesafety.examine(headset)
        print(name, report.irradiance_w_m2, "least margin", report.margin)
        assert report.ok, report.worst
        assert report.margin > 1.05, "nothing is left for what was not thought of"
        assert {row.case for row in report.rows} == {NORMAL, COMMAND, FAULT}
        assert json.loads(json.dumps(report.report()))["ok"] is True


def test_no_drawn_person_gets_more_than_the_worst_case_says(headsets):
    """Eyes of other sizes in other seats: the +-3 mm stand for all of them."""
    headset = headsets["led2gaze"]
    most = eyesafety.intensities_mw_sr(headset, eyesafety.SUPPLY_MOST_V)
    duty = Timing().emitter_duty(headset, timing.LATE_CYCLES)
    stated = eyesafety.examine(headset).of(COMMAND).value
    eyes = (eyesafety.cornea_points(draw_person(seed)) for seed in range(300))
    worst = max(eyesafety.irradiance(headset.emitters, most * duty, eye, True).max() for eye in eyes)
    print("worst of 300 simulated people", worst, "of", stated)
    assert 0.7 * stated < worst <= stated


def test_a_finer_look_at_eye_and_seats_finds_no_brighter_place(headsets):
    headset = headsets["led2gaze"]
    most = eyesafety.intensities_mw_sr(headset, eyesafety.SUPPLY_MOST_V)
    duty = Timing().emitter_duty(headset, timing.LATE_CYCLES)
    rng, stated = np.random.default_rng(1), eyesafety.examine(headset).of(COMMAND).value
    found = 0.0
    for _ in range(300):
        points = eyesafety.cornea_points(nominal_person(), rng.uniform(15, 25))
        seat = np.clip(rng.uniform(-6, 6, 3), -3, 3)  # often in a corner
        found = max(found, eyesafety.irradiance(headset.emitters, most * duty, points + seat, True).max())
    assert 0.9 * stated < found < 1.01 * stated


def test_normal_use_is_far_below_the_worst_case(headsets):
    report = eyesafety.examine(headsets["led2gaze"])
    assert report.of(NORMAL).value < report.of(COMMAND).value / 3
    hang = next(row for row in report.rows if (row.case, row.quantity) == (FAULT, "cornea, average"))
    assert hang.value < report.of(COMMAND).value, "a hang is shorter than its lockout"
    assert report.nearest_mm[1] < report.nearest_mm[0] - 3


def test_no_command_lights_longer_than_the_longest_exposures_of_the_shortest_slots(headsets):
    """What the firmware clips to is the most: every other setting is below it."""
    headset = headsets["led2gaze"]
    most = eyesafety.examine(headset).of(COMMAND).value
    emitted = eyesafety.intensities_mw_sr(headset, eyesafety.SUPPLY_MOST_V)
    near = eyesafety.cornea_points(nominal_person())[None] + eyesafety.seats()[:, None]
    rng = np.random.default_rng(4)
    for _ in range(10):
        slot = int(rng.integers(888, 1778))
        tried = Timing(slot, tuple(rng.integers(64, 1 << 16, 2)), int(rng.choice([1, 2, 4, 8, 16])))
        duty = tried.emitter_duty(headset, timing.LATE_CYCLES)
        got = eyesafety.irradiance(headset.emitters, emitted * duty, near.reshape(-1, 3), True).max()
        assert got <= most * (1 + 1e-9)


def test_a_supply_at_its_most_makes_them_brighter_by_what_the_resistor_lets_through(headsets):
    headset = headsets["led2gaze"]
    assert eyesafety.currents_ma(headset, 5.0) == pytest.approx([20.0] * 6)
    assert eyesafety.currents_ma(headset, 5.25) == pytest.approx([22.5] * 6)  # 2.25 V over 100 ohm
    assert eyesafety.currents_ma(headset, 5.5) == pytest.approx([25.0] * 6)
    report = eyesafety.examine(headset)
    assert report.of(FAULT).value == pytest.approx(report.of(COMMAND).value * 25.0 / 22.5)
    loose = replace(headset, board={})
    assert eyesafety.currents_ma(loose, 5.25) == pytest.approx([20.0] * 6)
    assert any("current_ma whatever the supply" in said for said in eyesafety.examine(loose).assumed)


def test_what_a_shorted_rail_would_do_is_said(headsets):
    said = " ".join(eyesafety.examine(headsets["led2gaze"]).assumed)
    command = eyesafety.examine(headsets["led2gaze"]).of(COMMAND).value
    # 3.8 V over 100 ohm instead of 2.25 V
    assert "rail shorted to ground it would be up to %.0f W/m2" % (command * 3.8 / 2.25) in said
    assert "rail" not in " ".join(eyesafety.examine(headsets["nextgaze_nano"]).assumed)


@pytest.mark.parametrize("key", ["intensity_mw_sr", "wavelength_nm"])
def test_what_has_to_be_known_and_is_not_in_the_file_is_asked_for(headsets, key):
    one = headsets["led2gaze"]
    third = replace(one.emitters[3], **{key: None})
    silent = replace(one, emitters=one.emitters[:3] + (third,) + one.emitters[4:])
    with pytest.raises(SceneError, match="led3 has no " + key) as caught:
        eyesafety.examine(silent)
    assert "data sheet" in caught.value.remedy


def test_dark_emitters_are_safe(headsets):
    one = headsets["led2gaze"]
    none = tuple(replace(p, intensity_mw_sr=0.0) for p in one.emitters)
    dark = eyesafety.examine(replace(one, emitters=none))
    assert dark.ok and dark.margin == float("inf")
    assert json.loads(json.dumps(dark.report(), allow_nan=False))["margin"] is None
