# SPDX-License-Identifier: Apache-2.0
"""The Cholesky factor of a covariance matrix: jitter, condition, inverse, and the repair of a matrix that is none."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh, lapack, svdvals
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from .errors import CalibrationError

JITTERS = (0.0, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6)  # relative to the mean diagonal, tried in turn
EPS = float(np.finfo(float).eps)
CONDITION_MOST = 0.1 / EPS  # 4.5e14: beyond it the least eigenvalue is within ten roundings of the largest
DENSE_MOST = 800  # rows up to which singular values are computed outright
RANK_TOLERANCE = 1e-12  # of the largest eigenvalue: smaller ones are removed by a repair


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

    From the singular values of the factor, which lose half as many digits as eigenvalues of the matrix would; by
    Lanczos iteration above DENSE_MOST rows, to 1e-3. Below 1 / CONDITION_MOST of the largest the smallest is
    rounding, whatever computes it.
    """
    lower = factor[0]
    n = len(lower)
    if n > DENSE_MOST:
        start = np.random.default_rng(1).standard_normal(n)
        whole = LinearOperator((n, n), matvec=lambda v: lower @ (lower.T @ v))
        undone = LinearOperator((n, n), matvec=lambda v: cho_solve(factor, v, check_finite=False))
        try:
            return tuple(
                float(eigsh(m, 1, which="LA", v0=start, tol=1e-3, ncv=40, return_eigenvectors=False)[0]) ** sign
                for m, sign in ((whole, 1), (undone, -1))
            )
        except ArpackNoConvergence:
            pass
    singular = svdvals(lower, check_finite=False)
    return float(singular[0] ** 2), float(max(singular[-1] ** 2, np.finfo(float).tiny))


def repaired(matrix):
    """The covariance matrix nearest to a symmetric matrix: (repaired [n, n], eigenvalues [n], vectors [n, n]).

    Eigenvalues below RANK_TOLERANCE of the largest are set to 0: the nearest positive semidefinite matrix in the
    Frobenius norm (Higham 1988).
    """
    values, vectors = eigh(matrix, check_finite=False)
    kept = vectors[:, values > RANK_TOLERANCE * values[-1]]
    result = (kept * values[-kept.shape[1] :]) @ kept.T
    return 0.5 * (result + result.T), values, vectors


def repaired_slope(slope, values, vectors):
    """Derivative in the matrix, given the derivative `slope` in the repaired one (Loewner's divided differences)."""
    after = np.where(values > RANK_TOLERANCE * values[-1], values, 0.0)
    gap = values[:, None] - values
    same = np.abs(gap) <= 1e-14 * values[-1]
    ratio = np.where(same, 0.0, after[:, None] - after) / np.where(same, 1.0, gap)
    ratio = np.where(same, ((after[:, None] > 0) & (after > 0)).astype(float), ratio)
    return vectors @ (ratio * (vectors.T @ slope @ vectors)) @ vectors.T


def residual(cov, jitter, alpha, target):
    """target - (cov + jitter mean diagonal) alpha, accumulated in extended precision where there is one: [n, o]."""
    weights = alpha.astype(np.longdouble)
    extra = jitter * float(np.mean(np.diag(cov)))
    out = np.empty(alpha.shape)
    for start in range(0, len(cov), 256):
        rows = slice(start, start + 256)
        out[rows] = target[rows] - cov[rows].astype(np.longdouble) @ weights - extra * weights[rows]
    return out
