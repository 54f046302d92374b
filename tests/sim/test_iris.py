# SPDX-License-Identifier: Apache-2.0
"""The iris seen by sensors so low that rays through the cornea fold on it: against Snell's law traced
forward, and against the adaptive reference, finer and finer.
"""

import numpy as np
import pytest
from random_scenes import random_scenes
from reference import other_pairs, reference_states
from reference_table import mean_total

from sparsegaze.person import draw_person
from sparsegaze.scene import Scene, c_person, simulator


class Snell:
    """Rays from one site refracted at a person's cornea, eye frame: the same eye, written again."""

    def __init__(self, person, site):
        self.radius, self.conic = person.cornea_radius_mm, 1 + person.cornea_asphericity
        rim = person.limbus_radius_mm
        self.apex = np.sqrt(person.globe_radius_mm**2 - rim**2) + self.sag(rim * rim)
        self.iris, self.index, self.site = self.apex - person.iris_depth_mm, person.refractive_index, site

    def sag(self, r2):
        return r2 / (self.radius + np.sqrt(self.radius**2 - self.conic * r2))

    def spot(self, x, y):
        """(where the ray through (x, y) of the cornea meets the iris' plane, cosine of incidence) or None."""
        point = np.array([x, y, self.apex - self.sag(x * x + y * y)])
        normal = np.array([x, y, np.sqrt(self.radius**2 - self.conic * (x * x + y * y))])
        normal /= np.linalg.norm(normal)
        ray = (point - self.site) / np.linalg.norm(point - self.site)
        cosine = -ray @ normal
        if cosine <= 0:
            return None
        inside = np.sqrt(1 - (1 - cosine**2) / self.index**2)
        ray = ray / self.index + (cosine / self.index - inside) * normal
        if ray[2] > -1e-3:
            return None
        return (point + ray * (self.iris - point[2]) / ray[2])[:2], cosine

    def determinant(self, x, y, h=1e-4):
        """Area on the iris per area of the cornea seen from the front, negative behind a caustic; or None."""
        ends = [self.spot(x + dx, y + dy) for dx, dy in ((h, 0), (-h, 0), (0, h), (0, -h))]
        if any(end is None for end in ends):
            return None
        columns = [(ends[i][0] - ends[i + 1][0]) / (2 * h) for i in (0, 2)]
        return np.linalg.det(np.array(columns))


@pytest.mark.parametrize("off_axis_deg", [50, 60, 65, 70, 75, 80, 85, 88, 90])
def test_every_ordinary_path_is_found(off_axis_deg):
    """Rays traced forward through the clear cornea: the spot each meets gets light, by the same path."""
    ffi, lib = simulator()
    seen = 0
    for seed in range(4):
        person = draw_person(seed)
        off, turn, distance = np.radians(off_axis_deg), 0.7 + 1.6 * seed, (16.0, 22.0, 30.0, 60.0)[seed]
        snell = Snell(person, np.zeros(3))
        site = distance * np.array([np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn), np.cos(off)])
        site[2] += snell.apex - 3.6
        snell.site = site
        rim = person.limbus_radius_mm
        made, exit_mm = c_person(ffi, person), ffi.new("double[3]")
        for x in np.linspace(-rim, rim, 31):
            for y in np.linspace(-rim, rim, 31):
                met = snell.spot(x, y) if np.hypot(x, y) < rim else None
                if met is None or np.hypot(*met[0]) > rim or met[1] < 0.02:
                    continue
                determinant = snell.determinant(x, y)
                if determinant is None or determinant < 0.03:
                    continue
                spot = ffi.new("double[3]", [*met[0], snell.iris])
                light = lib.sim_person_iris_light(made, ffi.new("double[3]", list(site)), spot, exit_mm)
                assert light > 0, (seed, x, y)
                assert np.hypot(exit_mm[0] - x, exit_mm[1] - y) < 1e-6, (seed, x, y)
                seen += 1
    assert seen > 600


@pytest.mark.parametrize(
    "name", ["nose between sensor and eye", "random 1", "random 21", "random 24", "random 31", "random 78"]
)
def test_the_error_falls_steadily_with_fineness(name):
    """A row beside a caustic that touches it lost all light at once (1e-4 whatever the fineness, up to 8). In
    random 31 stretches of rows were dark in their middle, and taken to be dark all along (1.7e-5 throughout).
    """
    case = next(case for case in random_scenes(90) if case.name == name)
    scale, pairs = mean_total(case), other_pairs(case.headset)
    truth, _, _ = reference_states(
        case.headset, case.person, case.states, pairs, 2e-6, terms=("iris",), scale=scale
    )
    s, e = np.array(pairs).T
    for fineness, bar in ((1.0, 1e-4), (2.0, 3e-5), (4.0, 6e-6)):
        scene = Scene(case.headset, case.person, quality={"iris": fineness, "face": 0.1})
        got = [scene.smooth(*gaze, pupil, lid, "iris")[0, 0, s, e] for *gaze, pupil, lid in case.states]
        assert np.sqrt(np.mean(((np.array(got) - truth["iris"]) / scale) ** 2)) < bar, fineness
