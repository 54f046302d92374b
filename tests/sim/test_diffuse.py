# SPDX-License-Identifier: Apache-2.0
"""Sclera and iris where they are hard to integrate: against much finer fineness of the same code (what the
order of convergence is), against images by other code, and against what must hold exactly.
"""

from dataclasses import replace

import numpy as np
import pytest
from brute_image import eye_response
from sim_scenes import LIDS_AWAY, OFF_DIAGONAL, pair, port, six

from sparsegaze.errors import SceneError
from sparsegaze.headset import Headset
from sparsegaze.person import Person, draw_person
from sparsegaze.scene import Scene, c_person, simulator

ROUGH_FACE = {"face": 0.1}  # no test here looks at the skin
STATES = [
    (4, -3, 3.1, 1.0),
    (-17, 11, 4.4, 1.0),
    (12, -22, 2.6, 0.8),
    (21, 19, 5.5, 0.6),
    (-9, -14, 3.7, 0.35),
]


def eye(scene, states, term="eye"):
    """Responses [state, sensor, emitter]."""
    return np.array([scene.smooth(a, e, pupil, lid, term)[0, 0] for a, e, pupil, lid in states])


def fine(term, value):
    return dict(ROUGH_FACE, **{term: value})


def error_at(headset, person, term, fineness, states=STATES, best=8):
    """(rms, greatest) difference from the finest, in units of the mean of sclera and iris with lids open."""
    open_lids = [(azimuth, elevation, 3.5, 1.0) for azimuth in (-15, 0, 15) for elevation in (-15, 0, 15)]
    truth = eye(Scene(headset, person, quality=fine(term, best)), states, term)
    unit = eye(Scene(headset, person, quality=ROUGH_FACE), open_lids).mean()
    got = eye(Scene(headset, person, quality=fine(term, fineness)), states, term)
    difference = (got - truth) / unit
    return np.sqrt(np.mean(difference**2)), np.abs(difference).max()


@pytest.mark.parametrize("term", ["sclera", "iris"])
def test_errors_fall_faster_than_the_cube_of_fineness(term):
    error = [error_at(six(), draw_person(2), term, fineness)[0] for fineness in (0.5, 1, 2)]
    assert error[0] > error[1] > error[2]
    assert error[0] / error[2] > 4**2.5


@pytest.mark.parametrize("term", ["sclera", "iris"])
@pytest.mark.parametrize("seed", [None, 1, 5])
def test_the_default_fineness_is_good_to_a_ten_thousandth(term, seed):
    person = Person() if seed is None else draw_person(seed)
    rms, most = error_at(six(), person, term, 1)
    assert rms < 1e-4
    assert most < 1e-3


@pytest.mark.parametrize(
    "name, sensor_mm, limit",
    [
        ("5 mm from the cornea", (3.0, -4.0, -17.5), 4e-4),
        ("500 mm away", (120.0, -90.0, -485.0), 1e-4),
        ("in the tangent plane of the apex", (24.0, -6.0, -13.1), 5e-4),
        ("grazing the sclera", (22.0, -18.0, -9.0), 4e-4),
    ],
)
def test_places_that_are_hard_to_see_from(name, sensor_mm, limit):
    sensor = port(sensor_mm, (1, -1, -12), 25.0, 0.5)
    headset = pair(sensor, port((-12, -9, -30), (0, 0, -11), 12.0, 1.0))
    for term in ("sclera", "iris"):
        rms, most = error_at(headset, Person(), term, 1)
        assert rms < limit, name
    value = eye(Scene(headset, Person(), quality=ROUGH_FACE), STATES)
    assert np.isfinite(value).all() and (value >= 0).all() and value.max() > 0


def test_the_iris_seen_from_one_side_and_lit_from_the_other_is_that_of_an_image():
    """Sensor 42 degrees to one side, gaze 10 to the other: it sees the iris at 52 degrees from the axis."""
    person = replace(draw_person(3), **LIDS_AWAY)
    sensor = port((25.0, -6.0, -28.0), (1, 0, -11), 9.0, 0.0)
    emitter = port((6.0, -10.0, -34.0), (1, 0, -11), 10.0, 0.0)
    image = eye_response(person, sensor, emitter, -10, 2, 3.3, 300)[1]
    scene = Scene(pair(sensor, emitter), person, quality=ROUGH_FACE)
    assert scene.smooth(-10, 2, 3.3, 1.0, "iris")[0, 0, 0, 0] == pytest.approx(image, rel=4e-3)


@pytest.mark.parametrize("term", ["sclera", "iris"])
def test_lids_from_open_to_closed_in_small_steps(term):
    scene = Scene(six(), draw_person(4), quality=ROUGH_FACE)
    opening = np.linspace(0, 1, 81)
    value = np.array([scene.smooth(3, 2, 3.5, lid, term)[0, 0] for lid in opening])[:, OFF_DIAGONAL]
    unit = value[-1].mean()
    assert (value[0] == 0).all()
    assert np.diff(value, axis=0).min() > -1e-4 * unit
    assert np.abs(np.diff(value, 2, axis=0)).max() < 0.05 * unit, "no step"


def test_lids_computed_together_equal_lids_computed_alone():
    scene = Scene(six(), Person(), quality=ROUGH_FACE)
    opening = np.linspace(0.1, 1, 7)
    together = scene.smooth(4, -6, [2.5, 5.0], opening, "eye")
    alone = np.array([[scene.smooth(4, -6, p, lid, "eye")[0, 0] for lid in opening] for p in (2.5, 5.0)])
    assert np.sqrt(np.mean((together - alone) ** 2)) < 3e-4 * together[:, -1].mean()


def test_pupils_computed_together_are_the_same_to_rounding():
    scene = Scene(six(), Person(), quality=ROUGH_FACE)
    pupils = [2.0, 3.0, 4.5, 8.0]
    together = scene.smooth(-7, 9, pupils, [0.7], "iris")
    for i, pupil in enumerate(pupils):
        np.testing.assert_allclose(together[i], scene.smooth(-7, 9, pupil, 0.7, "iris")[0], rtol=1e-10)


def test_the_pupils_edge_on_the_lids_edge_is_no_place_of_its_own():
    """Looking down with half closed lids the upper margin passes the pupil: errors stay what they are."""
    states = [(0, -8, pupil, lid) for pupil in (3.0, 5.0, 7.0) for lid in (0.3, 0.4, 0.5, 0.6)]
    rms, most = error_at(six(), Person(), "iris", 1, states)
    assert rms < 1e-4 and most < 1e-3


def test_an_eye_a_metre_off_the_origin_is_the_same_eye():
    away = np.array([1000.0, -1000.0, 1000.0])
    person = draw_person(6)
    moved = replace(person, eye_position_mm=tuple(np.add(person.eye_position_mm, away)))
    ports = tuple(replace(p, position_mm=tuple(np.add(p.position_mm, away))) for p in six().sensors)
    here = eye(Scene(six(), person, quality=ROUGH_FACE), STATES)
    there = eye(Scene(Headset("moved", ports, ports), moved, quality=ROUGH_FACE), STATES)
    np.testing.assert_allclose(there, here, rtol=1e-10, atol=1e-14 * here.max())


def test_less_light_comes_back_from_a_white_eye_than_was_sent():
    """Twelve sensors spread evenly over the half space in front; all albedos 1, no lids."""
    white = replace(Person(), **LIDS_AWAY, albedo_sclera=1.0, albedo_iris=1.0)
    n, far = 12, 300.0
    k = np.arange(n) + 0.5
    cosine, phi = 1 - k / n * 0.95, k * 2.39996322972865332
    sine = np.sqrt(1 - cosine**2)
    places = far * np.stack([sine * np.cos(phi), sine * np.sin(phi), -cosine], 1)
    sensors = tuple(port(tuple(p), (0, 0, 0), 85.0, 1.0) for p in places)
    lamp = port((4.0, -6.0, -32.0), (0, 0, -12), 6.0, 0.0)
    scene = Scene(Headset("dome", sensors, (lamp,)), white, quality=ROUGH_FACE)
    collected = scene.smooth(0, 0, 2.0, 1.0, "eye")[0, 0, :, 0].mean() * 2 * np.pi * far**2 * 0.95
    angle = np.linspace(0, 1.5, 4000)
    beam = np.exp(-np.tan(angle) ** 2 / (2 * np.tan(np.radians(6.0)) ** 2)) * 2 * np.pi * np.sin(angle)
    emitted = beam.sum() * (angle[1] - angle[0])
    assert 0.3 * emitted < collected < emitted


LASHED = replace(Person(), lash_opacity=0.5)


def test_lashes_of_no_opacity_change_no_bit():
    bare = Scene(six(), Person(), quality=ROUGH_FACE)
    clear = Scene(six(), replace(Person(), lash_length_mm=3.0, lash_opacity=0.0), quality=ROUGH_FACE)
    assert (eye(bare, STATES) == eye(clear, STATES)).all()


def test_lashes_cost_light_from_above_and_hardly_any_from_below():
    def kept(y_mm):
        place = port((5.0, y_mm, -32.0), (0, 0, -12), 12.0, 1.0)
        other = port((-5.0, y_mm, -32.0), (0, 0, -12), 12.0, 1.0)
        bare, lashed = (
            eye(Scene(pair(place, other), person, quality=ROUGH_FACE), [(0, 0, 3.5, 1.0)]).sum()
            for person in (Person(), LASHED)
        )
        return lashed / bare

    assert kept(16.0) < 0.7
    assert kept(-16.0) > 0.97


def test_lashes_cost_more_the_longer_and_denser_they_are_and_at_most_both_ways():
    above = pair(port((5, 14, -32), lens_radius_mm=1.0), port((-5, 14, -32), lens_radius_mm=1.0))
    value = [
        eye(
            Scene(above, replace(Person(), lash_length_mm=length, lash_opacity=opacity), quality=ROUGH_FACE),
            STATES,
        )
        for length, opacity in ((8, 0), (4, 0.5), (8, 0.5), (8, 1.0))
    ]
    for more, less in zip(value, value[1:]):
        assert (less <= more).all() and less.sum() < more.sum()
    assert (value[2] >= 0.25 * value[0]).all()


def test_lashes_dim_sclera_and_iris_alike_at_the_same_place():
    """Opacity 1 and no length hides what the thinnest margin would: both terms keep the rest."""
    scenes = [
        Scene(six(), replace(Person(), lash_length_mm=0.0, lash_opacity=opacity), quality=ROUGH_FACE)
        for opacity in (0, 1)
    ]
    for term in ("sclera", "iris"):
        bare, lashed = (eye(scene, STATES, term) for scene in scenes)
        assert (lashed <= bare).all() and lashed.sum() > 0.9 * bare.sum()


@pytest.mark.parametrize("values", [{"lash_opacity": 1.1}, {"lash_opacity": -0.1}, {"lash_length_mm": 40.0}])
def test_impossible_lashes_are_refused(values):
    with pytest.raises(SceneError, match="lashes"):
        Scene(six(), replace(Person(), **values), quality=ROUGH_FACE)


def test_a_path_through_the_cornea_is_found_for_every_spot():
    """From within 30 degrees of the axis Fermat's path exists: the transfer is positive."""
    ffi, lib = simulator()
    person, leaving = c_person(ffi, Person()), ffi.new("double[3]")
    rng = np.random.default_rng(0)
    for _ in range(200):
        r, phi = 5.5 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        spot = [r * np.cos(phi), r * np.sin(phi), 9.8]
        tilt, turn = rng.uniform(0, 0.5), rng.uniform(0, 2 * np.pi)
        toward = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        near, far = (lib.sim_person_iris_light(person, list(d * toward), spot, leaving) for d in (30.0, 60.0))
        assert near > 0 and far > 0
