# SPDX-License-Identifier: Apache-2.0
"""The proof that a device model's final sum fits its 24-bit accumulator, whatever the features."""

import numpy as np
from scipy.optimize import linprog

from .model import S_FRAC, S_MAX, U_STEPS

KERNEL_ERROR = 10.0  # of a device kernel value, Q0.16 steps, S2's rounding included (sg_gp.h)
CELLS_MAX = 200_000  # that are looked at before the proof is given up
BLOCK = 500
CUBE = np.sqrt(15.0) / 6.0


def reach(weights, trend, bias, centres, trust, enough=0.0):
    """Bound of |bias + trend . s + sum w k| over every input that no guard flags, in accumulator steps.

    weights [n, 2], trend [2, d], bias [2], centres [n, d]: integers as stored;  trust: trust.Trust
    enough    no better bound than this is looked for

    The inputs within guards and box are cut into cells, again and again where the bound is above `enough`.
    Within a cell of half widths h around c, with f the sum of kernels and L the length scale,

        |value - value(c)| <= |gradient(c)| . h + h . |curvature(c)| . h / 2 + sqrt(15)/6 |f| |h|^3 / L^3 :

    f is a member of the kernel's function space, where |f| = sqrt(w' K w) and every third derivative is at
    most |f| times the square root of the kernel's sixth, 15 / L^6. Each of the device's kernel values is
    within KERNEL_ERROR of the exact (sg_gp.h), and of every product less than 256 steps are left out.
    """
    rows = np.zeros((1, centres.shape[1])) if not trust.guards else trust.row[:, : centres.shape[1]]
    live = np.flatnonzero(np.any(centres, axis=0) | np.any(trend, axis=0) | np.any(rows, axis=0))
    length = U_STEPS * S_FRAC
    w, spot = weights.astype(float), centres[:, live] / U_STEPS
    slope, base = trend[:, live].T * (length / 16.0), bias / 16.0
    error = KERNEL_ERROR / 256.0 * np.abs(w).sum(axis=0) + (weights & 255).sum(axis=0) + 2.0
    if not len(live):
        return float(np.max(np.abs(base) + 256.0 * np.abs(w).sum(axis=0) + error))
    known, low, high = _constraints(trust, live)
    axes, start, end = _frame(known[: -len(live)], known, low, high)
    along = known @ axes
    gram = np.exp(-0.5 * ((spot[:, None] - spot) ** 2).sum(-1))
    norm = 256.0 * np.sqrt(np.maximum(np.einsum("io,ij,jo->o", w, gram, w), 0.0))

    def bound(middle, half):
        """Of the cells with these middles and half widths; -inf for cells without any input."""
        value = np.full(len(middle), -np.inf)
        inside = np.flatnonzero(
            np.all(
                (middle @ along.T + half @ np.abs(along).T >= low)
                & (middle @ along.T - half @ np.abs(along).T <= high),
                axis=1,
            )
        )
        middle, half = middle[inside], half[inside]
        x, size = middle @ axes.T, np.linalg.norm(half, axis=1)
        gap = x[:, None] - spot
        k = 256.0 * np.exp(-0.5 * (gap**2).sum(-1))
        gap = gap @ axes
        most = np.zeros(len(x))
        for o in range(2):
            f = k * w[:, o]
            gradient = np.abs(slope[:, o] @ axes - np.einsum("cn,cna->ca", f, gap))
            curve = np.einsum("cna,cn,cnb->cab", gap, f, gap) - f.sum(axis=1)[:, None, None] * np.eye(
                len(axes)
            )
            spread = np.sum(gradient * half, axis=1) + 0.5 * np.einsum(
                "ca,cab,cb->c", half, np.abs(curve), half
            )
            most = np.maximum(
                most,
                np.abs(base[o] + x @ slope[:, o] + f.sum(axis=1))
                + spread
                + CUBE * norm[o] * size**3
                + error[o],
            )
        value[inside] = most
        return value

    middle, half = 0.5 * (start + end)[None], 0.5 * (end - start)[None]
    worst, looked = 0.0, 0
    while len(middle):
        most = np.concatenate(
            [bound(middle[i : i + BLOCK], half[i : i + BLOCK]) for i in range(0, len(middle), BLOCK)]
        )
        looked += len(middle)
        again = most > enough
        if looked + 2 * again.sum() > CELLS_MAX:
            worst = max(worst, float(most.max()))
            break
        worst = max(worst, float(most[~again].max(initial=0.0)))
        middle, half = middle[again], half[again]
        axis = np.argmax(half, axis=1)
        step = np.zeros_like(half)
        picked = np.arange(len(half)), axis
        half[picked] *= 0.5
        step[picked] = half[picked]
        middle, half = np.vstack([middle - step, middle + step]), np.vstack([half, half])
    return float(worst * (1.0 + 1e-9))


def _constraints(trust, live):
    """What holds for every input that is not flagged, x in length scales: low <= rows @ x <= high.

    Guards first (they look at s >> 4, which lies up to 15 / 16 below s / 16), then the box.
    """
    length = U_STEPS * S_FRAC
    rows = np.asarray(trust.row, float)[:, live] if trust.guards else np.zeros((0, len(live)))
    low = 16.0 * trust.low - 15.0 * np.maximum(-rows, 0).sum(axis=1)
    high = 16.0 * trust.high + 15.0 * np.maximum(rows, 0).sum(axis=1)
    box = np.full(len(live), float(S_MAX))
    return np.vstack([rows, np.eye(len(live))]), np.r_[low, 0 * box] / length, np.r_[high, box] / length


def _frame(guards, known, low, high):
    """Orthonormal axes, columns of [d, d], the first of them spanning the guards, and their ranges (linear
    programs)."""
    axes = np.linalg.svd(guards.T)[0] if len(guards) else np.eye(known.shape[1])
    ends = []
    for axis in axes.T:
        pair = []
        for sign in (1.0, -1.0):
            found = linprog(sign * axis, np.vstack([known, -known]), np.r_[high, -low], bounds=(None, None))
            if found.status == 2:  # no input passes the guards
                return axes, np.zeros(len(axes)), np.zeros(len(axes))
            pair.append(axis @ found.x)
        ends.append(pair)
    return axes, *(np.array(ends).T + 1e-7 * np.array([[-1.0], [1.0]]))
