# SPDX-License-Identifier: Apache-2.0
"""Every peer, trained on one calibration: a list of Candidates. Runs in .venv-bench.

Settings are chosen by cross-validation on the calibration (training.py). What a library cannot do is a
Candidate too, with its own words.
"""

import importlib.metadata
import warnings

import numpy as np

from . import float_gp, libraries
from .candidate import Candidate
from .polynomial import Polynomial
from .training import Calibration

CENTRES = (32, 64, 128)
LADDER = (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768)  # N, for equal error
EQUAL_ERROR = 1.05  # of the full process's error to the truth: the project's own bar
DEGREES = (2, 3, 4)
RIDGES = (1e-10, 1e-8, 1e-6, 1e-4, 1e-2)
UNUSED = (
    ("everywhereml", "0.2.40", "forests and trees as classifiers only, no regression; brings 30 packages"),
    ("sklearn-porter", "0.7.4", "import fails with scikit-learn 1.9.1: No module named 'sklearn.tree.tree'"),
)


def train(features, target_deg, held_out, truth_deg, gp_mean_deg, say=lambda text: None):
    """Candidates for a calibration (features [n, d], target_deg [n, 2]) asked at held_out [m, d].

    truth_deg, gp_mean_deg [m, 2] decide one thing only, in favour of the peer: which number of centres
    naive float C needs for the full process's error.
    """
    calibration = Calibration(features, target_deg)
    held_out = np.asarray(held_out, float)
    made = []
    with warnings.catch_warnings(), np.errstate(all="ignore"):  # emlearn makes numpy raise on underflow
        warnings.simplefilter("ignore")  # optimisers that stop early say so; their errors are in the table
        for build in (
            lambda: naive(calibration, held_out, truth_deg, gp_mean_deg),
            lambda: polynomials(calibration, held_out),
            lambda: libraries.m2cgen_svr(calibration, held_out),
            lambda: libraries.emlearn_networks(calibration, held_out),
            lambda: libraries.emlearn_trees(calibration, held_out),
            lambda: libraries.micromlgen_trees(calibration, held_out),
            lambda: libraries.micromlgen_refuses(calibration),
            lambda: host(calibration, held_out),
        ):
            found = build()
            made += found
            say(", ".join(c.name for c in found))
    return made + [Candidate(*row) for row in UNUSED]


def naive(calibration, held_out, truth_deg, gp_mean_deg):
    """Float C with exp(): a process on a subset, and the best weights for the same centres."""
    gp = calibration.gp
    settings = gp.length, gp.signal_deg, gp.noise_deg
    known = calibration.features, calibration.target_deg

    def candidate(n, kind, why=""):
        model = float_gp.fit(*known, n, *settings, kind)
        note = f"{kind}: {len(model.centre)} centres spread evenly, scikit-learn's hyper-parameters{why}"
        name = f"naive float C, {kind}, N={len(model.centre)}"
        return Candidate(name, "-", note, {"peer.c": model.source()}, (), model.predict(held_out))

    most = len(calibration.features)
    made = [candidate(n, kind) for kind in ("subset", "inducing") for n in CENTRES if n <= most]
    bar = EQUAL_ERROR * mean_miss(gp_mean_deg, truth_deg)
    equal = None
    for n in [n for n in LADDER if n < most] + [most] * (most <= LADDER[-1]):
        equal = candidate(n, "inducing")
        if mean_miss(equal.predicted, truth_deg) <= bar:
            equal.name += ", equal error"
            equal.note += f"; the least N with at most {EQUAL_ERROR} times the full process's error"
            break
    else:
        if equal is not None:
            equal.note += f"; no N has at most {EQUAL_ERROR} times the full process's error"
    known_names = {c.name for c in made}
    return made + [equal] * (equal is not None and equal.name not in known_names)


def polynomials(calibration, held_out):
    """Polynomial ridge regression of some degrees."""
    c, made = calibration, []
    for degree in DEGREES:

        def fit(x, y, ridge, degree=degree):
            return Polynomial.fit(x, y, degree, ridge, c.origin, 1 / c.spread)

        errors = [c.validation_error(lambda x, y, r=r: fit(x, y, r).predict, c.features) for r in RIDGES]
        ridge = RIDGES[int(np.argmin(errors))]
        model = fit(c.features, c.target_deg, ridge)
        note = f"Horner's form, {len(model.terms)} terms, ridge {ridge:g}"
        name = f"polynomial ridge, degree {degree}, float C"
        made.append(Candidate(name, "-", note, {"peer.c": model.source()}, (), model.predict(held_out)))
    return made


def host(calibration, held_out):
    """scikit-learn's process on the computer."""
    gp = calibration.gp
    note = f"runs on the host only: {gp.rows} samples, ARD-RBF and white noise by marginal likelihood"
    figures = {"fit_s": gp.fit_s, "lml": gp.lml, "rows": gp.rows}
    version = importlib.metadata.version("scikit-learn")
    name = "scikit-learn GaussianProcessRegressor"
    return [Candidate(name, version, note, {}, (), gp.predict(held_out), figures)]


def mean_miss(a, b):
    """Mean distance in degrees of [n, 2] and [n, 2]."""
    return float(np.mean(np.hypot(*(np.asarray(a) - np.asarray(b)).T)))
