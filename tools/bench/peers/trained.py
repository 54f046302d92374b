# SPDX-License-Identifier: Apache-2.0
"""Every peer, trained on one calibration: a list of Candidates. Runs in .venv-bench.

Settings are chosen by cross-validation on the calibration (training.py). What a library cannot do is a
Candidate too, with its own words.
"""

import importlib.metadata
import time
import traceback
import warnings
from itertools import product

import numpy as np

from . import float_gp, libraries
from .candidate import Candidate
from .polynomial import Polynomial
from .training import Calibration

CENTRES = (32, 64, 128)
LONGER, NOISIER = (1.0, 1.5, 2.0), (0.5, 1.0, 2.0, 4.0)  # times scikit-learn's: few centres differ
LADDER = (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768)  # N, for equal error
EQUAL_ERROR = 1.05  # of the full process's error to the truth: the project's own bar
DEGREES = (2, 3, 4)
RIDGES = (1e-10, 1e-8, 1e-6, 1e-4, 1e-2)
UNUSED = (
    ("everywhereml", "0.2.40", "classifiers (trees, forests, XGBoost), no regression; 40 packages"),
    ("sklearn-porter", "0.7.4", "import fails with scikit-learn 1.9.1: No module named 'sklearn.tree.tree'"),
)


def train(features, target_deg, held_out, truth_deg, gp_mean_deg, spread=None, say=lambda text: None):
    """Candidates for a calibration (features [n, d], target_deg [n, 2]) asked at held_out [m, d].

    truth_deg, gp_mean_deg [m, 2] decide one thing only, in favour of the peer: which number of centres
    naive float C needs for the full process's error. spread: more rows to train on (training.Calibration)
    """
    calibration = Calibration(features, target_deg, spread)
    held_out = np.asarray(held_out, float)
    made = []
    with warnings.catch_warnings(), np.errstate(all="ignore"):  # emlearn makes numpy raise on underflow
        warnings.simplefilter("ignore")  # optimisers that stop early say so; their errors are in the table
        for build, *more in (
            (naive, truth_deg, gp_mean_deg),
            (polynomials,),
            (libraries.m2cgen_svr,),
            (libraries.emlearn_networks,),
            (libraries.emlearn_trees,),
            (libraries.micromlgen_trees,),
            (libraries.micromlgen_refuses,),
            (host,),
        ):
            began = time.perf_counter()
            try:
                found = build(calibration, held_out, *more)
            except Exception as error:  # a library that fails on this calibration is a row, not the end
                say(traceback.format_exc())
                found = [Candidate(build.__name__, "-", f"failed: {type(error).__name__}: {error}"[:300])]
            made += found
            say(f"{time.perf_counter() - began:.1f} s: {', '.join(c.name for c in found)}")
    return made + [Candidate(*row) for row in UNUSED]


def naive(calibration, held_out, truth_deg, gp_mean_deg):
    """Float C with exp(): a process on a subset, and the best weights for the same centres."""
    c, gp = calibration, calibration.gp
    made, equal = [], None

    def fit(x, y, kind, n, longer, noisier):
        return float_gp.fit(x, y, n, longer * gp.length, gp.signal_deg, noisier * gp.noise_deg, kind)

    def candidate(kind, n, name, choice):
        model = fit(*c.rows(name), *choice)
        longer, noisier = choice[2:]
        note = f"{len(model.centre)} centres spread evenly, trained on {name}, "
        note += f"scikit-learn's length scales x {longer:g} and noise x {noisier:g}"
        title = f"naive float C, {kind}, N={len(model.centre)}"
        return Candidate(title, "-", note, {"peer.c": model.source()}, (), model.predict(held_out))

    def chosen(kind, n):
        choices = [(kind, n, longer, noisier) for longer, noisier in product(LONGER, NOISIER)]
        return c.best(lambda x, y, *choice: fit(x, y, *choice).predict, choices)

    rows = max(len(x) for x, *_ in c.sets.values())
    settings = {(kind, n): chosen(kind, n) for kind in ("subset", "inducing") for n in CENTRES if n <= rows}
    made += [candidate(*of, *found) for of, found in settings.items()]
    bar = EQUAL_ERROR * mean_miss(gp_mean_deg, truth_deg)
    for n in [n for n in LADDER if n <= rows]:
        near = min((of for of in settings if of[0] == "inducing"), key=lambda of: abs(np.log(of[1] / n)))
        name, choice = settings[near]
        equal = candidate("inducing", n, name, ("inducing", n, *choice[2:]))
        if mean_miss(equal.predicted, truth_deg) <= bar:
            equal.note += f"; the least N with at most {EQUAL_ERROR} times the full process's error"
            break
    else:
        equal.note += f"; no N has at most {EQUAL_ERROR} times the full process's error"
    equal.name = "naive float C, equal error" + equal.name[equal.name.rindex(","):]
    return [*made, equal]


def polynomials(calibration, held_out):
    """Polynomial ridge regression of some degrees."""
    c, made = calibration, []
    for degree in DEGREES:

        def fit(x, y, ridge, degree=degree):
            return Polynomial.fit(x, y, degree, ridge, c.origin, 1 / c.deviation)

        name, (ridge,) = c.best(lambda *a, fit=fit: fit(*a).predict, [(r,) for r in RIDGES])
        model = fit(*c.rows(name), ridge)
        note = f"Horner's form, {len(model.terms)} terms, ridge {ridge:g}, trained on {name}"
        title = f"polynomial ridge, degree {degree}, float C"
        made.append(Candidate(title, "-", note, {"peer.c": model.source()}, (), model.predict(held_out)))
    return made


def host(calibration, held_out):
    """scikit-learn's process on the computer."""
    gp = calibration.gp
    x, y = calibration.rows(gp.name)
    began = time.perf_counter()
    process = gp.process(x, y)
    solve_s = time.perf_counter() - began
    note = f"runs on the host only: ARD-RBF and white noise by marginal likelihood of {gp.rows} samples, "
    note += f"then given {len(x)}; trained on {gp.name}"
    figures = {"fit_s": gp.fit_s + solve_s, "lml": gp.lml, "rows": gp.rows}
    version = importlib.metadata.version("scikit-learn")
    name = "scikit-learn GaussianProcessRegressor"
    return [Candidate(name, version, note, {}, (), process(held_out), figures)]


def mean_miss(a, b):
    """Mean distance in degrees of [n, 2] and [n, 2]."""
    return float(np.mean(np.hypot(*(np.asarray(a) - np.asarray(b)).T)))
