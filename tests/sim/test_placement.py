# SPDX-License-Identifier: Apache-2.0
"""What the default placement promises, and the pictures of its maps."""

import os
import sys
from dataclasses import replace

import numpy as np
import pytest
from sim_scenes import six

from sparsegaze.person import draw_person, nominal_person
from sparsegaze.scene import Scene
from sparsegaze.simulate import Grid, response_map


@pytest.fixture(scope="module")
def placement(repo_root):
    sys.path.insert(0, str(repo_root / "tools"))
    try:
        import placement as module
    finally:
        sys.path.pop(0)
    return module


@pytest.mark.parametrize("seed", [0, 17])
def test_one_frame_tells_gaze_to_less_than_half_a_degree_on_the_hardest_people(placement, led2gaze, seed):
    scene = Scene(led2gaze, draw_person(seed), quality=placement.QUICK)
    assert placement.precision_deg(scene, step_deg=10.0) < 0.45


def test_the_hardest_of_twenty_people_is_learnt_within_the_bar(placement, led2gaze):
    scene = Scene(led2gaze, draw_person(0), quality=placement.QUICK)
    to_target, to_true, _ = placement.learned_deg(scene, 0, 49)
    assert to_target < 0.95 and to_true < 0.8


def test_noise_is_the_measured_one_at_nominal_and_dim_light_and_has_a_floor(placement):
    from sparsegaze.simulate import REFERENCE_MEAN

    noise = placement.noise(REFERENCE_MEAN * np.array([200.0, 75.0, 20.0, 400.0, 4000.0]) / 200.0)
    np.testing.assert_allclose(noise[:2], (0.0017, 0.0042), rtol=0.02)
    assert noise[2] > 0.012
    np.testing.assert_allclose(noise[3:], 0.0015)


def test_the_same_eye_with_darker_tissue_tells_less(placement, led2gaze):
    bright = nominal_person()
    dark = replace(
        bright,
        albedo_sclera=bright.albedo_sclera / 2,
        albedo_iris=bright.albedo_iris / 2,
        albedo_skin=bright.albedo_skin / 2,
    )
    scenes = [Scene(led2gaze, person, quality=placement.QUICK) for person in (bright, dark)]
    light = [placement.light_na(scene, step_deg=20.0).mean() for scene in scenes]
    assert light[1] < 0.6 * light[0]
    error = [placement.precision_deg(scene, step_deg=20.0) for scene in scenes]
    assert error[1] > 1.4 * error[0]


def test_light_is_counted_from_the_reference_which_is_all_five_others(placement, led2gaze):
    five = Scene(replace(led2gaze, phases=()), nominal_person(), quality=placement.QUICK)
    assert placement.light_na(five).mean() == pytest.approx(200.0, rel=0.03)
    four = Scene(led2gaze, nominal_person(), quality=placement.QUICK)
    assert placement.light_na(four).mean() == pytest.approx(160.0, rel=0.1)


def test_the_search_refuses_people_whom_reports_are_about(placement, led2gaze):
    with pytest.raises(ValueError, match="1000"):
        placement.search(led2gaze, 0.0, 1, persons=(1000, 999))


def test_nobody_searched_on_is_judged(placement, led2gaze, monkeypatch, capsys):
    assert min(placement.SEARCHED) >= placement.FIRST_SEARCHED
    with pytest.raises(ValueError, match="searched"):
        placement.judge(led2gaze, range(990, 1001))
    monkeypatch.setattr(sys, "argv", ["placement.py", "--first", "990"])
    with pytest.raises(SystemExit):
        placement.main()
    assert "for the search" in capsys.readouterr().err


def test_wider_windows_tell_less(placement, led2gaze):
    wide = Scene(six(sigma_deg=35.0), draw_person(1), quality=placement.QUICK)
    narrow = Scene(led2gaze, draw_person(1), quality=placement.QUICK)
    assert placement.precision_deg(wide, 20.0) > 2 * placement.precision_deg(narrow, 20.0)


def test_an_aim_is_turned_and_read_back(placement, led2gaze):
    turned = placement.turned(led2gaze, 2, (3.0, -4.0, -11.0))
    np.testing.assert_allclose(placement.aim_point(turned.sensors[2]), (3.0, -4.0, -11.0), atol=1e-9)
    assert turned.sensors[1] == led2gaze.sensors[1] and turned.sensors == turned.emitters


def test_a_map_is_drawn_with_a_panel_per_sensor_and_one_of_the_placement(led2gaze, headset_path, tmp_path):
    from matplotlib.figure import Figure

    from sparsegaze.mapplot import draw_maps, save_maps

    rough = {"face": 0.2, "sclera": 0.2, "iris": 0.25}
    grid = Grid(
        half_angle_deg=20, smooth_nodes=5, glint_nodes=5, pupil_mm=(3.5,), lid_opening=(1.0,), quality=rough
    )
    path = response_map(led2gaze, 1, cache=str(tmp_path), grid=grid)
    figure = Figure()
    draw_maps(figure, path, led2gaze)
    titled = [axes for axes in figure.axes if axes.get_title()]
    assert len(titled) == 7
    assert all(axes.get_xlabel() and axes.get_ylabel() for axes in titled)
    picture = save_maps(path, headset_path, str(tmp_path / "map.png"))
    assert os.path.getsize(picture) > 20000
