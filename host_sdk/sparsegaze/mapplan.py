# SPDX-License-Identifier: Apache-2.0
"""How finely a map's terms need to be integrated: measured on the scene itself, before the map is made.

A dozen gazes (quasi-random, plus corners and edges) are evaluated on a ladder of finenesses whose rungs are a
factor sqrt(2) apart. The error of a rung is its difference from the rung two above it, which is twice as
fine; the cheapest rung whose rms error meets the term's share of the tolerance is taken. Values are shared
between rungs, so that the whole climb costs little more than its last two rungs.

The face costs at set-up and little afterwards, and its error falls by 4 and more from rung to rung; there a
rung is compared with the one below it, and the scene of the chosen rung is the one that makes the map.
"""

import numpy as np

from .scene import Scene

STEP = 2.0**0.5  # fineness from rung to rung
FINER = 2  # rungs between a value and what it is compared with
START = {"sclera": 0.7, "iris": 0.35, "glint": 0.5, "face": 0.5}  # fineness of rung 0
RUNGS = {"sclera": (-4, 6), "iris": (-2, 6), "glint": (-2, 6), "face": (-2, 5)}
FACE_FALLS = 2.0  # error of a rung of the face <= its difference from the rung below / this; measured 3 to 7
EYE_ONLY = 0.1  # fineness of the face where it is not asked for
RMS_SAFETY = 1.5  # a dozen gazes see this much less than the map's rms, at worst
N_PILOT = 12


def pilot_gazes(azimuth_deg, elevation_deg, count=N_PILOT):
    """Gazes [count, 2] over the rectangle of two axes: corners, middles of two edges, the rest
    quasi-random (the R2 sequence).
    """
    low = np.array([azimuth_deg.min(), elevation_deg.min()])
    span = np.array([azimuth_deg.max(), elevation_deg.max()]) - low
    fixed = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (0.5, 0), (0.5, 1)])
    return np.vstack([low + span * fixed, inner_gazes(azimuth_deg, elevation_deg, count)])[:count]


def inner_gazes(azimuth_deg, elevation_deg, count=N_PILOT):
    """Quasi-random gazes [count, 2] inside the rectangle of two axes: none is a node of anything."""
    low = np.array([azimuth_deg.min(), elevation_deg.min()])
    span = np.array([azimuth_deg.max(), elevation_deg.max()]) - low
    golden = 1.324717957244746
    steps = np.arange(1, count + 1)[:, None] * [1 / golden, 1 / golden**2]
    return low + span * ((0.5 + steps) % 1)


class Pilot:
    """The pilot gazes of one scene: values of any term at any fineness, kept.

    states    one (pupil_mm, lid_opening) per gaze          run    maps a function over a list, in threads
    """

    def __init__(self, headset, person, slip_mm, gazes, states, run):
        self._make = lambda quality: Scene(headset, person, slip_mm, quality)
        self.gazes, self.states, self._run = np.asarray(gazes, float), states, run
        self._scenes, self._values = {}, {}

    def scene(self, rung):
        """The scene whose eye terms are all on one rung. Its face is coarse."""
        if rung not in self._scenes:
            quality = {term: fineness(term, rung) for term in ("sclera", "iris", "glint")}
            self._scenes[rung] = self._make(dict(quality, face=EYE_ONLY))
        return self._scenes[rung]

    def value(self, term, rung):
        """[gaze, sensor, emitter] of a term on a rung."""
        key = term, rung
        if key not in self._values:
            self._values[key] = self.of(self.scene(rung), term)
        return self._values[key]

    def of(self, scene, term):
        """[gaze, sensor, emitter] of a term of any scene at the pilot's gazes and states."""

        def one(index):
            azimuth, elevation = self.gazes[index]
            return term_value(scene, term, azimuth, elevation, *self.states[index])

        return np.array(self._run(one, range(len(self.gazes))))

    def error(self, term, rung):
        """Absolute error of a term on a rung, [gaze, sensor, emitter], against the rung twice as fine."""
        return np.abs(self.value(term, rung) - self.value(term, rung + FINER))

    def choose(self, term, tolerance, rms, peak):
        """The lowest rung of a term of the eye whose rms error, with its safety, is below an absolute
        tolerance, and its largest below `peak` of that; or the highest.

        rms    of an error array, over the pairs that count
        """
        low, high = RUNGS[term]
        rung = 0

        def meets(at):
            error = self.error(term, at)
            return RMS_SAFETY * rms(error) <= tolerance and error.max() <= peak * tolerance

        if meets(rung):
            while rung > low and meets(rung - 1):
                rung -= 1
            return rung
        while rung < high and not meets(rung):
            rung += 1
        return rung

    def choose_face(self, quality, tolerance, rms, peak, start):
        """The same for the face, upward from two rungs: (rung, its scene, error [gaze, sensor, emitter]).

        quality    of the other terms of the scene
        """
        low, high = RUNGS["face"]

        def made(rung):
            return self._make(dict(quality, face=fineness("face", rung)))

        rung = int(np.clip(start, low + 1, high))
        scenes = self._run(made, [rung - 1, rung])
        below, here = (self.of(scene, "face") for scene in scenes)

        def meets():
            error = np.abs(below - here) / FACE_FALLS
            return RMS_SAFETY * rms(error) <= tolerance and error.max() <= peak * tolerance

        while rung < high and not meets():
            rung += 1
            scenes = [None, made(rung)]
            below, here = here, self.of(scenes[1], "face")
        self._values["face", rung] = here
        return rung, scenes[1], np.abs(below - here) / FACE_FALLS


def fineness(term, rung):
    """Value of a term's field of struct sim_quality on a rung."""
    return float(np.clip(START[term] * STEP**rung, 0.1, 16.0))


def term_value(scene, term, azimuth, elevation, pupil_mm, lid_opening):
    """One term at one state, [sensor, emitter]."""
    if term == "glint":
        return scene.glint(azimuth, elevation, lid_opening)[0]
    return scene.smooth(azimuth, elevation, pupil_mm, lid_opening, term)[0, 0]


# Gazes between which the slowly varying terms are interpolated ----------------------------------------------


def chebyshev_nodes(low, high, count):
    """Chebyshev points with both ends, ascending; those of count 2n - 1 contain those of n.
    One: the middle.
    """
    if count == 1:
        return np.array([(low + high) / 2])
    unit = -np.cos(np.pi * np.arange(count) / (count - 1))
    unit[count // 2] = 0.0
    return (low + high) / 2 + (high - low) / 2 * unit


def interpolation_matrix(nodes, at):
    """[len(at), len(nodes)]: values at any places from values at Chebyshev points (barycentric, exact at the
    points). One node: a constant.
    """
    count = len(nodes)
    if count == 1:
        return np.ones((len(at), 1))
    weight = (-1.0) ** np.arange(count)
    weight[[0, -1]] /= 2
    gap = np.asarray(at, float)[:, None] - nodes
    hit = np.abs(gap) < 1e-12 * (nodes[-1] - nodes[0])
    share = weight / np.where(hit, 1.0, gap)
    matrix = share / share.sum(1, keepdims=True)
    rows = hit.any(1)
    matrix[rows] = hit[rows]
    return matrix


def interpolate(table, elevation_nodes, azimuth_nodes, elevation, azimuth):
    """A table [elevation node, azimuth node, ...] on a grid: [elevation, azimuth, ...]."""
    rows = np.tensordot(interpolation_matrix(elevation_nodes, elevation), table, 1)
    return np.moveaxis(np.tensordot(interpolation_matrix(azimuth_nodes, azimuth), rows, (1, 1)), 0, 1)


def interpolate_at(table, elevation_nodes, azimuth_nodes, gazes):
    """A table [elevation node, azimuth node, ...] at gazes [n, (azimuth, elevation)]: [n, ...]."""
    across = interpolation_matrix(azimuth_nodes, gazes[:, 0])
    up = interpolation_matrix(elevation_nodes, gazes[:, 1])
    return np.einsum("ni,nj,ij...->n...", up, across, table)


def tail(table, axis):
    """How much the highest eighth of a table's Chebyshev coefficients along an axis still holds (rms)."""
    count = table.shape[axis]
    if count < 3:
        return 0.0
    k = np.arange(count)
    weight = np.ones(count)
    weight[[0, -1]] = 0.5
    # the discrete cosine transform of values at the points, ascending
    transform = (2.0 / (count - 1)) * np.cos(np.pi * np.outer(k, (count - 1) - k) / (count - 1)) * weight
    high = np.tensordot(transform[-max(2, count // 8) :], np.moveaxis(table, axis, 0), 1)
    return float(np.sqrt((high**2).sum(0).mean()))
