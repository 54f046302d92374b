# SPDX-License-Identifier: Apache-2.0
"""Makes the tables of a response map: direct evaluation at nodes, splines through them, and the error of the
result against direct and finer evaluation at states that are no nodes.

Four tables whose sum is the response. Each has nodes only along what its term sees, as close as the term
needs: the face neither pupil nor azimuth, the sclera no pupil, the glint close gaze nodes.
"""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.interpolate import make_interp_spline

from .errors import SceneError
from .mapfile import AXES, GLINT, PUPIL_ANY_MM, SMOOTH, fit_table
from .scene import Scene

TABLES_VERSION = 2  # changes with what this module or the file's layout does to values
TERMS = ("face", "sclera", "iris", "glint")
MOST_VALUES = 1 << 27  # of all tables: half of what the reader takes
LIDS_A_CALL = 32  # SIM_MAX_LIDS

# The glint's step follows the narrowest lobe, that of the smallest lenses: at 33 degrees per unit of Beckmann
# width a cubic spline is right to 1e-5 rms of the mean response; but limbus and margins have widths too.
_STEP_PER_LOBE_DEG, _WIDEST_STEP_DEG = 33.0, 0.8
_LARGEST_STEP_ERROR = 3e-4  # of the mean response, in the worst cells of a few lines: else the step shrinks
_TABLE_VALUES = 16e6  # most values of one term's table, 2 bytes each: lids' nodes go first
FEWEST_LIDS = 11

# The check: random states, and those where the tables are hardest to interpolate.
RANDOM_STATES, HARD_STATES = 24, 6
CHECK_FINENESS = 2.0  # times the tables' own
# What is stated is what was measured times these: a few dozen states do not meet the worst there is.
RMS_MARGIN, MAX_MARGIN = 2.0, 4.0


def glint_step_deg(headset, person):
    """Distance of the glint's gaze nodes that its narrowest lobe asks for, degrees."""
    narrowest = np.inf
    for ports in (headset.sensors, headset.emitters):
        half = []
        for port in ports:
            toward = np.subtract(port.position_mm, person.eye_position_mm) - (0.0, 0.0, -9.0)
            half.append(port.lens_radius_mm / (2.0 * np.linalg.norm(toward)))
        narrowest = min(narrowest, min(half))
    lobe = np.hypot(person.roughness, narrowest)
    return min(_WIDEST_STEP_DEG, _STEP_PER_LOBE_DEG * lobe)


def lid_nodes(wanted, values_a_lid):
    """How many lid nodes a term gets, of those wanted."""
    return int(min(wanted, max(FEWEST_LIDS, _TABLE_VALUES // values_a_lid)))


def choose_glint_nodes(scene, headset, person, half_angle_deg):
    """Number of the glint's gaze nodes, by its lobe's width and a check along four lines of gaze."""
    at = half_angle_deg * np.array([(0.1, 0.2), (-0.6, 0.3), (0.5, -0.6)])
    mean = np.mean([scene.response(*gaze) for gaze in at])
    most = int(min(513, (_TABLE_VALUES / (FEWEST_LIDS * np.prod(scene.shape))) ** 0.5))
    step = glint_step_deg(headset, person)
    for _ in range(4):
        nodes = max(5, min(most, int(np.ceil(2 * half_angle_deg / step)) + 1))
        if nodes == most or _line_error(scene, half_angle_deg, nodes) <= _LARGEST_STEP_ERROR * mean:
            break
        step /= 1.4
    return nodes


def _line_error(scene, half_angle_deg, nodes):
    gaze, worst = np.linspace(-half_angle_deg, half_angle_deg, nodes), 0.0
    middle = (gaze[1:] + gaze[:-1]) / 2
    for across in (-0.31 * half_angle_deg, 0.27 * half_angle_deg):
        for turned in (False, True):

            def along(angle):
                at = (across, angle) if turned else (angle, across)
                return scene.glint(*map(float, at), 1.0)[0].ravel()

            line = np.array([along(angle) for angle in gaze])
            bend = np.abs(np.diff(line, 4, axis=0)).max(axis=1)
            cells = np.argsort(bend)[-4:] + 1
            spline = make_interp_spline(gaze, line, 3)
            for cell in cells:
                worst = max(worst, np.abs(spline(middle[cell]) - along(middle[cell])).max())
    return worst


def chunked(evaluate, lids):
    """evaluate(some lids) [lid, ...] for any number of lids."""
    parts = [evaluate(lids[i : i + LIDS_A_CALL]) for i in range(0, len(lids), LIDS_A_CALL)]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _row(scene, term, nodes, elevation):
    """Values of one term at one elevation: [pupil, lid, azimuth, sensor, emitter]."""
    row = []
    for azimuth in nodes["azimuth_deg"]:
        if term == "glint":
            value = chunked(lambda lids: scene.glint(azimuth, elevation, lids), nodes["lid_opening"])[None]
        elif term == "iris":
            pupils = nodes["pupil_mm"]
            value = chunked(
                lambda lids: scene.smooth(azimuth, elevation, pupils, lids, term).swapaxes(0, 1),
                nodes["lid_opening"],
            ).swapaxes(0, 1)
        else:
            value = chunked(
                lambda lids: scene.smooth(azimuth, elevation, PUPIL_ANY_MM, lids, term)[0],
                nodes["lid_opening"],
            )[None]
        row.append(value)
    return np.stack(row, axis=2)


def tabulate(headset, person, grid, progress=None, workers=1):
    """(tables, values by term, nodes by term) of a map; grid is a simulate.Grid.

    SceneError when the scene is impossible or the tables are larger than a map may be.
    """
    n_slip = tuple(len(axis) for axis in grid.slip_mm)
    slips = list(np.ndindex(*n_slip))
    scenes = [
        Scene(headset, person, [grid.slip_mm[axis][at[axis]] for axis in range(3)], grid.table_quality())
        for at in slips
    ]
    nodes = grid.nodes(scenes[0], headset, person)
    pairs = (len(headset.sensors), len(headset.emitters))
    shape = {
        term: tuple(len(nodes[term][axis]) for axis in AXES[3:])
        for term in TERMS
    }
    if sum(np.prod(shape[term]) for term in TERMS) * len(slips) * np.prod(pairs) > MOST_VALUES:
        raise SceneError("the map would be too large", "fewer nodes, sensors or emitters")
    values = {term: np.empty(n_slip + shape[term] + pairs, np.float32) for term in TERMS}
    # Costs of a node of a term, in any unit, for the progress.
    cost = {"face": 0.5, "sclera": 1.0, "iris": 1.0, "glint": 0.3}
    jobs = [(at, term, row) for at in range(len(slips)) for term in TERMS for row in range(shape[term][2])]
    total = sum(cost[term] * np.prod(shape[term][1:]) for term in TERMS) * len(slips)
    lock, done = threading.Lock(), [0.0]

    def run(job):
        at, term, row = job
        elevation = float(nodes[term]["elevation_deg"][row])
        values[term][slips[at]][:, :, row] = _row(scenes[at], term, nodes[term], elevation)
        with lock:
            done[0] += cost[term] * shape[term][1] * shape[term][3]
            if progress:
                progress(min(1.0, done[0] / total))

    with ThreadPoolExecutor(max_workers=workers) as pool:
        for job in [pool.submit(run, job) for job in jobs]:
            job.result()
    tables = []
    for term in TERMS:
        axes = (*grid.slip_mm, *(nodes[term][axis] for axis in AXES[3:]))
        small = values[term].nbytes < 1 << 24
        kind = GLINT if term == "glint" else SMOOTH
        tables.append(fit_table(kind, axes, values[term], 4 if small else 2))
    return tables, values, nodes


def hard_states(values, nodes, pupils, count, lids):
    """States in the middle of the cells with the largest fourth differences: [2 * count, azimuth, elevation,
    pupil, lids]. Along gaze with the lids open, or along the lids.
    """
    found = []
    for term, axis in (("sclera", 1), ("glint", 1)) if lids else (("glint", 2), ("glint", 3)):
        table = values[term][0, 0, 0]
        if not lids:
            table = table[:, -1:]
        if table.shape[axis] < 5:
            continue
        bend = np.abs(np.diff(table, 4, axis=axis)).max(axis=(0, 4, 5))  # [lid, elevation, azimuth]
        at = nodes[term]
        axes = (at["lid_opening"] if lids else at["lid_opening"][-1:], at["elevation_deg"], at["azimuth_deg"])
        for _ in range(count):
            cell = list(np.unravel_index(np.argmax(bend), bend.shape))
            bend[tuple(slice(max(0, c - 4), c + 5) for c in cell)] = -1.0
            cell[axis - 1] += 1
            lid, elevation, azimuth = (at_axis[c : c + 2].mean() for at_axis, c in zip(axes, cell))
            found.append((azimuth, elevation, pupils[len(found) % len(pupils)], lid))
    return np.array(found).reshape(-1, 4)


def measure_error(evaluate, headset, person, grid, values, nodes):
    """The four numbers of struct sim_map_error: errors of evaluate(states [n, 7]) against direct and finer
    evaluation, times the margins above.
    """
    rng = np.random.default_rng(20)
    pupil, lid = nodes["iris"]["pupil_mm"], nodes["glint"]["lid_opening"]
    half = nodes["glint"]["azimuth_deg"][-1]
    still = all(len(axis) == 1 for axis in grid.slip_mm)
    slips = [
        np.array([rng.uniform(axis[0], axis[-1]) for axis in grid.slip_mm]) for _ in range(1 if still else 3)
    ]
    finer = {key: min(16.0, CHECK_FINENESS * value) for key, value in grid.table_quality().items()}
    scenes = [Scene(headset, person, slip, finer) for slip in slips]
    shape = scenes[0].shape
    others = ~np.eye(*shape, dtype=bool) if min(shape) > 1 else np.ones(shape, bool)
    middles = (pupil[1:] + pupil[:-1]) / 2 if len(pupil) > 1 else pupil
    result = []
    for lids in (False, True)[: min(2, len(lid))]:
        n = grid.check_states
        states = np.column_stack(
            [
                rng.uniform(-half, half, (n, 2)),
                rng.uniform(pupil[0], pupil[-1], n),
                rng.uniform(lid[0], lid[-1], n) if lids else np.full(n, lid[-1]),
            ]
        )
        hard = hard_states(values, nodes, middles, -(-n * HARD_STATES // RANDOM_STATES), lids)
        states = np.concatenate([states, hard])
        error = []
        for number, state in enumerate(states):
            which = number % len(slips)
            direct = scenes[which].response(*state)
            error.append((evaluate(np.concatenate([state, slips[which]])[None])[0] - direct)[others])
        error = np.array(error)
        result += [RMS_MARGIN * np.sqrt(np.mean(error[:n] ** 2)), MAX_MARGIN * np.abs(error).max()]
    return tuple(result) if len(lid) > 1 else tuple(2 * result)
