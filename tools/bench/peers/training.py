# SPDX-License-Identifier: Apache-2.0
"""The calibration as peers are trained on it: groups for cross-validation, scaled inputs, scikit-learn's GP.

Everything that a peer can choose is chosen by leaving out a third of the calibration's targets in turn; the
held-out data never have a say. Runs in .venv-bench.
"""

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.model_selection import GroupKFold

FOLDS = 3
GP_ROWS = 500  # that scikit-learn's likelihood is maximised on: its cost grows with their cube
RESTARTS = 1


@dataclass
class Calibration:
    """features [n, d] feature units, target_deg [n, 2]; seed of every random choice."""

    features: np.ndarray
    target_deg: np.ndarray
    seed: int = 0

    def __post_init__(self):
        self.features = np.asarray(self.features, float)
        self.target_deg = np.asarray(self.target_deg, float)
        self.origin = self.features.mean(axis=0)
        spread = self.features.std(axis=0)
        self.spread = np.where(spread > 0, spread, 1.0)
        self.level_deg = float(np.sqrt(np.mean((self.target_deg - self.target_deg.mean(axis=0)) ** 2)))
        self.groups = np.unique(self.target_deg, axis=0, return_inverse=True)[1].ravel()
        rng = np.random.default_rng([0x70656572, self.seed])
        self.order = rng.permutation(len(self.features))

    @cached_property
    def folds(self):
        """[(rows to train on, rows to judge by)]: samples of one target stay together."""
        shuffled = np.random.default_rng(self.seed).permutation(self.groups.max() + 1)[self.groups]
        return list(GroupKFold(FOLDS).split(self.features, groups=shuffled))

    def standard(self, features):
        """Inputs in standard deviations from the calibration's mean."""
        return (np.asarray(features, float) - self.origin) / self.spread

    def in_lengths(self, features):
        """Inputs in the length scales that scikit-learn's process has found."""
        return (np.asarray(features, float) - self.origin) / self.gp.length

    def at_most(self, rows):
        """Indices of at most that many samples, drawn without order."""
        return np.sort(self.order[:rows])

    def validation_error(self, make, inputs, folds=None):
        """Mean distance in degrees over the folds; make(x, y) returns a function x -> degrees [n, 2]."""
        misses = []
        for train, judge in folds or self.folds:
            gaze = make(inputs[train], self.target_deg[train])(inputs[judge])
            misses.append(np.hypot(*(gaze - self.target_deg[judge]).T))
        return float(np.mean(np.concatenate(misses)))

    @cached_property
    def gp(self):
        """SklearnGP fitted to GP_ROWS samples at most."""
        return SklearnGP.fit(self, self.at_most(GP_ROWS))


@dataclass
class SklearnGP:
    """scikit-learn's process: length [d] feature units, signal_deg, noise_deg, lml in units of degrees."""

    model: object
    calibration: Calibration
    length: np.ndarray
    signal_deg: float
    noise_deg: float
    lml: float
    fit_s: float
    rows: int

    @classmethod
    def fit(cls, calibration, rows):
        """ARD-RBF plus white noise, hyper-parameters by marginal likelihood, both outputs in one."""
        c, d = calibration, calibration.features.shape[1]
        kernel = ConstantKernel(10.0, (1e-3, 1e5)) * RBF(np.full(d, 2.0), (0.05, 100.0))
        kernel += WhiteKernel(1e-3, (1e-8, 1.0))
        y = (c.target_deg - c.target_deg.mean(axis=0)) / c.level_deg
        began = time.perf_counter()
        model = GaussianProcessRegressor(
            kernel, alpha=0.0, n_restarts_optimizer=RESTARTS, random_state=c.seed
        ).fit(c.standard(c.features[rows]), y[rows])
        fit_s = time.perf_counter() - began
        found = model.kernel_
        # A density of y / level is level^2 times that of y, for each sample's two outputs together.
        lml = float(model.log_marginal_likelihood_value_) - 2 * len(rows) * np.log(c.level_deg)
        return cls(
            model,
            c,
            found.k1.k2.length_scale * c.spread,
            float(np.sqrt(found.k1.k1.constant_value) * c.level_deg),
            float(np.sqrt(found.k2.noise_level) * c.level_deg),
            lml,
            fit_s,
            len(rows),
        )

    def predict(self, features):
        """Degrees [m, 2]."""
        c = self.calibration
        return self.model.predict(c.standard(features)) * c.level_deg + c.target_deg.mean(axis=0)
