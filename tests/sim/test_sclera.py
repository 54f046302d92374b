# SPDX-License-Identifier: Apache-2.0
"""The sclera where one pair outshines all others: against an independent adaptive quadrature."""

from dataclasses import replace

import pytest
from reference import reference_response
from sim_scenes import pair, port

from sparsegaze.person import draw_person
from sparsegaze.scene import Scene

# A lens that senses and emits; gaze, pupil, lids; the greatest error allowed, of its response.
HARD = {
    # Only a corner of 3 mm between limbus and upper lid sends light back.
    "8 mm from the globe": (
        draw_person(101),
        (-1.7, 0.9, -19.6),
        (-0.167, 0.12, 0.979),
        22.7,
        1.0,
        (9.962, -10.287, 5.9, 1.0),
        5e-5,
    ),
    # The circle where the clear cornea begins crosses a row beside the beginning of a lid's edge; pieces
    # between two such places were once left out (1.2e-3).
    "limbus under the lid's edge": (
        draw_person(104),
        (5.97859289, -1.32533726, -17.31080021),
        (-0.5314, 0.0821, 0.8431),
        30.17,
        0.3,
        (2.2475, 26.0799, 7.66, 0.8752),
        1e-4,
    ),
    "spot of 2 mm": (
        replace(
            draw_person(107),
            lid_upper_deg=45.0,
            lid_lower_deg=-45.0,
            canthus_deg=75.0,
            lid_thickness_mm=0.5,
        ),
        (-2.347, -10.26, -45.433),
        (0.0467, 0.366, 0.9294),
        4.23,
        0.0,
        (18.4616, -29.1105, 6.0, 1.0),
        1e-4,
    ),
}


@pytest.mark.parametrize("name", HARD)
def test_a_port_that_outshines_all_others(name):
    person, place, aim, sigma_deg, radius_mm, state, limit = HARD[name]
    at = tuple(p + e for p, e in zip(place, person.eye_position_mm))
    lens = replace(port(at, lens_radius_mm=radius_mm), aim=aim, sigma_deg=sigma_deg)
    headset = pair(lens, lens)
    value, error = reference_response(headset, person, *state, tol=1e-6, terms=("sclera",))
    assert error["sclera"][0] < limit / 5 * value["sclera"][0]
    scene = Scene(headset, person, quality={"face": 0.1})
    assert scene.smooth(*state, "sclera")[0, 0, 0, 0] == pytest.approx(value["sclera"][0], rel=limit)
