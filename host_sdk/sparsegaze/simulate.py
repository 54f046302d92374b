# SPDX-License-Identifier: Apache-2.0
"""Response maps: what every sensor of a headset collects from every emitter, over gaze, pupil and lids of
one person.

A map is tabulated once (`response_map`, kept in a cache by the hash of everything it depends on) and then
evaluated at any state (`ResponseMap`, `evaluate`, with derivatives `ResponseMap.gradient`), smoothly between
its nodes. Every map says how wrong it is between them: `ResponseMap.error_estimate`.
"""

import hashlib
import os
from collections import namedtuple

import numpy as np

from .errors import SceneError
from .headset import Headset, load_headset
from .mapfile import AXES, PUPIL_ANY_MM, write_tables
from .person import Person, draw_person, load_person
from .scene import simulator
from .tabulate import (
    RANDOM_STATES,
    TABLES_VERSION,
    choose_glint_nodes,
    lid_nodes,
    measure_error,
    tabulate,
)

# Gaze goes beyond the +-20 degrees of the targets: saccades overshoot and blinks drag the eye.
HALF_ANGLE_DEG = 25.0
SMOOTH_GAZE_NODES = 27
PUPIL_NODES_MM = tuple(2.0 + 0.5 * k for k in range(13))
# Nodes of the lids' opening by term: a margin of 0.8 mm cuts the glint, a point, and the skin beside it
# sharply, the sclera and the iris as areas. About 1 mm of the margin's way is 0.1 of opening.
LID_NODES = {"face": 81, "sclera": 41, "iris": 41, "glint": 61}
PUPIL_NOMINAL_MM = 3.5
# Fineness of the nodes' own values: an error there looks like structure. Many lids at once leave the iris's
# rows uncut by their margins, which is ten times less exact than one opening alone.
TABLE_QUALITY = {"sclera": 1.0, "iris": 2.0, "glint": 1.0, "face": 1.0}
MEAN_HALF_DEG = 20.0

# sim_map_mean() of headsets/led2gaze.toml on nominal_person(): the unit of light. physics.toml's
# [photocurrent] gives the current of exactly this mean (nominal_na = 200 nA), so that a map of any other
# headset or person stands for nominal_na * its own mean / REFERENCE_MEAN: darker skin, a deeper seat or a
# dim placement collect less. Depends on the default headset and on the simulator's optics only; a test
# computes it again.
REFERENCE_MEAN = 8.01755e-6

STATE_FIELDS = (
    "azimuth_deg",
    "elevation_deg",
    "pupil_mm",
    "lid_opening",
    "slip_x_mm",
    "slip_y_mm",
    "slip_z_mm",
)


def cache_directory():
    """Where maps are kept unless a directory is given: $XDG_CACHE_HOME/sparsegaze, or ~/.cache/sparsegaze."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return os.path.join(base, "sparsegaze")


def as_headset(headset):
    """A Headset as it is, or one read from a path."""
    return headset if isinstance(headset, Headset) else load_headset(headset)


def as_person(person):
    """A Person as it is, drawn from a seed, or read from a path."""
    if isinstance(person, Person):
        return person
    return draw_person(person) if isinstance(person, (int, np.integer)) else load_person(person)


class Grid:
    """Nodes of a map. The defaults are the product's; coarser ones make quick, rough maps for tests.

    glint_nodes    None: as many as the scene's lobes ask for
    lid_opening    None: LID_NODES, uniform; else these for every term
    quality        {field of struct sim_quality: value} for the nodes' values, over TABLE_QUALITY
    check_states   number of random states at which the map's error is measured, lids open and again
                   with any lids
    """

    def __init__(
        self,
        half_angle_deg=HALF_ANGLE_DEG,
        smooth_nodes=SMOOTH_GAZE_NODES,
        glint_nodes=None,
        pupil_mm=PUPIL_NODES_MM,
        lid_opening=None,
        slip_mm=((0.0,), (0.0,), (0.0,)),
        quality=(),
        check_states=RANDOM_STATES,
    ):
        self.half_angle_deg, self.smooth_nodes, self.glint_nodes = half_angle_deg, smooth_nodes, glint_nodes
        self.pupil_mm = np.array(pupil_mm, float)
        self.lid_opening = None if lid_opening is None else np.array(lid_opening, float)
        self.slip_mm = tuple(np.array(axis, float) for axis in slip_mm)
        self.quality = dict(quality)
        self.check_states = int(check_states)

    def table_quality(self):
        """Fineness of the nodes' values by term."""
        return {**TABLE_QUALITY, **self.quality}

    def describe(self):
        """Everything a map's values depend on, as text."""
        lids = LID_NODES if self.lid_opening is None else self.lid_opening.tolist()
        return repr(
            (
                (self.half_angle_deg, self.smooth_nodes, self.glint_nodes, self.pupil_mm.tolist(), lids),
                [axis.tolist() for axis in self.slip_mm],
                sorted(self.table_quality().items()),
                self.check_states,
            )
        )

    def nodes(self, scene, headset, person):
        """{term: {axis: nodes}} for one scene."""
        half, any_pupil = self.half_angle_deg, np.array([PUPIL_ANY_MM])
        pairs = int(np.prod(scene.shape))
        gaze = np.linspace(-half, half, self.smooth_nodes)
        glint_nodes = self.glint_nodes
        if glint_nodes is None:
            glint_nodes = choose_glint_nodes(scene, headset, person, half)
        fine = np.linspace(-half, half, glint_nodes)
        wide = np.linspace(-half, half, max(4, 4 * self.smooth_nodes // 5))  # the iris's: costly and smooth
        values = {
            "face": 4 * self.smooth_nodes,
            "sclera": self.smooth_nodes**2,
            "iris": len(wide) ** 2 * len(self.pupil_mm),
            "glint": glint_nodes**2,
        }
        lids = {
            term: np.linspace(0.0, 1.0, lid_nodes(LID_NODES[term], values[term] * pairs))
            if self.lid_opening is None
            else self.lid_opening
            for term in LID_NODES
        }
        shut = np.array([0.0])
        face = np.linspace(-half, half, 2 * self.smooth_nodes - 1)
        return {
            "face": dict(pupil_mm=any_pupil, lid_opening=lids["face"], elevation_deg=face, azimuth_deg=shut),
            "sclera": dict(
                pupil_mm=any_pupil, lid_opening=lids["sclera"], elevation_deg=gaze, azimuth_deg=gaze
            ),
            "iris": dict(
                pupil_mm=self.pupil_mm, lid_opening=lids["iris"], elevation_deg=wide, azimuth_deg=wide
            ),
            "glint": dict(
                pupil_mm=any_pupil, lid_opening=lids["glint"], elevation_deg=fine, azimuth_deg=fine
            ),
        }


def map_name(headset, person, grid=None):
    """File name of a map: the hash of headset, person, nodes and the simulator's own source."""
    ffi, lib = simulator()
    text = repr((headset.describe(), person.describe(), (grid or Grid()).describe(), TABLES_VERSION))
    text += ffi.string(lib.sim_source_hash).decode()
    return hashlib.sha256(text.encode()).hexdigest()[:32] + ".sgmap"


def response_map(headset, person, progress=None, cache=None, grid=None, workers=None):
    """Path of the map of a headset on a person, made when it is not in the cache yet.

    headset    Headset, or path of a headset TOML          person    Person, seed, or path of a person TOML
    progress   called with the finished part, 0..1, from any thread          cache    directory (created)
    workers    threads; None = two, or one on a one-core machine
    Raises SceneError for an impossible scene, OSError when the cache cannot be written.
    """
    headset, person, grid = as_headset(headset), as_person(person), grid or Grid()
    directory = os.fspath(cache) if cache is not None else cache_directory()
    path = os.path.join(directory, map_name(headset, person, grid))
    if os.path.exists(path):
        try:
            ResponseMap(path).close()
            if progress:
                progress(1.0)
            return path
        except SceneError:
            pass  # damaged: made again below
    os.makedirs(directory, exist_ok=True)
    write_made(path, headset, person, grid, progress, workers or min(2, os.cpu_count() or 1))
    return path


def write_made(path, headset, person, grid, progress=None, workers=1):
    """Tabulate a map, measure its mean and its error, and write it."""
    tables, values, nodes = tabulate(headset, person, grid, progress, workers)
    draft = "%s.%d.draft" % (path, os.getpid())
    try:
        write_tables(draft, tables, 1.0)
        with ResponseMap(draft) as opened:
            mean = mean_response(opened, min(MEAN_HALF_DEG, grid.half_angle_deg))
            error = measure_error(opened.evaluate, headset, person, grid, values, nodes)
    finally:
        if os.path.exists(draft):
            os.unlink(draft)
    write_tables(path, tables, mean, error)


def mean_response(opened, half_deg=MEAN_HALF_DEG):
    """What sim_map_mean() promises, of an open map: by 24 x 24 Gauss-Legendre nodes."""
    at, weight = np.polynomial.legendre.leggauss(24)
    elevation, azimuth = np.meshgrid(half_deg * at, half_deg * at, indexing="ij")
    response = opened.evaluate(np.column_stack([azimuth.ravel(), elevation.ravel()]))
    mean = np.tensordot(np.outer(weight, weight).ravel() / 4, response, 1)
    if min(mean.shape) > 1:
        np.fill_diagonal(mean, 0.0)
    return float(mean.sum() / len(mean))


ErrorEstimate = namedtuple("ErrorEstimate", "open_rms open_max lids_rms lids_max")
ErrorEstimate.__doc__ = """Errors of a map's responses, bounds for states that were not looked at: divided by
the mean response of a pair. open_: lids open; lids_: lids anywhere; _rms: of many states; _max: of any. NaN
where nobody measured."""


class ResponseMap:
    """An open map file. `evaluate` may be called from several threads at once; close it, or use it in a
    `with`.
    """

    def __init__(self, path):
        self._ffi, self._lib = simulator()
        error = self._ffi.new("char[200]")
        made = self._lib.sim_map_open(os.fsencode(path), error, 200)
        if made == self._ffi.NULL:
            reason = self._ffi.string(error).decode()
            raise SceneError("%s: %s" % (path, reason), "delete it, it will be made again")
        self._map = self._ffi.gc(made, self._lib.sim_map_close)
        self.shape = (self._lib.sim_map_sensors(made), self._lib.sim_map_emitters(made))
        self.mean = self._lib.sim_map_mean(made)
        others = self.shape[1] - (min(self.shape) > 1)
        stated = self._lib.sim_map_error(made)
        self.error_estimate = ErrorEstimate(
            *(
                np.nan if value < 0 else value * others / self.mean
                for value in (getattr(stated, name) for name in ErrorEstimate._fields)
            )
        )

    def close(self):
        """Free the tables; the map cannot be used afterwards."""
        if self._map is not None:
            self._ffi.release(self._map)
            self._map = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def axis(self, table, name):
        """Nodes of an axis (of mapfile.AXES) of a table, numbered as in the file; [] where there is none."""
        nodes = self._ffi.new("double **")
        count = self._lib.sim_map_axis(self._map, table, AXES.index(name), nodes)
        return np.array([nodes[0][i] for i in range(count)])

    def _states(self, states):
        """States [n, 2..7] filled up to [n, 7]."""
        states = np.atleast_2d(np.asarray(states, float))
        full = np.zeros((len(states), len(STATE_FIELDS)))
        full[:, 2:4] = PUPIL_NOMINAL_MM, 1.0
        full[:, : states.shape[1]] = states
        return full

    def evaluate(self, states):
        """Responses [n, sensor, emitter] at states [n, 2..7]: STATE_FIELDS in order.

        What is missing of a state: pupil 3.5 mm, lids open, no slip. Outside the map it is clamped.
        Raises SceneError when a state is not finite.
        """
        full = self._states(states)
        out = np.empty((len(full),) + self.shape)
        bad = self._lib.sim_map_eval_many(
            self._map,
            self._ffi.cast("struct sim_state *", self._ffi.from_buffer("double[]", full)),
            len(full),
            self._ffi.from_buffer("double[]", out),
        )
        if bad:
            raise SceneError("%d states are not finite" % bad, "correct the states")
        return out

    def parts(self, states):
        """(smooth terms, glint), each [n, sensor, emitter]: their sum is the response, not cut at 0."""
        full = self._states(states)
        terms = np.empty((2, len(full)) + self.shape)
        state = self._ffi.cast("struct sim_state *", self._ffi.from_buffer("double[]", full))
        smooth, glint = (self._ffi.from_buffer("double[]", term) for term in terms)
        pairs = self.shape[0] * self.shape[1]
        for i in range(len(full)):
            if self._lib.sim_map_eval_parts(self._map, state + i, smooth + i * pairs, glint + i * pairs):
                raise SceneError("state %d is not finite" % i, "correct the states")
        return terms[0], terms[1]

    def gradient(self, states):
        """(responses [n, sensor, emitter], derivatives [n, 7, sensor, emitter] by STATE_FIELDS) at states as
        for `evaluate`; per degree, per mm and per unit of lid opening.

        0 where the state is clamped, and along what the map has one node for: slip, unless it was asked for.
        """
        full = self._states(states)
        out = np.empty((len(full),) + self.shape)
        slope = np.empty((len(full), len(STATE_FIELDS)) + self.shape)
        state = self._ffi.cast("struct sim_state *", self._ffi.from_buffer("double[]", full))
        values = self._ffi.from_buffer("double[]", out)
        slopes = self._ffi.from_buffer("double[]", slope)
        pairs = self.shape[0] * self.shape[1]
        for i in range(len(full)):
            if self._lib.sim_map_eval_gradient(
                self._map, state + i, values + i * pairs, slopes + i * pairs * len(STATE_FIELDS)
            ):
                raise SceneError("state %d is not finite" % i, "correct the states")
        return out, slope


def evaluate(path, states):
    """Responses [n, sensor, emitter] of a map file at states; see ResponseMap.evaluate."""
    with ResponseMap(path) as opened:
        return opened.evaluate(states)
