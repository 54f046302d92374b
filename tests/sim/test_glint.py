# SPDX-License-Identifier: Apache-2.0
"""The glint: the lobe's quadrature and the mirror points, against closed forms, an independent adaptive
quadrature
and each other, up to the fold at the limbus, grazing light and lobes of any width.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from brute_image import Eye, transmission, unit
from glint_quadrature import Glint
from random_scenes import random_scenes
from reference import reference_response
from sim_scenes import LIDS_AWAY, OFF_DIAGONAL, pair, port, six

from sparsegaze.headset import Headset, load_headset
from sparsegaze.person import Person, draw_person, nominal_person
from sparsegaze.scene import Scene, c_person, simulator

HEADSET = Path(__file__).resolve().parents[2] / "headsets" / "led2gaze.toml"
# No relief that could hide a port: what is tested here is the eye and the lids.
FLAT_FACE = dict(brow_mm=0.0, nose_mm=0.0, cheek_mm=0.0)
WIDE = dict(LIDS_AWAY, **FLAT_FACE)
STRAIGHT = dict(kappa_azimuth_deg=0.0, kappa_elevation_deg=0.0)
# A sharp limbus: one with a fold. The nominal one has none: its curvature stays positive.
SHARP = replace(Person(), limbus_blend_mm=0.3, **WIDE)
A = port((12, -8, -28), sigma_deg=25.0, lens_radius_mm=0.0)
B = port((-9, -10, -31), sigma_deg=25.0, lens_radius_mm=0.0)


def mirrors(scene, azimuth, elevation, sensor=0, emitter=0, opening=1.0):
    """All mirror points of a pair, as dicts."""
    ffi, lib = simulator()
    found = ffi.new("struct sim_mirror_light[]", 32)
    n = lib.sim_scene_mirrors(scene._scene, azimuth, elevation, opening, sensor, emitter, found, 32)
    assert n >= 0
    return [
        {key: (list(m.point_mm) if key == "point_mm" else getattr(m, key)) for key, _ in ffi.typeof(m).fields}
        for m in found[0:n]
    ]


def lobe(person, sensor, emitter, azimuth, elevation, fineness=1.0, opening=1.0):
    scene = Scene(pair(sensor, emitter), person, quality={"glint": fineness})
    return scene.glint(azimuth, elevation, opening)[0, 0, 0]


def fold_gaze(person, sensor, emitter):
    """Azimuth at which two mirror points are born on the limbus, to 1e-9 degrees."""
    scene = Scene(pair(sensor, emitter), person)
    count = [len(mirrors(scene, a, 0.0)) for a in np.arange(0, 45.1, 0.5)]
    first = next(i for i in range(90) if count[i] == 1 and count[i + 1] == 3)
    lo, hi = first / 2, first / 2 + 0.5
    while hi - lo > 1e-9:
        middle = (lo + hi) / 2
        lo, hi = (middle, hi) if len(mirrors(scene, middle, 0.0)) == 1 else (lo, middle)
    return lo


CASES = {
    "interior": (replace(Person(), **WIDE), A, B, 3.0, -4.0),
    "interior, roughness 0.005": (replace(Person(), roughness=0.005, **WIDE), A, B, 3.0, -4.0),
    "limbus": (replace(Person(), **WIDE), A, B, 30.0, 25.0),
    "sclera": (replace(Person(), **WIDE), A, B, -45.0, 40.0),
    "roughness 0.1": (replace(Person(), roughness=0.1, **WIDE), A, B, -8.0, 12.0),
    "roughness 0.5": (replace(Person(), roughness=0.5, **WIDE), A, B, 8.0, -5.0),
    "large lenses": (replace(Person(), **WIDE), replace(A, lens_radius_mm=3.0), B, 10.0, 3.0),
    "lower lid across the lobe": (replace(Person(), roughness=0.03, **FLAT_FACE), A, B, -2.0, 15.0),
    "half-closed lids": (replace(draw_person(3), roughness=0.1, **FLAT_FACE), A, B, 4.0, 2.0),
    "grazing": (
        replace(Person(), roughness=0.05, **WIDE),
        port((26, 0, -15.5), sigma_deg=60.0, lens_radius_mm=0.5),
        port((-26, 1, -15), sigma_deg=60.0, lens_radius_mm=0.5),
        2.0,
        1.0,
    ),
    "sensor 5 mm away": (replace(Person(), **WIDE), port((3, -4, -17.6), (0, 0, -11), 60.0, 0.0), B, 5, 5),
    "sensor 500 mm away": (
        replace(Person(), **WIDE),
        port((90, -60, -500), (0, 0, -11), 3.0, 0.0),
        B,
        12.0,
        9.0,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_lobe_is_that_of_an_independent_adaptive_quadrature(name):
    person, sensor, emitter, azimuth, elevation = CASES[name]
    opening = 0.55 if name == "half-closed lids" else 1.0
    exact, error = Glint(person, sensor, emitter, azimuth, elevation, opening).integrate()
    got = lobe(person, sensor, emitter, azimuth, elevation, 1.0, opening)
    assert error < 3e-5 * exact
    print("%s: %.6e, off by %.1e" % (name, exact, got / exact - 1))
    assert got == pytest.approx(exact, rel=5e-4 if name == "grazing" else 2e-4)
    assert lobe(person, sensor, emitter, azimuth, elevation, 4.0, opening) == pytest.approx(exact, rel=3e-5)


@pytest.mark.parametrize("roughness", [0.05, 0.01])
def test_half_vector_exactly_at_the_fold(roughness):
    """Where the mirror point's response is infinite the lobe's is not, and is as good as anywhere."""
    person = replace(SHARP, roughness=roughness)
    gaze = fold_gaze(person, A, B)
    exact, error = Glint(person, A, B, gaze, 0.0).integrate()
    assert error < 3e-5 * exact
    assert lobe(person, A, B, gaze, 0.0) == pytest.approx(exact, rel=1e-4)
    beyond = mirrors(Scene(pair(A, B), person), gaze + 1e-6, 0.0)
    assert len(beyond) == 3 and max(m["response"] for m in beyond) > 20 * exact


def test_gaze_that_puts_the_glint_on_the_limbus_is_where_it_is_brightest():
    person = replace(SHARP, roughness=0.01, **STRAIGHT)
    scene = Scene(pair(A, B), person)
    gaze = np.arange(0, 45.01, 0.25)
    glint = np.array([scene.glint(g, 0.0, 1.0)[0, 0, 0] for g in gaze])
    at = mirrors(scene, gaze[glint.argmax()], 0.0)
    limbus_deg = np.degrees(np.arcsin(person.limbus_radius_mm / person.globe_radius_mm))
    assert min(abs(m["theta_deg"] - limbus_deg) for m in at) < 5
    assert glint.max() > 2 * np.median(glint)


def test_roughness_from_a_half_to_a_thousandth_converges_to_the_mirror_point():
    person = replace(Person(), **WIDE)
    (mirror,) = mirrors(Scene(pair(A, B), person), 3.0, -4.0)
    alpha = np.array([0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001])
    value = np.array([lobe(replace(person, roughness=a), A, B, 3.0, -4.0, 4.0) for a in alpha])
    off = np.abs(value / mirror["response"] - 1)
    print(dict(zip(alpha, off)))
    slope = np.diff(np.log(off[3:])) / np.diff(np.log(alpha[3:]))
    assert np.abs(slope[:3] - 2).max() < 0.15, "second order in roughness"
    assert off[-1] < 1e-5


@pytest.mark.parametrize("lens_mm", [0.0, 0.5, 3.0])
def test_fineness_one_serves_every_roughness_and_lens(lens_mm):
    """Errors in units of a mean response of the default kind (2e-6); with lids, gazes over the limbus."""
    worst = {}
    for alpha in (0.5, 0.1, 0.03, 0.01, 0.001):
        error = []
        for seed in range(2):
            person = replace(draw_person(seed), roughness=alpha)
            scenes = [Scene(six(lens_radius_mm=lens_mm), person, quality={"glint": q}) for q in (1.0, 5.0)]
            for gaze in np.random.default_rng(seed).uniform(-25, 25, (4, 2)):
                fine, finer = (s.glint(*gaze, 1.0)[0][OFF_DIAGONAL] for s in scenes)
                error.append(fine - finer)
        worst[alpha] = (np.sqrt(np.mean(np.square(error))) / 2e-6, np.abs(error).max() / 2e-6)
    print(lens_mm, {a: "%.1e %.1e" % w for a, w in worst.items()})
    assert max(w[0] for w in worst.values()) < 1.5e-5
    assert max(w[1] for w in worst.values()) < 1.5e-4


def test_error_falls_with_fineness():
    person = draw_person(5)
    gazes = np.random.default_rng(5).uniform(-25, 25, (8, 2))
    value = {}
    for q in (0.1, 0.25, 0.5, 1.0, 2.0, 12.0):
        scene = Scene(six(), person, quality={"glint": q})
        value[q] = np.array([scene.glint(*g, 1.0)[0] for g in gazes])
    error = [np.sqrt(np.mean((value[q] - value[12.0]) ** 2)) for q in (0.1, 0.25, 0.5, 1.0, 2.0)]
    assert all(b < a for a, b in zip(error, error[1:]))
    assert error[0] > 300 * error[3]


def test_swapping_sensor_and_emitter_changes_no_glint():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        person = replace(draw_person(seed), roughness=10 ** rng.uniform(-3, -0.5))
        one, other = Scene(pair(A, B), person), Scene(pair(B, A), person)
        for gaze in rng.uniform(-25, 25, (5, 2)):
            assert one.glint(*gaze, 1.0) == pytest.approx(other.glint(*gaze, 1.0), rel=1e-12)
            there, back = mirrors(one, *gaze), mirrors(other, *gaze)
            assert [m["response"] for m in there] == pytest.approx([m["response"] for m in back], rel=1e-6)


def test_an_eye_a_metre_off_the_origin_glints_the_same():
    """The same scene moved along: what is left is the rounding of positions."""
    away = np.array([1000.0, -300.0, 600.0])
    moved = [replace(p, position_mm=tuple(np.add(p.position_mm, away))) for p in (A, B)]
    for alpha in (0.05, 0.002):
        person = replace(Person(), roughness=alpha)
        far = replace(person, eye_position_mm=tuple(away))
        assert lobe(far, *moved, 4.0, 9.0) == pytest.approx(lobe(person, A, B, 4.0, 9.0), rel=1e-9)


def test_mirror_points_are_odd_in_number_over_ten_thousand_gazes_and_pairs():
    """And one more is a minimum or maximum of the path than a saddle, as on any closed smooth surface. The
    miss of
    the mirror condition at each is checked against the other implementation's normals."""
    count, index = Counter(), Counter()
    ffi, lib = simulator()
    found = ffi.new("struct sim_mirror_light[]", 32)
    for blend in (0.05, 0.2, 0.5, 0.9):
        person = replace(draw_person(1), limbus_blend_mm=blend)
        headset = six()
        scene = Scene(headset, person)
        for gaze in np.random.default_rng(7).uniform(-50, 50, (125, 2)):
            for s in range(6):
                for e in range(s, 6):
                    n = lib.sim_scene_mirrors(scene._scene, *gaze, 1.0, s, e, found, 32)
                    count[n] += 1
                    index[sum(1 if m.determinant > 0 else -1 for m in found[0:n])] += 1
            eye = Eye(person, *gaze)
            point = np.array([list(m.point_mm) for m in found[0:n]])
            port_mm = np.subtract(headset.sensors[5].position_mm, person.eye_position_mm)
            normal = eye.normal(eye.local(point)) @ eye.axes.T
            assert np.linalg.norm(np.cross(unit(port_mm - point), normal), axis=1).max() < 1e-6
    print(count)
    assert count.total() >= 10000 and set(count) <= {1, 3, 5} and count[3] > 200
    assert set(index) == {1}


def test_determinant_is_that_of_ray_tubes():
    """Rays from the emitter past a mirror point, reflected by the other implementation's surface: the area
    that a
    small cone covers at the sensor, by central differences."""
    tested = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        person = replace(draw_person(seed), limbus_blend_mm=(0.2, 0.8)[seed % 2], **WIDE)
        scene = Scene(pair(A, B), person)
        gaze = rng.uniform(-40, 40, 2)
        eye = Eye(person, *gaze)
        sensor, emitter = (eye.local(np.subtract(p.position_mm, person.eye_position_mm)) for p in (A, B))
        for m in mirrors(scene, *gaze):
            point = eye.local(m["point_mm"])
            along = unit(point - emitter)
            side = [unit(np.cross(along, [0.3, 0.5, 0.8]))]
            side.append(np.cross(along, side[0]))

            def lands(offset):
                ray, t = unit(along + offset), np.linalg.norm(point - emitter)
                for _ in range(30):
                    place = emitter + t * ray
                    t -= eye.outside(place) / (ray @ eye.normal(place)) * (unit(place) @ eye.normal(place))
                normal = eye.normal(emitter + t * ray)
                out, place = ray - 2 * (ray @ normal) * normal, emitter + t * ray
                back = unit(sensor - point)
                return place + (back @ (sensor - place)) / (back @ out) * out

            step = 2e-5
            d = [(lands(step * s) - lands(-step * s)) / (2 * step) for s in side]
            area = np.linalg.norm(np.cross(*d))
            product = m["sensor_mm"] * m["emitter_mm"]
            light = m["cosine"] ** 2 / (product**2 * abs(m["determinant"]))
            tested.append(light * area - 1)
    assert len(tested) >= 8
    assert np.abs(tested).max() < 3e-4 and np.median(np.abs(tested)) < 1e-5


def test_a_single_sphere_mirrors_as_the_closed_form_says():
    """Sensor and emitter on either side of the axis: F / ((s + d + 2 s d / (R cos)) (s + d + 2 s d cos /
    R)); both
    in one place on it: F / (4 d^2 (1 + d / R)^2)."""
    person = replace(Person(), cornea_asphericity=0.0, roughness=0.001, **STRAIGHT, **WIDE)
    apex = simulator()[1].sim_person_profile_mm(c_person(simulator()[0], person), 0.0)
    for high, aside in ((5.0, 2.0), (20.0, 15.0), (500.0, 100.0)):
        s, e = (port((x, 0.0, -apex - high), (0, 0, -apex), 80.0, 0.0) for x in (-aside, aside))
        d, radius = np.hypot(high, aside), person.cornea_radius_mm
        cosine = high / d
        spread = (2 * d + 2 * d * d / (radius * cosine)) * (2 * d + 2 * d * d * cosine / radius)
        exact = (1 - transmission(person.refractive_index, cosine)) / spread
        (mirror,) = mirrors(Scene(pair(s, e), person), 0, 0)
        assert mirror["response"] == pytest.approx(exact, rel=1e-7)
        assert lobe(person, s, e, 0, 0) == pytest.approx(exact, rel=5e-5)
        one = port((0.0, 0.0, -apex - high), (0, 0, -apex), 80.0, 0.0)
        exact = (1 - transmission(person.refractive_index, 1.0)) / (4 * high**2 * (1 + high / radius) ** 2)
        assert lobe(person, one, one, 0, 0) == pytest.approx(exact, rel=5e-5)


def test_close_up_the_cornea_is_a_flat_mirror():
    """F / (s + d)^2, off by the curvature's s d / (R (s + d)) and less the closer."""
    sphere = dict(cornea_asphericity=0.0, lid_radius_mm=12.1, **STRAIGHT, **WIDE)
    person = replace(Person(), roughness=0.001, **sphere)
    apex = simulator()[1].sim_person_profile_mm(c_person(simulator()[0], person), 0.0)
    off = []
    for high in (0.88, 0.44):
        s, e = (port((x * high, 0.0, -apex - high), (0, 0, -apex), 80.0, 0.0) for x in (-0.1, 0.1))
        flat = (1 - transmission(person.refractive_index, 1 / np.hypot(1, 0.1))) / (4 * 1.01 * high**2)
        off.append(1 - lobe(person, s, e, 0, 0) / flat)
    assert off[1] < 0.13
    assert off[0] / off[1] == pytest.approx(2, rel=0.2)


@pytest.mark.parametrize("distance_mm", [5.0, 500.0])
@pytest.mark.parametrize("lens_mm", [0.0, 1.0])
def test_sensor_near_and_far_and_led_radius_zero(distance_mm, lens_mm):
    """Gazes all over: the narrow lobe of point-like LEDs is the sum over mirror points."""
    person = replace(Person(), roughness=0.001, **WIDE)
    direction = unit(np.array([0.3, -0.35, -0.9]))
    sensor = port(tuple((13.4 + distance_mm) * direction), (0, 0, 0), 80.0, lens_mm)
    scenes = [Scene(pair(sensor, B), person, quality={"glint": q}) for q in (1.0, 5.0)]
    for gaze in np.random.default_rng(2).uniform(-30, 30, (12, 2)):
        one, finer = (s.glint(*gaze, 1.0)[0, 0, 0] for s in scenes)
        assert one == pytest.approx(finer, rel=2e-4)
        if lens_mm == 0:
            total = sum(m["response"] * m["open"] for m in mirrors(scenes[0], *gaze))
            assert one == pytest.approx(total, rel=2e-3)


def random_scene(seed):
    rng = np.random.default_rng(seed)
    person = replace(
        draw_person(seed), roughness=10 ** rng.uniform(-3, -1.3), limbus_blend_mm=rng.uniform(0.2, 1.1)
    )
    headset = six(rng.uniform(8, 25), rng.choice([0.0, 0.0, 0.3, 1.0]))
    return headset, person, rng.uniform(-20, 20, (8, 2))


def test_tolerance_bounds_what_the_mirror_point_changes():
    """On random scenes no response changes by more than quality.tolerance, and the tolerance is used."""
    ffi, lib = simulator()
    counts, used, worst = ffi.new("long long[3]"), Counter(), 0.0
    for seed in range(5):
        headset, person, gazes = random_scene(seed)
        exact = Scene(headset, person, quality={"glint": 4})
        for tolerance in (2e-11, 2e-10, 2e-9):
            scene = Scene(headset, person, quality={"glint": 4, "tolerance": tolerance})
            change = [np.abs(scene.glint(*g, 1.0) - exact.glint(*g, 1.0)).max() for g in gazes]
            worst = max(worst, max(change) / tolerance)
            lib.sim_scene_glint_counts(scene._scene, counts)
            assert sum(counts) == len(gazes) * 21
            used[tolerance] += counts[0]
        lib.sim_scene_glint_counts(exact._scene, counts)
        assert counts[0] == 0
    print(worst, used)
    assert worst < 1
    assert used[2e-9] > used[2e-10] > used[2e-11] > 100


def test_a_headset_of_many_ports_in_one_place_gets_each_its_own_glint():
    """More pairs than the mirror's scratch holds, and windows that differ: as if each were alone."""
    sensors = tuple(port((12, -8, -28), (x, 0, -11), 20.0, 0.0) for x in np.linspace(-3, 3, 12))
    emitters = tuple(port((-9, -10, -31), (0, y, -11), 20.0, 0.0) for y in np.linspace(-3, 3, 7))
    person = replace(Person(), roughness=0.005)
    for tolerance in (0.0, 1e-9):
        together = Scene(Headset("many", sensors, emitters), person, quality={"tolerance": tolerance})
        glint = together.glint(3.0, 12.0, [0.5, 1.0])
        for s, e in ((0, 0), (11, 6), (5, 2)):
            alone = Scene(pair(sensors[s], emitters[e]), person).glint(3.0, 12.0, [0.5, 1.0])[:, 0, 0]
            np.testing.assert_allclose(glint[:, s, e], alone, rtol=1e-9, atol=1e-16)


def test_a_gaze_in_the_eyes_plane_of_symmetry_returns():
    """Azimuth -kappa puts the optical axis there, between two ports that mirror one another: two azimuths of
    each ring are equally near. It once never returned (1.25 degrees up) or found no glint at all."""
    for fineness in (0.7071, 1.0, 4.0):
        scene = Scene(load_headset(HEADSET), nominal_person(), quality={"glint": fineness, "face": 0.1})
        for elevation in (-0.1, 0.0, 0.5, 1.0, 1.25, 1.5):
            at, beside = scene.glint(-5.0, elevation, 1.0)[0], scene.glint(-4.999, elevation, 1.0)[0]
            assert min(at[0, 5], at[5, 0]) > 3e-7
            assert np.abs(at - beside)[OFF_DIAGONAL].max() < 2e-4 * beside.max()


def test_glint_near_the_horizon_of_a_nearly_tangent_port():
    """One that every fineness once missed, 3 % of the scene's mean response."""
    case = next(c for c in random_scenes(13) if c.name == "random 2")
    azimuth, elevation, pupil, lid = case.states[0]
    pairs = [(3, 1), (1, 3)]
    exact, error = reference_response(
        case.headset, case.person, azimuth, elevation, pupil, lid, pairs, 1e-5, terms=("glint",)
    )
    for fineness, rel in ((1.0, 1e-3), (4.0, 2e-5)):
        got = Scene(case.headset, case.person, quality={"glint": fineness}).glint(azimuth, elevation, lid)[0]
        assert [got[p] for p in pairs] == pytest.approx(list(exact["glint"]), rel=rel)
    assert error["glint"].max() < 1e-5 * exact["glint"].min()
