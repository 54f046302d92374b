# SPDX-License-Identifier: Apache-2.0
"""The proof that a device model's final sum fits its 24-bit accumulator, whatever the features."""

import numpy as np

from .model import S_FRAC, S_MAX, U_STEPS

KERNEL_ERROR = 4.0  # of a device kernel value, Q0.16 steps, S2's rounding included (sg_gp.h)
CELL, CELLS_MAX = 0.2, 20_000  # length scales; see reach()


def reach(weights, trend, bias, centres, rails):
    """Bound of |bias + trend . s + sum w k| over every input that no guard flags, in accumulator steps.

    The guards' parallelepiped is cut into cells. Within a cell of half widths h around c, with f the sum of
    kernels and L the length scale,   |value - value(c)| <= |gradient(c) . h| + sqrt(3)/2 |f| |h|^2 / L^2 :
    f is a member of the kernel's function space, where |f| = sqrt(w' K w) and every second derivative is at
    most |f| times the square root of the kernel's fourth, 3 / L^4. Each of the device's kernel values is
    within KERNEL_ERROR of the exact (sg_gp.h).
    """
    live = np.flatnonzero(centres.any(axis=0) | np.any(trend, axis=0))
    rows, low, high = _slabs(rails, live)
    length = U_STEPS * S_FRAC
    columns = np.linalg.inv(rows) / length
    extent = np.linalg.norm(columns, axis=0) * (high - low)
    cell = CELL
    while np.prod(np.ceil(extent / cell)) > CELLS_MAX:
        cell *= 1.1
    cuts = np.ceil(extent / cell).astype(int)
    parts = [lo + (np.arange(cut) + 0.5) * (hi - lo) / cut for lo, hi, cut in zip(low, high, cuts)]
    middle = np.stack([g.ravel() for g in np.meshgrid(*parts, indexing="ij")], axis=1) @ columns.T
    half = columns * (high - low) / (2 * cuts)
    size2 = np.abs(half.T @ half).sum()
    overlap = np.abs(half).sum(axis=1)  # cells outside the box hold no input
    middle = middle[((middle > -overlap) & (middle < S_MAX / length + overlap)).all(axis=1)]
    spot = centres[:, live] / U_STEPS
    gram = np.exp(-0.5 * ((spot[:, None] - spot) ** 2).sum(-1))
    norm = np.sqrt(
        np.maximum(np.einsum("io,ij,jo->o", weights.astype(float), gram, weights.astype(float)), 0.0)
    )
    worst = 0.0
    for block in np.array_split(middle, max(1, len(middle) // 2000)):
        k = 256.0 * np.exp(-0.5 * ((block[:, None] - spot) ** 2).sum(-1))
        for o in range(2):
            w, slope = weights[:, o].astype(float), trend[o, live].astype(float) * length / 16
            value = bias[o] / 16 + block @ slope + k @ w
            gradient = slope + (k * w) @ spot - (k @ w)[:, None] * block
            spread = np.abs(gradient @ half).sum(axis=1) + 256.0 * np.sqrt(3.0) / 2 * norm[o] * size2
            worst = max(worst, np.max(np.abs(value) + spread) + KERNEL_ERROR / 256 * np.abs(w).sum() + 256.0 * len(w))
    return float(worst * (1.0 + 1e-9))


def _slabs(rails, live):
    """Rows [d, d] and their ranges that hold every input in the box and within the guards.

    The guards' directions are completed to all d by axes of the box, most independent first.
    """
    d = len(live)
    rows, low, high = [], [], []
    for row, least, most in zip(rails.row[:, live].astype(float), rails.low, rails.high):
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
    return np.array(rows[:d]), np.array(low[:d]), np.array(high[:d])
