# SPDX-License-Identifier: Apache-2.0
"""The calibration as peers are trained on it: training sets, folds for cross-validation, scikit-learn's GP.

Everything that a peer can choose, the training set included, is chosen by leaving out a third of the targets
in turn and judging single frames of theirs; the held-out data never have a say. Runs in .venv-bench.
"""

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

FOLDS = 3
FRAMES = 2000  # that are kept, evenly from all targets
GP_ROWS = 300  # that scikit-learn's likelihood is maximised on: its cost grows with their cube
RESTARTS = 1


@dataclass
class Calibration:
    """features [n, d] feature units, target_deg [n, 2]; spread (features, target_deg) or None: more rows of
    the same calibration, made by somebody's augmentation; seed of every random choice.

    sets {name: (features, target_deg, target's number)}: "frames"; "means" of the targets, where there are
    several frames each; "spread". origin, deviation [d] of the features; level_deg rms of the targets
    """

    features: np.ndarray
    target_deg: np.ndarray
    spread: tuple = None
    seed: int = 0

    def __post_init__(self):
        x, y = np.asarray(self.features, float), np.asarray(self.target_deg, float)
        rng = np.random.default_rng([0x70656572, self.seed])
        places, group = np.unique(y, axis=0, return_inverse=True)
        group = group.ravel()
        means = np.array([x[group == k].mean(axis=0) for k in range(len(places))])
        kept = evenly(group, FRAMES, rng)
        self.features, self.target_deg, self.group = x[kept], y[kept], group[kept]
        self.sets = {"frames": (self.features, self.target_deg, self.group)}
        if len(places) < len(x) / 2:
            self.sets["means"] = means, places, np.arange(len(places))
        if self.spread is not None:
            more, where = np.asarray(self.spread[0], float), np.asarray(self.spread[1], float)
            few = np.sort(rng.permutation(len(more))[:FRAMES])
            self.sets["spread"] = more[few], where[few], cKDTree(places).query(where[few])[1]
        self.origin, deviation = x.mean(axis=0), x.std(axis=0)
        self.deviation = np.where(deviation > 0, deviation, 1.0)
        self.middle_deg = places.mean(axis=0)
        self.level_deg = float(np.sqrt(np.mean((y - self.middle_deg) ** 2)))
        self.fold_of_group = rng.permutation(np.arange(len(places)) % FOLDS)

    def standard(self, features):
        """Inputs in standard deviations from the calibration's mean."""
        return (np.asarray(features, float) - self.origin) / self.deviation

    def rows(self, name, most=None):
        """(features, target_deg) of a training set, at most so many rows, evenly from all targets."""
        x, y, group = self.sets[name]
        kept = evenly(group, most or len(x), np.random.default_rng(self.seed))
        return x[kept], y[kept]

    def error(self, make, name, most=None, folds=FOLDS):
        """Mean distance in degrees of frames of targets that were left out.

        make(features, target_deg) returns a function features -> degrees [n, 2]; name of its training set, of
        which it is given at most so many rows; folds: how many of them are judged
        """
        x, y, group = self.sets[name]
        misses = []
        for fold in range(folds):
            train = np.flatnonzero(self.fold_of_group[group] != fold)
            train = train[evenly(group[train], most or len(train), np.random.default_rng(self.seed))]
            judged = self.fold_of_group[self.group] == fold
            gaze = make(x[train], y[train])(self.features[judged])
            misses.append(np.hypot(*(gaze - self.target_deg[judged]).T))
        return float(np.mean(np.concatenate(misses)))

    def best(self, make, choices, most=None, folds=FOLDS, names=None):
        """(set name, choice) with the least error; make(features, target_deg, *choice) as for `error`."""
        tried = [(name, choice) for name in names or self.sets for choice in choices]
        errors = [
            self.error(lambda x, y, c=choice: make(x, y, *c), name, most, folds) for name, choice in tried
        ]
        return tried[int(np.argmin(errors))]

    @cached_property
    def gp(self):
        """SklearnGP on the training set whose likelihood leads to the least error."""
        made = {name: SklearnGP.learn(self, name) for name in self.sets}
        errors = {name: self.error(gp.process, name, 2 * GP_ROWS) for name, gp in made.items()}
        return made[min(errors, key=errors.get)]


@dataclass
class SklearnGP:
    """Hyper-parameters as scikit-learn finds them: length [d] feature units, signal_deg, noise_deg; lml of
    `rows` samples of a training set `name`, in units of degrees, found in fit_s seconds."""

    calibration: Calibration
    kernel: object
    name: str
    length: np.ndarray
    signal_deg: float
    noise_deg: float
    lml: float
    fit_s: float
    rows: int

    @classmethod
    def learn(cls, calibration, name):
        """ARD-RBF plus white noise, by marginal likelihood, both outputs in one."""
        c, d = calibration, calibration.features.shape[1]
        x, y = c.rows(name, GP_ROWS)
        kernel = ConstantKernel(10.0, (1e-3, 1e5)) * RBF(np.full(d, 2.0), (0.05, 100.0))
        kernel += WhiteKernel(1e-3, (1e-8, 1.0))
        began = time.perf_counter()
        model = GaussianProcessRegressor(
            kernel, alpha=0.0, n_restarts_optimizer=RESTARTS, random_state=c.seed
        ).fit(c.standard(x), (y - c.middle_deg) / c.level_deg)
        fit_s = time.perf_counter() - began
        found = model.kernel_
        # A density of y / level is level^2 times that of y, for each sample's two outputs together.
        lml = float(model.log_marginal_likelihood_value_) - 2 * len(x) * np.log(c.level_deg)
        length = found.k1.k2.length_scale * c.deviation
        signal_deg, noise_deg = (
            float(np.sqrt(v) * c.level_deg) for v in (found.k1.k1.constant_value, found.k2.noise_level)
        )
        return cls(c, found, name, length, signal_deg, noise_deg, lml, fit_s, len(x))

    def process(self, x, y):
        """scikit-learn's process with these hyper-parameters, given x [n, d] and y [n, 2]; a function."""
        c = self.calibration
        model = GaussianProcessRegressor(self.kernel, alpha=0.0, optimizer=None)
        model.fit(c.standard(x), (y - c.middle_deg) / c.level_deg)
        return lambda q: model.predict(c.standard(q)) * c.level_deg + c.middle_deg


def evenly(group, most, rng):
    """Sorted indices of at most `most` rows, as many of each group as there are, drawn at random."""
    if len(group) <= most:
        return np.arange(len(group))
    drawn = rng.permutation(len(group))
    by_group = drawn[np.argsort(group[drawn], kind="stable")]
    first = np.r_[0, np.flatnonzero(np.diff(group[by_group])) + 1]
    turn = np.arange(len(group)) - np.repeat(first, np.diff(np.r_[first, len(group)]))
    return np.sort(by_group[np.argsort(turn, kind="stable")[:most]])
