# SPDX-License-Identifier: Apache-2.0
"""Gaussian-process regression in float64: features -> gaze, two outputs sharing one ARD-RBF kernel.

    y_o(x) = b_o . h(x) + f_o(x) + noise        f_o ~ GP(0, s^2 exp(-1/2 sum_j ((x_j - x'_j) / l_j)^2))

with h(x) = (1, x) or (1) or nothing (least squares on top of the process, Rasmussen & Williams section 2.7),
and noise covariance  s_n^2 diag(noise_scale) + s_g^2 [same group]:  samples of one fixation share the error
of where the eye really rested. LED2Gaze section 5.2 is this mean without the noise term. Hyper-parameters by
marginal likelihood with analytic gradients; every solve goes through one Cholesky factor.
"""

import warnings
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular
from scipy.optimize import minimize

from .errors import CalibrationError

JITTERS = (0.0, 1e-12, 1e-10, 1e-8, 1e-6)  # relative to the mean diagonal, tried in turn
LENGTH_RANGE = (0.05, 100.0)  # in standard deviations of the channel
SIGNAL_RANGE = (1e-2, 1e3)  # in rms gaze
NOISE_RANGE = (1e-4, 1.0)
START_SPREAD = 0.7  # natural log, of the random restarts


@dataclass(frozen=True)
class Hyper:
    """Kernel parameters in the units of the data.

    length [d] in feature units (inf drops a channel); signal_deg, noise_deg, group_deg standard deviations
    """

    length: np.ndarray
    signal_deg: float
    noise_deg: float
    group_deg: float = 0.0


@dataclass
class GaussianProcess:
    """A fitted process. Make one with `fit`.

    x [n, d], y [n, 2] the training data; hyper; mean "zero" | "constant" | "linear"; lml of both outputs
    condition of the covariance matrix (2-norm); jitter relative to its mean diagonal; dropped channels
    """

    x: np.ndarray
    y: np.ndarray
    hyper: Hyper
    mean: str
    noise_scale: np.ndarray
    groups: np.ndarray
    dropped: tuple = ()
    lml: float = np.nan
    jitter: float = 0.0
    condition: float = np.nan
    alpha: np.ndarray = field(default=None, repr=False)
    beta: np.ndarray = field(default=None, repr=False)
    _factor: object = field(default=None, repr=False)
    _origin: np.ndarray = field(default=None, repr=False)

    @classmethod
    def fit(
        cls,
        features,
        gaze_deg,
        noise_scale=None,
        groups=None,
        mean="linear",
        hyper=None,
        restarts=2,
        seed=0,
        group_noise=False,
        length_max=LENGTH_RANGE[1],
    ):
        """Fit to features [n, d] and gaze_deg [n, 2].

        noise_scale   [n] relative noise variance of each sample (default 1)
        groups        int [n], samples that share one error; used when group_noise, or hyper.group_deg > 0
        hyper         use these parameters instead of optimising the likelihood
        length_max    longest length scale, in standard deviations of the channel
        restarts      random starting points beside the standard one, drawn from the seed
        The result is a pure function of data and seed; samples are put in a canonical order first.
        Raises CalibrationError for fewer samples than the mean needs, for nan or infinities, and when all
        channels are constant. A constant channel is dropped with a warning.
        """
        x, y = np.array(features, float), np.array(gaze_deg, float)
        n = len(x)
        if x.ndim != 2 or y.shape != (n, 2):
            raise CalibrationError(
                f"features {x.shape} and gaze {y.shape} do not fit together", "give [n, d] and [n, 2]"
            )
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise CalibrationError("features or targets hold nan or infinity", "mark those rows valid = 0")
        varying = np.ptp(x, axis=0) > 0 if n else np.zeros(x.shape[1], bool)
        columns = _mean_columns(mean, int(varying.sum()))
        if n < columns + 2:
            raise CalibrationError(
                f"{n} samples are too few for a {mean} mean in {x.shape[1]} channels",
                f"give at least {columns + 2}",
            )
        if not varying.any():
            raise CalibrationError(
                "no channel changes between the targets", "check that the LEDs are connected and see the eye"
            )
        dropped = tuple(int(j) for j in np.flatnonzero(~varying))
        if dropped:
            warnings.warn(f"constant channel dropped: {', '.join(f's{j}' for j in dropped)}", stacklevel=2)
        scale = np.ones(n) if noise_scale is None else np.array(noise_scale, float)
        labels = np.arange(n) if groups is None else np.unique(groups, return_inverse=True)[1]
        order = np.lexsort(np.column_stack([labels, y, x]).T)
        x, y, scale, labels = x[order], y[order], scale[order], labels[order]
        gp = cls(x, y, hyper, mean, scale, labels, dropped)
        if hyper is None:
            gp.hyper = _optimise(gp, varying, restarts, seed, group_noise, length_max)
        gp._solve(varying)
        return gp

    def predict(self, features, return_std=False):
        """Mean [m, 2] at features [m, d]; with return_std also the standard deviation [m] of f; degrees."""
        features = np.asarray(features, float)
        mean = np.empty((len(features), 2))
        std = np.empty(len(features))
        for rows in _blocks(len(features), len(self.x)):
            k = self._kernel(features[rows])
            h = self._basis(features[rows])
            mean[rows] = k @ self.alpha + h @ self.beta
            if return_std:
                v = solve_triangular(self._factor[0], k.T, lower=True)
                variance = self.hyper.signal_deg**2 - np.sum(v * v, axis=0)
                if h.shape[1]:
                    r = h.T - self._h_white.T @ v
                    variance += np.sum(solve_triangular(self._h_factor, r, trans="T") ** 2, axis=0)
                std[rows] = np.sqrt(np.maximum(variance, 0.0))
        return (mean, std) if return_std else mean

    def loo(self):
        """Leave-one-out in closed form, b refitted each time: (mean [n, 2], standard deviation [n]), degrees.

        In the order of self.x. R & W equations 5.10 to 5.12, with K^-1 replaced by its projection off h(x).
        """
        p = _inverse(self._factor[0])
        h = self._basis(self.x)
        if h.shape[1]:
            q = solve_triangular(self._h_factor, (p @ h).T, trans="T")
            p = p - q.T @ q
        diagonal = np.diag(p)
        return self.y - p @ self.y / diagonal[:, None], np.sqrt(1.0 / diagonal)

    def loo_groups(self):
        """Leave-one-group-out in closed form: y - prediction [n, 2], the sample's whole group left out."""
        p = _inverse(self._factor[0])
        h = self._basis(self.x)
        if h.shape[1]:
            q = solve_triangular(self._h_factor, (p @ h).T, trans="T")
            p = p - q.T @ q
        weighted, residual = p @ self.y, np.empty_like(self.y)
        for label in np.unique(self.groups):
            rows = np.flatnonzero(self.groups == label)
            residual[rows] = np.linalg.solve(p[np.ix_(rows, rows)], weighted[rows])
        return residual

    def _kernel(self, features):
        scaled, own = features / self.hyper.length, self.x / self.hyper.length
        centre = own.mean(axis=0)  # the squared distance below cancels; keep the numbers small
        scaled, own = scaled - centre, own - centre
        d2 = np.sum(scaled**2, 1)[:, None] + np.sum(own**2, 1) - 2.0 * scaled @ own.T
        return self.hyper.signal_deg**2 * np.exp(-0.5 * np.maximum(d2, 0.0))

    def _basis(self, features):
        if self.mean == "zero":
            return np.empty((len(features), 0))
        one = np.ones((len(features), 1))
        if self.mean == "constant":
            return one
        kept = [j for j in range(features.shape[1]) if j not in self.dropped]
        return np.hstack([one, (features[:, kept] - self._origin[0, kept]) / self._origin[1, kept]])

    def _solve(self, varying):
        x, hyper, n = self.x, self.hyper, len(self.x)
        self._origin = np.stack([x.mean(axis=0), np.where(varying, x.std(axis=0), 1.0)])
        cov = self._kernel(x)
        cov = 0.5 * (cov + cov.T)
        np.fill_diagonal(cov, hyper.signal_deg**2)
        cov[np.diag_indices(n)] += hyper.noise_deg**2 * self.noise_scale
        if hyper.group_deg > 0:
            cov += hyper.group_deg**2 * (self.groups[:, None] == self.groups)
        self._factor, self.jitter = _cholesky(cov)
        lower = self._factor[0]
        white_y = solve_triangular(lower, self.y, lower=True)
        h = self._basis(x)
        self.beta = np.zeros((h.shape[1], 2))
        if h.shape[1]:
            self._h_white = solve_triangular(lower, h, lower=True)
            q, self._h_factor = np.linalg.qr(self._h_white)
            if np.abs(np.diag(self._h_factor)).min() < 1e-12 * np.abs(np.diag(self._h_factor)).max():
                raise CalibrationError(
                    "channels depend on each other linearly: a linear mean is not unique",
                    "use mean='constant'",
                )
            self.beta = solve_triangular(self._h_factor, q.T @ white_y)
            white_y = white_y - self._h_white @ self.beta
        self.alpha = solve_triangular(lower, white_y, lower=True, trans="T")
        logdet = 2 * np.sum(np.log(np.diag(lower)))
        self.lml = float(-0.5 * np.sum(white_y**2) - logdet - n * np.log(2 * np.pi))
        self.condition = _condition(cov, self._factor)


def _mean_columns(mean, channels):
    try:
        return {"zero": 0, "constant": 1, "linear": 1 + channels}[mean]
    except KeyError:
        raise ValueError(f"mean {mean!r} is none of zero, constant, linear") from None


def _optimise(gp, varying, restarts, seed, group_noise, length_max):
    """Maximise the marginal likelihood over log length, signal, noise (and group) deviations."""
    x = gp.x[:, varying]
    spread = x.std(axis=0)
    z = (x - x.mean(axis=0)) / spread
    level = float(np.sqrt(np.mean((gp.y - gp.y.mean(axis=0)) ** 2))) or 1.0
    y, d, n = gp.y / level, z.shape[1], len(z)
    one = np.ones((n, 1))
    h = {"zero": one[:, :0], "constant": one, "linear": np.hstack([one, z])}[gp.mean]
    squares = np.stack([(z[:, j, None] - z[:, j]) ** 2 for j in range(d)])
    same = (gp.groups[:, None] == gp.groups).astype(float) if group_noise else None
    scales = [SIGNAL_RANGE, NOISE_RANGE] + [NOISE_RANGE] * bool(group_noise)
    bounds = np.log([(LENGTH_RANGE[0], length_max)] * d + scales)

    def objective(theta):
        value, slope = _likelihood(theta, squares, y, h, gp.noise_scale, same)
        return -value, -slope

    start = np.log(np.r_[np.full(d, min(3.0, 0.7 * length_max)), 3.0, 0.05, [0.03] * bool(group_noise)])
    rng = np.random.default_rng([0x6770, seed])
    best = None
    for trial in range(restarts + 1):
        guess = start if trial == 0 else start + START_SPREAD * rng.standard_normal(len(start))
        found = minimize(
            objective,
            np.clip(guess, *bounds.T),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 200},
        )
        if best is None or found.fun < best.fun - 1e-6:
            best = found
    value = np.exp(best.x)
    length = np.full(gp.x.shape[1], np.inf)
    length[varying] = value[:d] * spread
    return Hyper(
        length,
        float(value[d] * level),
        float(value[d + 1] * level),
        float(value[d + 2] * level) if group_noise else 0.0,
    )


def _likelihood(theta, squares, y, h, noise_scale, same):
    """Log marginal likelihood of both outputs, and its gradient in theta (R & W equation 5.9).

    theta = log of (length [d], signal, noise[, group]); squares [d, n, n] squared differences per channel.
    b is at its generalised-least-squares value, where the likelihood is stationary in b.
    """
    d, n, _ = squares.shape
    inverse_l2 = np.exp(-2 * theta[:d])
    k = np.exp(2 * theta[d]) * np.exp(-0.5 * np.tensordot(inverse_l2, squares, 1))
    noise = np.exp(2 * theta[d + 1]) * noise_scale
    cov = k.copy()
    cov[np.diag_indices(n)] += noise
    if same is not None:
        cov += np.exp(2 * theta[d + 2]) * same
    try:
        factor, _ = _cholesky(cov)
    except CalibrationError:
        return -1e25, np.zeros_like(theta)
    residual = y
    if h.shape[1]:
        white = solve_triangular(factor[0], h, lower=True)
        b = np.linalg.lstsq(white, solve_triangular(factor[0], y, lower=True), rcond=1e-12)[0]
        residual = y - h @ b
    alpha = cho_solve(factor, residual)
    value = -0.5 * np.sum(residual * alpha) - 2 * np.sum(np.log(np.diag(factor[0]))) - n * np.log(2 * np.pi)
    m = alpha @ alpha.T - 2 * _inverse(factor[0])
    mk = m * k
    slope = np.empty_like(theta)
    for j in range(d):
        slope[j] = 0.5 * inverse_l2[j] * np.sum(mk * squares[j])
    slope[d] = np.sum(mk)
    slope[d + 1] = np.sum(np.diag(m) * noise)
    if same is not None:
        slope[d + 2] = np.exp(2 * theta[d + 2]) * np.sum(m * same)
    return value, slope


def _cholesky(cov):
    """Lower Cholesky factor of cov with the least jitter that works: (cho_factor tuple, relative jitter)."""
    diagonal = float(np.mean(np.diag(cov)))
    for jitter in JITTERS:
        try:
            c, lower = cho_factor(
                cov + jitter * diagonal * np.eye(len(cov)) if jitter else cov, lower=True, check_finite=False
            )
        except np.linalg.LinAlgError:
            continue
        return (np.tril(c), lower), jitter
    raise CalibrationError(
        "the covariance matrix is numerically singular", "remove duplicate samples or allow more noise"
    )


def _inverse(lower):
    """K^-1 from its Cholesky factor, for traces and diagonals that need its entries (never for a solve)."""
    inverse, status = lapack.dpotri(lower, lower=1)
    assert status == 0
    return np.tril(inverse) + np.tril(inverse, -1).T


def _condition(cov, factor, steps=40):
    """Condition number in the 2-norm by power iteration on K and K^-1: a lower bound, a few percent off."""
    rng = np.random.default_rng(1)
    largest = smallest = 1.0
    v = rng.standard_normal(len(cov))
    w = v.copy()
    for _ in range(steps):
        v = cov @ (v / np.linalg.norm(v))
        w = cho_solve(factor, w / np.linalg.norm(w))
        largest, smallest = np.linalg.norm(v), np.linalg.norm(w)
    return float(largest * smallest)


def _blocks(n, width, entries=4_000_000):
    step = max(1, entries // max(width, 1))
    return [slice(i, min(i + step, n)) for i in range(0, n, step)]
