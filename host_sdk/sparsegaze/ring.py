# SPDX-License-Identifier: Apache-2.0
"""The bright ring: where the glint crosses the edge of the cornea. In a map it is an arc round the half
vector of sensor and emitter, in a sweep a spike.

Its height and width depend on three things that nobody has measured well: how gently cornea and globe meet
(limbus_blend_mm), the tear film's roughness, and the lenses' radius. tests/sim/test_paper_findings.py has the
table.
"""

from dataclasses import replace

import numpy as np

from .headset import Headset, Port
from .person import nominal_person
from .scene import Scene

# A pair whose half vector lies 30 degrees to the side and 17 down: its ring crosses the middle of a
# horizontal sweep. Position mm, both aimed at the middle of the cornea.
PLACES_MM = (-16.0, -8.0, -30.0), (-12.0, -8.0, -32.0)
AIM_MM, SIGMA_DEG, LENS_RADIUS_MM = (0.0, 0.0, -11.0), 15.0, 0.5
HALF_DEG, STEP_DEG = 25.0, 0.1
HARD_BLEND_MM = 0.02
FINENESS = 4.0


def ring_pair(lens_radius_mm=LENS_RADIUS_MM):
    """The headset of that one sensor and one emitter."""
    ports = []
    for place in PLACES_MM:
        direction = np.subtract(AIM_MM, place)
        aim = tuple(float(v) for v in direction / np.linalg.norm(direction))
        ports.append(Port(place, aim, SIGMA_DEG, lens_radius_mm))
    return Headset("ring", (ports[0],), (ports[1],))


def glint_sweep(headset, person, elevation_deg=0.0, lid_opening=1.0):
    """The glint alone along a horizontal sweep: (azimuth [n], glint [n, sensor, emitter])."""
    azimuth = np.arange(-HALF_DEG, HALF_DEG + STEP_DEG / 2, STEP_DEG)
    scene = Scene(headset, person, quality={"glint": FINENESS, "face": 0.1})
    return azimuth, np.array([scene.glint(a, elevation_deg, lid_opening)[0] for a in azimuth])


def ring_figures(person=None, lens_radius_mm=LENS_RADIUS_MM):
    """The spike of that pair in a sweep at elevation 0, lids open: {peak_deg, peak_over_median, fwhm_deg,
    hard_crease_peak_over_median (the same person without a blend: a plateau)}. person: the nominal one.
    """
    person, headset = person or nominal_person(), ring_pair(lens_radius_mm)
    azimuth, glint = glint_sweep(headset, person)
    figures = rise_of_glint(azimuth, glint[:, 0, 0])
    azimuth, glint = glint_sweep(headset, replace(person, limbus_blend_mm=HARD_BLEND_MM))
    return {
        "peak_deg": figures["peak_deg"],
        "peak_over_median": figures["peak_over_median"],
        "fwhm_deg": figures["fwhm_deg"],
        "hard_crease_peak_over_median": rise_of_glint(azimuth, glint[:, 0, 0])["peak_over_median"],
    }


def ring_of_sensors(made, state=0):
    """Where each sensor's glint is brightest against everything else, its emitters lit: a list of
    {sensor, azimuth_deg, elevation_deg, glint_percent, within (false: on the map's border, so that the
    brightest place may lie outside)}. Empty when the parts were not kept; no entry without a glint.
    """
    if not made.parts:
        return []
    rings, glints, totals = [], made.sensor_maps(state, "glint"), made.sensor_maps(state)
    for sensor, (glint, total) in enumerate(zip(glints, totals)):
        rest = total - glint
        share = np.divide(glint, rest, out=np.zeros_like(glint), where=rest > 0)
        row, column = np.unravel_index(np.argmax(share), share.shape)
        if not share[row, column] > 0:
            continue
        inner = [0 < at < size - 1 or size == 1 for at, size in zip((row, column), share.shape)]
        rings.append(
            {
                "sensor": sensor,
                "azimuth_deg": float(made.azimuth_deg[column]),
                "elevation_deg": float(made.elevation_deg[row]),
                "glint_percent": 100 * float(share[row, column]),
                "within": all(inner),
            }
        )
    return rings


def rise_of_glint(angle_deg, glint, rest=None):
    """The highest place of a glint along a line of gaze: {peak_deg, peak_over_median, fwhm_deg (above
    the median; None when the line ends first), percent (of the rest there, when it is given)}; None when it
    has no light.
    """
    glint = np.asarray(glint, float)
    if not glint.max() > 0:
        return None
    at, median = int(np.argmax(glint)), float(np.median(glint))
    half, edges = (glint[at] + median) / 2, []
    for step in (-1, 1):
        i = at
        while 0 <= i + step < len(glint) and glint[i + step] > half:
            i += step
        j = i + step
        if not 0 <= j < len(glint):
            break
        part = (glint[i] - half) / (glint[i] - glint[j])
        edges.append(angle_deg[i] + part * (angle_deg[j] - angle_deg[i]))
    return {
        "peak_deg": float(angle_deg[at]),
        "percent": float(100 * glint[at] / rest[at]) if rest is not None and rest[at] > 0 else None,
        "peak_over_median": float(glint[at] / median) if median > 0 else float("inf"),
        "fwhm_deg": float(abs(edges[1] - edges[0])) if len(edges) == 2 else None,
    }
