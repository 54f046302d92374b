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

SVR_ROWS, SVR_JUDGED = 600, 400  # its cost grows with their square and more
SVR_CHOICES = (100.0, 1000.0, 5000.0), (0.05, 0.15, 0.4)  # C, gamma
SVR_TUBES_DEG = (0.05, 0.2, 0.5)
SVR_WIDEST_DEG, SVR_HALVINGS = 8.0, 7
SVR_EXPORTED = 300  # of one output: m2cgen recurses for each vector, up to Python's limit
SVR_VECTORS_FIT = 72  # of both outputs: at 400 bytes of code each, what 30 KB hold
NETWORKS = (((16,), "tanh"), ((16,), "relu"), ((16, 16), "tanh"), ((16, 16), "relu"))
MLP_ROWS, MLP_SEEDS = 1000, 3
MLP_WORK, MLP_STEPS = 2e6, (500, 5000)  # samples times steps; least and most steps
MLP_DECAYS = (5e-5, 2e-6, 5e-4)
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
    c = calibration

    def pair(x, y, cost, gamma, tube):
        return [SVR(C=cost, gamma=gamma, epsilon=tube).fit(c.standard(x), y[:, o]) for o in (0, 1)]

    def make(x, y, *choice):
        models = pair(x, y, *choice)
        return lambda q: _stacked(models)(c.standard(q))

    def chosen(costs, tubes, names=None):
        return c.best(make, list(product(*costs, tubes)), SVR_JUDGED, 2, names)

    def trained(name, choice):
        return pair(*c.rows(name, SVR_ROWS), *choice)

    name, choice = chosen(SVR_CHOICES, SVR_TUBES_DEG[1:2])
    name, choice = chosen([[v] for v in choice[:2]], SVR_TUBES_DEG, [name])
    made = [_svr(c, held_out, trained(name, choice), name, choice, "best error")]
    for _ in range(2):  # the tube that leaves few enough vectors, then what suits that tube
        low, high = SVR_TUBES_DEG[0], SVR_WIDEST_DEG
        for _ in range(SVR_HALVINGS):
            tube = float(np.sqrt(low * high))
            count = sum(len(m.support_) for m in trained(name, (*choice[:2], tube)))
            low, high = (low, tube) if count <= SVR_VECTORS_FIT else (tube, high)
        small = name, (*choice[:2], high)
        name, choice = chosen(SVR_CHOICES, [high], [name])
    return [*made, _svr(c, held_out, trained(*small), *small, "small enough")]


def _svr(calibration, held_out, models, name, choice, why):
    names, title = ("svr_azimuth", "svr_elevation"), f"m2cgen SVR, {why}"
    counts = [len(m.support_) for m in models]
    note = "RBF, C {:g}, gamma {:g}, epsilon {:.3g} deg; ".format(*choice)
    note += f"{counts[0]} + {counts[1]} support vectors, trained on {name}"
    predicted = _stacked(models)(calibration.standard(held_out))
    if max(counts) > SVR_EXPORTED:
        note += f"; too many for m2cgen itself, which recurses ({SVR_EXPORTED} are not); the PC's error"
        return Candidate(title, _version("m2cgen"), note, predicted=predicted)
    sources = {f"{n}.c": m2cgen.export_to_c(m, function_name=n) for n, m in zip(names, models, strict=True)}
    sources["peer.c"] = WRAPPED.format(
        scaling=scaling(calibration.origin, 1 / calibration.deviation, "double"),
        declare="".join(f"double {n}(double *);\n" for n in names),
        type="double",
        scale="peer_scale(feature, x)",
        azimuth="svr_azimuth(x)",
        elevation="svr_elevation(x)",
    )
    return Candidate(title, _version("m2cgen"), note, sources, (), predicted)


def emlearn_networks(calibration, held_out):
    """Multilayer perceptrons in float."""
    c, made = calibration, []

    def network(x, y, layers, kind, decay, seed):
        steps = int(np.clip(MLP_WORK / len(x), *MLP_STEPS))
        return MLPRegressor(
            hidden_layer_sizes=layers,
            activation=kind,
            alpha=decay * len(x),  # scikit-learn divides it by the number of samples
            solver="lbfgs",
            max_iter=steps,
            max_fun=10 * steps,
            tol=1e-9,
            random_state=seed,
        ).fit(c.standard(x), (y - c.middle_deg) / c.level_deg)

    def make(x, y, layers, kind, decay):
        model = network(x, y, layers, kind, decay, 0)
        return lambda q: model.predict(c.standard(q)) * c.level_deg + c.middle_deg

    name, _ = c.best(make, [(*NETWORKS[0], MLP_DECAYS[0])], MLP_ROWS, 2)
    for layers, kind in NETWORKS:
        choices = [(layers, kind, decay) for decay in MLP_DECAYS]
        _, (*_, decay) = c.best(make, choices, MLP_ROWS, 2, [name])
        rows = c.rows(name)
        tries = [network(*rows, layers, kind, decay, seed) for seed in range(MLP_SEEDS)]
        model = min(tries, key=lambda m: m.loss_)
        shape = "-".join(str(n) for n in (len(c.origin), *layers, 2))
        note = f"L-BFGS, alpha {decay:g} a sample, best training loss of {MLP_SEEDS} starts, "
        note += f"trained on {name}; weights stay in SRAM"
        model.coefs_[-1] = model.coefs_[-1] * c.level_deg  # the last layer answers in degrees
        model.intercepts_[-1] = model.intercepts_[-1] * c.level_deg + c.middle_deg
        predicted = model.predict(c.standard(held_out))
        made.append(_network(c, model, f"emlearn MLP {shape} {kind}", note, predicted))
    return made


def _network(calibration, model, name, note, predicted):
    code = emlearn.convert(model, method="loadable", return_type="regressor").save(name="net")
    text = f"""#include "peer.h"
#include "net.h"

{scaling(calibration.origin, 1 / calibration.deviation)}
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


def micromlgen_refuses(calibration, _held_out):
    """What micromlgen says to the models that suit this task."""
    c = calibration
    x, y = c.rows("frames", 60)
    x, y = c.standard(x), y[:, 0]
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

    def quantise(features):
        return np.rint(np.asarray(features)) // (2 if halve else 1)

    def pair(x, y, trees, leaves):
        return [
            RandomForestRegressor(trees, max_leaf_nodes=leaves, bootstrap=trees > 1, random_state=c.seed).fit(
                quantise(x), y[:, o]
            )
            for o in (0, 1)
        ]

    def make(x, y, *choice):
        models = pair(x, y, *choice)
        return lambda q: _stacked(models)(quantise(q))

    name, (trees, leaves) = c.best(make, choices)
    models = pair(*c.rows(name), trees, leaves)
    note = f"{trees} x {leaves} leaves at most for each output, trained on {name}"
    return models, note, _stacked(models)(quantise(held_out))


def _stacked(models):
    return lambda x: np.column_stack([m.predict(x) for m in models])


def _version(package):
    return importlib.metadata.version(package)
