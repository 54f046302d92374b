# SPDX-License-Identifier: Apache-2.0
"""A float64 network (mlp_train.Network) as the integers of a device (mlp.MlpModel), and what that costs.

The integers are found layer by layer: each layer's weights are fitted to the float network's own sums, given
the activations that the device's rounded earlier layers really produce, and rounded one column after the
other, those still free making good what rounding cost. The last layer is fitted to the float network's
outputs. A pure function of its arguments.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from threadpoolctl import threadpool_limits

from .errors import CalibrationError
from .mlp import (
    HALF,
    ONE,
    OUTPUT_ONE,
    TANH_ONE,
    Z_END,
    Layer,
    MlpModel,
    activations,
    emulate,
    squash,
    sums,
)

MARGIN = 0.12  # of an input's calibrated range, on each side
RIDGE = 1e-5  # of an activation's variance, towards the float weights
LIMIT = 0.02  # units of output: distance to the float network up to which a layer may have 1-byte weights
TANH_ERROR = 1.8  # activation steps: table, interpolation and rounding (sg_mlp.h)


@dataclass(frozen=True)
class QuantReport:
    """What rounding to the device's integers cost, in units of the output.

    rms, max       distance to the float network over the rows given, all outputs together (max: of one row)
    bound          proven distance, for any input, between the device and the real-number network of the same
                   integers: roundings of activations, products and tanh, the largest of the outputs
    bound_rows     the same for the rows given, and what of it was reached there
    reached
    weight_bytes   of each layer; n_bytes of the image; scratch_bytes that a prediction needs
    """

    rms: float
    max: float
    bound: float
    bound_rows: float
    reached: float
    weight_bytes: tuple
    n_bytes: int
    scratch_bytes: int


def quantise(network, features, weight_bytes="auto", limit=LIMIT, margin=MARGIN):
    """A network in the device's integers.

    features       [n, d] 0..65535, rows such as the device will meet: their range and a margin is what inputs
                   may have without being flagged, and the integers are fitted on them
    weight_bytes   1 or 2 for all layers, a tuple with one for each, or "auto": 1 for the largest layers, as
                   long as the rms distance to the float network stays below `limit` (units of output), else 2
    Returns (MlpModel, QuantReport). Raises CalibrationError when no format holds the network.
    """
    x = np.clip(np.rint(np.asarray(features, float)), 0, 65535).astype(np.uint16)
    if x.ndim != 2 or x.shape[1] != len(network.mean) or not len(x):
        raise CalibrationError(f"features {x.shape} for {len(network.mean)} inputs", "give [n, d]")
    x = x[np.lexsort(x.T)]  # the order of the rows must not matter, not even for rounding
    count = len(network.layers)
    with threadpool_limits(1):
        if weight_bytes != "auto":
            given = (weight_bytes,) * count if isinstance(weight_bytes, int) else tuple(weight_bytes)
            if len(given) != count or not set(given) <= {1, 2}:
                none = f"weight_bytes {weight_bytes} for {count} layers"
                raise CalibrationError(none, "give 1 or 2 for each layer")
            return _quantised(network, x, given, margin)
        chosen = (2,) * count
        best = _quantised(network, x, chosen, margin)
        for k in sorted(range(count), key=lambda k: -network.layers[k][0].size):
            trial = chosen[:k] + (1,) + chosen[k + 1 :]
            made = _quantised(network, x, trial, margin)
            if made[1].rms <= limit:
                chosen, best = trial, made
    return best


def error_bound(model, features=None):
    """Proven |device - real_outputs| of each output [outputs], in its unit, where no output saturates.

    For any input, every tanh as steep as at 0; with features [n, inputs] for those rows, each tanh as steep
    as it can be there."""
    real = None if features is None else activations(model, features)[0] / ONE - 1.0
    error = np.zeros((1, model.inputs))  # of an activation, in its steps
    for k, layer in enumerate(model.layers):
        z = error @ np.abs(layer.weights).T / 256 + _products(layer)[1]
        q = z * layer.scale / 256 + 0.5
        if k == len(model.layers) - 1:
            return (q / 256 + 0.5).max(axis=0) / OUTPUT_ONE
        slope = 1.0
        if real is not None:
            u = _real_q(layer, real)
            slope = np.cosh(np.minimum(np.maximum(np.abs(u) - q, 0) / TANH_ONE, 300.0)) ** -2.0
            real = np.tanh(u / TANH_ONE)
        error = np.minimum(slope * q * ONE / TANH_ONE + TANH_ERROR, 2 * ONE)


def real_outputs(model, features):
    """What the real-number network of the same integers gives, float64 [n, outputs]: no rounding behind the
    inputs' own. What shortened products are off in the mean counts as bias."""
    a = activations(model, features)[0] / ONE - 1.0
    for layer in model.layers[:-1]:
        a = np.tanh(_real_q(layer, a) / TANH_ONE)
    return _real_q(model.layers[-1], a) / 256 / OUTPUT_ONE


def _real_q(layer, a):
    bias = layer.bias + 128.0 * layer.weights.sum(axis=1) + _products(layer)[0]
    return (128.0 * (a @ layer.weights.T) + bias) * layer.scale / 256


def _products(layer):
    """(mean [r], largest distance from it [r]) of what z gains by shortened products, if every low byte of an
    activation is as likely as any other."""
    rows, columns = layer.weights.shape
    if layer.weight_bytes == 1:  # each loses its low byte, S >> 1 a half
        lost = 127.5 / 256 * columns
        return np.full(rows, 0.25 - lost), np.full(rows, 0.25 + lost)
    share = 0.5 - (layer.weights & 255) / 256  # of an activation's low byte: L >> 1, without lo * lo
    return 127.5 * share.sum(axis=1) - 0.25, 127.5 * np.abs(share).sum(axis=1) + 0.25


def _quantised(network, x, weight_bytes, margin):
    offset, gain_q8 = _windows(network, x, margin)
    step = np.where(gain_q8 > 0, 256.0 / np.maximum(gain_q8, 1), 0.0)
    inputs = _Inputs(offset, gain_q8)
    a, clamped = activations(inputs, x)
    a, x = a[~clamped], x[~clamped]
    # the first layer in activations: x = offset + step * (a + 1/2), a = 32768 (alpha + 1)
    w, b = network.layers[0]
    v = w @ network.whiten.T
    layers = [(v * step * ONE, b + v @ (offset + step * (ONE + 0.5) - network.mean)), *network.layers[1:]]
    w, b = layers[-1]
    layers[-1] = w * network.scale_y[:, None], b * network.scale_y + network.mean_y
    h, made = (x - network.mean) @ network.whiten, []
    for k, (w, b) in enumerate(layers):
        last = k == len(layers) - 1
        z = network.predict(x) if last else h @ network.layers[k][0].T + network.layers[k][1]
        layer = _rounded(w, b, a, z, OUTPUT_ONE * 256 if last else TANH_ONE, weight_bytes[k])
        made.append(layer)
        if not last:
            a, h = squash(sums(layer, a), layer.scale), np.tanh(z)
    model = MlpModel.from_layers(offset, gain_q8, made)
    y = emulate(model, x)[0] / OUTPUT_ONE
    miss = y - network.predict(x)
    distance = np.sqrt(np.sum(miss**2, axis=1))
    widest = max(max(layer.weights.shape) + 1 & ~1 for layer in made)
    return model, QuantReport(
        float(np.sqrt(np.mean(distance**2))),
        float(distance.max()),
        float(error_bound(model).max()),
        float(error_bound(model, x).max()),
        float(np.abs(y - real_outputs(model, x)).max()),
        tuple(weight_bytes),
        len(model.image),
        4 * widest,
    )


@dataclass(frozen=True)
class _Inputs:
    offset: np.ndarray
    gain_q8: np.ndarray


def _windows(network, x, margin):
    """(offset, gain_q8) int64 [d]: an input's range and a margin on 16 bits; gain 0 for what is not used."""
    low, high = x.min(axis=0).astype(float), x.max(axis=0).astype(float)
    room = margin * (high - low) + 2
    low, high = np.floor(np.maximum(low - room, 0)), np.ceil(np.minimum(high + room, 65535))
    gain_q8 = np.minimum(np.floor(65536 * 256 / (high - low + 1)), 65535).astype(np.int64)
    used = np.any(network.whiten != 0, axis=1)
    return np.where(used, low, 0).astype(np.int64), np.where(used, gain_q8, 0)


def _rounded(w, b, a, z, one, weight_bytes):
    """A Layer whose sums are z (real, [n, r], `one` steps of q to 1.0) for device activations a [n, c]."""
    alpha = a / ONE - 1.0
    centre = alpha.mean(axis=0)
    design = alpha - centre
    normal = design.T @ design / len(a)
    normal[np.diag_indices(len(normal))] += RIDGE * max(np.trace(normal) / len(normal), 1e-12)
    factor = cho_factor(normal)
    inverse = cho_solve(factor, np.eye(len(normal)))  # its entries steer the rounding, column by column
    target = z - z.mean(axis=0)
    free = w + cho_solve(factor, design.T @ (target - design @ w.T) / len(a)).T
    limit = HALF[weight_bytes] - 1
    columns = w.shape[1]
    # q = scale / 2 * sum w_int alpha, so a weight is worth scale / (2 * one)
    reach = np.abs(b) + np.abs(free).sum(axis=1) + np.abs(free).max(axis=1)
    scale = 256 * one * reach / (Z_END - 1024 * columns)
    scale = np.maximum(2 * one * np.abs(free).max(axis=1) / limit, scale)
    scale = np.maximum(np.ceil(scale * 1.0005), 1)
    for _ in range(40):
        if scale.max() > 65535:
            break
        layer = _with_scale(free, inverse, alpha, z, one, weight_bytes, scale.astype(np.int64), a)
        low, high = layer.range
        bad = (low < -Z_END) | (high >= Z_END) | (np.abs(layer.weights).max(axis=1) > limit)
        if not bad.any():
            return layer
        scale = np.where(bad, np.ceil(scale * 1.03), scale)
    raise CalibrationError(
        "a row of weights is too large for the device's integers", "train with more decay or fewer units"
    )


def _with_scale(free, inverse, alpha, z, one, weight_bytes, scale, a):
    step = scale / (2.0 * one)
    value, left = free.copy(), inverse.copy()
    whole = np.zeros(free.shape, np.int64)
    for i in range(free.shape[1]):
        whole[:, i] = np.rint(value[:, i] / step)
        error = (value[:, i] - whole[:, i] * step) / left[i, i]
        value -= np.outer(error, left[i])
        left -= np.outer(left[:, i], left[i]) / left[i, i]
    layer = Layer(whole, np.zeros(len(whole), np.int64), scale, weight_bytes)
    # without a bias the sums may wrap: the whole-number part comes off first
    sure = -128 * whole.sum(axis=1)
    layer = Layer(whole, sure, scale, weight_bytes)
    wanted = z * one * 256 / scale
    bias = sure + np.rint(np.mean(wanted - sums(layer, a), axis=0)).astype(np.int64)
    return Layer(whole, bias, scale, weight_bytes)
