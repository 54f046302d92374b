# SPDX-License-Identifier: Apache-2.0
"""Headsets, persons, slips and qualities that no scene can be made of: each refused with its reason."""

from dataclasses import replace

import pytest
from sim_scenes import pair, port

from sparsegaze.errors import SceneError
from sparsegaze.headset import Headset
from sparsegaze.person import Person
from sparsegaze.scene import Scene

NEAR = port((10, -10, -30))


@pytest.mark.parametrize(
    "bad, says",
    [
        (port((3, 2, -8), (0, 0, -50)), "is inside the eyeball"),
        (port((0, 0, -13.0), (0, 0, -50)), "is inside the eyeball"),
        (port((0, 0, 30)), "is inside or behind the face"),
        (port((-25, 0, -10)), "is inside or behind the face"),
        (replace(NEAR, position_mm=(0.0, float("nan"), -30.0)), "not finite"),
        (replace(NEAR, position_mm=(0.0, 0.0, float("-inf"))), "not finite"),
        (replace(NEAR, position_mm=(0.0, 0.0, -1e5)), "10 m"),
        (replace(NEAR, aim=(0.0, 0.0, 0.0)), "no aim"),
        (replace(NEAR, aim=(0.0, 1e200, 0.0)), "not finite"),
        (replace(NEAR, sigma_deg=0.0), "sigma"),
        (replace(NEAR, sigma_deg=90.0), "sigma"),
        (replace(NEAR, sigma_deg=float("nan")), "not finite"),
        (replace(NEAR, lens_radius_mm=-1.0), "negative radius"),
        (port((3, 2, -18.5), (0, 0, -11), 0.5), "narrower than 0.2 mm"),
        (port((2, 20, -30), (2, 20, 0), 0.5), "narrower than 0.2 mm"),
        (replace(NEAR, lens_radius_mm=9.0), "too large"),
        (port((0, 0, -16), (0, 10, -16), lens_radius_mm=3.5), "reaches into the eye or the face"),
    ],
)
def test_an_impossible_port_is_refused_by_kind_number_and_reason(bad, says):
    for kind, headset in (
        ("sensor 1", Headset("x", (NEAR, bad), (NEAR,))),
        ("emitter 2", Headset("x", (NEAR,), (NEAR, NEAR, bad))),
    ):
        with pytest.raises(SceneError) as caught:
            Scene(headset, Person())
        assert kind in str(caught.value) and says in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"nose_mm": 500.0},
        {"lid_radius_mm": 1e9},
        {"kappa_azimuth_deg": 120.0},
        {"lid_softness_mm": 0.19},
        {"lid_upper_follow": 50.0},
        {"eye_position_mm": (0.0, 0.0, -1e7)},
    ],
)
def test_wild_numbers_of_a_person_are_refused(change):
    with pytest.raises(SceneError) as caught:
        Scene(pair(NEAR, NEAR), replace(Person(), **change))
    assert "impossible scene: " in str(caught.value)


@pytest.mark.parametrize("slip", [None, 3, (1, 2), (0, 0, float("nan")), ("a", 0, 0)])
def test_a_slip_that_is_no_vector_is_refused(slip):
    with pytest.raises(SceneError):
        Scene(pair(NEAR, NEAR), Person(), slip_mm=slip)


@pytest.mark.parametrize("quality", [{"nose": 1.0}, {"face": 0.0}, {"face": float("nan")}, {"face": "fine"}])
def test_an_unknown_quality_is_refused(quality):
    with pytest.raises(SceneError):
        Scene(pair(NEAR, NEAR), Person(), quality=quality)
