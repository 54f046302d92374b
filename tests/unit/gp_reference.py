# SPDX-License-Identifier: Apache-2.0
"""Kernels written out, a Gaussian process in 60 decimal digits, and the simulated data gp.py is judged on.

Gaussian elimination from the definitions of the kernels; it shares no line with the product.
"""

import warnings
from decimal import Decimal, getcontext

import numpy as np

from sparsegaze.gp import GaussianProcess, Hyper

getcontext().prec = 60
LENGTH = np.array([900.0, 1200, 700, 1500, 1000, 800])
KERNELS = [
    ("rbf", None),
    ("matern52", None),
    ("laplace", None),
    ("minkowski", 0.5),
    ("minkowski", 1.5),
    ("canberra", None),
    ("cosine", None),
]
CASES = {
    "rbf": ("rbf", None, None),
    "matern52": ("matern52", None, None),
    "laplace": ("laplace", None, None),
    "laplace to the 0.5": ("laplace", None, 0.5),
    "p=0.5": ("minkowski", 0.5, None),
    "p=1": ("minkowski", 1.0, None),
    "p=1.5": ("minkowski", 1.5, None),
    "p=1.5, unsquared": ("minkowski", 1.5, 1.0),
    "p=2": ("minkowski", 2.0, None),
    "p=2, unsquared": ("minkowski", 2.0, 1.0),
    "p=3": ("minkowski", 3.0, None),
    "p=10": ("minkowski", 10.0, None),
    "p=inf": ("minkowski", np.inf, None),
    "canberra": ("canberra", None, None),
    "canberra to the 0.5": ("canberra", None, 0.5),
    "cosine": ("cosine", None, None),
}


def written_out(case, a, b, length):
    """The kernel from its definition, entry by entry; length may be complex."""
    name, p, q = CASES[case]
    gap = np.abs(a[:, None] - b[None]) / length
    if name == "rbf":
        return np.exp(-np.sum(gap**2, -1) / 2)
    if name == "matern52":
        r = np.sqrt(5 * np.sum(gap**2, -1) + 0j)
        return (1 + r + r**2 / 3) * np.exp(-r)
    if name == "cosine":
        norms = np.linalg.norm(a, axis=1)[:, None] * np.linalg.norm(b, axis=1)
        return np.exp((a @ b.T / norms - 1) / length[0] ** 2)
    if name == "canberra":
        total = a[:, None] + b[None]
        return np.exp(-(np.sum(np.abs(a[:, None] - b) / total / length, -1) ** (q or 1.0)))
    p = 1.0 if name == "laplace" else p
    q = q or min(p, 2.0 if p <= 2 else 1.0)
    if np.isinf(p):
        return np.exp(-np.take_along_axis(gap, np.argmax(gap.real, -1)[..., None], -1)[..., 0] ** q)
    inner = np.sum(np.where(gap == 0, 0, np.where(gap == 0, 1, gap) ** p), -1)
    return np.exp(-np.where(inner == 0, 0, np.where(inner == 0, 1, inner) ** (q / p)))


def recording(n, seed=0, noise_deg=0.2, step_noise=5.0):
    """Six smooth channels over +-20 deg of a simulated eye: (features [n, 6], gaze [n, 2])."""
    rng = np.random.default_rng([11, seed])
    gaze = rng.uniform(-20, 20, (n, 2))
    angle = np.arange(6) * np.pi / 3
    place = 25 * np.stack([np.cos(angle), np.sin(angle)], 1)
    bump = np.exp(-((gaze[:, None] - place) ** 2).sum(-1) / (2 * 18.0**2))
    features = 45000 + 4096 * np.log2(1 - 0.5 * bump) + step_noise * rng.standard_normal((n, 6))
    return features, gaze + noise_deg * rng.standard_normal((n, 2))


def quietly(*args, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return GaussianProcess.fit(*args, **kwargs)


def exactly(values):
    return [Decimal(float(v)) for v in values]


def decimal_kernel(name, p, a, b, length):
    gaps = [abs(u - v) for u, v in zip(a, b)]
    scaled = [g / w for g, w in zip(gaps, length)]
    if name == "rbf":
        return (-sum(g * g for g in scaled) / 2).exp()
    if name == "matern52":
        r = (5 * sum(g * g for g in scaled)).sqrt()
        return (1 + r + r * r / 3) * (-r).exp()
    if name == "canberra":
        return (-sum(g / (u + v) / w for g, u, v, w in zip(gaps, a, b, length))).exp()
    if name == "cosine":
        norm = (sum(u * u for u in a) * sum(v * v for v in b)).sqrt()
        return ((sum(u * v for u, v in zip(a, b)) / norm - 1) / length[0] ** 2).exp()
    power = Decimal(1 if name == "laplace" else p)
    return (-sum((g.ln() * power).exp() if g else Decimal(0) for g in scaled)).exp()


def decimal_solve(matrix, right):
    """Gaussian elimination with pivoting."""
    n, rows = len(matrix), [a[:] + b[:] for a, b in zip(matrix, right)]
    for i in range(n):
        pivot = max(range(i, n), key=lambda r: abs(rows[r][i]))
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for r in range(i + 1, n):
            f = rows[r][i] / rows[i][i]
            if f:
                rows[r] = [u - f * v for u, v in zip(rows[r], rows[i])]
    result = [None] * n
    for i in reversed(range(n)):
        done = [sum(rows[i][c] * result[c][o] for c in range(i + 1, n)) for o in range(len(right[0]))]
        result[i] = [(rows[i][n + o] - d) / rows[i][i] for o, d in enumerate(done)]
    return result


def reference(gp, query, p=None):
    """The mean [m, 2] of gp at query in 60 digits, the jitter it reports included."""
    length = exactly(gp.hyper.length)
    s2, noise2 = Decimal(float(gp.hyper.signal_deg)) ** 2, Decimal(float(gp.hyper.noise_deg)) ** 2
    x = [exactly(row) for row in gp.x]
    k = [[s2 * decimal_kernel(gp.kernel.name, p, a, b, length) for b in x] for a in x]
    for i, scale in enumerate(exactly(gp.noise_scale)):
        k[i][i] += noise2 * scale
    extra = Decimal(gp.jitter) * sum(k[i][i] for i in range(len(x))) / len(x)
    for i in range(len(x)):
        k[i][i] += extra
    columns = {"zero": 0, "constant": 1, "linear": 7}[gp.mean]
    basis = [([Decimal(1)] + row)[:columns] for row in x]
    zeros = [Decimal(0)] * columns
    k = [row + h for row, h in zip(k, basis)] + [[h[c] for h in basis] + zeros for c in range(columns)]
    weights = decimal_solve(k, [exactly(row) for row in gp.y] + [[Decimal(0)] * 2] * columns)
    rows = [
        [s2 * decimal_kernel(gp.kernel.name, p, q, b, length) for b in x] + ([Decimal(1)] + q)[:columns]
        for q in map(exactly, query)
    ]
    return np.array([[float(sum(u * w[o] for u, w in zip(row, weights))) for o in (0, 1)] for row in rows])


def hyper_for(name, scale, signal_deg, noise_deg):
    length = LENGTH * {"canberra": 1e-5}.get(name, 1.0) * scale
    return Hyper(np.full(6, 0.05 * scale) if name == "cosine" else length, signal_deg, noise_deg)
