# SPDX-License-Identifier: Apache-2.0
"""The skin's term and what the face hides, against dense searches, other quadratures and a closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import exp1
from sim_scenes import OFF_DIAGONAL, pair, port

from sparsegaze.errors import SceneError
from sparsegaze.headset import Headset
from sparsegaze.person import Person, draw_person
from sparsegaze.scene import DERIVATIVES, Scene, c_person, simulator

LEAST_LENS_MM = 0.25


def smoothstep(t):
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 + t * (6 * t - 15))


def orbit(person, x, y):
    """The height field without the lids' bulge."""
    nose = smoothstep((-x - 13) / 18) * (1 - 0.3 * smoothstep((y + 2) / 20))
    brow, cheek = np.exp(-((y - 21) ** 2) / 98), np.exp(-((y + 24) ** 2) / 128)
    temple = -8 * smoothstep((x - 12) / 20)
    return 4 + person.brow_mm * brow + person.cheek_mm * cheek + person.nose_mm * nose + temple


def face(person, x, y):
    big, r = person.lid_radius_mm, np.hypot(x, y)
    edge, foot = 0.9 * big, np.sqrt(0.19) * big
    sphere = np.sqrt(np.maximum(big**2 - r**2, 0.0))
    bulge = np.where(r < edge, sphere, foot - (r - edge) * edge / foot)
    rest = orbit(person, x, y)
    return np.maximum(bulge, rest) + np.maximum(1 - np.abs(bulge - rest) / 3, 0) ** 3 * 3 / 6


def gradient(person, x, y, h=1e-4):
    return (
        (face(person, x + h, y) - face(person, x - h, y)) / (2 * h),
        (face(person, x, y + h) - face(person, x, y - h)) / (2 * h),
    )


def horizon(height, person, points, to, at_zero, n):
    """inf of gap(u) / u for points [k, 3], from n samples of each ray and a parabola through the least."""
    u = (np.arange(1, n + 1) / n)[:, None]
    x, y, z = (points[:, i] + u * (to[i] - points[:, i]) for i in range(3))
    gap = np.vstack([at_zero, (-z - height(person, x, y)) / u])
    least, k = gap.min(0), gap.argmin(0)
    inside = (k > 0) & (k < n)
    column = np.arange(len(k))[inside]
    left, mid, right = (gap[k[inside] + i, column] for i in (-1, 0, 1))
    bend = left - 2 * mid + right
    with np.errstate(invalid="ignore", divide="ignore"):
        vertex = mid - (right - left) ** 2 / (8 * bend)
    least[inside] = np.where((bend > 0) & np.isfinite(vertex), vertex, mid)
    return least


def tangent(person, points, to):
    slope = gradient(person, points[:, 0], points[:, 1])
    return points[:, 2] - to[2] - sum(slope[i] * (to[i] - points[:, i]) for i in range(2))


def seen_share(h, at_zero, lens):
    """Of a lens, relative to what the point's own horizon leaves."""
    below = at_zero <= -lens
    own = np.where(below, 1.0, smoothstep(0.5 + at_zero / (2 * lens)))
    return np.where(below, 1.0, smoothstep(0.5 + h / (2 * lens)) / own)


def skin_at(person, x, y):
    return np.stack([x, y, -face(person, x, y)], -1)


def clear_places(rng, n, person):
    """Places in front of the face."""
    found = []
    while len(found) < n:
        place = rng.uniform([-30, -28, -45], [30, 28, -8])
        if -place[2] > face(person, place[0], place[1]) + 1 and np.linalg.norm(place) > 16:
            found.append(place)
    return found


def people(n):
    return [Person()] + [draw_person(seed) for seed in range(n - 1)]


@pytest.mark.parametrize("person", people(4))
def test_the_horizon_of_skin_is_that_of_a_dense_search(person):
    ffi, lib = simulator()
    rng = np.random.default_rng(5)
    worst, hidden = 0.0, 0
    for to in clear_places(rng, 40, person):
        points = skin_at(person, rng.uniform(-34, 30, 10), rng.uniform(-32, 32, 10))
        at_zero = tangent(person, points, to)
        truth = horizon(face, person, points, to, at_zero, 20000)
        got = [lib.sim_person_horizon_mm(c_person(ffi, person), list(p), list(to), 0) for p in points]
        worst = max(worst, np.abs(got - truth).max())
        hidden += int((truth < np.minimum(at_zero, 0) - 0.1).sum())
    assert worst < 2e-4, "mm; a tenth of it would change no response by 1e-5"
    assert hidden > 20, "the case was meant to have shadows"


@pytest.mark.parametrize("person", people(3))
def test_the_share_of_a_lens_seen_from_skin_is_the_models(person):
    ffi, lib = simulator()
    rng = np.random.default_rng(6)
    partly = 0
    for to in clear_places(rng, 40, person):
        points = skin_at(person, rng.uniform(-34, 30, 25), rng.uniform(-32, 32, 25))
        at_zero = tangent(person, points, to)
        h = horizon(face, person, points, to, at_zero, 6000)
        for radius in (0.0, 0.7, 2.5):
            lens = max(radius, LEAST_LENS_MM)
            below = at_zero <= -lens
            share = seen_share(h, at_zero, lens)
            got = [lib.sim_person_skin_share(c_person(ffi, person), *p[:2], list(to), radius) for p in points]
            # Where the ratio is of two small numbers both sides cost digits, and the cosine is all but 0.
            sure = below | (at_zero > -0.8 * lens)
            np.testing.assert_allclose(np.array(got)[sure], share[sure], atol=2e-3)
            partly += int(((share > 0.01) & (share < 0.99)).sum())
    assert partly > 15


def test_what_the_face_leaves_of_the_eye_is_that_of_a_dense_search():
    """Sites at the temple, beside the nose and under the brow, from which the relief does hide the eye."""
    rng = np.random.default_rng(7)
    places = [(29, -3, -5), (-30, 6, -22), (4, 27, -14), (-22, -16, -26), (16, 0, -28)]
    worst, partly, table = 0.0, 0, 0
    for person in people(3):
        for place in places:
            site = port(place, lens_radius_mm=rng.choice([0.0, 0.5, 2.0]))
            scene = Scene(pair(site, port((10, -10, -30))), person)
            alpha, beta = rng.uniform(-66, 66, 400), rng.uniform(-42, 48, 400)
            a, b, r = np.radians(alpha), np.radians(beta), person.lid_radius_mm
            points = r * np.stack([np.sin(a) * np.cos(b), np.sin(b), -np.cos(a) * np.cos(b)], -1)
            to, lens = np.subtract(place, person.eye_position_mm), max(site.lens_radius_mm, LEAST_LENS_MM)
            h = horizon(orbit, person, points, to, np.full(400, np.inf), 6000)
            share = smoothstep(0.5 + h / (2 * lens))
            share[-points[:, 2] <= orbit(person, points[:, 0], points[:, 1])] = 0
            got = np.array([scene.eye_reach("sensor", 0, *d) for d in zip(alpha, beta)])
            worst = max(worst, np.abs(got - share).max())
            partly += int(((share > 0) & (share < 1)).sum())
            table += int(((share == 0) | (share == 1)).sum())
    assert worst < 2e-4
    assert partly > 100 and table > 100


def opening(person, elevation_deg, opening_, points):
    """The lids' mask over skin, 1 = eye."""
    x, y, z = points.T
    alpha, beta = np.arctan2(x, -z), np.arctan2(y, np.hypot(x, z))
    half, rho = np.radians(person.canthus_deg), np.linalg.norm(points, axis=-1)
    open_upper = person.lid_upper_deg + person.lid_upper_follow * elevation_deg
    open_lower = person.lid_lower_deg + person.lid_lower_follow * elevation_deg
    meet = open_lower + person.lid_close_at * (open_upper - open_lower)
    mask = 1 - smoothstep((rho - (person.lid_radius_mm + 1)) / 1.5)
    mask *= (z < -1) & (np.abs(alpha) < half + np.radians(4)) & (np.abs(beta) < np.radians(65))
    for margin, sign in ((open_upper, 1), (open_lower, -1)):
        peak, tilt = np.radians(meet + opening_ * (margin - meet)), person.canthus_tilt_deg / 45
        curve = tilt * alpha + peak * (1 - (alpha / half) ** 2)
        slope = (tilt - 2 * alpha / half**2 * peak) / np.cos(beta)
        mask *= smoothstep(sign * rho * (curve - beta) / np.hypot(1, slope) / person.lid_softness_mm)
    return mask


def skin_light(person, x, y, ports):
    """Response of one pair per area of the frontal plane, at flat arrays of places."""
    points, (wx, wy) = skin_at(person, x, y), gradient(person, x, y)
    stretch = np.sqrt(1 + wx**2 + wy**2)
    normal = -np.stack([wx, wy, np.ones_like(wx)], -1) / stretch[:, None]
    light = person.albedo_skin / np.pi * stretch
    for p in ports:
        to = np.subtract(p.position_mm, person.eye_position_mm)
        away = to - points
        distance = np.linalg.norm(away, axis=-1)
        away /= distance[:, None]
        cosine, half = (away * normal).sum(-1), p.lens_radius_mm / distance + 1e-9
        rounded = np.where(cosine >= half, cosine, np.maximum(cosine + half, 0) ** 2 / (4 * half))
        off = np.maximum(-away @ np.array(p.aim), 1e-3)
        window = np.exp(-(1 - off**2) / off**2 / (2 * np.tan(np.radians(p.sigma_deg)) ** 2))
        light = light * rounded / distance**2 * window
        seen = light > 1e-7 * light.max()
        light[~seen] = 0
        at_zero, lens = tangent(person, points[seen], to), max(p.lens_radius_mm, LEAST_LENS_MM)
        h = np.empty(seen.sum())
        for part in np.array_split(np.arange(len(h)), 1 + len(h) // 20000):
            h[part] = horizon(face, person, points[seen][part], to, at_zero[part], 250)
        light[seen] *= seen_share(h, at_zero, lens)
    return light


def face_term(person, ports, poses):
    """Closed lids by Gauss-Legendre panels of 4 mm; the opening by the midpoint rule at 0.15 mm."""
    t, w = np.polynomial.legendre.leggauss(20)
    axis = (np.arange(16)[:, None] * 4 + 2 + 2 * t).ravel()
    weight = np.tile(2 * w, 16)
    x, y = np.meshgrid(axis - 34, axis - 32)
    closed = (np.outer(weight, weight).ravel() * skin_light(person, x.ravel(), y.ravel(), ports)).sum()
    step = 0.15
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-33.95, 30, step), np.arange(-20, 20, step)))
    masks = [opening(person, elevation, open_, skin_at(person, x, y)) for elevation, open_ in poses]
    cut = np.any(masks, 0)
    light = skin_light(person, x[cut], y[cut], ports)
    return np.array([closed - step**2 * (mask[cut] * light).sum() for mask in masks])


def fine_face_term(person, ports, poses, box, step=0.01):
    """By the midpoint rule over a box (x from, to, y from, to) that holds all the light."""
    axes = (np.arange(a + step / 2, b, step) for a, b in (box[:2], box[2:]))
    x, y = (v.ravel() for v in np.meshgrid(*axes))
    light, points = skin_light(person, x, y, ports), skin_at(person, x, y)
    return np.array([step**2 * (light * (1 - opening(person, e, o, points))).sum() for e, o in poses])


QUADRATURE_CASES = {
    "two leds of the default kind": (
        Person(),
        port((15, -2, -28), (-3, 2, -11), 8.5, 2.0),
        port((-10, -12, -28), (2, -3, -11), 8.5, 2.0),
    ),
    "beside the nose, shadows of the nose": (
        draw_person(4),
        port((-27, -12, -23), (-6, 4, -12), 20.0, 2.0),
        port((20, -8, -20), (-14, -2, -10), 20.0, 1.5),
    ),
    "at the temple, shadows of the lids' bulge": (
        draw_person(9),
        port((27, 2, -9), (-2, 0, -12), 25.0, 2.5),
        port((8, -16, -22), (0, 2, -11), 15.0, 2.0),
    ),
}


@pytest.mark.parametrize("name", QUADRATURE_CASES)
def test_the_face_term_is_that_of_another_quadrature(name):
    """Within 4e-5 of the scene's response, the sum of both quadratures' errors."""
    person, sensor, emitter = QUADRATURE_CASES[name]
    poses = [(0.0, 0.0), (0.0, 1.0), (14.0, 0.8), (-18.0, 1.0)]
    scene = Scene(pair(sensor, emitter), person)
    got = np.array([scene.smooth(0, e, 3.5, o, "face")[0, 0, 0, 0] for e, o in poses])
    error = (got - face_term(person, (sensor, emitter), poses)) / scene.response(0, 0)[0, 0]
    assert np.abs(error).max() < 4e-5, error


def test_a_flat_face_seen_from_a_point_is_an_exponential_integral():
    """A lamp that senses itself, 10 mm over a plane: rho / d^2 exp(1 / t^2) E3(1 / t^2), t = tan sigma."""
    small = {
        name: getattr(Person(), name) / 100
        for name in (
            "cornea_radius_mm limbus_radius_mm limbus_blend_mm limbus_haze_mm globe_radius_mm iris_depth_mm "
            "lid_radius_mm lid_thickness_mm"
        ).split()
    }
    plain = replace(Person(), brow_mm=0.0, nose_mm=0.0, cheek_mm=0.0, **small)
    lamp = port((-4.0, -5.0, -14.0), (-4.0, -5.0, 0.0), 12.0, 0.0)
    got = Scene(pair(lamp, lamp), plain).smooth(0, 0, 0.03, 0.0, "face")[0, 0, 0, 0]
    z = 1 / np.tan(np.radians(12.0)) ** 2
    e3 = ((1 - z) * np.exp(-z) + z * z * exp1(z)) / 2
    assert got == pytest.approx(plain.albedo_skin / 10.0**2 * np.exp(z) * e3, rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_the_face_terms_error_falls_as_its_fineness_grows(led2gaze, seed):
    poses = [(0, 1.0), (0, 0.0), (13, 1.0), (-17, 0.7), (5, 0.4)]

    def term(fineness):
        scene = Scene(led2gaze, draw_person(seed), quality={"face": fineness})
        return np.array([scene.smooth(0, e, 3.5, o, "face")[0, 0][OFF_DIAGONAL] for e, o in poses])

    mean = Scene(led2gaze, draw_person(seed)).response(0, 0)[OFF_DIAGONAL].mean()
    truth = term(4)
    error = [np.sqrt(np.mean((term(q) - truth) ** 2)) / mean for q in (0.25, 0.5, 1, 2)]
    assert error[2] < 2e-5 and error[3] < 3e-6
    assert error[0] > error[1] > error[2] > error[3]


def test_no_staircase_when_a_port_moves_by_a_micrometre():
    """The skin's term along 9 steps of 1 um is a straight line to 2e-6 of itself."""
    person, sensor, emitter = QUADRATURE_CASES["beside the nose, shadows of the nose"]
    k = np.arange(9)
    value = []
    for step in k:
        moved = replace(sensor, position_mm=tuple(np.add(sensor.position_mm, [1e-3 * step, 0, 0])))
        value.append(Scene(pair(moved, emitter), person).smooth(0, 3, 3.5, 1.0, "face")[0, 0, 0, 0])
    line = np.polyval(np.polyfit(k, value, 1), k)
    assert np.abs(value - line).max() / np.mean(value) < 2e-6
    assert abs(value[-1] - value[0]) / np.mean(value) > 1e-5, "and it does change"


@pytest.mark.parametrize("far_mm", [5.0, 500.0])
def test_a_sensor_very_near_or_very_far_sees_the_face_as_another_quadrature_does(far_mm):
    person = Person()
    apex = simulator()[1].sim_person_profile_mm(c_person(simulator()[0], person), 0.0)
    direction = np.array([0.15, -0.25, -1.0]) / np.linalg.norm([0.15, -0.25, -1.0])
    sensor = port(tuple(direction * (apex + far_mm)), (0, 0, -11), 20.0, 1.0)
    emitter = port((14, -9, -26), (0, 0, -11), 12.0, 2.0)
    scene = Scene(pair(sensor, emitter), person)
    got = [scene.smooth(0, e, 3.5, o, "face")[0, 0, 0, 0] for e, o in ((0, 0.0), (0, 1.0))]
    want = face_term(person, (sensor, emitter), [(0, 0.0), (0, 1.0)])
    assert np.abs(got - want).max() / scene.response(0, 0)[0, 0] < 1e-4


def test_the_narrowest_spot_and_margin_that_are_not_refused_are_integrated_rightly():
    """Sigma 0.21 mm on the upper lid beside its margin, which is 0.2 mm wide."""
    person = replace(Person(), lid_softness_mm=0.2)
    tight = port((2.0, 6.0, -35.0), (1.5, 4.9, -12.3), 0.55, 1.0)
    wide = port((8, -9, -28), (1, 8, -10), 12.0, 2.0)
    poses = [(0.0, 0.0), (0.0, 1.0), (0.0, 0.9), (6.0, 1.0)]
    scene = Scene(pair(tight, wide), person)
    got = np.array([scene.smooth(0, e, 3.5, o, "face")[0, 0, 0, 0] for e, o in poses])
    want = fine_face_term(person, (tight, wide), poses, (-1.0, 4.0, 2.5, 7.5))
    assert want[0] > 1.5 * want[1] > 0 and want[2] > 1.2 * want[1]
    np.testing.assert_allclose(got, want, atol=2e-4 * want.max())


def test_skin_of_the_nose_in_the_openings_directions_stays():
    """Lids 80 degrees wide reach the side of the nose; what stands 2.5 mm before them is no lid."""
    person = replace(Person(), canthus_deg=80.0, nose_mm=16.0)
    lens = port((-8.0, -2.0, -26.0), (-17.0, 0.0, -8.0), 8.0, 1.0)
    scene = Scene(pair(lens, lens), person)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-33.95, 30, 0.1), np.arange(-20, 20, 0.1)))
    points = skin_at(person, x, y)
    light, mask = skin_light(person, x, y, (lens, lens)), opening(person, 0.0, 1.0, points)
    before = np.linalg.norm(points, axis=-1) > person.lid_radius_mm + 2.5
    assert (mask[before] == 0).all()
    shut, wide_open = (scene.smooth(0, 0, 3.5, o, "face")[0, 0, 0, 0] for o in (0.0, 1.0))
    assert shut - wide_open == pytest.approx(0.01 * (mask * light).sum(), abs=1e-4 * shut)


def test_lenses_of_no_radius_are_points_and_the_limit_of_small_ones():
    def term(radius):
        ends = QUADRATURE_CASES["two leds of the default kind"][1:]
        ends = [replace(p, lens_radius_mm=radius) for p in ends]
        return Scene(pair(*ends), Person()).smooth(0, 0, 3.5, 1.0, "face")[0, 0, 0, 0]

    assert term(0.0) == pytest.approx(term(1e-3), rel=1e-6)


def test_an_eye_a_metre_off_the_origin_is_the_same_eye():
    offset = np.array([700.0, -400.0, 600.0])
    _, sensor, emitter = QUADRATURE_CASES["two leds of the default kind"]
    moved = [replace(p, position_mm=tuple(np.add(p.position_mm, offset))) for p in (sensor, emitter)]
    here = Scene(pair(sensor, emitter), Person()).response(6, -4)
    there = Scene(pair(*moved), replace(Person(), eye_position_mm=tuple(offset))).response(6, -4)
    np.testing.assert_allclose(there, here, rtol=1e-9)


@pytest.mark.parametrize("seed, gaze", [(2, (7.0, -5.0)), (5, (-12.0, 8.0))])
def test_derivatives_are_within_their_stated_error_of_finer_differences(led2gaze, seed, gaze):
    """Against Richardson's extrapolation from two other steps, everything integrated four times as finely."""
    got, stated = Scene(led2gaze, draw_person(seed)).derivatives(*gaze)
    assert got.shape == stated.shape == (len(DERIVATIVES), 6, 6)
    mean = Scene(led2gaze, draw_person(seed)).response(*gaze).mean()
    fine = {"sclera": 4, "iris": 2, "glint": 4, "face": 2}

    def differences(step):
        still = Scene(led2gaze, draw_person(seed), quality=fine)
        rows = []
        for move in step * np.eye(5):
            ends = []
            for sign in (1, -1):
                scene = still
                if move[2:].any():
                    scene = Scene(led2gaze, draw_person(seed), sign * move[2:], fine)
                ends.append(scene.response(*(np.array(gaze) + sign * move[:2])))
            rows.append((ends[0] - ends[1]) / (2 * step))
        return np.array(rows)

    truth = (4 * differences(0.15) - differences(0.3)) / 3
    assert (np.abs(got - truth) <= stated + 2e-5 * mean).all()
    assert (stated < 0.02 * np.abs(truth).max((1, 2), keepdims=True)).all()


def test_a_derivative_by_something_else_is_refused(led2gaze):
    with pytest.raises(SceneError):
        Scene(led2gaze, Person()).derivatives(0, 0, by=("pupil_mm",))


def test_a_scene_says_what_it_left_out(led2gaze):
    usual = " ".join(Scene(led2gaze, Person()).left_out())
    assert "hides nothing of the eye from every sensor" in usual
    _, sensor, emitter = QUADRATURE_CASES["beside the nose, shadows of the nose"]
    hidden = Scene(pair(replace(sensor, lens_radius_mm=0.0), emitter), draw_person(4)).left_out()
    assert any("lens of 0.25 mm" in line and "sensor 0" in line for line in hidden)
    assert not any("no penumbra" in line and "sensor 0" in line for line in hidden)
    assert "too many hard shadows" not in usual
    angle = np.arange(30) * 0.4
    far = [port((450 * np.cos(a), 450 * np.sin(a), -200.0 - 8 * a), sigma_deg=60.0) for a in angle]
    many = Headset("far points", tuple(replace(p, lens_radius_mm=0.0) for p in far), (emitter,))
    assert any("too many hard shadows" in line for line in Scene(many, Person()).left_out())
    away = Scene(pair(port((10, -10, -30), (10, -10, -90)), emitter), Person()).left_out()
    assert any("lid poses change nothing" in line for line in away)
