# SPDX-License-Identifier: Apache-2.0
"""What a calibration costs on the host, beside scikit-learn; the same bits on every target; hard cases."""

import subprocess
import sys
import tempfile
import time
import warnings
import xml.etree.ElementTree as tree
import zlib
from itertools import product
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from sparsegaze import predict
from sparsegaze.distil import distil
from sparsegaze.errors import SparsegazeError
from sparsegaze.gp import GaussianProcess
from sparsegaze.model import emulate

ROOT = Path(__file__).resolve().parents[2]
# Where hard cases are tested, and by what in their names (or their files') they are known.
HARD_FILES = (
    "tests/unit/test_*hard*.py",
    "tests/unit/test_core_gp.py",
    "tests/unit/test_core_avr.py",
    "tests/unit/test_model.py",
    "tests/unit/test_distil.py",
    "tests/unit/test_recording.py",
    "tests/target/test_predict.py",
)
HARD_NAMES = (
    "hard",
    "corner",
    "extreme",
    "closed_lids",
    "cannot_wrap",
    "order_of",
    "nan_in",
    "hold_nan",
    "out_of_range",
)
SAMPLES, VECTORS = 2000, 64
BATCH, ROUNDS = 100_000, 5
IDENTITY_ROWS = 400


def speed(features, gaze_deg, model, quick=False):
    """Host figures for 2000 samples features [n, d], gaze_deg [n, 2]; predictions with any DeviceModel.

    fit_s, distil_s      seconds of the full process and of its distillation to 64 vectors, one BLAS thread;
                         with cpu_ before the names those of the processor, which a busy machine leaves alone
    lml                  log marginal likelihood of all samples at the parameters found, two outputs, no mean
    exact_lml, lml_gap   the best that climbing on with scikit-learn's likelihood finds, what ours lacks; nats
    sklearn_fit_s, sklearn_lml  GaussianProcessRegressor of the same kernel from its own start, all samples
    predictions_per_second      of the device model through cffi, per second of one core, best of five
    quick                       300 samples
    """
    count = 300 if quick else SAMPLES
    x, y = np.asarray(features[:count], float), np.asarray(gaze_deg[:count], float)
    y = y - y.mean(axis=0)
    with threadpool_limits(1, user_api="blas"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began = np.array([time.perf_counter(), time.process_time()])
        gp = GaussianProcess.fit(x, y, mean="zero")
        fitted = np.array([time.perf_counter(), time.process_time()])
        distil(gp, x, y, VECTORS)
        distilled = np.array([time.perf_counter(), time.process_time()])
        names = "fit_s", "distil_s", "cpu_fit_s", "cpu_distil_s"
        figures = dict(zip(names, np.column_stack([fitted - began, distilled - fitted]).ravel().tolist()))
        figures.update(samples=count, **against_sklearn(gp, x, y))
    return {**figures, "predictions_per_second": rate(model, features)}


def against_sklearn(gp, x, y):
    """Likelihoods and scikit-learn's time on centred y; see `speed`. x may be in any units."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    unit, level = x.std(axis=0), np.sqrt(np.mean(y**2))
    scaled, whole = x / unit, y / level
    # A density of y / level is level times as dense at each of its entries.
    jacobian = y.size * np.log(level)

    def regressor(signal, length, noise):
        smooth = ConstantKernel(signal**2, (1e-6, 1e9)) * RBF(length, (1e-3, 1e5))
        return GaussianProcessRegressor(smooth + WhiteKernel(noise**2, (1e-10, 1e2)), alpha=0.0)

    began, began_cpu = time.perf_counter(), time.process_time()
    theirs = regressor(1.0, np.ones(x.shape[1]), 0.1).fit(scaled, whole)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - began_cpu
    hyper = gp.hyper
    at_ours = regressor(hyper.signal_deg / level, hyper.length / unit, hyper.noise_deg / level)
    climbed = at_ours.fit(scaled, whole)
    ours = climbed.log_marginal_likelihood(at_ours.kernel.theta) - jacobian
    best = max(climbed.log_marginal_likelihood_value_, theirs.log_marginal_likelihood_value_) - jacobian
    return {
        "lml": float(ours),
        "exact_lml": float(max(best, ours)),
        "lml_gap": float(max(best - ours, 0.0)),
        "sklearn_fit_s": seconds,
        "cpu_sklearn_fit_s": cpu_seconds,
        "sklearn_lml": float(theirs.log_marginal_likelihood_value_ - jacobian),
    }


def rate(model, features):
    """Predictions a second of a DeviceModel by the firmware's own code through cffi, one core."""
    rows = np.resize(np.asarray(features, np.uint16), (BATCH, features.shape[1]))
    model.predict(rows[:100])
    best = np.inf
    for _ in range(ROUNDS):
        began = time.process_time()
        model.predict(rows)
        best = min(best, time.process_time() - began)
    return BATCH / best


def identity(model, features, benches, say):
    """One CRC-32 over the bytes of all answers, by target; to features uint16 [n, d] all corners are added.

    benches   {name: inference_cycles.Bench}: the core alone on the ATmega328P
    Returns {"targets": [...], "crc": [...], "missing": {target: why}, "rows": n}.
    """
    corners = np.array(list(product((0, 65535), repeat=features.shape[1])), np.uint16)
    rows = np.vstack([features[:IDENTITY_ROWS], corners])
    crc, missing = {}, {}
    azimuth, elevation, flags = emulate(model, rows)[:3]
    for name, bench in benches.items():
        gaze = bench.run(model, rows).gaze
        crc[f"ATmega328P core, {name}"] = f"{zlib.crc32(gaze):08X}"
    for target in predict.TARGETS:
        say(f"identity: {target}")
        try:
            made = predict.predict(model, rows, target)
        except (SparsegazeError, OSError) as error:
            missing[target] = str(error)
            continue
        if target == "host":
            same = np.array_equal(made.gaze["azimuth_deg_q7"], azimuth)
            same &= np.array_equal(made.gaze["elevation_deg_q7"], elevation) & np.array_equal(
                made.flags, flags
            )
            crc["numpy integers, gaze and flags"] = f"{made.crc:08X}" if same else "differs"
        crc[target] = f"{made.crc:08X}"
    return {"targets": list(crc), "crc": list(crc.values()), "missing": missing, "rows": len(rows)}


def hard_cases(patterns=HARD_FILES):
    """[{name, outcome}] of the tests of hard cases, run now. Outcome: passed, failed, error or skipped."""
    files = sorted({str(path.relative_to(ROOT)) for pattern in patterns for path in ROOT.glob(pattern)})
    if not files:
        return []
    with tempfile.TemporaryDirectory(prefix="sgh-") as folder:
        report = Path(folder) / "hard.xml"
        chosen = " or ".join(HARD_NAMES)
        command = [sys.executable, "-m", "pytest", "-q", "-k", chosen, f"--junitxml={report}", *files]
        subprocess.run(command, cwd=ROOT, capture_output=True, timeout=3600)
        if not report.is_file():
            return [{"name": name, "outcome": "error"} for name in files]
        return outcomes(report)


def outcomes(report):
    """[{name, outcome}] of a JUnit file."""
    rows = []
    for case in tree.parse(report).getroot().iter("testcase"):
        tags = {child.tag for child in case}
        words = (("error", "error"), ("failure", "failed"), ("skipped", "skipped"))
        outcome = next((word for tag, word in words if tag in tags), "passed")
        name = f"{case.get('classname', '').split('.')[-1]}::{case.get('name')}"
        rows.append({"name": name, "outcome": outcome})
    return rows
