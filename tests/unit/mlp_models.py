# SPDX-License-Identifier: Apache-2.0
"""Stored networks for tests of sg_mlp."""
import pathlib
import sys

import numpy as np

from sparsegaze.mlp import HALF, Z_END, Layer, MlpModel

BENCH = pathlib.Path(__file__).resolve().parents[2] / "tools" / "bench"
TYPICAL_HIDDEN, TYPICAL_OUTPUT = 12000, 256 * 4000      # of q: tanh(1), and 31 degrees


def filled_layer(rng, rows, columns, weight_bytes, typical):
    """A layer whose rows use all of their 24 bits, with q about `typical` for ordinary activations."""
    half = HALF[weight_bytes]
    weights = rng.integers(-half, half, (rows, columns))
    room = (Z_END - 1) // 256 - 2 * columns
    total = np.abs(weights).sum(axis=1, keepdims=True)
    shrunk = np.trunc(weights * (room / np.maximum(total, 1))).astype(np.int64)
    weights = np.where(total > room, shrunk, weights)
    spread = 128 * 0.6 * np.sqrt((weights.astype(float) ** 2).sum(axis=1)) + 1
    up, down = np.maximum(weights, 0).sum(axis=1), np.maximum(-weights, 0).sum(axis=1)
    low, high = -Z_END + 256 * (down + columns), Z_END - 1 - 256 * (up + columns)
    bias = -128 * weights.sum(axis=1) + np.rint(rng.normal(0, 0.5, rows) * spread).astype(np.int64)
    scale = np.clip(np.rint(typical * 256 / spread), 1, 65535).astype(np.int64)
    return Layer(weights, np.clip(bias, low, high), scale, weight_bytes)


def random_model(rng, inputs, widths, outputs, weight_bytes, typical=TYPICAL_HIDDEN):
    """A network that is right in form, with wild content; weight_bytes: one for each layer."""
    shapes = list(zip([*widths, outputs], [inputs, *widths], weight_bytes))
    layers = [filled_layer(rng, *shape, typical) for shape in shapes[:-1]]
    layers.append(filled_layer(rng, *shapes[-1], TYPICAL_OUTPUT))
    return MlpModel.from_layers(rng.integers(0, 30000, inputs), rng.integers(700, 3000, inputs), layers)


def inputs_near(rng, model, n):
    """uint16 [n, inputs]: most inside the range of every input, some beyond."""
    span = 65536 * 256 / model.gain_q8
    x = model.offset + rng.uniform(-0.02, 1.02, (n, model.inputs)) * span
    return np.clip(x, 0, 65535).astype(np.uint16)


def golden_case():
    """The network and inputs behind the golden checksum."""
    rng = np.random.default_rng(20260)
    model = random_model(rng, 6, (16, 13, 5), 2, (2, 1, 2, 2), typical=40000)
    return model, inputs_near(rng, model, 64)


def expected_bytes(model, features):
    """What the targets' programs write for each point, by the host's core: outputs, flags, verdict."""
    *outputs, flags = model.predict(features)
    y = (np.array(outputs).T * 128).astype("<i2")
    saturated = np.any(np.abs(y) == 32767, axis=1)
    verdict = np.where(saturated, 256 - 2, 0).astype(np.uint8)
    return b"".join(row.tobytes() + bytes([f, v]) for row, f, v in zip(y, flags, verdict))


def synthetic_set(seed):
    """A smooth synthetic set of tools/bench/inference_data.py: features float [289, 6], gaze, held-out
    features uint16 [2000, 6], their true gaze."""
    sys.path.insert(0, str(BENCH))
    try:
        from inference_data import synthetic
    finally:
        sys.path.remove(str(BENCH))
    made = synthetic("smooth", seed)
    fitted, held = made.calibration, made.held_out
    return fitted.features.astype(float), fitted.target_deg, held.features, held.target_deg
