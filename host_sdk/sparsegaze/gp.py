# SPDX-License-Identifier: Apache-2.0
"""Gaussian-process regression in float64: features -> gaze, two outputs sharing one covariance function.

    y_o(x) = b_o . h(x) + f_o(x) + noise        f_o ~ GP(0, s^2 k(x, x'))

with k one of kernels.py, h(x) = (1, x) or (1) or nothing (least squares on top of the process, Rasmussen &
Williams section 2.7), and noise covariance  s_n^2 diag(noise_scale) + s_g^2 [same group]:  samples of one
fixation share the error of where the eye really rested. LED2Gaze section 5.2 is this mean without the noise
term (`noise_free`). Hyper-parameters by marginal likelihood with analytic gradients (likelihood.py); every
solve goes through one Cholesky factor (factor.py). Nothing depends on the order of the samples or on the
number of threads: samples are put in a canonical order, and BLAS runs on one thread.
"""

import warnings
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular
from threadpoolctl import ThreadpoolController

from .errors import CalibrationError
from .factor import CONDITION_MOST, EPS, JITTERS, cholesky, extremes, inverse, last_sum, leftover
from .hyper import Hyper, gap, learnt, refined
from .kernels import Kernel
from .kernels import kernel as make_kernel
from .likelihood import LENGTH_RANGE
from .repair import Repair
from .samples import Samples, spread

LEARN_ROWS = 600  # rows of the likelihood that is searched from several starts
ROWS_MAX = 3000  # of the process: 9e6 entries, 72 MB a matrix
ROUNDING_MOST_DEG = 0.01  # proven error of a prediction by rounding; more jitter is added until it is below
REPAIR_MISS_MOST = 1.7  # median of error over claim for samples left out; a claim that is right has 0.83
PROBES = 200  # of the rows, and as many places between them, where the error by rounding is bounded
_blas = ThreadpoolController()


@dataclass
class GaussianProcess:
    """A fitted process. Make one with `fit`.

    x [n, d], y [n, 2] the training data; hyper; mean "zero" | "constant" | "linear"; lml of both outputs
    kernel     kernels.Kernel;  alpha [n, 2] weights of s^2 k(., x_i);  beta [columns, 2] of the mean
    condition  of the matrix that is solved (2-norm), jitter included; condition_raw without it, inf where it
               has no Cholesky factor. Above 4.5e14 float64 cannot tell it from any larger number
    jitter     relative to its mean diagonal;  dropped channels;  rows_given to fit (n of them kept)
    rounding_deg  bound of a prediction's error by float64, at the data and between them
    repair     None, or what was done to a matrix that is no covariance: words and sizes
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
    kernel: Kernel = None
    noise_free: bool = False
    rows_given: int = 0
    rounding_deg: float = np.nan
    condition_raw: float = np.inf
    repair: dict = None
    length_max: float = LENGTH_RANGE[1]
    _factor: object = field(default=None, repr=False)
    _origin: np.ndarray = field(default=None, repr=False)
    _repair: Repair = field(default=None, repr=False)

    @classmethod
    @_blas.wrap(limits=1, user_api="blas")
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
        kernel="rbf",
        p=None,
        exponent=None,
        noise_free=False,
        learn_rows=LEARN_ROWS,
        rows_max=ROWS_MAX,
        refine=False,
    ):
        """Fit to features [n, d] and gaze_deg [n, 2].

        noise_scale   [n] relative noise variance of each sample (default 1)
        groups        int [n], samples that share one error; used when group_noise, or hyper.group_deg > 0
        hyper         use these parameters instead of optimising the likelihood; with refine start from them
                      and take a few steps to its maximum (at most 14 evaluations on at most 2000 rows)
        length_max    longest length scale, in standard deviations of the channel
        restarts      random starting points beside the standard one, drawn from the seed
        kernel, p, exponent  see kernels.kernel
        noise_free    learn the paper's form, noise_deg = 0 (with hyper its noise_deg decides)
        learn_rows    above it the likelihood is searched on that many rows, then polished on up to 2000
        rows_max      above it the process keeps that many rows, evenly spread, and warns
        The result is a pure function of data and seed; samples are put in a canonical order first.
        Raises CalibrationError for fewer samples than the mean needs, for nan or infinities, when all
        channels are constant, and when float64 cannot hold the answer. A constant channel is dropped with
        a warning.
        """
        shape = make_kernel(kernel, p, exponent)
        known = Samples.check(features, gaze_deg, noise_scale, groups, shape, mean, rows_max, depth=3)
        gp = cls(known.x, known.y, hyper, mean, known.noise_scale, known.groups, known.dropped, kernel=shape)
        gp.rows_given, gp.length_max = known.given, length_max
        gp.noise_free = noise_free if hyper is None else hyper.noise_deg == 0
        if hyper is None:
            gp.hyper = learnt(gp, restarts, seed, group_noise, learn_rows)
        else:
            gp.hyper = hyper.checked(gp.x.shape[1], known.dropped)
            if refine:
                gp.hyper = refined(gp, learn_rows)
        gp._solve()
        return gp

    @_blas.wrap(limits=1, user_api="blas")
    def predict(self, features, return_std=False):
        """Mean [m, 2] at features [m, d]; with return_std also the standard deviation [m] of f; degrees.

        Raises CalibrationError for nan or infinities, and where the kernel's measure is not defined.
        """
        features = self._query(features)
        mean = np.empty((len(features), 2))
        std = np.empty(len(features))
        for rows in _blocks(len(features), len(self.x)):
            k = self._kernel(features[rows])
            h = self._basis(features[rows])
            mean[rows] = k @ self.alpha + h @ self.beta
            if return_std:
                k, prior = self._sound(k)
                v = solve_triangular(self._factor[0], k.T, lower=True)
                variance = prior - np.sum(v * v, axis=0)
                if h.shape[1]:
                    r = h.T - self._h_white.T @ v
                    variance += np.sum(solve_triangular(self._h_factor, r, trans="T") ** 2, axis=0)
                std[rows] = np.sqrt(np.maximum(variance, 0.0))
        return (mean, std) if return_std else mean

    @_blas.wrap(limits=1, user_api="blas")
    def gradient(self, features):
        """Derivative of the mean by the features, [m, 2, d], degrees per feature unit; 0 in dropped channels.

        Where a kernel has a cusp (all but rbf, matern52 and cosine, at a training sample) the mean has no
        derivative; that sample's own kernel then counts 0, the mean of both sides.
        """
        features = self._query(features)
        out = np.zeros((len(features), 2, features.shape[1]))
        used, own, length = self.hyper.used, self._kept(self.x), self.hyper.lengths(self.kernel)
        for rows in _blocks(len(features), len(self.x)):
            part = self.kernel.slope(self._kept(features[rows]), own, length, self.alpha)
            out[rows][:, :, used] = self.hyper.signal_deg**2 * part
        if self.mean == "linear":
            live = [j for j in range(features.shape[1]) if j not in self.dropped]
            out[:, :, live] += (self.beta[1:] / self._origin[1, live, None]).T
        return out

    @_blas.wrap(limits=1, user_api="blas")
    def loo(self):
        """Leave-one-out in closed form, b refitted each time: (mean [n, 2], standard deviation [n]), degrees.

        In the order of self.x. R & W equations 5.10 to 5.12, with K^-1 replaced by its projection off h(x).
        """
        p = self._projector()
        diagonal = np.diag(p)
        return self.y - p @ self.y / diagonal[:, None], np.sqrt(1.0 / diagonal)

    @_blas.wrap(limits=1, user_api="blas")
    def loo_groups(self):
        """Leave-one-group-out in closed form: y - prediction [n, 2], the sample's whole group left out."""
        p = self._projector()
        weighted, miss = p @ self.y, np.empty_like(self.y)
        for label in np.unique(self.groups):
            rows = np.flatnonzero(self.groups == label)
            miss[rows] = np.linalg.solve(p[np.ix_(rows, rows)], weighted[rows])
        return miss

    @_blas.wrap(limits=1, user_api="blas")
    def likelihood_gap(self, restarts=8, seed=1):
        """Log likelihood of the best of many tight searches, less that of `hyper`: nats, >= 0.

        For a report, not for use: minutes at 2000 rows. The searches run on a part of the rows; the best
        three and the parameters in use are then followed to convergence on up to 2000 of them.
        """
        return gap(self, restarts, seed)

    def describe(self):
        """The process in a dict for JSON: kernel, hyper-parameters, fit, what was done to the matrix."""
        error = self.y - self.loo()[0]
        named = self.kernel.name in ("minkowski", "laplace")
        certain = self.condition_raw <= CONDITION_MOST
        beyond = f"without jitter beyond {CONDITION_MOST:.1e}, all that float64 can tell: perhaps any larger"
        return {
            "kernel": self.kernel.name,
            "formula": f"{self.hyper.signal_deg:.6g}^2 {self.kernel.formula()}",
            "p": None if not named else "inf" if np.isinf(self.kernel.p) else float(self.kernel.p),
            "positive_definite": bool(self.kernel.definite(int(self.hyper.used.sum()))),
            "length": [float(v) if np.isfinite(v) else None for v in self.hyper.length],
            "length_unit": self.kernel.length_unit,
            "signal_deg": float(self.hyper.signal_deg),
            "noise_deg": float(self.hyper.noise_deg),
            "group_deg": float(self.hyper.group_deg),
            "mean": self.mean,
            "noise_free": bool(self.noise_free),
            "lml": self.lml,
            "loo_rms_deg": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
            "condition": self.condition,
            "condition_raw": self.condition_raw if certain else None,
            "condition_note": "" if certain else beyond,
            "jitter": self.jitter,
            "jitter_deg": self._jitter_deg(),
            "rounding_deg": self.rounding_deg,
            "repair": self.repair,
            "rows": len(self.x),
            "rows_given": self.rows_given,
            "dropped": list(self.dropped),
        }

    def _query(self, features):
        features = np.asarray(features, float)
        if features.ndim != 2 or features.shape[1] != self.x.shape[1]:
            raise CalibrationError(
                f"features {features.shape} do not fit a process of {self.x.shape[1]} channels",
                f"give [m, {self.x.shape[1]}]",
            )
        if not np.isfinite(features).all():
            raise CalibrationError("features hold nan or infinity", "leave those rows out")
        self.kernel.check(self._kept(features))
        return features

    def _kept(self, features):
        """The channels that the kernel uses, as an array of its own."""
        return np.ascontiguousarray(features[:, self.hyper.used])

    def _kernel(self, features):
        value = self.kernel.value(self._kept(features), self._kept(self.x), self.hyper.lengths(self.kernel))
        return self.hyper.signal_deg**2 * value

    def _sound(self, k):
        """Covariances [m, n] with the data, and variances, of what is solved; k from `_kernel`."""
        s2 = self.hyper.signal_deg**2
        return (k, s2) if self._repair is None else self._repair.extend(k, s2)

    def _basis(self, features):
        if self.mean == "zero":
            return np.empty((len(features), 0))
        one = np.ones((len(features), 1))
        if self.mean == "constant":
            return one
        kept = [j for j in range(features.shape[1]) if j not in self.dropped]
        return np.hstack([one, (features[:, kept] - self._origin[0, kept]) / self._origin[1, kept]])

    def _projector(self):
        p = inverse(self._factor[0])
        h = self._basis(self.x)
        if h.shape[1]:
            q = solve_triangular(self._h_factor, (p @ h).T, trans="T")
            p = p - q.T @ q
        return p

    def _solve(self, verify=True):
        x, hyper = self.x, self.hyper
        deviation = x.std(axis=0)
        deviation[list(self.dropped)] = 1.0
        self._origin = np.stack([x.mean(axis=0), deviation])
        cov = self._kernel(x)
        cov = 0.5 * (cov + cov.T)
        np.fill_diagonal(cov, hyper.signal_deg**2)
        if not self.kernel.definite(int(hyper.used.sum())):
            cov = self._repaired(cov)
        cov[np.diag_indices(len(x))] += hyper.noise_deg**2 * self.noise_scale
        if hyper.group_deg > 0:
            cov += hyper.group_deg**2 * (self.groups[:, None] == self.groups)
        left = JITTERS
        while left:
            self._factor, self.jitter = cholesky(cov, left)
            left = [jitter for jitter in left if jitter > self.jitter]
            self._weigh(cov)
            self.condition_raw = self.condition if self.jitter == 0 else self.condition_raw
            if self.rounding_deg <= ROUNDING_MOST_DEG:
                break
        else:
            raise CalibrationError(
                f"float64 cannot hold these weights: predictions could be off by {self.rounding_deg:.1g} deg",
                "allow more noise, or shorter length scales",
            )
        if self.jitter and not self.noise_free:
            warnings.warn(
                f"the covariance matrix is singular to float64: noise of {self._jitter_deg():.2g} deg added",
                stacklevel=4,
            )
        if verify and self.repair and self.repair["negative"]:
            self._verify_repair()

    def _weigh(self, cov):
        """Weights, likelihood, condition and error bound, from the factor."""
        lower, n = self._factor[0], len(self.x)
        white_y = solve_triangular(lower, self.y, lower=True)
        h = self._basis(self.x)
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
        alpha = solve_triangular(lower, white_y, lower=True, trans="T")
        logdet = 2 * np.sum(np.log(np.diag(lower)))
        self.lml = float(-0.5 * np.sum(white_y**2) - logdet - n * np.log(2 * np.pi))
        largest, smallest = extremes(self._factor)
        self.condition = largest / smallest
        lost = smallest <= 4 * EPS * largest  # no more than Cholesky's own rounding
        self.rounding_deg = np.inf if lost else self._rounding(cov, alpha, h)
        self.alpha = alpha if self._repair is None else self._repair.project(alpha)

    def _rounding(self, cov, alpha, h):
        """Bound of a prediction's error at the data and between them (PROBES places), degrees."""
        near = self.x[spread(len(self.x), PROBES)]
        probes = np.vstack([near, 0.5 * (near[1:] + near[:-1])])
        s2 = self.hyper.signal_deg**2
        relative, absolute = self.kernel.rounding(self._kept(self.x), self.hyper.lengths(self.kernel))
        entries = relative, absolute * s2
        lost = 30 * EPS * self._repair.values[-1] if self._repair else 0.0
        miss = leftover(cov, self.jitter, alpha, self.y - h @ self.beta, entries, lost)
        miss += 4 * EPS * np.abs(self.y)
        v = solve_triangular(self._factor[0], self._sound(self._kernel(probes))[0].T, lower=True)
        off = np.zeros((len(probes), 2))
        if h.shape[1]:
            lack = solve_triangular(self._h_factor, self._basis(probes).T - self._h_white.T @ v, trans="T")
            multiplier = solve_triangular(self._h_factor, lack)
            v = v + self._h_white @ multiplier
            off = np.abs(multiplier.T) @ (np.abs(h.T @ alpha) + len(h) * EPS * (np.abs(h.T) @ np.abs(alpha)))
        off += np.abs(solve_triangular(self._factor[0], v, lower=True, trans="T").T) @ miss
        return float(np.max(off + last_sum(cov, alpha, entries)) + 8 * EPS * np.abs(self.y).max())

    def _repaired(self, cov):
        """cov made a covariance matrix."""
        self._repair = fix = Repair(cov)
        done = f"{fix.negative} negative eigenvalues, {100 * fix.share:.2g} % of the spectrum, were removed"
        done += f", and noise of {np.sqrt(fix.noise):.2g} deg added"
        done = done if fix.negative else "on these samples it happens to, nothing had to be removed"
        distance = f"the Minkowski distance of p = {self.kernel.p:g}"
        self.repair = {
            "words": f"{distance} gives no covariance in 3 or more channels: {done}",
            "negative": fix.negative,
            "smallest_eigenvalue": fix.least / self.hyper.signal_deg**2,
            "removed_share": fix.share,
            "rank": len(fix.values),
            "noise_deg": float(np.sqrt(fix.noise)),
        }
        return fix.matrix + fix.noise * np.eye(len(cov))

    def _verify_repair(self):
        """Refuse a repair whose process misses what it has not seen by more than it says.

        Leaving out in closed form cannot tell: the repaired matrix has seen the sample. So every eighth
        sample is left out of matrix and repair.
        """
        out = np.arange(len(self.x)) % 8 == 3
        known = [v[~out] for v in (self.x, self.y, self.noise_scale, self.groups)]
        mean = "constant" if self.mean == "linear" else self.mean
        part = GaussianProcess(*known[:2], self.hyper, mean, *known[2:], self.dropped, kernel=self.kernel)
        part.noise_free = True  # no word about its jitter
        part._solve(verify=False)
        mean, std = part.predict(self.x[out], return_std=True)
        miss = np.sqrt(np.mean((mean - self.y[out]) ** 2, axis=1))
        shared2 = self._repair.noise + self.hyper.group_deg**2
        said = np.sqrt(std**2 + shared2 + self.hyper.noise_deg**2 * self.noise_scale[out])
        self.repair |= {"held_out_deg": float(np.median(miss)), "claimed_deg": float(np.median(said))}
        if np.median(miss / said) > REPAIR_MISS_MOST:
            raise CalibrationError(
                f"p = {self.kernel.p:g} cannot be repaired on this recording: samples left out are "
                f"missed by {np.median(miss):.2g} deg where the process claims {np.median(said):.2g}",
                "use p of at most 2, or other hyper-parameters",
            )
        warnings.warn(self.repair["words"], stacklevel=5)

    def _jitter_deg(self):
        """Standard deviation of the noise that the jitter amounts to."""
        noise2 = self.hyper.noise_deg**2 * np.mean(self.noise_scale) + self.hyper.group_deg**2
        return float(np.sqrt(self.jitter * (self.hyper.signal_deg**2 + noise2)))


def _blocks(n, width, entries=4_000_000):
    step = max(1, entries // max(width, 1))
    return [slice(i, min(i + step, n)) for i in range(0, n, step)]
