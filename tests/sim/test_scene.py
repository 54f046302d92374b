# SPDX-License-Identifier: Apache-2.0
"""The simulator against what is known without it: closed forms, symmetry, energy, and smoothness."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from sim_scenes import LIDS_AWAY, OFF_DIAGONAL, pair, port, six

from sparsegaze.headset import Headset
from sparsegaze.person import Person, draw_person
from sparsegaze.scene import Scene, c_person, simulator

WIDE = replace(Person(), **LIDS_AWAY)
# A corneal sphere on the optical axis, looking where the eye looks.
SPHERE = replace(
    WIDE, cornea_asphericity=0.0, kappa_azimuth_deg=0.0, kappa_elevation_deg=0.0, limbus_blend_mm=0.3
)


def window(port_, point):
    direction = np.subtract(point, port_.position_mm)
    cosine = direction @ np.array(port_.aim) / np.linalg.norm(direction)
    return np.exp(-(1 / cosine**2 - 1) / (2 * np.tan(np.radians(port_.sigma_deg)) ** 2))


def fresnel(index, cosine):
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    return (
        ((cosine - index * inside) / (cosine + index * inside)) ** 2
        + ((inside - index * cosine) / (inside + index * cosine)) ** 2
    ) / 2


def sphere_glint(centre, radius, sensor, emitter, index):
    """Response of a mirror sphere by Fermat's path and the determinant of its second derivatives."""
    s, e = np.array(sensor.position_mm), np.array(emitter.position_mm)
    middle = s + e - 2 * centre
    axis = middle / np.linalg.norm(middle)
    u = np.cross(axis, [0.3, 0.9, 0.1])
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)

    def point(q):
        flat = np.clip(q, -0.7 * radius, 0.7 * radius)
        return centre + flat[0] * u + flat[1] * v + np.sqrt(radius**2 - flat @ flat) * axis

    def length(q):
        return np.linalg.norm(point(q) - s) + np.linalg.norm(point(q) - e)

    q = minimize(length, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 1e-15}).x
    h = 1e-3 * min(radius, np.linalg.norm(point(q) - s), np.linalg.norm(point(q) - e))
    d = np.eye(2) * h
    second = np.array(
        [
            [
                (
                    length(q + d[i] + d[j])
                    - length(q + d[i] - d[j])
                    - length(q - d[i] + d[j])
                    + length(q - d[i] - d[j])
                )
                / (4 * h * h)
                for j in range(2)
            ]
            for i in range(2)
        ]
    )
    p = point(q)
    normal = (p - centre) / radius
    determinant = np.linalg.det(second) * (normal @ axis) ** 2
    ds, de = np.linalg.norm(p - s), np.linalg.norm(p - e)
    cosine = normal @ (s - p) / ds
    return (
        fresnel(index, cosine)
        * cosine**2
        / (ds * ds * de * de * determinant)
        * window(sensor, p)
        * window(emitter, p)
    )


@pytest.mark.parametrize(
    "sensor_mm, emitter_mm",
    [
        ((6, -4, -40), (-7, -2, -38)),
        ((3, 8, -30), (4, -6, -26)),
        ((12, 0, -60), (2, -9, -200)),
        ((1, 2, -500), (-9, 3, -33)),
    ],
)
def test_glint_of_a_single_sphere_is_the_closed_form_to_second_order_in_roughness(sensor_mm, emitter_mm):
    sensor = port(sensor_mm, sigma_deg=60.0, lens_radius_mm=0.0)
    emitter = port(emitter_mm, sigma_deg=60.0, lens_radius_mm=0.0)
    apex = simulator()[1].sim_person_profile_mm(c_person(simulator()[0], SPHERE), 0.0)
    centre = np.array([0, 0, -(apex - SPHERE.cornea_radius_mm)])
    exact = sphere_glint(centre, SPHERE.cornea_radius_mm, sensor, emitter, SPHERE.refractive_index)
    error = []
    for alpha in (0.04, 0.02, 0.01):
        scene = Scene(
            pair(sensor, emitter), replace(SPHERE, roughness=alpha), quality={"glint": 10}
        )
        error.append(abs(scene.glint(0, 0, 1.0)[0, 0, 0] / exact - 1))
    assert error[2] < 1e-3
    assert error[0] / error[2] > 10, "quarters with each halving of the roughness"


def test_a_very_large_cornea_is_a_flat_mirror():
    """An eye 100 times the size, 10 mm in front of it: F / (s + d)^2, up to the curvature's s d / (R (s +
    d)).
    """
    grow = {
        name: 100 * getattr(SPHERE, name)
        for name in (
            "cornea_radius_mm",
            "limbus_radius_mm",
            "limbus_blend_mm",
            "limbus_haze_mm",
            "globe_radius_mm",
            "iris_depth_mm",
        )
    }
    person = replace(SPHERE, roughness=0.01, lid_radius_mm=1205.0, **grow)
    apex = simulator()[1].sim_person_profile_mm(c_person(simulator()[0], person), 0.0)
    sensor, emitter = (port((x, 0.0, -apex - 10.0), (0, 0, -apex), 60.0, 0.0) for x in (-3.0, 3.0))
    scene = Scene(pair(sensor, emitter), person, quality={"glint": 10})
    cosine = 10 / np.hypot(3, 10)
    flat = fresnel(person.refractive_index, cosine) / (4 * (9 + 100)) * window(sensor, (0, 0, -apex)) ** 2
    got = scene.glint(0, 0, 1.0)[0, 0, 0]
    assert got == pytest.approx(flat, rel=0.028)
    centre, radius = np.array([0, 0, 780.0 - apex]), 780.0
    assert got == pytest.approx(
        sphere_glint(centre, radius, sensor, emitter, person.refractive_index), rel=1e-3
    )


@pytest.mark.parametrize("seed", range(3))
def test_swapping_sensor_and_emitter_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    a, b = port((14, -8, -28), (2, 1, -11), 9.0, 1.2), port((-12, -10, -31), (-3, 0, -11), 14.0, 2.0)
    person = draw_person(seed)
    one, other = Scene(pair(a, b), person), Scene(pair(b, a), person)
    for _ in range(3):
        state = (*rng.uniform(-20, 20, 2), rng.uniform(2, 7), rng.uniform(0.3, 1))
        np.testing.assert_allclose(one.response(*state), other.response(*state), rtol=1e-12)


def test_no_more_light_comes_back_than_was_emitted():
    """Sensors all over the half space in front, everything white: what they collect against what was sent
    there.
    """
    white = replace(WIDE, albedo_sclera=1.0, albedo_iris=1.0, albedo_skin=1.0)
    n, far = 200, 500.0
    k = np.arange(n) + 0.5
    cosine, phi = 1 - k / n * (1 - 16 / far), k * 2.39996322972865332
    sine = np.sqrt(1 - cosine**2)
    places = far * np.stack([sine * np.cos(phi), sine * np.sin(phi), -cosine], 1)
    sensors = tuple(port(tuple(p), (0, 0, 0), 85.0, 0.0) for p in places)
    lamp = port((8.0, -8.0, -30.0), sigma_deg=12.0, lens_radius_mm=0.0)
    scene = Scene(Headset("dome", sensors, (lamp,)), white)
    collected = scene.response(0, 0)[:, 0].mean() * 2 * np.pi * far**2 * (1 - 16 / far)
    angle = np.linspace(0, 1.5, 4000)
    beam = np.exp(-np.tan(angle) ** 2 / (2 * np.tan(np.radians(12.0)) ** 2)) * 2 * np.pi * np.sin(angle)
    emitted = beam.sum() * (angle[1] - angle[0])
    assert 0.3 * emitted < collected < emitted


@pytest.mark.parametrize("seed", range(3))
def test_finer_integration_changes_less_than_a_thousandth(seed):
    rng = np.random.default_rng(seed)
    fine = {"sclera": 2.5, "iris": 2.5, "glint": 5, "face": 1.4}
    default, finer = Scene(six(), draw_person(seed)), Scene(six(), draw_person(seed), quality=fine)
    error, mean = [], []
    for _ in range(5):
        state = (*rng.uniform(-20, 20, 2), rng.uniform(2.2, 6.5), 1.0)
        truth = finer.response(*state)[OFF_DIAGONAL]
        error.append(default.response(*state)[OFF_DIAGONAL] - truth)
        mean.append(truth.mean())
    assert np.sqrt(np.mean(np.square(error))) / np.mean(mean) < 5e-4
    assert np.abs(error).max() / np.mean(mean) < 2e-3


def test_closed_lids_hide_the_eye_exactly_and_opening_them_shows_it_steadily():
    scene = Scene(six(), Person())
    opening = np.linspace(0, 1, 21)
    eye = scene.smooth(3, 2, 3.5, opening, "eye")[0].sum((1, 2))
    face = scene.smooth(3, 2, 3.5, opening, "face")[0].sum((1, 2))
    glint = scene.glint(3, 2, opening).sum((1, 2))
    assert eye[0] == 0 and glint[0] == 0
    assert (np.diff(eye) >= 0).all() and (np.diff(face) <= 0).all() and (np.diff(glint) >= 0).all()
    assert glint[-1] > 0 and eye[-1] > 20 * glint[-1] / 100


@pytest.mark.parametrize("sweep", ["azimuth", "elevation", "pupil", "lid"])
def test_no_staircase_in_any_direction(sweep):
    """Second differences over small steps fall with the step squared; a staircase's would not."""
    scene = Scene(six(), draw_person(4))

    def along(t):
        state = {
            "azimuth": (t, 3, 3.5, 1),
            "elevation": (3, t, 3.5, 1),
            "pupil": (3, 2, 4 + t / 10, 1),
            "lid": (3, 2, 3.5, 0.85 + t / 100),
        }[sweep]
        return scene.response(*state)[OFF_DIAGONAL]

    def roughness(step):
        values = np.array(
            [along(t) for t in np.arange(-7, 7.01, 0.5)[:, None] + step * np.arange(3) for t in t]
        )
        values = values.reshape(-1, 3, values.shape[-1])
        return np.sqrt(np.mean((values[:, 0] - 2 * values[:, 1] + values[:, 2]) ** 2)) / values.mean()

    coarse, fine = roughness(0.8), roughness(0.1)
    assert fine < 1e-4
    assert coarse / fine > 16, "64 for a smooth function, 1 for a staircase"


RING_PAIR = pair(port((-16, -8, -30), lens_radius_mm=0.5), port((-12, -8, -32), lens_radius_mm=0.5))


def ring_sweep(person):
    azimuth = np.arange(-30, 30.01, 0.25)
    scene = Scene(RING_PAIR, replace(person, kappa_azimuth_deg=0.0, kappa_elevation_deg=0.0))
    glint = np.array([scene.glint(a, 0, 1.0)[0, 0, 0] for a in azimuth])
    # The window's slow fall is not the ring's doing.
    over = glint / np.median(glint)
    wide = azimuth[over > 1 + (over.max() - 1) / 2]
    return azimuth[np.argmax(over)], over.max(), wide[-1] - wide[0]


def test_the_papers_bright_ring_is_a_narrow_spike_in_a_horizontal_sweep():
    peak_deg, over, width_deg = ring_sweep(replace(WIDE, cornea_asphericity=0.0))
    assert 5 < peak_deg < 16
    assert over > 2.0
    assert width_deg < 6.0


def test_without_a_smooth_limbus_there_is_a_plateau_and_no_spike():
    _, over, width_deg = ring_sweep(replace(WIDE, cornea_asphericity=0.0))
    _, hard_over, hard_width_deg = ring_sweep(replace(WIDE, cornea_asphericity=0.0, limbus_blend_mm=0.02))
    assert hard_over < over and hard_width_deg > 1.5 * width_deg


def test_nearly_all_of_the_signal_is_diffuse_and_the_pupil_darkens_it():
    scene = Scene(six(), Person())
    glint = scene.glint(0, 0, 1.0)[0][OFF_DIAGONAL].mean()
    iris = scene.smooth(0, 0, [2, 4, 6, 8], 1.0, "iris")[:, 0].sum((1, 2))
    total = scene.response(0, 0)[OFF_DIAGONAL].mean()
    assert 0 < glint < 0.25 * total
    assert (np.diff(iris) < 0).all()


def test_pupils_computed_together_equal_pupils_computed_alone():
    scene = Scene(six(), Person(), quality={"iris": 3})
    together = scene.smooth(4, -6, [2.5, 3.5, 5.0], [0.7, 1.0])
    for i, pupil in enumerate((2.5, 3.5, 5.0)):
        for j, lid in enumerate((0.7, 1.0)):
            np.testing.assert_allclose(together[i, j], scene.smooth(4, -6, pupil, lid)[0, 0], rtol=1e-4)
