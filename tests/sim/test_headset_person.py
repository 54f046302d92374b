# SPDX-License-Identifier: Apache-2.0
"""Scenes as data: what is read, what is drawn, and what is refused with its reason."""

from dataclasses import replace

import numpy as np
import pytest
from sim_scenes import pair, port

from sparsegaze.errors import SceneError
from sparsegaze.headset import load_headset
from sparsegaze.person import LID_FOLLOW_GAIN, Person, draw_person, load_person, nominal_person, read_toml
from sparsegaze.scene import Scene

LED = """
[[led]]
position_mm = [16.0, 0.0, -28.0]
aim_mm = [0.0, 0.0, -11.0]
sensitivity_sigma_deg = 10.0
lens_radius_mm = 1.5
"""


def write(tmp_path, text):
    path = tmp_path / "it.toml"
    path.write_text(text)
    return str(path)


def test_the_default_headset_is_six_leds_that_all_sense_and_emit(led2gaze):
    assert len(led2gaze.sensors) == len(led2gaze.emitters) == 6
    assert led2gaze.sensors == led2gaze.emitters


def test_the_default_headset_leaves_the_view_free_and_keeps_its_distance(led2gaze):
    apex = np.array([0, 0, -13.1])
    for led in led2gaze.sensors:
        away = np.array(led.position_mm) - apex
        distance = np.linalg.norm(away)
        assert 18 <= distance <= 30
        assert np.degrees(np.arccos(-away[2] / distance)) > 25
        assert led.position_mm[1] < 3, "not above the eye: lashes"
        assert 8 <= led.sigma_deg <= 12


def test_the_default_headset_has_a_pin_for_each_led_and_leaves_the_digital_ones_free(led2gaze):
    assert [led.pin for led in led2gaze.sensors] == ["A0", "A1", "A2", "A3", "A4", "A5"]


def test_every_led_of_the_default_headset_senses_once_with_the_four_others_lit(led2gaze):
    assert [phase.sense for phase in led2gaze.phases] == [(5, 0), (1, 4), (2, 3)]
    assert (led2gaze.lit.sum(1) == 4).all() and not led2gaze.lit.diagonal().any()
    for phase in led2gaze.phases:
        assert set(phase.sense) | set(phase.light) == set(range(6))
        assert not led2gaze.lit[np.ix_(phase.sense, phase.sense)].any()


def test_the_photodiode_headset_is_six_sensors_each_lit_by_one_of_three_emitters(repo_root):
    headset = load_headset(repo_root / "headsets" / "nextgaze_nano.toml")
    assert [p.pin for p in headset.sensors] == ["A0", "A1", "A2", "A3", "A4", "A5"]
    assert [p.pin for p in headset.emitters] == ["D2", "D3", "D4"]
    assert headset.lit.astype(int).tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]] * 2
    places = np.array([p.position_mm for p in headset.sensors + headset.emitters])
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + 100 * np.eye(9)
    assert apart.min() > 5.5, "parts of 5 mm fit beside each other"
    assert (places[:, 1] < 3).all(), "none above the eye: lashes"


def test_the_photodiodes_see_the_eye_turn(repo_root):
    headset = load_headset(repo_root / "headsets" / "nextgaze_nano.toml")
    for person in (nominal_person(), draw_person(3)):
        scene = Scene(headset, person, quality={"face": 0.2})
        looks = [headset.collect(scene.response(*gaze)) for gaze in ((-15, 0), (15, 0), (0, -15), (0, 15))]
        across, up = np.log(looks[1] / looks[0]), np.log(looks[3] / looks[2])
        assert np.abs(across).max() > 0.2 and np.abs(up).max() > 0.2
        assert np.linalg.matrix_rank(np.column_stack([across, up]), tol=0.2) == 2, "two axes, not one"


def test_without_phases_a_sensor_collects_from_whoever_stands_elsewhere(led2gaze):
    assert (replace(led2gaze, phases=()).lit == ~np.eye(6, dtype=bool)).all()
    apart = pair(port((12, 0, -30)), port((10, -10, -30)))
    assert apart.lit.tolist() == [[True]]
    lone = port((12, 0, -30))
    assert pair(lone, lone).lit.tolist() == [[True]], "one that has nobody else sees itself"


def test_what_a_sensor_collects_is_the_sum_over_those_who_are_lit(led2gaze):
    response = np.arange(72.0).reshape(2, 6, 6)
    lit = [[j for j in range(6) if led2gaze.lit[i, j]] for i in range(6)]
    by_hand = [[sum(response[n, i, j] for j in lit[i]) for i in range(6)] for n in (0, 1)]
    assert led2gaze.collect(response).tolist() == by_hand
    response[:, 0, 5] = np.nan  # not lit: not looked at
    assert led2gaze.collect(response)[0, 0] == by_hand[0][0]


def test_pins_and_phases_are_no_part_of_what_a_cached_map_depends_on(led2gaze):
    bare = replace(
        led2gaze,
        phases=(),
        board={},
        wiring={},
        sensors=tuple(replace(p, pin=None, intensity_mw_sr=None, series_ohm=None) for p in led2gaze.sensors),
    )
    assert bare.describe() == led2gaze.describe()


def test_sensors_and_emitters_may_be_separate(tmp_path):
    text = (
        LED.replace("[[led]]", "[[sensor]]")
        + LED.replace("[[led]]", "[[emitter]]").replace("sensitivity_sigma_deg", "beam_sigma_deg") * 2
    )
    headset = load_headset(write(tmp_path, text))
    assert (len(headset.sensors), len(headset.emitters)) == (1, 2)
    assert Scene(headset, Person()).response(0, 0).shape == (1, 2)


@pytest.mark.parametrize(
    "text, says",
    [
        ("", "0 sensors"),
        ("led = 3", "[[led]]"),
        ("[[led]]\n", "position_mm"),
        ("[[led", "it.toml"),
        (LED.replace("16.0, 0.0", "16.0"), "position_mm"),
        (LED.replace("16.0", "nan"), "position_mm"),
        (LED.replace("16.0", "inf"), "position_mm"),
        (LED.replace("16.0", "true"), "position_mm"),
        (LED.replace("16.0", '"16"'), "position_mm"),
        (LED.replace("[16.0, 0.0, -28.0]", "[0.0, 0.0, -11.0]"), "aim_mm"),
        (LED.replace("= 10.0", "= 0.0"), "sensitivity_sigma_deg"),
        (LED.replace("= 10.0", "= nan"), "sensitivity_sigma_deg"),
        (LED.replace("= 1.5", "= -1.5"), "lens_radius_mm"),
        (LED.replace("lens_radius_mm = 1.5", ""), "lens_radius_mm"),
        (LED * 33, "33"),
        (LED + 'pin = 3\n', "pin"),
        (LED + "shade = 3\n", "no key shade"),
        (LED + 'anode_pin = "D2"\n', "anode_pin is gone"),
        (LED + 'cathode_pin = "A2"\n', "cathode_pin is gone"),
        (LED + "intensity_mw_sr = -1.0\n", "intensity_mw_sr"),
        (LED + 'wavelength_nm = "940"\n', "wavelength_nm"),
        (LED + "source_diameter_mm = 0\n", "source_diameter_mm"),
        (LED + "series_ohm = nan\n", "series_ohm"),
        (LED.replace("led", "sensor") + "current_ma = 3\n", "no key current_ma"),
        (LED.replace("led", "emitter").replace("sensitivity", "beam") * 2, "0 sensors"),
        ("colour = 1\n" + LED, "no key colour"),
        ("board = 1\n" + LED, "[board]"),
        ("[board]\nrail = 2\n" + LED, "no key rail"),
        ("name = 3\n" + LED, "name is not text"),
        (2 * (LED + 'name = "one"\n'), "there is a one already"),
    ],
)
def test_a_malformed_headset_is_refused_naming_the_entry(tmp_path, text, says):
    with pytest.raises(SceneError) as caught:
        load_headset(write(tmp_path, text))
    assert says in str(caught.value)


def test_a_missing_headset_file_is_refused(tmp_path):
    with pytest.raises(SceneError):
        load_headset(str(tmp_path / "none.toml"))


@pytest.mark.parametrize("path", ["/dev/zero", "/dev"])
def test_what_is_no_file_is_refused_at_once(path):
    with pytest.raises(SceneError, match="not a file"):
        load_headset(path)


def test_an_endless_file_is_not_read_to_its_end(tmp_path):
    with open(tmp_path / "long.toml", "wb") as file:
        file.truncate(1 << 33)
    with pytest.raises(SceneError, match="larger than 1 MB"):
        load_headset(str(tmp_path / "long.toml"))


def scene_refusal(sensor, person=Person()):
    with pytest.raises(SceneError) as caught:
        Scene(pair(sensor, port((10, -10, -30))), person)
    return str(caught.value)


@pytest.mark.parametrize("position", [(0, 0, -1), (3, 2, -8), (0, 0, -13.0), (9, 0, -9)])
def test_a_sensor_inside_the_eyeball_is_refused(position):
    assert "sensor 0 is inside the eyeball" in scene_refusal(port(position, (0, 0, -50)))


@pytest.mark.parametrize("position", [(0, 0, 30), (0, 22, -8), (-25, 0, -10), (20, -20, 5)])
def test_a_sensor_inside_or_behind_the_face_is_refused(position):
    assert "face" in scene_refusal(port(position))


def test_a_sensor_behind_the_face_only_after_slip_is_refused():
    headset = pair(port((0, -12, -14)), port((10, -10, -30)))
    Scene(headset, Person())
    with pytest.raises(SceneError):
        Scene(headset, Person(), slip_mm=(0, 0, 9))


@pytest.mark.parametrize(
    "change",
    [
        {"cornea_radius_mm": float("nan")},
        {"cornea_radius_mm": 5.0},
        {"globe_radius_mm": 5.0},
        {"cornea_asphericity": 3.0},
        {"iris_depth_mm": 1.0},
        {"iris_depth_mm": 20.0},
        {"albedo_skin": 1.2},
        {"albedo_iris": -0.1},
        {"roughness": 0.0},
        {"refractive_index": 1.0},
        {"lid_upper_deg": -40.0},
        {"canthus_deg": 0.0},
        {"lid_radius_mm": 11.0},
        {"limbus_blend_mm": 0.0},
        {"eye_position_mm": (0.0, float("inf"), 0.0)},
    ],
)
def test_an_impossible_person_is_refused(change):
    scene_refusal(port((12, 0, -30)), replace(Person(), **change))


def test_a_gaze_beyond_any_eye_is_refused(led2gaze):
    scene = Scene(led2gaze, Person())
    for gaze in ((61, 0), (0, -90), (float("nan"), 0)):
        with pytest.raises(SceneError):
            scene.response(*gaze)
    with pytest.raises(SceneError):
        scene.response(0, 0, pupil_mm=-2)
    with pytest.raises(SceneError):
        scene.response(0, 0, lid_opening=1.5)


def test_the_same_seed_is_the_same_person_and_another_seed_another():
    assert draw_person(7) == draw_person(7)
    assert draw_person(7) != draw_person(8)


@pytest.mark.parametrize("seed", [-1, 1.5, True])
def test_a_seed_that_is_no_seed_is_refused(seed):
    with pytest.raises(SceneError):
        draw_person(seed)


def test_people_have_the_published_means_spreads_and_correlations():
    people = [draw_person(seed) for seed in range(800)]
    column = {
        name: np.array([getattr(p, name) for p in people])
        for name in ("cornea_radius_mm", "globe_radius_mm", "kappa_azimuth_deg", "cornea_asphericity")
    }
    assert (
        abs(column["cornea_radius_mm"].mean() - 7.8) < 0.03
        and abs(column["cornea_radius_mm"].std() - 0.26) < 0.02
    )
    assert (
        abs(column["kappa_azimuth_deg"].mean() - 5.0) < 0.15
        and abs(column["kappa_azimuth_deg"].std() - 1.33) < 0.1
    )
    assert np.corrcoef(column["globe_radius_mm"], column["cornea_radius_mm"])[0, 1] > 0.3
    assert abs(np.corrcoef(column["globe_radius_mm"], column["kappa_azimuth_deg"])[0, 1]) < 0.12


def test_every_one_of_many_people_can_wear_the_default_headset(led2gaze):
    for seed in range(25):
        response = Scene(led2gaze, draw_person(seed), quality={"face": 0.2}).response(0, 0)
        assert np.isfinite(response).all() and (response > 0).all()


def test_a_person_file_gives_what_it_says_and_the_rest_is_nominal(tmp_path):
    person = load_person(write(tmp_path, "[person]\ncornea_radius_mm = 8\neye_position_mm = [1, 0, -1]\n"))
    assert person == replace(Person(), cornea_radius_mm=8.0, eye_position_mm=(1.0, 0.0, -1.0))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[person]\ncornea = 8\n",
        "[person]\nbrow_mm = 'high'\n",
        "[person]\nbrow_mm = nan",
        "[person]\neye_position_mm = [1, 2]",
    ],
)
def test_a_malformed_person_file_is_refused(tmp_path, text):
    with pytest.raises(SceneError):
        load_person(write(tmp_path, text))


def test_lids_follow_by_the_gain_that_the_virtual_nanos_physics_states(repo_root):
    stated = read_toml(repo_root / "tools" / "vheadset" / "physics.toml")["eye"]["lid_follow_gain"]
    assert LID_FOLLOW_GAIN == stated
    assert nominal_person().lid_upper_follow == draw_person(3).lid_upper_follow == stated


def test_another_lid_gain_changes_nothing_else_of_a_drawn_person():
    assert draw_person(3, 0.5) == replace(draw_person(3), lid_upper_follow=0.5)
    assert nominal_person(0.5) == replace(Person(), lid_upper_follow=0.5)


@pytest.mark.parametrize("gain", [-0.1, 2.1, float("nan")])
def test_a_lid_gain_that_nobody_has_is_refused(gain):
    with pytest.raises(SceneError):
        draw_person(3, gain)
