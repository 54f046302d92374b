# SPDX-License-Identifier: Apache-2.0
"""A sum of few kernels and a plane that imitates a function, its centres and length scales optimised.

    g(z) = sum_i w_i exp(-|a * z - c_i|^2 / 2) + b . (1, z)        z [d] input, a [d] gains, c_i [d] centres

Variable projection: for given gains and centres the weights are a linear least-squares problem, and what is
left
to minimise depends on gains and centres alone (Golub & Pereyra 1973; the Jacobian is Kaufman's, 1975).
Levenberg-Marquardt needs some 30 steps of it where L-BFGS needs a thousand, and its matrix is cheap: outputs
share the kernels, so that the normal matrix is the Gram matrix of the kernels' derivatives, projected once,
times the products of the weights, entry by entry. Good minima are found from above: more centres than wanted,
the least useful removed little by little (Hassibi & Stork 1993), the others moving on in between.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, blas, cho_factor, cho_solve, cholesky, solve_triangular

DAMPING_START, DAMPING_LEAST = 1e-2, 1e-9
TRIALS = 8  # of a step, with four times the damping each
STEP_MOST, GAIN_STEP_MOST = 0.5, 0.2  # length scales; natural log
PATIENCE = 3  # steps in a row that gain less than the tolerance
TOLERANCE = 2e-3  # of the mean squared residual
FLAT = 1e-9  # of the largest curvature: no direction counts as flatter
PRUNE_SHARE = 8  # a removal takes at most one in so many


@dataclass
class Problem:
    """What is imitated: y [m, outputs] at z [m, d], residuals in units of y's own spread.

    ridge      of a squared weight, relative to a squared residual
    gain_range [2, d] least and largest gain
    floor, top, low   centres lie between max(low, floor * a) and that plus `top`; low is -top / 2 unless
    given
    """

    z: np.ndarray
    y: np.ndarray
    ridge: float
    gain_range: np.ndarray
    floor: np.ndarray
    top: float
    low: np.ndarray = None

    def __post_init__(self):
        self.level = float(np.sqrt(np.mean((self.y - self.y.mean(axis=0)) ** 2))) or 1.0
        self.target = (self.y - self.y.mean(axis=0)) / self.level
        spread = np.where(self.z.std(axis=0) > 0, self.z.std(axis=0), 1.0)
        self.plane = np.vstack([np.ones(len(self.z)), ((self.z - self.z.mean(axis=0)) / spread).T])

    def bounds(self, gains):
        """Least and largest centre, [d] each."""
        low = np.maximum(-self.top / 2 if self.low is None else self.low, self.floor * gains)
        return low, low + self.top


class Expansion:
    """Gains a [d] and centres [n, d] (length scales) with their best weights for a Problem.

    cost  mean squared residual plus the ridge's part;  weights [n, outputs] in units of y.
    Raises numpy.linalg.LinAlgError where the normal matrix has no Cholesky factor.
    """

    def __init__(self, problem, gains, centres):
        self.problem, self.gains, self.centres = problem, gains, centres
        m = len(problem.z)
        self.x = problem.z * gains
        d2 = np.sum(centres**2, 1)[:, None] + np.sum(self.x**2, 1) - 2.0 * (centres @ self.x.T)
        self.design = np.vstack([np.exp(-0.5 * np.maximum(d2, 0.0)), problem.plane])
        normal = _gram(self.design)
        normal[np.diag_indices(len(normal))] += problem.ridge * m
        self.lower = cholesky(normal, lower=True, check_finite=False)
        self.scaled = cho_solve((self.lower, True), self.design @ problem.target, check_finite=False)
        self.residual = self.design.T @ self.scaled - problem.target
        self.cost = float(np.sum(self.residual**2) / m + problem.ridge * np.sum(self.scaled**2))

    rms = property(
        lambda self: self.problem.level * float(np.sqrt(np.mean(np.sum(self.residual**2, axis=1))))
    )
    weights = property(lambda self: self.scaled[: len(self.centres)] * self.problem.level)

    def without(self, count):
        """The same without the `count` centres whose removal, others refitted, costs least, one by one."""
        inverse = cho_solve((self.lower, True), np.eye(len(self.lower)), check_finite=False)
        weights, left = self.scaled.copy(), np.arange(len(self.centres))
        for _ in range(count):
            harm = np.sum(weights[left] ** 2, axis=1) / np.diag(inverse)[left]
            gone = left[np.argmin(harm)]
            left = left[left != gone]
            column = inverse[:, gone] / inverse[gone, gone]
            weights = weights - np.outer(column, weights[gone])
            inverse = inverse - np.outer(column, inverse[gone])
        return Expansion(self.problem, self.gains, self.centres[left])

    def improved(self, steps, frozen=None, tolerance=TOLERANCE):
        """At most `steps` steps of Levenberg-Marquardt further.

        frozen  bool [n, d]: coordinates of centres that stay; with it the gains stay too
        """
        now, damping, slow = self, DAMPING_START, 0
        for _ in range(steps):
            found = now._step(damping, frozen)
            if found is None:
                break
            best, damping = found
            gain = 1.0 - best.cost / now.cost if now.cost > 0 else 0.0
            now, damping = best, max(damping / 4, DAMPING_LEAST)
            slow = slow + 1 if gain < tolerance else 0
            if slow >= PATIENCE:
                break
        return now

    def gradient(self):
        """Derivative of m * cost / 2 in the centres [n, d] and in the log gains [d], centres moving along."""
        slopes, bends = self._derivatives()
        pull = self._by_weight(slopes @ self.residual)
        return pull.T, sum(bend @ self.residual[:, o] for o, bend in enumerate(bends))

    def _derivatives(self):
        """Of the kernels in the centres, [d, n, m]; of every output in the log gains, list of [d, m]."""
        n, d = self.centres.shape
        k, weights = self.design[:n], self.scaled[:n]
        slopes, bends = np.empty((d, n, k.shape[1])), [
            np.empty((d, k.shape[1])) for _ in range(weights.shape[1])
        ]
        for j in range(d):
            gap = self.x[:, j] - self.centres[:, j, None]
            np.multiply(k, gap, out=slopes[j])
            gap *= slopes[j]
            for o, bend in enumerate(bends):
                bend[j] = -(weights[:, o] @ gap)
        return slopes, bends

    def _by_weight(self, values):
        """[d, n, outputs] -> [d, n], summed with the weights."""
        return np.sum(values * self.scaled[: len(self.centres)], axis=2)

    def _step(self, damping, frozen):
        """(a better Expansion, the damping that made it), or None."""
        problem, (n, d) = self.problem, self.centres.shape
        slopes, bends = self._derivatives()
        if frozen is not None:
            bends = []
        rows = np.vstack([slopes.reshape(d * n, -1), *bends])
        across = solve_triangular(self.lower, self.design @ rows.T, lower=True, check_finite=False)
        gram = _gram(rows) - across.T @ across
        size = d * n
        weight = np.tile(self.scaled[:n], (d, 1))
        curve, slope = (
            gram[:size, :size] * (weight @ weight.T),
            self._by_weight(slopes @ self.residual).ravel(),
        )
        if bends:
            parts = [slice(size + o * d, size + (o + 1) * d) for o in range(len(bends))]
            mixed = sum(weight[:, o, None] * gram[:size, part] for o, part in enumerate(parts))
            curve = np.block([[curve, mixed], [mixed.T, sum(gram[part, part] for part in parts)]])
            slope = np.r_[slope, sum(bend @ self.residual[:, o] for o, bend in enumerate(bends))]
        free = self._free(slope, frozen)
        if not free.any():
            return None
        curve, slope = curve[np.ix_(free, free)], slope[free]
        steep = np.maximum(np.diag(curve), FLAT * np.diag(curve).max())
        for _ in range(TRIALS):
            damped = curve.copy()
            damped[np.diag_indices(len(damped))] += damping * steep
            try:
                move = np.zeros(len(free))
                move[free] = cho_solve(cho_factor(damped, check_finite=False), -slope, check_finite=False)
                trial = Expansion(problem, *self._moved(move, frozen))
            except (LinAlgError, ValueError):
                damping *= 10
                continue
            if trial.cost < self.cost:
                return trial, damping
            damping *= 4
        return None

    def _free(self, slope, frozen):
        """Which variables may move: neither frozen nor pressed against a bound. bool, as `slope`."""
        n, d = self.centres.shape
        low, high = self.problem.bounds(self.gains)
        centres, pull = self.centres.T, slope[: d * n].reshape(d, n)
        held = ((centres <= low[:, None]) & (pull > 0)) | ((centres >= high[:, None]) & (pull < 0))
        if frozen is not None:
            return ~(held | frozen.T).ravel()
        least, most = self.problem.gain_range
        pull = slope[d * n :]
        return ~np.r_[
            held.ravel(), ((self.gains <= least) & (pull > 0)) | ((self.gains >= most) & (pull < 0))
        ]

    def _moved(self, move, frozen):
        n, d = self.centres.shape
        shift = np.clip(move[: d * n], -STEP_MOST, STEP_MOST).reshape(d, n).T
        if frozen is not None:
            low, high = self.problem.bounds(self.gains)
            return self.gains, np.where(frozen, self.centres, np.clip(self.centres + shift, low, high))
        growth = np.exp(np.clip(move[d * n :], -GAIN_STEP_MOST, GAIN_STEP_MOST))
        gains = np.clip(self.gains * growth, *self.problem.gain_range)
        return gains, np.clip(self.centres * (gains / self.gains) + shift, *self.problem.bounds(gains))


def pruned(start, wanted, steps):
    """Expansions of len(start.centres), then fewer and fewer centres down to `wanted`, each improved."""
    now = start
    yield now
    while len(now.centres) > wanted:
        n = len(now.centres)
        now = now.without(min(n - wanted, max(1, n // PRUNE_SHARE))).improved(steps)
        yield now


def spread_start(problem, count, gains, pool):
    """An Expansion with centres at `count` rows of pool [k, d], each as far as possible from those before."""
    x = pool * gains
    chosen = [int(np.argmin(((x - x.mean(axis=0)) ** 2).sum(1)))]
    nearest = np.full(len(x), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, ((x - x[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(np.argmax(nearest)))
    return Expansion(problem, gains, np.clip(x[chosen], *problem.bounds(gains)))


def _gram(rows):
    """rows @ rows.T, symmetric to the bit."""
    upper = blas.dsyrk(1.0, rows.T, trans=1)
    return np.triu(upper) + np.triu(upper, 1).T
