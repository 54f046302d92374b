# SPDX-License-Identifier: Apache-2.0
"""Scenes to judge the simulator by: ten hard ones by name, then random ones. The same list every time."""

from dataclasses import dataclass, replace
from typing import Tuple

import numpy as np
from reference import face_mm
from sim_scenes import pair, port, six

from sparsegaze.headset import Headset
from sparsegaze.person import Person, draw_person, nominal_person


@dataclass(frozen=True)
class Case:
    """states: (azimuth_deg, elevation_deg, pupil_mm, lid_opening) each."""

    name: str
    headset: Headset
    person: Person
    states: Tuple[Tuple[float, float, float, float], ...]


def _apart(name, sensors, emitters):
    return Headset(name, tuple(sensors), tuple(emitters))


def _hard():
    nominal = nominal_person()
    ring = six()
    side = port((14.0, -8.0, -28.0), (1.0, 0.0, -11.0), 12.0, 1.0)
    sharp = [replace(p, lens_radius_mm=0.0) for p in ring.sensors]
    yield Case(
        "glint on the limbus",
        pair(port((-16, -8, -30), (-5, -2, -11), 12.0, 0.5), port((-12, -8, -32), (-5, -2, -11), 12.0, 0.5)),
        nominal,
        ((7.0, 0.0, 3.5, 1.0), (9.0, 0.0, 3.5, 1.0), (11.0, 0.0, 3.5, 1.0)),
    )
    yield Case(
        "narrow lobe",
        _apart("sharp", sharp[:3], sharp[2:5]),
        replace(nominal, roughness=1e-3),
        ((3.0, -4.0, 3.0, 1.0), (-18.0, 9.0, 4.0, 1.0), (14.0, -12.0, 4.0, 1.0)),
    )
    yield Case(
        "roughness 0.5",
        ring,
        replace(draw_person(3), roughness=0.5),
        ((0.0, 0.0, 3.5, 1.0), (20.0, -15.0, 2.5, 1.0)),
    )
    yield Case(
        "sensor 5 mm from the eye",
        _apart(
            "near", [port((4.0, -3.0, -17.4), (0.0, 0.0, -12.0), 25.0, 0.5)], ring.emitters[3:5] + (side,)
        ),
        nominal,
        ((5.0, 2.0, 3.5, 1.0), (-12.0, 6.0, 5.0, 1.0)),
    )
    yield Case(
        "sensor 500 mm away",
        _apart("far", [port((70.0, -60.0, -491.0), (0.0, 0.0, -11.0), 5.0, 2.5)], ring.emitters[:4]),
        draw_person(5),
        ((-6.0, 3.0, 3.0, 1.0), (17.0, -20.0, 4.5, 1.0)),
    )
    yield Case(
        "half-closed lids",
        ring,
        draw_person(8),
        ((0.0, 0.0, 3.5, 0.5), (10.0, -14.0, 3.5, 0.3), (-8.0, 10.0, 4.5, 0.12)),
    )
    yield Case(
        "pupil edge at the lid edge",
        _apart("half ring", ring.sensors[1:4], ring.emitters[2:6]),
        replace(nominal, lid_upper_deg=17.0, lid_lower_deg=-22.0),
        ((0.0, 2.0, 8.0, 1.0), (6.0, -9.0, 8.0, 0.8)),
    )
    yield Case(
        "tangent sensor",
        _apart(
            "tangent", [port((27.0, 1.0, -13.2), (2.0, 0.0, -11.5), 20.0, 1.0)], ring.emitters[3:] + (side,)
        ),
        nominal,
        ((0.0, 0.0, 3.5, 1.0), (22.0, 5.0, 3.5, 1.0), (-22.0, -5.0, 5.0, 1.0)),
    )
    nose = [
        port((-43.0, -3.0, -23.0), (0, 0, -11.5), 15.0, 1.5),
        port((-40, 4, -22.5), (0, 0, -11.5), 15.0, 0.0),
    ]
    yield Case(
        "nose between sensor and eye",
        _apart("nasal", nose, [side, port((-14, -6, -28), (-2, 0, -11), 20.0, 1.5)]),
        replace(nominal, nose_mm=16.5),
        ((-15.0, 0.0, 3.5, 1.0), (12.0, -10.0, 4.0, 1.0)),
    )
    away = np.array([612.0, -523.0, 591.0])
    moved = [replace(p, position_mm=tuple(np.array(p.position_mm) + away)) for p in ring.sensors]
    yield Case(
        "eye 1 m off the origin",
        _apart("moved", moved[1:5], moved[1:5]),
        replace(draw_person(2), eye_position_mm=tuple(away)),
        ((4.0, -7.0, 3.3, 1.0), (-21.0, 13.0, 4.0, 1.0)),
    )


def _draw_port(rng, person):
    """A port in a possible place: outside the eye, at least 1 mm in front of the face."""
    while True:
        off, turn = np.radians(rng.uniform(5, 68)), rng.uniform(0, 2 * np.pi)
        distance = 19.0 * np.exp(rng.uniform(0, 1.3))
        at = distance * np.array([np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn), -np.cos(off)])
        radius = float(rng.choice([0.0, rng.uniform(0.2, 2.5)], p=[0.2, 0.8]))
        aim = (rng.uniform(-6, 6), rng.uniform(-5, 5), -11.0)
        sigma = float(np.exp(rng.uniform(np.log(5), np.log(40))))
        clear = all(
            -at[2] > face_mm(person, at[0] + dx, at[1] + dy) + 1
            for dx, dy in ((0, 0), (2, 0), (-2, 0), (0, 2), (0, -2))
        )
        if clear and distance > 15.5 + 2 * radius:
            return port(
                np.round(at + person.eye_position_mm, 3), np.add(aim, person.eye_position_mm), sigma, radius
            )


def _draw(seed):
    rng = np.random.default_rng([seed, 0x5CE])
    person = draw_person(100 + seed)
    if rng.random() < 0.6:
        leds = tuple(_draw_port(rng, person) for _ in range(rng.integers(2, 7)))
        headset = Headset("drawn %d" % seed, leds, leds)
    else:
        n_sensors, n_emitters = rng.integers(1, 4), rng.integers(2, 5)
        headset = _apart(
            "drawn %d" % seed,
            [_draw_port(rng, person) for _ in range(n_sensors)],
            [_draw_port(rng, person) for _ in range(n_emitters)],
        )
    states = []
    for _ in range(rng.integers(2, 4)):
        lid = 1.0 if rng.random() < 0.7 else float(np.round(rng.uniform(0.2, 0.95), 3))
        gaze = np.round(rng.uniform(-25, 25, 2), 3)
        states.append((float(gaze[0]), float(gaze[1]), float(np.round(rng.uniform(2, 8), 3)), lid))
    return Case("random %d" % seed, headset, person, tuple(states))


def random_scenes(n=20):
    """n cases, the first ten of them hard."""
    cases = list(_hard())
    return (cases + [_draw(seed) for seed in range(max(0, n - len(cases)))])[:n]
