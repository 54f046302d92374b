# SPDX-License-Identifier: Apache-2.0
"""From a calibration to a Trust: which features gaze explains, how far they may be off, how wrong gaze is.

A gaze moves the features on a surface. With lids half closed, or a headset that has slipped, they leave it,
long before they leave the box of the calibration: in six channels a surface leaves four directions free. The
expected features of a gaze are a table over gaze, smooth between its nodes; the guards look along those
directions in which frames vary most, in units of their noise, once that expectation is taken off. Two
directions are left out: along them the gaze itself was chosen to fit.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .errors import CalibrationError
from .model import quantise
from .trust import BASE_MAX, DOUBT_UNIT, GUARDS, RESIDUAL_SD, ROW_MAX, Trust

CELL_DEG = 4.0
CELLS_MAX = 12  # per axis; wider fields get wider cells
MARGIN_DEG = 2.0
SMOOTHNESS = 3e-3  # weight of a second difference between nodes, per frame of a cell
FOLDS = 5  # of fixations, for an expectation that has not seen them
DRIFT = 4.0  # how often a variance between fixations counts, against one within them
STEP_SD = 0.29  # steps of s >> 4, of what is rounded to them
TAIL = 1e-3  # quantile taken for the ends of what was calibrated
LIMIT_QUANTILE, LIMIT_MARGIN = 0.95, 1.4  # of doubts by an expectation that has not seen the fixation
LIMIT_LEAST = 90.0  # squared deviations: pupils go on drifting after the calibration
RANGE_MARGIN, RANGE_SIGMAS = 0.12, 6.0
INNER = 0.8  # of the field: what is left out there is interpolated
SIGMA_AT_LIMIT = 2.0  # how many times larger sigma is where a point is refused
NODE_STEP = 8  # of a guard's projection, per step of an expectation


def learn(features, gaze_deg, sigma_deg, offset, gain_q12, noise, label=None, cells_max=CELLS_MAX):
    """Trust for a model whose inputs are scaled by offset and gain_q12.

    features   [n, d] frames of the calibration, blinks excluded
    gaze_deg   [n, 2] what the process says of those frames (not their targets)
    sigma_deg  [n] standard deviation of each of its angles there;  noise [d] rms of one frame, feature units
    label      int [n] fixation of each frame; None: each its own
    cells_max  of the grid, per axis: what the slot leaves room for
    Raises CalibrationError for fewer than 4 frames.
    """
    features, gaze = np.asarray(features, float), np.asarray(gaze_deg, float)
    if len(features) < 4:
        raise CalibrationError(f"{len(features)} frames tell nothing of what to expect",
                               "record more targets")
    s, _ = quantise(np.clip(np.rint(features), 0, 65535), offset, gain_q12)
    step = (s >> 4).astype(float)
    origin, scale, nodes = _grid(gaze, cells_max)
    blend = _shares(gaze, origin, scale, nodes)
    table = _smooth(blend, nodes, np.column_stack([step, np.log2(np.maximum(sigma_deg, 1e-3))]))
    surface, sigma = table[:, :-1], table[:, -1]
    miss = step - blend @ surface
    live = np.flatnonzero(gain_q12 > 0)
    spread = np.sqrt((np.asarray(noise, float) * gain_q12 / 65536.0)[live] ** 2 + STEP_SD**2)
    rows = _directions(miss[:, live], spread, label)
    row = np.zeros((len(rows), features.shape[1]), np.int64)
    for i, direction in enumerate(rows):
        row[i, live] = _whole(direction, surface[:, live])
    projection = (s >> 4) @ row.T
    middle = surface @ row.T
    base = np.clip(np.floor(middle.min(axis=0)), -BASE_MAX, BASE_MAX).astype(np.int64)
    expected = np.clip(np.rint((middle - base) / NODE_STEP), 0, 255).astype(np.int64)
    low, high = np.quantile(projection, [TAIL / 2, 1 - TAIL / 2], axis=0)
    margin = np.maximum(RANGE_MARGIN * (high - low), RANGE_SIGMAS * RESIDUAL_SD)
    shape = (nodes[1], nodes[0])
    code = np.clip(np.rint(16 * (sigma + 8)), 1, 240).astype(np.int64).reshape(shape)
    doubt = _doubt_of_strangers(blend, nodes, step, row, label)
    limit = max(LIMIT_MARGIN * float(np.quantile(doubt, LIMIT_QUANTILE)), LIMIT_LEAST * DOUBT_UNIT)
    limit = int(min(np.ceil(limit), 65535))
    return Trust(
        row,
        base,
        np.floor(low - margin).astype(np.int64),
        np.ceil(high + margin).astype(np.int64),
        expected.reshape(*shape, len(rows)),
        code,
        origin,
        scale,
        limit,
        int(min(255, np.rint(16 * np.log2(SIGMA_AT_LIMIT) * 4096 / limit))),
    )


def spread(learnt, gp, fixed, rows, gaze_deg):
    """Standard deviation [n] of each angle of single frames, about where their targets stood.

    learnt   process of the fixations' means (one row of it per fixation);  gp the final process
    fixed    fixations.Fixations; rows int [n] of its frames;  gaze_deg [n, 2] = gp.predict of these
    The sum of three variances: the process's own and its noise (where the eye rested, pupil, seat), and a
    frame's noise through the slope of the mean. One factor then makes 68.3 % of leave-one-fixation-out errors
    of frames lie inside; fixations at the edge do not count for it: left out, they are extrapolated.
    """
    features, label = fixed.features[rows], fixed.label[rows]
    _, own = learnt.predict(features, return_std=True)
    through = (gp.gradient(features) * fixed.noise) ** 2
    sigma = np.sqrt(own**2 + learnt.hyper.noise_deg**2 + through.sum(axis=(1, 2)) / 2)
    place = {(*x, *y): i for i, (x, y) in enumerate(zip(learnt.x, learnt.y))}
    known = np.array([place.get((*x, *y), -1) for x, y in zip(fixed.mean, fixed.target)])
    miss = (learnt.y - learnt.loo()[0])[known]
    count = np.bincount(label, minlength=len(known))
    total = np.stack([np.bincount(label, g, len(known)) for g in gaze_deg.T], axis=1)
    mean = total / np.maximum(count, 1)[:, None]
    error = np.abs(gaze_deg - mean[label] - miss[label])
    off = np.abs(fixed.target - np.median(fixed.target, axis=0))
    inner = (known[label] >= 0) & (off <= INNER * off.max(axis=0)).all(axis=1)[label]
    if inner.sum() < 20:
        inner = known[label] >= 0
    return sigma * float(np.quantile(error[inner] / sigma[inner][:, None], 0.683))


def _grid(gaze, cells_max):
    """(origin_deg_q7 [2], scale [2], nodes [2]) of a grid over gaze [n, 2]; azimuth, elevation."""
    low, high = np.quantile(gaze, [TAIL, 1 - TAIL], axis=0)
    low, high = np.maximum(low - MARGIN_DEG, -127.0), np.minimum(high + MARGIN_DEG, 127.0)
    cells = np.clip(np.ceil((high - low) / CELL_DEG), 1, cells_max).astype(np.int64)
    scale = np.clip(np.floor(512.0 * cells / (high - low)), 1, 255).astype(np.int64)
    return np.floor(low * 128).astype(np.int64), scale, cells + 1


def _shares(gaze, origin, scale, nodes):
    """Each gaze as shares of the nodes around it: sparse [n, nodes], azimuth first as in the model."""
    cell, part = [], []
    for axis in range(2):
        t = np.clip((gaze[:, axis] * 128 - origin[axis]) * scale[axis] / 65536.0, 0, nodes[axis] - 1 - 1e-9)
        cell.append(t.astype(int))
        part.append(t - cell[axis])
    rows, columns, values = [], [], []
    for corner in range(4):
        right, up = corner % 2, corner // 2
        rows.append(np.arange(len(gaze)))
        columns.append((cell[1] + up) * nodes[0] + cell[0] + right)
        values.append((part[0] if right else 1 - part[0]) * (part[1] if up else 1 - part[1]))
    shape = (len(gaze), int(nodes[0] * nodes[1]))
    return sparse.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape)


def _smooth(blend, nodes, values):
    """Node values [nodes, columns] whose blend fits `values` [n, columns], bent as little as that allows."""
    wide, high = int(nodes[0]), int(nodes[1])
    bends = []
    for along, across, stride, skip in ((wide, high, 1, wide), (high, wide, wide, 1)):
        first = (np.arange(across)[:, None] * skip + np.arange(along - 2) * stride).ravel()
        if len(first):
            entry = np.repeat(np.arange(len(first)), 3)
            at = (first[:, None] + stride * np.arange(3)).ravel()
            bend = np.tile([1.0, -2.0, 1.0], len(first))
            bends.append(sparse.csr_matrix((bend, (entry, at)), (len(first), wide * high)))
    frames = blend.shape[0] / max(1, (wide - 1) * (high - 1))
    normal = blend.T @ blend + 1e-9 * frames * sparse.identity(wide * high)
    for bend in bends:
        normal = normal + SMOOTHNESS * frames * (bend.T @ bend)
    return splu(sparse.csc_matrix(normal)).solve(blend.T @ values)


def _doubt_of_strangers(blend, nodes, step, row, label):
    """m of every frame [n], by an expectation that has not seen its fixation: as the device meets new gazes.

    Where targets stand far apart, that is much more than the doubt of frames that the grid was fitted to.
    """
    label = np.arange(len(step)) if label is None else np.unique(label, return_inverse=True)[1]
    doubt = np.zeros(len(step))
    for fold in range(FOLDS):
        out = label % FOLDS == fold
        if out.all() or not out.any():
            continue
        surface = _smooth(blend[~out], nodes, step[~out])
        miss = np.clip(step[out] @ row.T - blend[out] @ (surface @ row.T), -127, 127)
        doubt[out] = np.sum(miss**2, axis=1)
    return doubt


def _directions(miss, spread, label):
    """Rows [g, d] along which `miss` [n, d] varies most, in units of `spread` [d], each to deviation 1.

    What differs between fixations (pupil, seat) has had minutes to show itself and will go on: it counts
    DRIFT times. What differs within them is noise.
    """
    white = miss / spread
    if label is None:
        mean = np.zeros_like(white)
    else:
        _, label = np.unique(label, return_inverse=True)
        total = np.stack([np.bincount(label, column) for column in white.T], axis=1)
        mean = (total / np.bincount(label)[:, None])[label]
    cov = (white - mean).T @ (white - mean) / len(white) + DRIFT * (mean.T @ mean) / len(white)
    variance, direction = np.linalg.eigh(cov)
    free = max(1, min(GUARDS, len(spread) - 2))
    chosen = np.argsort(-variance)[:free]
    return (direction[:, chosen] / np.sqrt(np.maximum(variance[chosen], 1e-6))).T / spread


def _whole(direction, surface):
    """Integers along a direction: a residual's deviation is RESIDUAL_SD steps, if row and grid hold that."""
    size = RESIDUAL_SD
    size = min(size, ROW_MAX / max(np.abs(direction).sum(), 1e-9))
    reach = surface @ direction
    size = min(size, 250.0 * NODE_STEP / max(float(np.ptp(reach)), 1e-9))
    row = np.rint(size * direction).astype(np.int64)
    while np.abs(row).sum() > ROW_MAX:
        row[np.argmax(np.abs(row))] -= np.sign(row[np.argmax(np.abs(row))])
    if not row.any():
        row[np.argmax(np.abs(direction))] = 1
    return row
