# SPDX-License-Identifier: Apache-2.0
"""From samples, or from a Gaussian process, to a small tanh network in float64 (mlp_round.py: in integers).

Full-batch L-BFGS on whitened inputs, with weight decay and early stopping on held-out rows. The result is a
pure function of the arguments: rows are put in a canonical order, and linear algebra runs on one thread.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from .errors import CalibrationError
from .mlp import HIDDEN_MAX, INPUTS_MAX, OUTPUTS_MAX, WIDTH_MAX

HELD_OUT = 0.15  # of the rows
PATIENCE = 200  # steps without a better held-out error
MEMORY = 40  # pairs that L-BFGS keeps
DECAY = 1e-6  # of the mean squared weight, outputs having variance 1
FLAT = 1e-10  # of the largest variance: directions below it are dropped
NEIGHBOURS = 8


@dataclass(frozen=True)
class Network:
    """A float64 network:  y = mean_y + scale_y * (W_k tanh(... tanh(W_0 (x - mean) @ whiten + b_0)) + b_k).

    mean [d], whiten [d, e]; layers of (W [r, c], b [r]); mean_y [m], scale_y [m]; held_out_rms in units of y
    """

    mean: np.ndarray
    whiten: np.ndarray
    layers: tuple
    mean_y: np.ndarray
    scale_y: np.ndarray
    held_out_rms: float = np.nan

    def predict(self, features):
        """Outputs, float64 [n, m], for features [n, d] in the units trained in."""
        h = (np.asarray(features, float) - self.mean) @ self.whiten
        return self.mean_y + self.scale_y * _forward(self.layers, h)[-1]


def train(features, targets, widths=(16, 16), seed=0, restarts=2, decay=DECAY, steps=3000, held_out=None):
    """Fit a network.

    features   [n, d], d up to 8;  targets [n, m], m up to 8
    widths     hidden layers, 0 to 4 of them, 1 to 64 each
    restarts   starting points, drawn from the seed; the best on held-out rows is taken
    held_out   bool [n], rows that only stop the training (default: 15 % of the rows, drawn from the seed)
    Raises CalibrationError for shapes that do not fit, nan or infinities, too few rows, no channel that
    changes. A constant channel is dropped with a warning.
    """
    x, y = np.array(features, float), np.array(targets, float)
    _check(x, y, widths, restarts, steps)
    given = np.zeros(len(x), bool) if held_out is None else np.asarray(held_out, bool)
    if given.shape != (len(x),) or given.all():
        raise CalibrationError("no rows are left to train on", "hold out fewer rows")
    order = np.lexsort(np.column_stack([given, y, x]).T)
    x, y = x[order], y[order]
    held = _held_out(len(x), seed) if held_out is None else given[order]
    mean, whiten = _whitening(x[~held])
    mean_y, scale_y = y[~held].mean(axis=0), y[~held].std(axis=0)
    scale_y = np.where(scale_y > 0, scale_y, 1.0)
    h, t = (x - mean) @ whiten, (y - mean_y) / scale_y
    shapes = list(zip([*widths, y.shape[1]], [whiten.shape[1], *widths]))
    best = None
    with threadpool_limits(1):
        for restart in range(restarts):
            rng = np.random.default_rng([0x6D6C70, seed, restart])
            start = [(rng.normal(0, c**-0.5, (r, c)), rng.normal(0, 0.3, r)) for r, c in shapes]
            error, layers = _descend(start, h[~held], t[~held], h[held], t[held], decay, steps)
            if best is None or error < best[0]:
                best = error, layers
    network = Network(mean, whiten, tuple(best[1]), mean_y, scale_y)
    judge = held if held.any() else ~held
    miss = network.predict(x[judge]) - y[judge]
    rms = float(np.sqrt(np.mean(np.sum(miss**2, axis=1))))
    return Network(mean, whiten, network.layers, mean_y, scale_y, rms)


def distil(gp, features, gaze_deg, widths=(16, 16), points=3000, noise=0.0, seed=0, **options):
    """Train on a fitted GaussianProcess's mean over a cloud of likely inputs: mixtures of neighbouring rows.

    features [n, d], gaze_deg [n, 2] of the calibration (gaze only tells who is whose neighbour)
    noise      rms in feature units that the cloud has beyond the rows' own;  options: as of train
    """
    x, gaze = np.asarray(features, float), np.asarray(gaze_deg, float)
    if x.ndim != 2 or gaze.shape != (len(x), 2) or not 2 <= len(x):
        shapes = f"features {x.shape} and gaze {gaze.shape} do not do"
        raise CalibrationError(shapes, "give [n, d] and [n, 2]")
    order = np.lexsort(np.column_stack([gaze, x]).T)
    x, gaze = x[order], gaze[order]
    rng = np.random.default_rng([0x636C64, seed])
    anchor = rng.integers(0, len(x), points)
    distance = np.sum((gaze[anchor, None] - gaze) ** 2, axis=2)
    near = np.argsort(distance, axis=1, kind="stable")[:, : min(NEIGHBOURS, len(x))]
    share = rng.dirichlet(np.full(near.shape[1], 0.5), points)
    cloud = np.einsum("ij,ijk->ik", share, x[near]) + rng.normal(0, 1, (points, x.shape[1])) * noise
    with threadpool_limits(1):
        labels = gp.predict(cloud)
    return train(cloud, labels, widths, seed=seed, **options)


def _check(x, y, widths, restarts, steps):
    if x.ndim != 2 or y.ndim != 2 or len(x) != len(y):
        shapes = f"features {x.shape} and targets {y.shape} do not fit"
        raise CalibrationError(shapes, "give [n, d] and [n, m]")
    if not (1 <= x.shape[1] <= INPUTS_MAX and 1 <= y.shape[1] <= OUTPUTS_MAX):
        raise CalibrationError(
            f"{x.shape[1]} inputs and {y.shape[1]} outputs do not fit the device",
            f"give 1 to {INPUTS_MAX} inputs and 1 to {OUTPUTS_MAX} outputs",
        )
    if len(widths) > HIDDEN_MAX or any(not 1 <= w <= WIDTH_MAX for w in widths):
        raise CalibrationError(
            f"hidden layers of {list(widths)} do not fit the device",
            f"give 0 to {HIDDEN_MAX} layers of 1 to {WIDTH_MAX}",
        )
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise CalibrationError("features or targets hold nan or infinity", "mark those rows valid = 0")
    if len(x) < 4:
        raise CalibrationError(f"{len(x)} rows are too few for a network", "record more targets")
    if restarts < 1 or steps < 1:
        raise CalibrationError("no training asked for", "give restarts and steps of 1 or more")


def _held_out(n, seed):
    held = np.zeros(n, bool)
    held[np.random.default_rng([0x686F, seed]).permutation(n)[: max(1, int(HELD_OUT * n))]] = True
    return held


def _whitening(x):
    """(mean [d], matrix [d, e]): principal components with variance 1, flat ones left out."""
    mean, std = x.mean(axis=0), x.std(axis=0)
    live = np.flatnonzero(std > 0)
    if not len(live):
        raise CalibrationError("no channel changes", "check that the LEDs are connected and see the eye")
    if len(live) < x.shape[1]:
        dead = ", ".join(f"s{j}" for j in np.flatnonzero(std == 0))
        warnings.warn(f"constant channel dropped: {dead}", stacklevel=3)
    values, vectors = eigh(np.cov((x[:, live] / std[live]).T).reshape(len(live), len(live)))
    keep = values > FLAT * values[-1]
    largest = np.abs(vectors).argmax(axis=0)  # the sign of a component is anyone's choice
    vectors = vectors * np.sign(vectors[largest, np.arange(len(live))])
    whiten = np.zeros((x.shape[1], int(keep.sum())))
    whiten[live] = vectors[:, keep] / np.sqrt(values[keep]) / std[live, None]
    return mean, whiten


def _descend(start, h, t, h_held, t_held, decay, steps):
    """L-BFGS from one starting point: (held-out mean square, layers at the best step)."""
    shapes = [w.shape for w, _ in start]
    state = {"error": np.inf, "layers": start, "since": 0}

    judged = (h_held, t_held) if len(h_held) else (h, t)

    def judge(flat):
        layers = _unflat(flat, shapes)
        error = np.mean(np.sum((_forward(layers, judged[0])[-1] - judged[1]) ** 2, axis=1))
        state["since"] += 1
        if error < state["error"]:
            state.update(error=error, since=0, layers=[(w.copy(), b.copy()) for w, b in layers])
        if state["since"] > PATIENCE:
            raise _Enough

    flat = np.concatenate([np.r_[w.ravel(), b] for w, b in start])
    options = {"maxiter": steps, "maxfun": 2 * steps, "maxcor": MEMORY, "ftol": 1e-14, "gtol": 1e-9}
    try:
        cost = (_cost, flat, (shapes, h, t, decay))
        minimize(*cost, jac=True, method="L-BFGS-B", callback=judge, options=options)
    except _Enough:
        pass
    return state["error"], state["layers"]


class _Enough(Exception):
    """Held-out rows have not gained for a while."""


def _forward(layers, h):
    """Activations of every layer, the inputs first and the linear outputs last."""
    kept = [h]
    for w, b in layers[:-1]:
        kept.append(np.tanh(kept[-1] @ w.T + b))
    w, b = layers[-1]
    return [*kept, kept[-1] @ w.T + b]


def _cost(flat, shapes, h, t, decay):
    """(mean over rows of the squared miss + decay * sum of squared weights, its gradient)."""
    layers = _unflat(flat, shapes)
    *kept, outputs = _forward(layers, h)
    miss = outputs - t
    value = np.mean(np.sum(miss**2, axis=1))
    back, slopes = 2 * miss / len(h), []
    for k in reversed(range(len(layers))):
        w = layers[k][0]
        value += decay * np.sum(w**2)
        slopes.append(np.r_[(back.T @ kept[k] + 2 * decay * w).ravel(), back.sum(axis=0)])
        if k:
            back = (back @ w) * (1 - kept[k] ** 2)
    return value, np.concatenate(slopes[::-1])


def _unflat(flat, shapes):
    layers, at = [], 0
    for r, c in shapes:
        layers.append((flat[at : at + r * c].reshape(r, c), flat[at + r * c : at + r * c + r]))
        at += r * c + r
    return layers
