# SPDX-License-Identifier: Apache-2.0
"""The eye's diffuse response against an image of it, made by another method and other code
(brute_image.py).
"""

from dataclasses import replace

import numpy as np
import pytest
from brute_image import Eye, eye_response, refract
from sim_scenes import LIDS_AWAY, pair, port

from sparsegaze.person import draw_person
from sparsegaze.scene import Scene, c_person, simulator

SENSOR = port((14, -8, -28), (2, 1, -11), 8.5, 0.0)
EMITTER = port((-12, -10, -31), (-1, 0, -11), 9.0, 0.0)


def test_an_image_of_the_eye_gives_the_same_to_a_thousandth():
    error = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        person = replace(draw_person(seed), **LIDS_AWAY)
        gaze, pupil = rng.uniform(-15, 15, 2), rng.uniform(2.5, 6)
        image = np.array(eye_response(person, SENSOR, EMITTER, *gaze, pupil, 360))
        scene = Scene(pair(SENSOR, EMITTER), person)
        ours = [scene.smooth(*gaze, pupil, 1.0, term)[0, 0, 0, 0] for term in ("sclera", "iris")]
        error.append((np.array(ours) - image) / image.sum())
    # What is left is mostly the image's pixels at the pupil's edge: it changes by as much from 200 to 400.
    assert np.abs(error).max() < 2e-3
    assert np.sqrt(np.mean(np.square(error))) < 8e-4


def test_the_image_sees_more_pixels_and_comes_closer():
    person = replace(draw_person(1), **LIDS_AWAY)
    scene = Scene(pair(SENSOR, EMITTER), person)
    ours = scene.smooth(4, -7, 3.3, 1.0, "eye")[0, 0, 0, 0]
    coarse, fine = (
        abs(sum(eye_response(person, SENSOR, EMITTER, 4, -7, 3.3, n)) / ours - 1) for n in (24, 360)
    )
    assert fine < 2e-3 and coarse > 2 * fine


@pytest.mark.parametrize("seed", range(3))
def test_the_profile_is_the_same_surface(seed):
    person = draw_person(seed)
    ffi, lib = simulator()
    eye = Eye(person, 0, 0)
    for angle in np.linspace(0, 100, 51):
        radius = lib.sim_person_profile_mm(c_person(ffi, person), angle)
        direction = np.array([np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))])
        assert abs(eye.outside(radius * direction)) < 1e-9


@pytest.mark.parametrize(
    "site", [(12, -8, 16), (-11, -7, 29), (3, 2, 40), (-19, 4, 14), (0, 0, 25), (300, 0, 400)]
)
def test_every_place_of_the_iris_that_snells_law_reaches_is_found_with_its_light(site):
    """Fermat's path and its Hessian against rays traced forward, up to the rim and to grazing light."""
    ffi, lib = simulator()
    person = draw_person(0)
    eye, made = Eye(person, 0, 0), c_person(ffi, person)
    site = np.array(site, float)
    grid = np.arange(-5.75, 6, 0.5)
    q = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    q = q[np.hypot(*q.T) < person.limbus_radius_mm]
    point, iris, through, good = refract(eye, site, q)
    h = 1e-5
    dx, dy = (
        (refract(eye, site, q + s)[1] - refract(eye, site, q - s)[1]) / (2 * h)
        for s in (np.array([h, 0]), np.array([0, h]))
    )
    stretch = np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])
    away = site - point
    distance = np.linalg.norm(away, axis=1)
    cosine = (away * eye.normal_of_cornea(q)).sum(1) / distance
    area = 1 / eye.normal_of_cornea(q)[:, 2]
    light = cosine * area / distance**2 / stretch * through
    exit_ = ffi.new("double[3]")
    for i in np.flatnonzero(good & (cosine > 0.02)):
        spot = ffi.new("double[3]", [*iris[i], eye.iris_z])
        got = lib.sim_person_iris_light(made, ffi.new("double[3]", list(site)), spot, exit_)
        assert got == pytest.approx(light[i], rel=1e-6)
        assert np.hypot(exit_[0] - q[i, 0], exit_[1] - q[i, 1]) < 1e-6
