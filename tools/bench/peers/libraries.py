# SPDX-License-Identifier: Apache-2.0
"""Models that libraries write out as C: m2cgen, emlearn, micromlgen. Runs in .venv-bench.

Their text is compiled as it comes; a wrapper scales the inputs and calls it once for each output.
"""

import importlib.metadata
import re
from itertools import product
from pathlib import Path

import emlearn
import m2cgen
import micromlgen
import numpy as np
from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.kernel_ridge import KernelRidge
from sklearn.neural_network import MLPRegressor
from sklearn.svm import SVR

from .candidate import Candidate, scaling

SVR_ROWS = 600  # its cost grows with their square and more
SVR_CHOICES = tuple(product((100.0, 1000.0, 5000.0), (0.05, 0.15, 0.4)))  # C, gamma
SVR_TUBES_DEG = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
SVR_VECTORS_FIT = 68  # of both outputs: at 390 bytes of code each, what 30 KB hold
NETWORKS = (((16,), "tanh"), ((16,), "relu"), ((16, 16), "tanh"), ((16, 16), "relu"))
MLP_ROWS, MLP_ALPHAS, MLP_SEEDS, MLP_STEPS = 800, (1e-5, 1e-3, 1e-1), 2, (400, 2000)
FORESTS = ((1, 40), (1, 120), (1, 300), (3, 110), (6, 55), (10, 32))  # trees, leaves: what 30 KB hold
WRAPPED = """#include "peer.h"

{scaling}
{declare}

void peer_predict(const uint16_t *feature, float *gaze_deg)
{{
    {type} x[PEER_CHANNELS];
    {scale};
    gaze_deg[0] = {azimuth};
    gaze_deg[1] = {elevation};
}}
"""
TREE_SCALE = "for (uint8_t j = 0; j < PEER_CHANNELS; j++) x[j] = feature[j]"


def m2cgen_svr(calibration, held_out):
    """SVR with the best error, and the best that fits the flash; one function of C for each output."""
    c, rows = calibration, calibration.at_most(SVR_ROWS)
    few = type(c)(c.features[rows], c.target_deg[rows], c.seed)
    few.origin, few.spread = c.origin, c.spread
    x = few.standard(few.features)

    def pair(x, y, cost, gamma, tube):
        return [SVR(C=cost, gamma=gamma, epsilon=tube).fit(x, y[:, o]) for o in (0, 1)]

    def judge(cost, gamma, tube):
        return few.validation_error(lambda x, y: _stacked(pair(x, y, cost, gamma, tube)), x)

    def best(tube):
        errors = [judge(*choice, tube) for choice in SVR_CHOICES]
        return min(errors), SVR_CHOICES[int(np.argmin(errors))]

    _, choice = best(0.3)
    tube = min(SVR_TUBES_DEG[:6], key=lambda tube: judge(*choice, tube))
    made = [_svr(c, held_out, pair(x, few.target_deg, *choice, tube), (*choice, tube), "best error")]
    for tube in SVR_TUBES_DEG:
        models = pair(x, few.target_deg, *choice, tube)
        if sum(len(m.support_) for m in models) <= SVR_VECTORS_FIT:
            _, choice = best(tube)
            models = pair(x, few.target_deg, *choice, tube)
            made.append(_svr(c, held_out, models, (*choice, tube), "small enough"))
            break
    return made


def _svr(calibration, held_out, models, choice, why):
    names = ("svr_azimuth", "svr_elevation")
    sources = {f"{n}.c": m2cgen.export_to_c(m, function_name=n) for n, m in zip(names, models, strict=True)}
    sources["peer.c"] = WRAPPED.format(
        scaling=scaling(calibration.origin, 1 / calibration.spread, "double"),
        declare="".join(f"double {n}(double *);\n" for n in names),
        type="double",
        scale="peer_scale(feature, x)",
        azimuth="svr_azimuth(x)",
        elevation="svr_elevation(x)",
    )
    count = " + ".join(str(len(m.support_)) for m in models)
    note = "RBF, C {:g}, gamma {:g}, epsilon {:g} deg; ".format(*choice) + f"{count} support vectors"
    predicted = _stacked(models)(calibration.standard(held_out))
    return Candidate(f"m2cgen SVR, {why}", _version("m2cgen"), note, sources, (), predicted)


def emlearn_networks(calibration, held_out):
    """Multilayer perceptrons in float."""
    c, rows, made = calibration, calibration.at_most(MLP_ROWS), []
    y = (c.target_deg - c.target_deg.mean(axis=0)) / c.level_deg
    x, middle = c.standard(c.features), c.target_deg.mean(axis=0)
    few = type(c)(c.features[rows], c.target_deg[rows], c.seed)

    def network(layers, kind, alpha, seed, steps, x, y):
        return MLPRegressor(
            hidden_layer_sizes=layers,
            activation=kind,
            alpha=alpha,
            solver="lbfgs",
            max_iter=steps,
            max_fun=10 * steps,
            tol=1e-9,
            random_state=seed,
        ).fit(x, y)

    for layers, kind in NETWORKS:

        def judged(alpha, layers=layers, kind=kind):
            def make(x, y):
                model = network(layers, kind, alpha, 0, MLP_STEPS[0], x, (y - middle) / c.level_deg)
                return lambda q: model.predict(q) * c.level_deg + middle

            return few.validation_error(make, x[rows], few.folds[:2])

        alpha = min(MLP_ALPHAS, key=judged)
        tries = [network(layers, kind, alpha, seed, MLP_STEPS[1], x, y) for seed in range(MLP_SEEDS)]
        model = min(tries, key=lambda m: m.loss_)
        predicted = model.predict(c.standard(held_out)) * c.level_deg + middle
        shape = "-".join(str(n) for n in (x.shape[1], *layers, 2))
        note = f"L-BFGS, alpha {alpha:g}, best training loss of {MLP_SEEDS} starts; weights stay in SRAM"
        model.coefs_[-1] = model.coefs_[-1] * c.level_deg  # the last layer answers in degrees
        model.intercepts_[-1] = model.intercepts_[-1] * c.level_deg + middle
        made.append(_network(c, model, f"emlearn MLP {shape} {kind}", note, predicted))
    return made


def _network(calibration, model, name, note, predicted):
    code = emlearn.convert(model, method="loadable", return_type="regressor").save(name="net")
    text = f"""#include "peer.h"
#include "net.h"

{scaling(calibration.origin, 1 / calibration.spread)}
void peer_predict(const uint16_t *feature, float *gaze_deg)
{{
    float x[PEER_CHANNELS];
    peer_scale(feature, x);
    net_regress(x, PEER_CHANNELS, gaze_deg, 2);
}}
"""
    include = (str(Path(emlearn.__file__).parent),)
    return Candidate(name, _version("emlearn"), note, {"net.h": code, "peer.c": text}, include, predicted)


def emlearn_trees(calibration, held_out):
    """A decision tree and a random forest on integers, nested ifs in flash; one for each output."""
    made, halve = [], bool(max(calibration.features.max(), np.max(held_out)) > 32767)
    for name, choices in (("tree", [f for f in FORESTS if f[0] == 1]), ("forest", FORESTS)):
        models, note, predicted = _forest(calibration, held_out, choices, halve)
        sources = {}
        for output, model in zip(("azimuth", "elevation"), models, strict=True):
            for tree in (e.tree_ for e in model.estimators_):
                # scikit-learn asks x <= 7.5; emlearn would cut that to x < 7 and answer differently at 7.
                tree.threshold[:] = np.floor(tree.threshold) + 1
            code = emlearn.convert(model, method="inline", dtype="int16_t").save(name=f"tree_{output}")
            sources[f"tree_{output}.h"] = code
        sources["peer.c"] = WRAPPED.format(
            scaling="",
            declare="".join(f'#include "{n}"\n' for n in sources),
            type="int16_t",
            scale=TREE_SCALE + " >> 1" * halve,
            azimuth="tree_azimuth_predict(x, PEER_CHANNELS)",
            elevation="tree_elevation_predict(x, PEER_CHANNELS)",
        )
        include = (str(Path(emlearn.__file__).parent),)
        note = "features halved to int16; " * halve + note
        made.append(Candidate(f"emlearn {name}", _version("emlearn"), note, sources, include, predicted))
    return made


def micromlgen_trees(calibration, held_out):
    """A decision tree of floats in flash, in C++."""
    choices = [f for f in FORESTS if f[0] == 1]
    models, note, predicted = _forest(calibration, held_out, choices, False)
    sources = {"cstdarg": "#include <stdarg.h>\n"}
    names = ("TreeAzimuth", "TreeElevation")
    for name, model in zip(names, models, strict=True):
        code = micromlgen.port(model.estimators_[0], classname=name)
        sources[f"{name}.h"] = re.sub("#pragma once", "", code)
    sources["peer.cpp"] = WRAPPED.format(
        scaling="",
        declare="".join(f'#include "{n}.h"\nstatic Eloquent::ML::Port::{n} at_{n};\n' for n in names),
        type="float",
        scale=TREE_SCALE,
        azimuth="at_TreeAzimuth.predict(x)",
        elevation="at_TreeElevation.predict(x)",
    )
    note += "; avr-g++ has no <cstdarg>, which it includes: compiled with a one-line stand-in"
    return [Candidate("micromlgen tree", _version("micromlgen"), note, sources, (), predicted)]


def micromlgen_refuses(calibration):
    """What micromlgen says to the models that suit this task."""
    c = calibration
    x, y = c.standard(c.features)[c.at_most(60)], c.target_deg[c.at_most(60), 0]
    said = {}
    for model in (GaussianProcessRegressor(), KernelRidge(), SVR(), MLPRegressor(max_iter=5)):
        try:
            micromlgen.port(model.fit(x, y))
        except Exception as error:  # its own choice of error is what is asked for
            said[type(model).__name__] = f"{type(error).__name__}: {str(error)[:60]}"
    note = "refused: " + "; ".join(f"{name} ({words})" for name, words in said.items())
    return [Candidate("micromlgen kernels and networks", _version("micromlgen"), note)]


def _forest(calibration, held_out, choices, halve):
    """(models of both outputs, note, predicted): trees and leaves by cross-validation."""
    c = calibration
    quantise = (lambda f: np.floor(np.asarray(f) / 2)) if halve else np.asarray

    def pair(x, y, trees, leaves):
        return [
            RandomForestRegressor(trees, max_leaf_nodes=leaves, bootstrap=trees > 1, random_state=c.seed).fit(
                x, y[:, o]
            )
            for o in (0, 1)
        ]

    x = quantise(c.features)
    trees, leaves = min(
        choices, key=lambda f: c.validation_error(lambda x, y: _stacked(pair(x, y, *f)), x)
    )
    models = pair(x, c.target_deg, trees, leaves)
    note = f"{trees} x {leaves} leaves at most for each output"
    return models, note, _stacked(models)(quantise(held_out))


def _stacked(models):
    return lambda x: np.column_stack([m.predict(x) for m in models])


def _version(package):
    return importlib.metadata.version(package)
