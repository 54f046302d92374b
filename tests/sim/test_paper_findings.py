# SPDX-License-Identifier: Apache-2.0
"""What real signals of photosensor eye trackers show, and what of the model sets it.

Three parameters that nobody has measured well set the ring's height: the limbus's blend, the tear film's
roughness, the lenses' radius. Horizontal sweep of the pair in ring.py, nominal person, glint over its median:

    blend  roughness  lens     peak at  height   width at half height
    0.02   0.015      0.5 mm    (none)   2.1      10 deg: a plateau, the hard crease
    0.3    0.015      0.5 mm    2.3 deg  5.2      2.8
    0.8    0.015      0.5 mm    3.4      2.8      4.4      nominal
    1.5    0.015      0.5 mm    4.8      1.5     12
    0.8    0.005      0.5 mm    3.3      2.9      4.1
    0.8    0.060      0.5 mm    3.7      2.3      6.9
    0.8    0.015      0          3.4      2.8      4.2
    0.8    0.015      2.0 mm    3.6      2.4      5.9
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import find_peaks
from sim_scenes import LIDS_AWAY, port

from sparsegaze.headset import Headset
from sparsegaze.person import Person
from sparsegaze.ring import PLACES_MM, glint_sweep, ring_figures, ring_pair, rise_of_glint
from sparsegaze.scene import Scene, c_person, simulator

# Lids out of the way and the optical axis along the gaze: what concerns the cornea alone.
BARE = replace(Person(), kappa_azimuth_deg=0.0, kappa_elevation_deg=0.0, **LIDS_AWAY)

BARE_WITH_KAPPA = replace(BARE, kappa_azimuth_deg=5.0, kappa_elevation_deg=-1.0)


def direction(azimuth_deg, elevation_deg):
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    return np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), -np.cos(azimuth) * np.cos(elevation)]
    )


def ring_angles(headset, sensor_mm, emitter_mm, along):
    """Angles (deg) between the gaze and the half vector at the edge of the cornea, wherever along horizontal
    sweeps the glint is brightest.
    """
    scene = Scene(headset, BARE, quality={"face": 0.1})
    angles = []
    for elevation in np.arange(-25, 16, 5.0):
        glint = [scene.glint(a, elevation, 1.0)[0, 0, 0] for a in along]
        axis = direction(along[int(np.argmax(glint))], elevation)
        place = 10.5 * axis
        for _ in range(3):  # the side of the cornea's edge that the half vector is on
            to = [np.subtract(end, place) for end in (sensor_mm, emitter_mm)]
            half = sum(u / np.linalg.norm(u) for u in to)
            half /= np.linalg.norm(half)
            side = half - (half @ axis) * axis
            place = 10.5 * axis + BARE.limbus_radius_mm * side / np.linalg.norm(side)
        angles.append(np.degrees(np.arccos(half @ axis)))
    return np.array(angles)


def test_the_bright_ring_is_an_arc_around_the_half_vector_where_the_cornea_ends():
    """Measured: 36.9 to 38.2 degrees from the half vector, over 55 degrees of elevation."""
    angles = ring_angles(ring_pair(), *PLACES_MM, np.arange(-5, 25.1, 0.5))
    assert 35 < angles.min() and angles.max() < 41
    assert np.ptp(angles) < 1.5


def test_the_ring_is_a_spike_in_a_horizontal_sweep_and_the_hard_crease_a_plateau():
    figures = ring_figures()
    assert figures["peak_deg"] == pytest.approx(3.4, abs=0.2)
    assert figures["peak_over_median"] == pytest.approx(2.76, abs=0.05)
    assert figures["fwhm_deg"] == pytest.approx(4.4, abs=0.2)
    assert 1.9 < figures["hard_crease_peak_over_median"] < 2.4

    def top_deg(person):
        """Width of what is above 85 % of the peak, as part of the width at half height."""
        azimuth, glint = glint_sweep(ring_pair(), person)
        width = rise_of_glint(azimuth, glint[:, 0, 0])["fwhm_deg"]
        return np.ptp(azimuth[glint[:, 0, 0] > 0.85 * glint.max()]) / width

    assert top_deg(replace(Person(), limbus_blend_mm=0.02)) > 0.75
    assert top_deg(Person()) < 0.6


def height_and_width(lens_radius_mm=0.5, **changed):
    azimuth, glint = glint_sweep(ring_pair(lens_radius_mm), replace(Person(), **changed))
    figures = rise_of_glint(azimuth, glint[:, 0, 0])
    return figures["peak_over_median"], figures["fwhm_deg"]


@pytest.mark.parametrize(
    "changed, height, width_deg",
    [
        ({"limbus_blend_mm": 0.3}, 5.2, 2.8),
        ({"limbus_blend_mm": 1.5}, 1.5, 12.2),
        ({"roughness": 0.005}, 2.85, 4.1),
        ({"roughness": 0.03}, 2.6, 5.2),
        ({"roughness": 0.06}, 2.3, 6.9),
        ({"lens_radius_mm": 0.0}, 2.8, 4.25),
        ({"lens_radius_mm": 2.0}, 2.45, 5.9),
    ],
)
def test_blend_roughness_and_lens_set_the_rings_height(changed, height, width_deg):
    measured = height_and_width(**changed)
    assert measured[0] == pytest.approx(height, rel=0.03)
    assert measured[1] == pytest.approx(width_deg, rel=0.05)


EMITTERS_MM = [(-12, -8, -32), (-4, -15, -30), (5, -14, -31), (12, -7, -33), (14, 2, -32), (-13, 3, -31)]


@pytest.mark.parametrize("elevation_deg", [-5.0, 0.0, 5.0])
def test_more_emitters_at_once_make_more_rings_and_a_less_smooth_signal(elevation_deg):
    """Roughness: rms bend (second derivative over azimuth) of one sensor's signal, in units of the mean
    signal of one emitter per square degree. 6.2e-3 with one emitter, 2.0e-2 with six at elevation 0. As a
    part of the sum it falls, 6.2e-3 to 3.3e-3: single rings drown in the others' light.
    """
    azimuth = np.arange(-25, 25.1, 0.25)
    emitters = tuple(port(place, sigma_deg=15.0, lens_radius_mm=0.5) for place in EMITTERS_MM)
    scene = Scene(
        Headset("six at once", ring_pair().sensors, emitters), BARE_WITH_KAPPA, quality={"face": 0.2}
    )
    glint = np.array([scene.glint(a, elevation_deg, 1.0)[0, 0] for a in azimuth])
    rest = np.array([scene.smooth(a, elevation_deg, 3.5, 1.0)[0, 0, 0] for a in azimuth])
    rings, roughness = [], []
    for count in range(1, len(EMITTERS_MM) + 1):
        bright, signal = glint[:, :count].sum(1), (glint + rest)[:, :count].sum(1)
        rings.append(len(find_peaks(bright, prominence=0.005 * bright.max())[0]))
        bend = np.diff(signal, 2) / 0.25**2
        roughness.append(np.sqrt((bend**2).mean()) / (signal.mean() / count))
    assert (np.diff(roughness) > 0).all() and roughness[-1] > 2.5 * roughness[0]
    assert rings[0] == 1 and max(rings) >= 3, rings


def test_a_co_located_pairs_ring_is_centred_on_itself():
    """Sensor and emitter in one place: the half vector is the direction to it, the ring goes round that."""
    place = (-16.0, -8.0, -30.0)
    lone = port(place, sigma_deg=15.0, lens_radius_mm=0.5)
    angles = ring_angles(Headset("one", (lone,), (lone,)), place, place, np.arange(-14, 25.1, 0.5))
    assert np.ptp(angles) < 1.5 and 35 < angles.min() and angles.max() < 41


def test_a_co_located_pair_sees_a_glint_only_where_the_eyes_normal_points_at_it():
    """An LED that looks at 2.5 mm of the eye: of the gazes at which no normal in there points back at it, the
    brightest glint is 5 % of the brightest of all.
    """
    place, sigma_deg = np.array([14.0, -9.0, -34.0]), 3.0
    lone = port(place, (6.0, -2.0, -10.0), sigma_deg, 0.5)
    scene = Scene(Headset("one", (lone,), (lone,)), BARE, quality={"face": 0.1})
    ffi, lib = simulator()
    person = c_person(ffi, BARE)
    theta = np.radians(np.linspace(0, 100, 2001))
    rho = np.array([lib.sim_person_profile_mm(person, t) for t in np.degrees(theta)])
    normal = theta - np.arctan2(np.gradient(rho, theta), rho)

    def weight(azimuth, elevation):
        """The window's weight, twice, at the brightest mirror point: all lie in the plane of axis and LED."""
        axis = direction(azimuth, elevation)
        side = place - (place @ axis) * axis
        side /= np.linalg.norm(side)
        to = place - rho[:, None] * (np.cos(theta)[:, None] * axis + np.sin(theta)[:, None] * side)
        to /= np.linalg.norm(to, axis=1)[:, None]
        off = np.arctan2(to @ side, to @ axis) - normal
        roots = np.flatnonzero(np.diff(np.sign(off)) != 0)
        tangent2 = 1 / (to[roots] @ np.array(lone.aim)) ** 2 - 1
        return np.exp(-tangent2 / np.tan(np.radians(sigma_deg)) ** 2).max(initial=0.0)

    gazes = [(a, e) for a in np.arange(-40, 41, 4.0) for e in np.arange(-40, 41, 4.0)]
    seen = np.array([weight(*gaze) for gaze in gazes])
    glint = np.array([scene.glint(*gaze, 1.0)[0, 0, 0] for gaze in gazes])
    away = seen < 0.03 * seen.max()
    assert away.sum() > 50 and glint[away].max() < 0.08 * glint.max()
    assert (seen[glint > 0.5 * glint.max()] > 0.2 * seen.max()).all()


def eye_seen_from(height_mm, person, lid_opening):
    """Light of the eye itself and its change with azimuth, seen and lit from above or below it."""
    ends = [port((x, height_mm, -28.0), sigma_deg=15.0, lens_radius_mm=0.5) for x in (0.0, 6.0, -8.0)]
    quality = {"face": 0.2, "sclera": 0.7, "iris": 0.4, "glint": 0.5}
    scene = Scene(Headset("view", tuple(ends[:2]), tuple(ends[2:])), person, quality=quality)
    degrees = np.arange(-20, 21, 5.0)
    light = np.array(
        [
            [
                scene.smooth(a, e, 3.5, lid_opening, "eye")[0, 0] + scene.glint(a, e, lid_opening)[0]
                for a in degrees
            ]
            for e in degrees
        ]
    )
    return light.mean(), light.std(1).mean()


@pytest.mark.parametrize(
    "lash_opacity, lid_opening, at_most",
    [(0.0, 1.0, 0.75), (0.0, 0.5, 0.2), (0.5, 1.0, 0.4), (0.5, 0.5, 0.06), (0.9, 1.0, 0.25)],
)
def test_from_below_the_eye_the_lashes_and_the_upper_lid_are_not_in_the_way(
    lash_opacity, lid_opening, at_most
):
    """Light and gaze signal from 14 mm above as parts of those from 14 mm below: 0.69 and 0.70 with open lids
    and no lashes, 0.17 and 0.15 with half-closed lids, 0.32 with lashes of opacity 0.5, 0.04 with both.
    """
    person = replace(Person(), lash_opacity=lash_opacity)
    above, below = eye_seen_from(14.0, person, lid_opening), eye_seen_from(-14.0, person, lid_opening)
    assert 0 < above[0] / below[0] < at_most
    assert 0 < above[1] / below[1] < at_most


def test_lashes_take_nothing_from_a_view_from_below():
    without = eye_seen_from(-14.0, Person(), 1.0)
    dense = eye_seen_from(-14.0, replace(Person(), lash_opacity=0.9), 1.0)
    assert dense[1] == pytest.approx(without[1], rel=0.01)
