# SPDX-License-Identifier: Apache-2.0
"""The proof that a device model's final sum fits its 24-bit accumulator, whatever the features."""

import numpy as np

from .model import S_FRAC, S_MAX, U_STEPS

KERNEL_ERROR = 4.0  # of a device kernel value, Q0.16 steps, S2's rounding included (sg_gp.h)
CELLS_MAX = 200_000  # that are looked at before the proof is given up
BLOCK = 2000


def reach(weights, trend, bias, centres, trust, enough=0.0):
    """Bound of |bias + trend . s + sum w k| over every input that no guard flags, in accumulator steps.

    weights [n, 2], trend [2, d], bias [2], centres [n, d]: integers as stored;  trust: trust.Trust
    enough    no better bound than this is looked for

    The guards' parallelepiped, completed by axes of the box, is cut into cells, again and again where the bound is
    above `enough`. Within a cell of half widths h around c, with f the sum of kernels and L the length scale,
    |value - value(c)| <= |gradient(c) . h| + sqrt(3)/2 |f| |h|^2 / L^2 :  f is a member of the kernel's function
    space, where |f| = sqrt(w' K w) and every second derivative is at most |f| times the square root of the kernel's
    fourth, 3 / L^4. Each of the device's kernel values is within KERNEL_ERROR of the exact (sg_gp.h), and of every
    product less than 256 steps are left out.
    """
    live = np.flatnonzero(centres.any(axis=0) | np.any(trend, axis=0))
    length = U_STEPS * S_FRAC
    w, spot = weights.astype(float), centres[:, live] / U_STEPS
    slope, base = trend[:, live].T * (length / 16.0), bias / 16.0
    error = KERNEL_ERROR / 256.0 * np.abs(w).sum(axis=0) + (weights & 255).sum(axis=0) + 2.0
    if not len(live):
        return float(np.max(np.abs(base) + 256.0 * np.abs(w).sum(axis=0) + error))
    rows, low, high = _slabs(trust, live)
    columns = np.linalg.inv(rows) / length
    gram = np.exp(-0.5 * ((spot[:, None] - spot) ** 2).sum(-1))
    bend = 256.0 * np.sqrt(3.0) / 2 * np.sqrt(np.maximum(np.einsum("io,ij,jo->o", w, gram, w), 0.0))
    touch = np.abs(columns.T @ columns)

    def bound(middle, half):
        """Of the cells with these middles and half widths, along the slabs; -inf for cells outside the box."""
        x, size2 = middle @ columns.T, np.einsum("ci,ij,cj->c", half, touch, half)
        overlap = half @ np.abs(columns.T)
        k = 256.0 * np.exp(-0.5 * ((x[:, None] - spot) ** 2).sum(-1))
        most = np.zeros(len(x))
        for o in range(2):
            gradient = slope[:, o] + (k * w[:, o]) @ spot - (k @ w[:, o])[:, None] * x
            spread = np.sum(np.abs(gradient @ columns) * half, axis=1) + bend[o] * size2
            most = np.maximum(most, np.abs(base[o] + x @ slope[:, o] + k @ w[:, o]) + spread + error[o])
        return np.where(((x > -overlap) & (x < S_MAX / length + overlap)).all(axis=1), most, -np.inf)

    middle, half = 0.5 * (low + high)[None], 0.5 * (high - low)[None]
    worst, looked = 0.0, 0
    while len(middle):
        most = np.concatenate([bound(middle[i : i + BLOCK], half[i : i + BLOCK]) for i in range(0, len(middle), BLOCK)])
        looked += len(middle)
        again = most > enough
        if looked + 2 * again.sum() > CELLS_MAX:
            worst = max(worst, float(most.max()))
            break
        worst = max(worst, float(most[~again].max(initial=0.0)))
        middle, half = middle[again], half[again]
        axis = np.argmax(half * np.linalg.norm(columns, axis=0), axis=1)
        step = np.zeros_like(half)
        picked = np.arange(len(half)), axis
        half[picked] *= 0.5
        step[picked] = half[picked]
        middle, half = np.vstack([middle - step, middle + step]), np.vstack([half, half])
    return float(worst * (1.0 + 1e-9))


def _slabs(trust, live):
    """Rows [d, d] and their ranges that hold every input in the box and within the guards.

    The guards' directions are completed to all d by axes of the box, most independent first.
    """
    d = len(live)
    rows, low, high = [], [], []
    for guard in range(trust.guards):
        row, least, most = trust.row[guard][live].astype(float), trust.low[guard], trust.high[guard]
        if np.linalg.matrix_rank(np.array(rows + [row])) > len(rows):  # a direction twice bounds no further one
            rows.append(row)
            low.append(256.0 * least)
            high.append(256.0 * (most + 1))
    for _ in range(d - len(rows)):
        free = np.eye(d)
        if rows:
            basis = np.linalg.qr(np.array(rows).T)[0]
            free = free - basis @ basis.T
        axis = int(np.argmax(np.linalg.norm(free, axis=0)))
        rows.append(np.eye(d)[axis])
        low.append(0.0)
        high.append(float(S_MAX))
    return np.array(rows), np.array(low), np.array(high)
