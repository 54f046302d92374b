# SPDX-License-Identifier: Apache-2.0
"""The marginal likelihood of a Gaussian process with two outputs, its gradient, and its maximum.

    log p = sum_o -1/2 r_o' K^-1 r_o  - log|K| - n log 2 pi      r = y - H b, b by generalised least squares
    d log p / d theta = 1/2 tr((sum_o a_o a_o' - 2 K^-1) dK)      a = K^-1 r      (R & W equation 5.9)

The likelihood is stationary in b, so that b's own derivative drops out.
"""

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize

from .errors import CalibrationError
from .factor import cholesky, inverse
from .repair import Repair
from .samples import spread

LENGTH_RANGE = (0.05, 100.0)  # in natural units: standard deviations of the channel for most kernels
SIGNAL_RANGE = (1e-2, 1e3)  # in rms gaze
NOISE_RANGE = (1e-4, 1.0)
START_SPREAD = 0.7  # natural log, of the random restarts
JITTER_NOISE_FREE = 1e-10  # of the signal variance, while a process without noise learns
LEARN_ROWS_REPAIRED = 200  # of a kernel whose matrix is repaired: each evaluation takes a spectrum
REFINE_ROWS, REFINE_EVALUATIONS = 2000, 14  # rows and evaluations of the polish: 0.5 s each at 2000 rows
STACK_MOST = 600  # rows up to which the terms of all channels are kept: 8 n^2 d bytes
IMPOSSIBLE = -1e25


class Likelihood:
    """The problem to be maximised: theta = log of (lengths [L], signal[, noise][, group]) in natural units.

    kernel   Kernel; z [n, d] its natural coordinates; unit [L] the natural units there
    y [n, 2] gaze over its rms;  h [n, c] columns of the mean;  noise_scale [n];  groups int [n]
    noise_free  no noise parameter;  group_noise  one more, the error that a group shares
    """

    def __init__(self, kernel, z, unit, y, h, noise_scale, groups, noise_free=False, group_noise=False):
        self.kernel, self.z, self.y, self.h = kernel, z, y, h
        self.noise_scale, self.groups = noise_scale, groups
        self.unit, self.noise_free, self.group_noise = np.asarray(unit, float), noise_free, group_noise
        self.sound = kernel.definite(z.shape[1])
        self._stack = None
        if len(z) <= STACK_MOST and kernel.additive:
            a = kernel.coordinates(z)
            self._stack = np.stack(list(kernel.terms(a, a)))

    def part(self, rows):
        """The same problem on some of the rows."""
        return Likelihood(
            self.kernel,
            self.z[rows],
            self.unit,
            self.y[rows],
            self.h[rows],
            self.noise_scale[rows],
            self.groups[rows],
            self.noise_free,
            self.group_noise,
        )

    def bounds(self, length_max=LENGTH_RANGE[1]):
        """[len(theta), 2]"""
        scales = [SIGNAL_RANGE] + [NOISE_RANGE] * ((not self.noise_free) + bool(self.group_noise))
        return np.log([(LENGTH_RANGE[0], length_max)] * len(self.unit) + scales)

    def start(self, length_max=LENGTH_RANGE[1]):
        """Where a search begins."""
        length = min(self.kernel.start, 0.7 * length_max)
        scales = [3.0] + [0.05] * (not self.noise_free) + [0.03] * bool(self.group_noise)
        return np.log(np.r_[np.full(len(self.unit), length), scales])

    def __call__(self, theta):
        """(log likelihood, gradient [len(theta)]); IMPOSSIBLE where the matrix cannot be factored."""
        lengths, n = len(self.unit), len(self.z)
        kernel, signal2 = self.kernel, np.exp(2 * theta[lengths])
        u, c = self._distance(theta[:lengths])
        k = signal2 * kernel.shape(u)
        repair = None if self.sound else Repair(0.5 * (k + k.T))
        cov = k.copy() if self.sound else repair.matrix + repair.noise * np.eye(n)
        at = lengths + 1
        if self.noise_free:
            noise = np.full(n, JITTER_NOISE_FREE * signal2)
        else:
            noise, at = np.exp(2 * theta[at]) * self.noise_scale, at + 1
        cov[np.diag_indices(n)] += noise
        same = (self.groups[:, None] == self.groups).astype(float) if self.group_noise else None
        if same is not None:
            cov += np.exp(2 * theta[at]) * same
        try:
            factor, _ = cholesky(cov)
        except CalibrationError:
            return IMPOSSIBLE, np.zeros_like(theta)
        r = self.y
        if self.h.shape[1]:
            white = solve_triangular(factor[0], self.h, lower=True)
            b = np.linalg.lstsq(white, solve_triangular(factor[0], self.y, lower=True), rcond=1e-12)[0]
            r = self.y - self.h @ b
        alpha = cho_solve(factor, r)
        value = -0.5 * np.sum(r * alpha) - 2 * np.sum(np.log(np.diag(factor[0]))) - n * np.log(2 * np.pi)
        m = alpha @ alpha.T - 2 * inverse(factor[0])
        slope = np.empty_like(theta)
        before = m if self.sound else repair.slope(m)
        slope[:lengths] = 0.5 * self._length_sums(before * (signal2 * kernel.fall(u)), theta[:lengths], u, c)
        slope[lengths] = np.sum(before * k)
        if self.noise_free:
            slope[lengths] += np.sum(np.diag(m) * noise)
        else:
            slope[lengths + 1] = np.sum(np.diag(m) * noise)
        if same is not None:
            slope[at] = np.exp(2 * theta[at]) * np.sum(m * same)
        return value, slope

    def _distance(self, log_length):
        if self._stack is None:
            return self.kernel.distance(self.z, self.z, np.exp(log_length) * self.unit), None
        c = np.exp(-self.kernel.degree * (log_length + np.log(self.unit)))
        return np.tensordot(c, self._stack, 1), c

    def _length_sums(self, weight, log_length, u, c):
        if c is None:
            return self.kernel.length_sums(weight, self.z, np.exp(log_length) * self.unit, u)
        return self.kernel.degree * c * [np.sum(weight * term) for term in self._stack]


def maximise(problem, starts, length_max, tight=False):
    """The best of several searches by L-BFGS-B: (theta, log likelihood). starts: list of theta."""
    bounds = problem.bounds(length_max)

    def objective(theta):
        value, slope = problem(theta)
        return -value, -slope

    options = {"maxiter": 1000, "ftol": 1e-13, "gtol": 1e-6, "maxls": 50} if tight else {"maxiter": 200}
    best = None
    for guess in starts:
        found = minimize(
            objective, np.clip(guess, *bounds.T), jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
        if best is None or found.fun < best.fun - 1e-6:
            best = found
    return best.x, -float(best.fun)


def random_starts(problem, count, seed, length_max):
    """The standard start and `count` random ones about it."""
    start = problem.start(length_max)
    rng = np.random.default_rng([0x6770, seed])
    return [start] + [start + START_SPREAD * rng.standard_normal(len(start)) for _ in range(count)]


def learn(problem, length_max, restarts, seed, rows):
    """theta near the maximum: searched from several starts on at most `rows` rows, then `polish`ed."""
    n = len(problem.z)
    part = problem.part(spread(n, rows if problem.sound else min(rows, LEARN_ROWS_REPAIRED)))
    theta, _ = maximise(part, random_starts(part, restarts, seed, length_max), length_max)
    return theta if len(part.z) == n else polish(problem, theta, length_max, len(part.z))


def polish(problem, theta, length_max, rows):
    """theta nearer to the maximum on REFINE_ROWS, curvature from `rows` of them; a repair is left alone."""
    if not problem.sound:
        return theta
    n = len(problem.z)
    whole, part = problem.part(spread(n, REFINE_ROWS)), problem.part(spread(n, rows))
    return refine(whole, part, theta, length_max, REFINE_EVALUATIONS)[0]


def thorough(problem, theta, length_max, restarts, seed):
    """How much log likelihood theta lacks of the best of many tight searches, nats, >= 0.

    Searched on STACK_MOST rows; the three best and theta are followed to convergence on up to REFINE_ROWS.
    """
    whole = problem.part(spread(len(problem.z), REFINE_ROWS))
    part = whole.part(spread(len(whole.z), STACK_MOST))
    starts = [theta] + random_starts(part, restarts, seed, length_max)
    ends = [maximise(part, [start], length_max, tight=True) for start in starts]
    ends = [theta] + [end for end, _ in sorted(ends, key=lambda end: -end[1])[:3]]
    best = max(maximise(whole, [end], length_max, tight=True)[1] for end in ends)
    return float(max(0.0, best - whole(theta)[0]))


def refine(problem, part, theta, length_max, evaluations):
    """A few quasi-Newton steps on `problem` from the maximum of its `part`: (theta, value, evaluations).

    The curvature of the part, scaled by the number of rows, is the first guess of the whole's, so that the
    first step is nearly Newton's; BFGS updates it. Never returns less likelihood than it was given.
    """
    bounds = problem.bounds(length_max)
    theta = np.clip(theta, *bounds.T)
    curvature = _curvature(part, theta) * (len(problem.z) / len(part.z))
    value, slope = problem(theta)
    used = 1
    while used < evaluations:
        at_bound = (theta <= bounds[:, 0]) & (slope < 0) | (theta >= bounds[:, 1]) & (slope > 0)
        free = np.flatnonzero(~at_bound)
        if not len(free):
            break
        step = np.zeros_like(theta)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], slope[free])
        if slope @ step < 1e-4:  # twice the gain that is left, in natural log units
            break
        step /= max(1.0, np.abs(step).max())
        while used < evaluations:
            trial = np.clip(theta + step, *bounds.T)
            moved = trial - theta
            found, found_slope = problem(trial)
            used += 1
            if found >= value + 1e-4 * (slope @ moved):
                break
            rise = slope @ moved  # the least of the parabola through value, slope and what was found
            step = moved * np.clip(0.5 * rise / max(rise - (found - value), 1e-300), 0.1, 0.5)
        else:
            break
        change = slope - found_slope
        if change @ moved > 1e-10 * np.linalg.norm(change) * np.linalg.norm(moved):
            push = curvature @ moved
            curvature += np.outer(change, change) / (change @ moved) - np.outer(push, push) / (moved @ push)
        theta, value, slope = trial, found, found_slope
    return theta, value, used


def _curvature(problem, theta, step=1e-3):
    """Minus the second derivative of the log likelihood, made positive definite."""
    rows = []
    for i in range(len(theta)):
        shift = np.zeros_like(theta)
        shift[i] = step
        rows.append((problem(theta - shift)[1] - problem(theta + shift)[1]) / (2 * step))
    values, vectors = np.linalg.eigh(0.5 * (np.array(rows) + np.array(rows).T))
    values = np.maximum(np.abs(values), max(1e-4 * np.abs(values).max(), 1e-2))
    return (vectors * values) @ vectors.T
