# SPDX-License-Identifier: Apache-2.0
"""How much light there is: the unit that photocurrents are relative to."""

from dataclasses import replace

import pytest

from sparsegaze.person import draw_person, nominal_person
from sparsegaze.simulate import REFERENCE_MEAN, Grid, ResponseMap, response_map

# The product's steps in gaze within +-20 degrees, the pupils about 3.5 mm, lids open.
WITHIN = dict(
    half_angle_deg=20.0, smooth_nodes=22, pupil_mm=(3.0, 3.5, 4.0), lid_opening=(1.0,), check_states=1
)
COARSE = dict(WITHIN, smooth_nodes=9, glint_nodes=9)


def mean_of(headset, person, directory, nodes):
    with ResponseMap(response_map(headset, person, cache=str(directory), grid=Grid(**nodes))) as opened:
        return opened.mean


def test_the_reference_is_the_default_headset_on_the_nominal_person(led2gaze, tmp_path):
    assert mean_of(led2gaze, nominal_person(), tmp_path, WITHIN) == pytest.approx(REFERENCE_MEAN, rel=1e-4)


def test_dark_people_and_deep_seats_get_less_light_than_the_nominal_person(led2gaze, tmp_path):
    nominal = nominal_person()
    dark = replace(nominal, albedo_sclera=0.3, albedo_iris=0.08, albedo_skin=0.35)
    deep = replace(nominal, eye_position_mm=(0.0, 0.0, 2.5))
    light = [mean_of(led2gaze, person, tmp_path, COARSE) for person in (nominal, dark, deep)]
    assert light[1] < 0.8 * light[0]
    assert light[2] < 0.95 * light[0]


def test_drawn_people_differ_in_light_about_the_reference(led2gaze, tmp_path):
    light = [mean_of(led2gaze, draw_person(seed), tmp_path, COARSE) / REFERENCE_MEAN for seed in (0, 1, 2, 3)]
    assert all(0.6 < value < 1.6 for value in light)
    assert max(light) > 1.05 * min(light)
