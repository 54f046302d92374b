# SPDX-License-Identifier: Apache-2.0
"""The reference (reference.py) judged by closed forms, by itself and by an image; then the simulator."""

from dataclasses import replace

import numpy as np
import pytest
from brute_image import eye_response
from random_scenes import random_scenes
from reference import TERMS, iris_light, reference_response, reference_states
from reference_table import compare
from scipy.special import expn
from sim_scenes import pair, port

from sparsegaze.person import draw_person, nominal_person

FLAT = dict(brow_mm=0.0, cheek_mm=0.0, nose_mm=0.0, kappa_azimuth_deg=0.0, kappa_elevation_deg=0.0)
# Lids so far away, and so thin, that nothing of the eye is covered.
NO_LIDS = dict(lid_upper_deg=900.0, lid_lower_deg=-900.0, canthus_deg=9000.0, canthus_tilt_deg=0.0)
NO_LIDS.update(lid_thickness_mm=0.0, lid_upper_follow=0.0, lid_lower_follow=0.0)


def _case(name):
    return next(case for case in random_scenes() if case.name == name)


def _single(person, place, aim, sigma_deg, term, gaze=(0.0, 0.0), pupil_mm=3.0, tol=1e-8):
    """One term of a lamp that is its own sensor, radius 0."""
    one = port(place, aim, sigma_deg, 0.0)
    value, _ = reference_response(pair(one, one), person, *gaze, pupil_mm, 1.0, tol=tol, terms=(term,))
    return value[term][0]


def test_skin_under_a_lamp_is_the_exponential_integral():
    """A flat Lambertian patch straight below: albedo / h^2 e^a E3(a), a = 1 / tan^2 sigma."""
    person = replace(nominal_person(), **FLAT)
    a = 1 / np.tan(np.radians(5.0)) ** 2
    expected = person.albedo_skin / 12.0**2 * np.exp(a) * expn(3, a)
    got = _single(person, (-5.0, 22.0, -16.0), (-5.0, 22.0, 0.0), 5.0, "face")
    assert got == pytest.approx(expected, rel=1e-7)


def test_an_eye_that_is_a_white_ball_has_its_closed_form():
    """Lambertian ball of radius r at distance D from a lamp without a window: with k = D^2 - r^2,
    albedo / (2 r D) [ln x + k / x^2 - k^2 / (4 x^4)] from x = D - r to sqrt(k).
    """
    r, distance = 12.0, 60.0
    ball = dict(globe_radius_mm=r, cornea_radius_mm=r, cornea_asphericity=0.0, limbus_radius_mm=1e-3)
    ball.update(limbus_haze_mm=1e-4, limbus_blend_mm=1e-9, lid_radius_mm=40.0)
    person = replace(nominal_person(), **FLAT, **NO_LIDS, **ball)
    k = distance**2 - r**2

    def part(x):
        return np.log(x) + k / x**2 - k**2 / (4 * x**4)

    expected = person.albedo_sclera / (2 * r * distance) * (part(np.sqrt(k)) - part(distance - r))
    got = _single(person, (0, 0, -distance), (0, 0, 0), 89.99, "sclera", gaze=(20.0, 5.0))
    assert got == pytest.approx(expected, rel=3e-7)


def test_an_iris_behind_nothing_is_a_lambertian_ring():
    """Index 1: albedo h^2 / 2 (1 / (h^2 + a^2)^2 - 1 / (h^2 + b^2)^2) for a ring a..b at depth h."""
    person = replace(nominal_person(), **FLAT, **NO_LIDS, refractive_index=1.0, limbus_haze_mm=1e-3)
    limbus, radius, conic = 5.85, 7.8, 1 - 0.26
    apex = np.sqrt(12.0**2 - limbus**2) + limbus**2 / (radius + np.sqrt(radius**2 - conic * limbus**2))
    h2 = (60.0 - (apex - person.iris_depth_mm)) ** 2
    expected = person.albedo_iris * h2 / 2 * (1 / (h2 + 1.5**2) ** 2 - 1 / (h2 + limbus**2) ** 2)
    got = _single(person, (0, 0, -60.0), (0, 0, 0), 89.99, "iris")
    assert got == pytest.approx(expected, rel=3e-6)


def test_the_glint_of_a_sphere_is_that_of_a_convex_mirror():
    """Lobe of width 0, head on at distance d: F r^2 / (4 d^2 (r + d)^2)."""
    person = replace(nominal_person(), **FLAT, **NO_LIDS, cornea_asphericity=0.0, roughness=1e-4)
    limbus, radius, n = 5.85, 7.8, person.refractive_index
    d = 40.0 - (np.sqrt(12.0**2 - limbus**2) + radius - np.sqrt(radius**2 - limbus**2))
    expected = ((n - 1) / (n + 1)) ** 2 * radius**2 / (4 * d**2 * (radius + d) ** 2)
    assert _single(person, (0, 0, -40.0), (0, 0, 0), 89.99, "glint") == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("site", [(12.0, -8.0, 16.0), (3.0, 2.0, 40.0), (-29.035, 6.325, 4.602)])
def test_light_reaches_the_iris_on_fermats_path(site):
    """Moving the crossing to and fro makes the path longer; rays from the site beside the eye fold."""
    person = draw_person(0)
    conic, radius, n = 1 + person.cornea_asphericity, person.cornea_radius_mm, person.refractive_index
    reached = 0
    for r in (0.5, 2.0, 3.7, 4.4):
        for angle in np.linspace(0, 2 * np.pi, 7)[1:]:
            spot = (r * np.cos(angle), r * np.sin(angle))
            light, exit_mm = iris_light(person, site, spot)
            reached += light > 0
            if light <= 0:
                continue
            at = np.array(exit_mm[:2])
            apex = exit_mm[2] + at @ at / (radius + np.sqrt(radius**2 - conic * (at @ at)))
            target = np.array([*spot, apex - person.iris_depth_mm])

            def length(shift):
                q = at + shift
                sag = q @ q / (radius + np.sqrt(radius**2 - conic * (q @ q)))
                place = np.array([*q, apex - sag])
                return np.linalg.norm(place - site) + n * np.linalg.norm(place - target)

            for h in np.array([[1e-3, 0], [0, 1e-3]]):
                there, back, here = length(h), length(-h), length(0 * h)
                assert abs(there - back) / 2e-3 < 1e-6
                assert there + back > 2 * here
    assert reached >= 18


def test_the_eye_is_that_of_an_image_to_a_thousandth():
    person = replace(draw_person(2), **FLAT, **NO_LIDS, lid_radius_mm=40.0)
    sensor, emitter = port((14, -8, -48), (2, 1, -11), 6.0, 0.0), port(
        (-12, -10, -51), (-1, 0, -11), 7.0, 0.0
    )
    sclera, iris = eye_response(person, sensor, emitter, 6.0, -4.0, 4.0, 360)
    value, _ = reference_response(
        pair(sensor, emitter), person, 6.0, -4.0, 4.0, 1.0, terms=("sclera", "iris")
    )
    total = sclera + iris
    assert abs(value["sclera"][0] - sclera) < 1e-3 * total
    assert abs(value["iris"][0] - iris) < 1e-3 * total


@pytest.mark.parametrize("name", ["pupil edge at the lid edge", "random 5"])
def test_a_tighter_goal_changes_less_than_the_estimate(name):
    case = _case(name)
    pairs = [(0, 0), (1, 0)]
    rough, estimate, _ = reference_states(case.headset, case.person, case.states[:1], pairs, 1e-4)
    fine, closer, _ = reference_states(case.headset, case.person, case.states[:1], pairs, 3e-6)
    for term in TERMS:
        assert (np.abs(rough[term] - fine[term]) <= estimate[term] + closer[term]).all()
        assert closer[term].max() <= 3.1e-6 * sum(fine.values()).max()


def test_sensor_and_emitter_may_be_swapped():
    """The iris is then traced from its other end."""
    case = _case("tangent sensor")
    swapped = replace(case.headset, sensors=case.headset.emitters, emitters=case.headset.sensors)
    one, error, _ = reference_states(case.headset, case.person, case.states[1:2], [(0, 1)], 3e-6)
    other, more, _ = reference_states(swapped, case.person, case.states[1:2], [(1, 0)], 3e-6)
    for term in TERMS:
        assert (np.abs(one[term] - other[term]) <= error[term] + more[term]).all()


def test_scenes_are_the_same_every_time():
    first, again = random_scenes(), random_scenes(12)
    assert len(first) == 20 and len(again) == 12
    assert first[:12] == again
    assert len({case.name for case in first}) == 20


@pytest.mark.parametrize(
    "name",
    [
        "glint on the limbus",
        "sensor 5 mm from the eye",
        "pupil edge at the lid edge",
        "tangent sensor",
        "nose between sensor and eye",
        "random 1",
        "random 2",
        "random 4",
        "random 8",
    ],
)
def test_the_simulator_is_within_the_bar_of_the_reference(name):
    """Shares of the scene's mean total response; the bar is 1e-4 rms and 1e-3 at most."""
    row = compare(_case(name), tol=1e-5)
    for part in ("total", "diffuse", "glint"):
        assert row["rms"][part] < 1e-4, (part, row)
        assert row["max"][part] < 1e-3, (part, row)
    assert max(row["estimate"].values()) <= 1e-5
