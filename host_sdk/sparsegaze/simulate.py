# SPDX-License-Identifier: Apache-2.0
"""Response maps: what every sensor of a headset collects from every emitter, over gaze, pupil and lids of
one person.

A map is tabulated once (`response_map`, kept in a cache by the hash of everything it depends on) and then
evaluated at any state (`ResponseMap`, `evaluate`), smoothly between its nodes.

Errors, divided by the mean response of a pair, default headset, lids open: between nodes against direct
evaluation 2e-4 rms (tests/sim/test_maps.py); against much finer integration, interpolation included, up to
1e-3 rms, nearly all of it a constant of the face; what varies with gaze is 1e-4. Lids half way between two
nodes, as in a blink: 3e-3 rms, 4e-2 at most (a glint that a margin cuts).
"""

import hashlib
import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from .errors import SceneError
from .headset import Headset, load_headset
from .mapfile import write_map
from .person import Person, draw_person, load_person
from .scene import Scene, simulator

# Gaze goes beyond the +-20 degrees of the targets: saccades overshoot and blinks drag the eye. The pupil's
# and lids' nodes
# are closer where people mostly are.
HALF_ANGLE_DEG = 25.0
SMOOTH_GAZE_NODES = 31
GLINT_GAZE_NODES = 61
PUPIL_NODES_MM = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
LID_NODES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
PUPIL_NOMINAL_MM = 3.5

# sim_map_mean() of headsets/led2gaze.toml on nominal_person(): the unit of light. physics.toml's
# [photocurrent] gives the current of exactly this mean (nominal_na = 200 nA), so that a map of any other
# headset or person stands for nominal_na * its own mean / REFERENCE_MEAN: darker skin, a deeper seat or a
# dim placement collect less. Depends on the default headset and on the simulator's optics only; a test
# computes it again.
REFERENCE_MEAN = 8.1212e-6

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
    """Nodes of a map. The defaults are the product's; coarser ones make quick, rough maps for tests."""

    def __init__(
        self,
        half_angle_deg=HALF_ANGLE_DEG,
        smooth_nodes=SMOOTH_GAZE_NODES,
        glint_nodes=GLINT_GAZE_NODES,
        pupil_mm=PUPIL_NODES_MM,
        lid_opening=LID_NODES,
        slip_mm=((0.0,), (0.0,), (0.0,)),
        quality=(),
    ):
        self.smooth_deg = np.linspace(-half_angle_deg, half_angle_deg, smooth_nodes)
        self.glint_deg = np.linspace(-half_angle_deg, half_angle_deg, glint_nodes)
        self.pupil_mm, self.lid_opening = np.array(pupil_mm, float), np.array(lid_opening, float)
        self.slip_mm = tuple(np.array(axis, float) for axis in slip_mm)
        self.quality = dict(quality)

    def describe(self):
        """Everything a map's values depend on, as text."""
        arrays = (self.smooth_deg, self.glint_deg, self.pupil_mm, self.lid_opening) + self.slip_mm
        return repr([a.tolist() for a in arrays] + [sorted(self.quality.items())])


def map_name(headset, person, grid=None):
    """File name of a map: the hash of headset, person, nodes and the simulator's own source."""
    ffi, lib = simulator()
    text = repr((headset.describe(), person.describe(), (grid or Grid()).describe()))
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
    smooth, glint = _tabulate(headset, person, grid, progress, workers or min(2, os.cpu_count() or 1))
    write_map(
        path,
        pupil_mm=grid.pupil_mm,
        lid_opening=grid.lid_opening,
        slip_mm=grid.slip_mm,
        elevation_deg=grid.smooth_deg,
        azimuth_deg=grid.smooth_deg,
        smooth=smooth,
        glint_lid_opening=grid.lid_opening,
        glint_elevation_deg=grid.glint_deg,
        glint_azimuth_deg=grid.glint_deg,
        glint=glint,
        mean=_mean_response(grid, smooth, glint),
    )
    return path


def _tabulate(headset, person, grid, progress, workers):
    """Both tables, [slip x, slip y, slip z, (pupil,) lid, elevation, azimuth, sensor, emitter]."""
    slips = [
        (i, j, k)
        for i in range(len(grid.slip_mm[0]))
        for j in range(len(grid.slip_mm[1]))
        for k in range(len(grid.slip_mm[2]))
    ]
    n_slip = tuple(len(axis) for axis in grid.slip_mm)
    pairs = (len(headset.sensors), len(headset.emitters))
    n_smooth, n_glint, n_lid = len(grid.smooth_deg), len(grid.glint_deg), len(grid.lid_opening)
    smooth = np.empty(n_slip + (len(grid.pupil_mm), n_lid, n_smooth, n_smooth) + pairs, np.float32)
    glint = np.empty(n_slip + (n_lid, n_glint, n_glint) + pairs, np.float32)
    lock, done = threading.Lock(), [0]
    # One row of smooth nodes costs about three times what a row node of the glint does.
    total = len(slips) * (3 * n_smooth * n_smooth + n_glint * n_glint)

    def report(units):
        with lock:
            done[0] += units
            if progress:
                progress(min(1.0, done[0] / total))

    def smooth_row(scene, at, row):
        elevation = float(grid.smooth_deg[row])
        # The face does not see where the eye looks sideways, only where the lids are.
        face = scene.smooth(0.0, elevation, grid.pupil_mm[:1], grid.lid_opening, "face")
        for column, azimuth in enumerate(grid.smooth_deg):
            eye = scene.smooth(float(azimuth), elevation, grid.pupil_mm, grid.lid_opening, "eye")
            smooth[at + (slice(None), slice(None), row, column)] = eye + face
        report(3 * n_smooth)

    def glint_row(scene, at, row):
        for column, azimuth in enumerate(grid.glint_deg):
            value = scene.glint(float(azimuth), float(grid.glint_deg[row]), grid.lid_opening)
            glint[at + (slice(None), row, column)] = value
        report(n_glint)

    with ThreadPoolExecutor(max_workers=workers) as pool:
        for at in slips:
            slip = [grid.slip_mm[axis][at[axis]] for axis in range(3)]
            scene = Scene(headset, person, slip, grid.quality)
            jobs = [pool.submit(smooth_row, scene, at, row) for row in range(n_smooth)]
            jobs += [pool.submit(glint_row, scene, at, row) for row in range(n_glint)]
            for job in jobs:
                job.result()
    return smooth, glint


def _mean_response(grid, smooth, glint):
    """What sim_map_mean() promises, from the two tables by interpolation of neither: means over their own
    gaze nodes.

    The pupil is interpolated between its nodes (quadratic: the area counts).
    """
    slip = tuple(int(np.argmin(np.abs(axis))) for axis in grid.slip_mm)
    pupil = np.array(
        [np.interp(PUPIL_NOMINAL_MM**2, grid.pupil_mm**2, row) for row in np.eye(len(grid.pupil_mm))]
    )
    opened = np.tensordot(pupil, smooth[slip].astype(float), 1)[-1]
    total = 0.0
    for table, nodes in ((opened, grid.smooth_deg), (glint[slip][-1].astype(float), grid.glint_deg)):
        inside = np.abs(nodes) <= 20.0 + 1e-9
        mean = table[inside][:, inside].mean(axis=(0, 1))
        if min(mean.shape) > 1:
            np.fill_diagonal(mean, 0.0)
        total += mean.sum() / len(mean)
    return total


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

    def close(self):
        """Free the tables; the map cannot be used afterwards."""
        if self._map is not None:
            self._ffi.release(self._map)
            self._map = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def axis(self, number):
        """Nodes of one axis, numbered as in the file: pupil, lid, slip x y z, elevation, azimuth, then the
        glint's.
        """
        nodes = self._ffi.new("double **")
        count = self._lib.sim_map_axis(self._map, number, nodes)
        return np.array([nodes[0][i] for i in range(count)])

    def evaluate(self, states):
        """Responses [n, sensor, emitter] at states [n, 2..7]: STATE_FIELDS in order.

        What is missing of a state: pupil 3.5 mm, lids open, no slip. Outside the map it is clamped.
        Raises SceneError when a state is not finite.
        """
        states = np.atleast_2d(np.asarray(states, float))
        full = np.zeros((len(states), len(STATE_FIELDS)))
        full[:, 2:4] = PUPIL_NOMINAL_MM, 1.0
        full[:, : states.shape[1]] = states
        out = np.empty((len(full),) + self.shape)
        buffer = self._ffi.from_buffer("double[]", full)
        bad = self._lib.sim_map_eval_many(
            self._map,
            self._ffi.cast("struct sim_state *", buffer),
            len(full),
            self._ffi.from_buffer("double[]", out),
        )
        if bad:
            raise SceneError("%d states are not finite" % bad, "correct the states")
        return out


def evaluate(path, states):
    """Responses [n, sensor, emitter] of a map file at states; see ResponseMap.evaluate."""
    with ResponseMap(path) as opened:
        return opened.evaluate(states)
