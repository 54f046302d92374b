# SPDX-License-Identifier: Apache-2.0
"""Tabulated maps against direct evaluation off their nodes, and the cache."""

import os

import numpy as np
import pytest
from sim_scenes import OFF_DIAGONAL

from sparsegaze.errors import SceneError
from sparsegaze.person import Person, draw_person
from sparsegaze.scene import Scene
from sparsegaze.simulate import LID_NODES, PUPIL_NODES_MM, Grid, ResponseMap, evaluate, map_name, response_map

# The product's steps in gaze (1.67 and 0.83 degrees) and all its pupil nodes, over less gaze and with the
# lids open.
PATCH = dict(half_angle_deg=10.0, smooth_nodes=13, glint_nodes=25, lid_opening=(1.0,))
TINY = dict(
    half_angle_deg=5.0,
    smooth_nodes=4,
    glint_nodes=4,
    pupil_mm=(3.5,),
    lid_opening=(0.0, 1.0),
    quality={"face": 0.2, "sclera": 0.2, "iris": 0.25}.items(),
)


def off_grid(path, headset, person, states):
    scene = Scene(headset, person)
    truth = np.array([scene.response(*state) for state in states])[:, OFF_DIAGONAL]
    error = evaluate(path, states)[:, OFF_DIAGONAL] - truth
    return np.sqrt(np.mean(error**2)) / truth.mean(), np.abs(error).max() / truth.mean()


@pytest.mark.parametrize("seed", [0, 5])
def test_between_the_nodes_an_open_eye_is_right_to_half_a_thousandth(led2gaze, tmp_path, seed):
    person = draw_person(seed)
    path = response_map(led2gaze, person, cache=str(tmp_path), grid=Grid(**PATCH))
    rng = np.random.default_rng(seed)
    states = np.column_stack([rng.uniform(-9, 9, (60, 2)), rng.uniform(2.1, 7.5, 60), np.ones(60)])
    rms, largest = off_grid(path, led2gaze, person, states)
    assert rms < 5e-4
    assert largest < 4e-3


def test_during_a_blink_between_lid_nodes_the_error_stays_small(led2gaze, tmp_path):
    person = draw_person(1)
    grid = Grid(half_angle_deg=3.0, smooth_nodes=5, glint_nodes=9, pupil_mm=(3.0, 4.0), lid_opening=LID_NODES)
    path = response_map(led2gaze, person, cache=str(tmp_path), grid=grid)
    rng = np.random.default_rng(2)
    states = np.column_stack([rng.uniform(-3, 3, (80, 2)), np.full(80, 3.0), rng.uniform(0, 1, 80)])
    rms, _ = off_grid(path, led2gaze, person, states)
    assert rms < 1e-2


def test_the_mean_is_what_the_header_says(led2gaze, tmp_path):
    grid = Grid(
        half_angle_deg=20.0, smooth_nodes=5, glint_nodes=5, pupil_mm=PUPIL_NODES_MM, lid_opening=(1.0,)
    )
    path = response_map(led2gaze, Person(), cache=str(tmp_path), grid=grid)
    with ResponseMap(path) as opened:
        gaze = np.linspace(-20, 20, 5)
        states = [(az, el, 3.5, 1.0) for el in gaze for az in gaze]
        response = opened.evaluate(states) * (1 - np.eye(6))
        assert opened.mean == pytest.approx(response.sum((1, 2)).mean() / 6, rel=2e-3)


def test_a_second_call_finds_the_map_in_the_cache(led2gaze, tmp_path):
    first = response_map(led2gaze, Person(), cache=str(tmp_path), grid=Grid(**TINY))
    stamp, seen = os.stat(first).st_mtime_ns, []
    second = response_map(led2gaze, Person(), progress=seen.append, cache=str(tmp_path), grid=Grid(**TINY))
    assert second == first and os.stat(first).st_mtime_ns == stamp and seen == [1.0]


def test_a_damaged_map_in_the_cache_is_made_again(led2gaze, tmp_path):
    path = response_map(led2gaze, Person(), cache=str(tmp_path), grid=Grid(**TINY))
    whole = open(path, "rb").read()
    with open(path, "wb") as file:
        file.write(whole[: len(whole) // 2])
    assert response_map(led2gaze, Person(), cache=str(tmp_path), grid=Grid(**TINY)) == path
    assert open(path, "rb").read() == whole


def test_the_name_depends_on_headset_person_and_nodes(led2gaze):
    from dataclasses import replace

    name = map_name(led2gaze, Person(), Grid(**TINY))
    port = replace(led2gaze.sensors[0], sigma_deg=11.0)
    other = replace(led2gaze, sensors=(port,) + led2gaze.sensors[1:])
    names = {
        name,
        map_name(other, Person(), Grid(**TINY)),
        map_name(led2gaze, Person(), Grid()),
        map_name(led2gaze, replace(Person(), brow_mm=8.0), Grid(**TINY)),
    }
    assert len(names) == 4


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path, led2gaze):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = response_map(led2gaze, Person(), grid=Grid(**TINY))
    assert path.startswith(str(tmp_path / "sparsegaze") + os.sep)
    assert os.listdir(tmp_path / "sparsegaze") == [os.path.basename(path)]


def test_progress_grows_to_one(led2gaze, tmp_path):
    seen = []
    response_map(led2gaze, Person(), progress=seen.append, cache=str(tmp_path), grid=Grid(**TINY), workers=1)
    assert seen == sorted(seen) and seen[-1] == 1.0 and len(seen) >= 4


def test_threads_do_not_change_a_bit(led2gaze, tmp_path):
    one = response_map(led2gaze, Person(), cache=str(tmp_path / "1"), grid=Grid(**TINY), workers=1)
    two = response_map(led2gaze, Person(), cache=str(tmp_path / "2"), grid=Grid(**TINY), workers=3)
    assert open(one, "rb").read() == open(two, "rb").read()


def test_slip_nodes_are_tabulated_and_interpolated(led2gaze, tmp_path):
    grid = Grid(**dict(TINY, slip_mm=((-1.0, 0.0, 1.0), (0.0,), (0.0,))))
    path = response_map(led2gaze, Person(), cache=str(tmp_path), grid=grid)
    moved = Scene(led2gaze, Person(), (0.5, 0, 0), grid.quality).response(5, 5, 3.5, 1.0)
    still = Scene(led2gaze, Person(), quality=grid.quality).response(5, 5, 3.5, 1.0)
    got = evaluate(path, [[5, 5, 3.5, 1.0, 0.5, 0, 0]])[0]
    assert np.abs(got - moved).max() < 0.1 * np.abs(moved - still).max()


def test_an_impossible_scene_leaves_nothing_in_the_cache(led2gaze, tmp_path):
    from dataclasses import replace

    port = replace(led2gaze.sensors[0], position_mm=(0.0, 0.0, 0.0))
    with pytest.raises(SceneError):
        response_map(replace(led2gaze, sensors=(port,)), Person(), cache=str(tmp_path), grid=Grid(**TINY))
    assert not [name for name in os.listdir(tmp_path)]
