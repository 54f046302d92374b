# SPDX-License-Identifier: Apache-2.0
"""Pieces of the benchmark of inference that are kept between runs: fits, costs, references of a data set.

Each stands beside its data set with the hash of what it was made from, the code included.
"""

import ast
import os
import pickle
import time
from pathlib import Path

import inference_cycles
import inference_data
import inference_judge
import numpy as np
from threadpoolctl import threadpool_limits

PACKAGE = Path(__file__).resolve().parents[2] / "host_sdk" / "sparsegaze"
DEFAULT_N = 64
PLAIN_LEARN, PLAIN_ROWS = 400, 2000
COSTS = ("cycles_min", "cycles_max", "flash", "ram", "bytes", "identical")


def fit(recording, n_vectors):
    """The one place where the product's fit is called: a fit.FitResult."""
    from sparsegaze.fit import fit_recording

    return fit_recording(recording, n_vectors=n_vectors)


def kept(path, key, make):
    """What make() returns, from the file at `path` when it was made under the same key."""
    try:
        with open(path, "rb") as file:
            stored = pickle.load(file)
        if stored["key"] == key:
            return stored["value"]
    except (OSError, EOFError, pickle.UnpicklingError, KeyError, AttributeError):
        pass
    value = make()
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    with open(part, "wb") as file:
        pickle.dump({"key": key, "value": value}, file)
    part.replace(path)
    return value


def sources_of(module):
    """Files of the package that `module` imports, by whatever path, and itself."""
    found, ahead = set(), [module]
    while ahead:
        path = PACKAGE / f"{ahead.pop()}.py"
        if path in found or not path.is_file():
            continue
        found.add(path)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.level == 1:
                ahead += [node.module] if node.module else [alias.name for alias in node.names]
    return sorted(found)


def fitted(folder, data, n_vectors):
    """{image, gp_deg, gp_std, noise_deg, spread, seconds} of a data set's fit to so many vectors.

    gp_deg [n, 2] and gp_std [n]: the float64 process at every held-out row, and its noise_deg; spread
    (features [k, d], gaze_deg [k, 2]): the rows that it was given, moved frames among them. gp_std and spread
    at DEFAULT_N only.
    """
    words = data.key["hash"], n_vectors, inference_cycles.core_hash()

    def make():
        began = time.perf_counter()
        result = fit(data.calibration, n_vectors)
        seconds = time.perf_counter() - began
        features = data.held_out.features.astype(float)
        std = None
        if n_vectors == DEFAULT_N:
            mean, std = result.gp.predict(features, return_std=True)
        else:
            mean = result.gp.predict(features)
        return {
            "image": result.model.image,
            "gp_deg": mean,
            "gp_std": std,
            "noise_deg": result.gp.hyper.noise_deg,
            "spread": (result.gp.x, result.gp.y) if n_vectors == DEFAULT_N else None,
            "seconds": seconds,
        }

    key = inference_data.file_hash([*sources_of("fit"), Path(__file__)], *words)
    return kept(Path(folder) / f"fit-{n_vectors}.pickle", key, make)


def model_of(piece):
    """DeviceModel of what `fitted` returns."""
    from sparsegaze.model import DeviceModel

    return DeviceModel(piece["image"])


def row(folder, n_vectors):
    """One row of the frontier: a data set (its folder) and a number of vectors; None: the product chooses."""
    folder = Path(folder)
    data = inference_data.DataSet.load(folder)
    piece = fitted(folder, data, n_vectors)
    model = model_of(piece)
    figures = inference_judge.judge(data, model, piece["gp_deg"], inference_judge.shared_rows(data))
    rows = data.held_out.features[data.held_out.valid]
    key = inference_data.file_hash([], inference_cycles.core_hash(), data.key["hash"], model.crc)

    def count():
        cost = inference_cycles.Bench(folder.parent / f"avr-{os.getpid()}").run(model, rows)
        return {name: getattr(cost, name) for name in COSTS}

    cost = kept(folder / f"cost-{n_vectors}.pickle", key, count)
    found = {
        "dataset": data.name,
        "kind": data.kind,
        "n": n_vectors or model.vectors,
        "default": n_vectors is None,
        "cycles": cost["cycles_max"],
        **cost,
        **figures,
    }
    if n_vectors == DEFAULT_N:
        rows = data.held_out.valid
        plainly, true = plain_process(folder, data)[rows], data.truth["held_out_gaze_deg"][rows]
        found["plain_gp64_truth_mean_deg"] = float(inference_judge.distances_deg(plainly, true).mean())
    return {**found, "fit_s": piece["seconds"]}


def plain_process(folder, data):
    """What a process plainly fitted to single frames gives: float64 [n, 2], every held-out row.

    The reference beside the product's own (which learns from means of fixations, see fit.fit_recording):
    hyper-parameters by the likelihood of 400 of the frames.
    """
    from sparsegaze.gp import GaussianProcess

    def make():
        valid = np.flatnonzero(data.calibration.valid)

        def thinned(most):
            rows = valid[np.unique(np.linspace(0, len(valid) - 1, min(most, len(valid))).astype(int))]
            return data.calibration.features[rows].astype(float), data.calibration.target_deg[rows]

        with threadpool_limits(1, user_api="blas"):
            hyper = GaussianProcess.fit(*thinned(PLAIN_LEARN), mean="constant", length_max=3.0).hyper
            process = GaussianProcess.fit(*thinned(PLAIN_ROWS), mean="constant", hyper=hyper)
            return process.predict(data.held_out.features.astype(float))

    key = inference_data.file_hash(sources_of("gp"), data.key["hash"], PLAIN_LEARN, PLAIN_ROWS)
    return kept(Path(folder) / "plain.pickle", key, make)
