# SPDX-License-Identifier: Apache-2.0
"""Tabulated maps against direct evaluation off their nodes, and the cache."""

import os
from dataclasses import replace

import numpy as np
import pytest

from sparsegaze.errors import SceneError
from sparsegaze.person import Person, draw_person
from sparsegaze.scene import Scene
from sparsegaze.simulate import STATE_FIELDS, Grid, ResponseMap, evaluate, map_name, response_map
from sparsegaze.tabulate import glint_step_deg

LIDS_RMS, LIDS_MAX = 3e-4, 4e-3  # of the mean response

# All the product's nodes but those of the lids.
OPEN = dict(lid_opening=(1.0,))
TINY = dict(
    half_angle_deg=5.0,
    smooth_nodes=4,
    glint_nodes=4,
    pupil_mm=(3.5,),
    lid_opening=(0.0, 1.0),
    quality={"face": 0.2, "sclera": 0.2, "iris": 0.25}.items(),
    check_states=2,
)
FINER = dict(sclera=3.0, iris=3.0, glint=2.0, face=2.0)


def off_grid(opened, headset, person, states):
    """{term: (rms, largest)} of a map's error at states against finer direct evaluation, of the mean."""
    scene = Scene(headset, person, quality=FINER)
    smooth = np.array([scene.smooth(*state, "smooth")[0, 0] for state in states])
    glint = np.array([scene.glint(az, el, lid)[0] for az, el, _, lid in states])
    mapped = opened.parts(states)
    others = ~np.eye(*opened.shape, dtype=bool)
    unit = opened.mean / others.sum(1).mean()
    error = {"diffuse": mapped[0] - smooth, "glint": mapped[1] - glint}
    error["total"] = opened.evaluate(states) - smooth - glint
    return {
        term: (float(np.sqrt(np.mean(e[:, others] ** 2))) / unit, float(np.abs(e[:, others]).max()) / unit)
        for term, e in error.items()
    }


def random_states(seed, count, half_deg, lids=(1.0, 1.0)):
    rng = np.random.default_rng(seed)
    pupils, opening = rng.uniform(2, 8, count), rng.uniform(*lids, count)
    return np.column_stack([rng.uniform(-half_deg, half_deg, (count, 2)), pupils, opening])


def sharp(headset):
    """The headset with lenses that are points: their glints are as narrow as the tear film leaves them."""
    sensors, emitters = (
        tuple(replace(p, lens_radius_mm=0.0) for p in ports) for ports in (headset.sensors, headset.emitters)
    )
    return replace(headset, sensors=sensors, emitters=emitters)


@pytest.mark.parametrize("half_deg", [20.0, 25.0])
@pytest.mark.parametrize("seed", [0, 5])
def test_between_the_nodes_an_open_eye_is_right_to_a_ten_thousandth(led2gaze, open_map, seed, half_deg):
    with ResponseMap(open_map(seed)) as opened:
        error = off_grid(opened, led2gaze, draw_person(seed), random_states(seed + 7, 50, half_deg))
        stated = opened.error_estimate
    for term, (rms, largest) in error.items():
        assert rms <= 1e-4 and largest <= 1e-3, term
    assert error["total"][0] <= stated.open_rms and error["total"][1] <= stated.open_max


def test_glints_of_points_on_a_smooth_tear_film_get_nodes_as_close_as_they_need(led2gaze, tmp_path):
    person, headset = replace(draw_person(2), roughness=0.008), sharp(led2gaze)
    assert glint_step_deg(headset, person) < 0.5 * glint_step_deg(led2gaze, draw_person(2))
    grid = Grid(**dict(OPEN, half_angle_deg=10.0, smooth_nodes=13, pupil_mm=(3.0, 3.5, 4.0)))
    with ResponseMap(response_map(headset, person, cache=str(tmp_path), grid=grid)) as opened:
        assert len(opened.axis(3, "azimuth_deg")) > 2 * 10.0 / 0.3
        states = random_states(3, 40, 10.0)
        states[:, 2] = 3.5
        error = off_grid(opened, headset, person, states)
    assert error["glint"][0] <= 1e-4 and error["glint"][1] <= 1e-3


@pytest.fixture(scope="module")
def open_map(led2gaze, tmp_path_factory):
    """Path of the map of a drawn person, lids open, made once."""
    folder = str(tmp_path_factory.mktemp("open"))
    return lambda seed: response_map(led2gaze, seed, cache=folder, grid=Grid(**OPEN))


@pytest.mark.parametrize("seed", [1, 4])
def test_lids_anywhere_and_the_stated_error_bounds_what_other_states_show(led2gaze, tmp_path, seed):
    # The product's steps in gaze and lids over less gaze and three pupils.
    grid = Grid(half_angle_deg=5.0, smooth_nodes=7, pupil_mm=(3.0, 3.5, 4.0), check_states=16)
    with ResponseMap(response_map(led2gaze, seed, cache=str(tmp_path), grid=grid)) as opened:
        states = random_states(seed + 11, 60, 5.0, (0.0, 1.0))
        states[:, 2] = 3.5
        error, stated = off_grid(opened, led2gaze, draw_person(seed), states), opened.error_estimate
    assert error["total"][0] <= stated.lids_rms and error["total"][1] <= stated.lids_max
    assert error["total"][0] < LIDS_RMS and error["total"][1] < LIDS_MAX


@pytest.mark.parametrize("rough", [dict(), dict(smooth_nodes=4), dict(glint_nodes=8)])
def test_the_stated_error_follows_the_nodes(led2gaze, tmp_path, rough):
    grid = dict(half_angle_deg=12.0, smooth_nodes=9, glint_nodes=29, pupil_mm=(3.0, 4.0), lid_opening=(1.0,))
    grid.update(rough, check_states=12)
    person = draw_person(2)
    with ResponseMap(response_map(led2gaze, person, cache=str(tmp_path), grid=Grid(**grid))) as opened:
        states = random_states(1, 40, 12.0)
        states[:, 2] = 3 + states[:, 2] % 1
        error, stated = off_grid(opened, led2gaze, person, states)["total"], opened.error_estimate
    assert error[0] <= stated.open_rms and error[1] <= stated.open_max
    assert stated.open_rms < 8 * error[0] and stated.open_max < 60 * error[1]


def test_derivatives_are_those_of_the_response_itself(led2gaze, tmp_path):
    slips = ((-0.5, 0.0, 0.5), (0.0,), (0.0,))
    grid = dict(half_angle_deg=6.0, smooth_nodes=8, pupil_mm=(3.0, 3.5, 4.0), lid_opening=(1.0,))
    grid = Grid(**grid, slip_mm=slips, check_states=1)
    person = draw_person(3)
    with ResponseMap(response_map(led2gaze, person, cache=str(tmp_path), grid=grid)) as opened:
        state = np.array([2.3, -1.7, 3.4, 1.0, 0.1, 0.0, 0.0])
        value, slope = opened.gradient(state[None])
        for k, step in ((0, 0.3), (1, 0.3), (2, 0.1), (4, 0.1)):
            pair = []
            for sign in (1, -1):
                at = state.copy()
                at[k] += sign * step
                pair.append(Scene(led2gaze, person, at[4:], FINER).response(*at[:4]))
            change = (pair[0] - pair[1]) / (2 * step)
            # Central differences of the curve itself are as wrong as this at such steps.
            assert np.abs(slope[0, k] - change).max() < 0.03 * np.abs(change).max(), STATE_FIELDS[k]
        assert (slope[0, 5:] == 0).all() and value.shape == (1, 6, 6)


def test_the_mean_is_the_integral_that_the_header_says(led2gaze, tmp_path):
    grid = dict(half_angle_deg=20.0, smooth_nodes=9, glint_nodes=9, pupil_mm=(3.0, 3.5, 4.0))
    grid = Grid(**grid, lid_opening=(1.0,), check_states=1)
    path = response_map(led2gaze, Person(), cache=str(tmp_path), grid=grid)
    with ResponseMap(path) as opened:
        gaze = np.arange(-19.75, 20, 0.5)  # midpoints
        states = [(az, el, 3.5, 1.0) for el in gaze for az in gaze]
        response = opened.evaluate(states) * (1 - np.eye(6))
        assert opened.mean == pytest.approx(response.sum((1, 2)).mean() / 6, rel=1e-4)


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
    slips = ((-1.0, 0.0, 1.0), (0.0,), (0.0,))
    grid = Grid(**dict(TINY, slip_mm=slips, lid_opening=(1.0,), quality=()))
    path = response_map(led2gaze, Person(), cache=str(tmp_path), grid=grid)
    moved = Scene(led2gaze, Person(), (0.5, 0, 0)).response(5, 5, 3.5, 1.0)
    still = Scene(led2gaze, Person()).response(5, 5, 3.5, 1.0)
    got = evaluate(path, [[5, 5, 3.5, 1.0, 0.5, 0, 0]])[0]
    assert np.abs(got - moved).max() < 0.1 * np.abs(moved - still).max()


def test_an_impossible_scene_leaves_nothing_in_the_cache(led2gaze, tmp_path):
    port = replace(led2gaze.sensors[0], position_mm=(0.0, 0.0, 0.0))
    with pytest.raises(SceneError):
        response_map(replace(led2gaze, sensors=(port,)), Person(), cache=str(tmp_path), grid=Grid(**TINY))
    assert not [name for name in os.listdir(tmp_path)]
