# SPDX-License-Identifier: Apache-2.0
"""A symmetric matrix of similarities that is no covariance, made into the nearest one that is.

Negative eigenvalues are set to 0 (Higham 1988: the nearest positive semidefinite matrix). Weights of the
matrix as it is would be meaningless, and adding the missing eigenvalue as noise leaves one direction that
is almost singular: on simulated recordings and p = 10 that missed by 700 deg where this misses by 1.
"""

import numpy as np
from scipy.linalg import eigh

RANK_TOLERANCE = 1e-12  # of the largest eigenvalue: smaller ones are removed as well


class Repair:
    """matrix [n, n] repaired;  values [r], vectors [n, r] of its range;  least, negative: smallest
    eigenvalue and number of negative ones before;  share: of the sum of |eigenvalues| that was removed
    """

    def __init__(self, matrix):
        values, vectors = eigh(matrix, check_finite=False)
        kept = values > RANK_TOLERANCE * values[-1]
        self.values, self.vectors = values[kept], vectors[:, kept]
        self.matrix = (self.vectors * self.values) @ self.vectors.T
        self.matrix = 0.5 * (self.matrix + self.matrix.T)
        self.least = float(values[0])
        self.negative = int((values < -np.finfo(float).eps * len(values) * values[-1]).sum())
        self.share = float(np.abs(values[values < 0]).sum() / np.abs(values).sum())
        self._all = values, vectors

    def slope(self, slope):
        """Derivative in the matrix before, given that in the repaired one (Loewner's divided differences)."""
        values, vectors = self._all
        after = np.where(values > RANK_TOLERANCE * values[-1], values, 0.0)
        gap = values[:, None] - values
        same = np.abs(gap) <= 1e-14 * values[-1]
        ratio = np.where(same, 0.0, after[:, None] - after) / np.where(same, 1.0, gap)
        ratio = np.where(same, (after[:, None] > 0) & (after > 0), ratio)
        return vectors @ (ratio * (vectors.T @ slope @ vectors)) @ vectors.T

    def project(self, weights):
        """Weights [n, o] that give on the matrix before what `weights` give on the repaired one."""
        return self.vectors @ (self.vectors.T @ weights)

    def extend(self, k, variance):
        """Covariances [m, n] and variances [m] at new places, from similarities k [m, n] with the data.

        The process whose covariance is k(x, X) K+^-1 k(X, x'), K+ the repaired matrix on its range
        (Nystroem's extension), plus what of `variance` that leaves out, as noise of its own at each place.
        It is positive definite everywhere and equals K+ on the data, so that no predicted variance is
        negative.
        """
        along = k @ self.vectors
        return along @ self.vectors.T, np.maximum(variance, np.sum(along * along / self.values, axis=1))
