# SPDX-License-Identifier: Apache-2.0
"""The Cholesky factor of a covariance matrix: jitter, condition number, inverse, residual."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack, svdvals
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from .errors import CalibrationError

JITTERS = (0.0, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6)  # relative to the mean diagonal, tried in turn
EPS = float(np.finfo(float).eps)
CONDITION_MOST = 0.1 / EPS  # 4.5e14: beyond it the least eigenvalue is within ten roundings of the largest
DENSE_MOST = 800  # rows up to which singular values are computed outright


def cholesky(cov, jitters=JITTERS):
    """Lower Cholesky factor of cov with the least of the jitters that works: (cho_factor tuple, jitter).

    cov [n, n]; jitters relative to its mean diagonal. Raises CalibrationError when none works.
    """
    diagonal = float(np.mean(np.diag(cov)))
    for jitter in jitters:
        try:
            c, lower = cho_factor(
                cov + jitter * diagonal * np.eye(len(cov)) if jitter else cov, lower=True, check_finite=False
            )
        except np.linalg.LinAlgError:
            continue
        if np.isfinite(np.diag(c)).all():
            return (np.tril(c), lower), jitter
    raise CalibrationError(
        "the covariance matrix is numerically singular", "remove duplicate samples or allow more noise"
    )


def inverse(lower):
    """K^-1 from its Cholesky factor, for traces and diagonals that need its entries (never for a solve)."""
    result, status = lapack.dpotri(lower, lower=1)
    assert status == 0
    return np.tril(result) + np.tril(result, -1).T


def extremes(factor):
    """Largest and smallest eigenvalue of the matrix that was factored.

    From the singular values of the factor, which lose half as many digits as eigenvalues of the matrix
    would; by Lanczos iteration above DENSE_MOST rows, to 1e-3. Below 1 / CONDITION_MOST of the largest the
    smallest is rounding, whatever computes it.
    """
    lower = factor[0]
    n = len(lower)
    if n > DENSE_MOST:
        start = np.random.default_rng(1).standard_normal(n)
        whole = LinearOperator((n, n), matvec=lambda v: lower @ (lower.T @ v))
        undone = LinearOperator((n, n), matvec=lambda v: cho_solve(factor, v, check_finite=False))
        try:
            how = {"which": "LA", "v0": start, "tol": 1e-3, "ncv": 40, "return_eigenvectors": False}
            return float(eigsh(whole, 1, **how)[0]), 1.0 / float(eigsh(undone, 1, **how)[0])
        except ArpackNoConvergence:
            pass
    singular = svdvals(lower, check_finite=False)
    return float(singular[0] ** 2), float(max(singular[-1] ** 2, np.finfo(float).tiny))


def leftover(cov, jitter, alpha, target, entries, lost):
    """Bound of what alpha [n, o] leaves of (K + jitter mean diagonal) alpha = target, K exact: [n, o].

    The residual of the stored matrix, accumulated in extended precision where there is one, and what
    rounding of its entries adds: eps (g |entry| + h), entries = (g, h); and `lost` per root-mean-square
    weight.

    A mean k(x, X) alpha + h(x) b is off by w' r + m' t: r this, t what is left of H' alpha = 0, w the
    weights of the data in the mean at x, m the multipliers of its columns. Exact, but for w and m, which
    are computed.
    """
    weights, size = alpha.astype(np.longdouble), np.abs(alpha)
    extra = jitter * float(np.mean(np.diag(cov)))
    out = np.empty(alpha.shape)
    for start in range(0, len(cov), 256):
        rows = slice(start, start + 256)
        out[rows] = target[rows] - cov[rows].astype(np.longdouble) @ weights - extra * weights[rows]
    spread = entries[0] * (np.abs(cov) @ size) + entries[1] * size.sum(axis=0)
    return np.abs(out) + EPS * spread + lost * np.sqrt(np.mean(size**2, axis=0))


def last_sum(cov, alpha, entries):
    """Bound of the rounding of sum_i k(x, x_i) alpha_i itself, where kernels are like the data's: [o]."""
    size = np.abs(alpha)
    return EPS * ((entries[0] + len(size)) * (np.abs(cov) @ size).max(axis=0) + entries[1] * size.sum(axis=0))
