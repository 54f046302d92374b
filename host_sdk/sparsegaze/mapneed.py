# SPDX-License-Identifier: Apache-2.0
"""Which ports can see which term of the eye at all: an upper bound, without integrating anything.

A port's window falls off fast: one that looks past the iris gets nothing from it that a sum would notice. For
each port the largest window weight over squared distance, anywhere on a patch of the eye, is bounded; two
ports' bounds times the patch's area and its highest reflectance bound their pair's term.
"""

from dataclasses import replace

import numpy as np

from .scene import Scene

PATCH_STEP_DEG = 2.5


def may_see(headset, person, slip_mm, half_angle_deg, pupils_from_mm):
    """Upper bounds {"sclera", "iris", "glint": [sensor, emitter]} of each term, 1/mm^2, at every gaze whose
    azimuth and elevation are at most half_angle_deg, and any lids.
    """
    limbus, apex = person.limbus_radius_mm, _apex_mm(person)
    # Where on the eye (direction from its centre) each term can come from.
    kappa = np.hypot(person.kappa_azimuth_deg, person.kappa_elevation_deg)
    cornea = np.degrees(np.arcsin(limbus / person.globe_radius_mm))
    gaze = np.sqrt(2.0) * half_angle_deg + kappa + 3.0
    iris = _patch(min(180.0, gaze + cornea))
    lids = _patch(min(180.0, person.canthus_deg + 45.0))
    area = 2 * np.pi * apex**2
    sensors, emitters = (
        {
            name: np.array([_reach(port, person, slip_mm, patch, apex) for port in ports])
            for name, patch in (("iris", iris), ("eye", lids))
        }
        for ports in (headset.sensors, headset.emitters)
    )
    eye = np.outer(sensors["eye"], emitters["eye"])
    # Fresnel takes light, the cornea's lens concentrates it: at most n^2 times, which the 1/n^2 undoes.
    ring = np.pi * (limbus**2 - (min(pupils_from_mm) / 2) ** 2)
    return {
        "sclera": person.albedo_sclera / np.pi * area * eye,
        "iris": person.albedo_iris
        / np.pi
        * ring
        * person.refractive_index**2
        * np.outer(sensors["iris"], emitters["iris"]),
        # No direction of a lobe is brighter than 1/(4 pi alpha^2); reflectance at most 1.
        "glint": area * eye / (4 * np.pi * person.roughness**2),
    }


def _apex_mm(person):
    """Distance of the corneal apex from the centre of rotation, as sim_c has it."""
    r, p, x = person.cornea_radius_mm, 1 + person.cornea_asphericity, person.limbus_radius_mm
    return np.sqrt(person.globe_radius_mm**2 - x * x) + x * x / (r + np.sqrt(r * r - p * x * x))


def _patch(radius_deg):
    """Directions [n, 3] of which one is within PATCH_STEP_DEG of any that is at most so far from ahead."""
    polar = np.radians(np.arange(0, radius_deg + PATCH_STEP_DEG, PATCH_STEP_DEG))
    rows = []
    for angle in polar:
        count = max(1, int(np.ceil(360 * np.sin(angle) / PATCH_STEP_DEG)))
        turn = 2 * np.pi * np.arange(count) / count
        rows.append(
            np.column_stack(
                [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle) + 0 * turn]
            )
        )
    return np.vstack(rows)


def _reach(port, person, slip_mm, patch, apex):
    """Bound of window weight over squared distance (1/mm^2) over a patch of the eye, at depths from the
    iris's and the apex's.
    """
    at = np.add(port.position_mm, slip_mm) - person.eye_position_mm
    best = 0.0
    deep = apex - person.iris_depth_mm
    shells = np.linspace(0.7 * deep, apex, 5)
    slack = apex * np.radians(PATCH_STEP_DEG) + (shells[1] - shells[0]) / 2  # mm to the nearest sample
    for shell in shells:
        to = shell * patch - at
        distance = np.maximum(np.linalg.norm(to, axis=1) - slack, 0.2)
        angle = np.arccos(np.clip(to @ np.array(port.aim) / np.linalg.norm(to, axis=1), -1, 1))
        angle = np.maximum(angle - np.arcsin(np.minimum(slack / distance, 1)), 0.0)
        tangent = np.where(angle < np.radians(89), np.tan(np.minimum(angle, np.radians(89))), np.inf)
        weight = np.exp(-(tangent**2) / (2 * np.tan(np.radians(port.sigma_deg)) ** 2)) / distance**2
        best = max(best, float(weight.max()))
    return best


def other_ports(pairs, sensors, emitters):
    """Words for the ports that are not among the chosen."""
    if not len(sensors) or not len(emitters):
        return "all pairs"
    words = []
    for name, count, chosen in (("sensor", pairs[0], sensors), ("emitter", pairs[1], emitters)):
        others = [str(i) for i in range(count) if i not in chosen]
        if others:
            words.append("%s%s %s" % (name, "s" * (len(others) > 1), ", ".join(others)))
    return " and ".join(words)


def hidden_eye(lid_opening):
    """Sentences (one or none) about the states whose lids are closed."""
    closed = np.flatnonzero(np.asarray(lid_opening) == 0)
    if not len(closed):
        return []
    where = "every state" if len(closed) == len(lid_opening) else "state " + ", ".join(map(str, closed))
    return [
        "lids closed in %s: all of the eye is behind them, so sclera, iris and glint are 0 and were not "
        "computed; what is left is the face with its lids; error 0" % where
    ]


class Chosen:
    """A scene of some of a headset's ports, whose values have all ports' shape: nothing for the others."""

    def __init__(self, headset, person, slip_mm, quality, sensors, emitters):
        self._all = (len(headset.sensors), len(headset.emitters))
        self._at = np.ix_(sensors, emitters)
        fewer = replace(
            headset,
            sensors=tuple(headset.sensors[i] for i in sensors),
            emitters=tuple(headset.emitters[i] for i in emitters),
        )
        self._scene = Scene(fewer, person, slip_mm, quality)

    def smooth(self, *state):
        """As Scene.smooth."""
        return self._spread(self._scene.smooth(*state))

    def glint(self, *state):
        """As Scene.glint."""
        return self._spread(self._scene.glint(*state))

    def _spread(self, values):
        out = np.zeros(values.shape[:-2] + self._all)
        out[(...,) + self._at] = values
        return out
