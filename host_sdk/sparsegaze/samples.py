# SPDX-License-Identifier: Apache-2.0
"""The training data of a Gaussian process: checked, in canonical order, thinned to what it may keep."""

import warnings
from dataclasses import dataclass

import numpy as np

from .errors import CalibrationError

LARGEST = 1e100  # a feature or target beyond it overflows when it is squared


@dataclass(frozen=True)
class Samples:
    """x [n, d], y [n, 2], noise_scale [n], groups int [n] in canonical order; given: rows before thinning

    dropped: indices of channels that never change
    """

    x: np.ndarray
    y: np.ndarray
    noise_scale: np.ndarray
    groups: np.ndarray
    dropped: tuple
    given: int

    @classmethod
    def check(cls, features, gaze_deg, noise_scale, groups, kernel, mean, rows_max, depth):
        """Samples from what a caller of GaussianProcess.fit gave; warnings point `depth` frames up.

        The order is by channels, then targets, then group, so that it says nothing of the order given.
        Raises CalibrationError for shapes that do not fit, nan, infinities, too few samples, no live channel.
        """
        x, y = np.array(features, float), np.array(gaze_deg, float)
        n = len(x)
        if x.ndim != 2 or y.shape != (n, 2):
            raise CalibrationError(
                f"features {x.shape} and gaze {y.shape} do not fit together", "give [n, d] and [n, 2]"
            )
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise CalibrationError("features or targets hold nan or infinity", "mark those rows valid = 0")
        if max(np.abs(x).max(initial=0.0), np.abs(y).max(initial=0.0)) > LARGEST:
            raise CalibrationError("features or targets are larger than 1e100", "mark those rows valid = 0")
        kernel.check(x)
        varying = (np.ptp(x, axis=0) > 0) & (x.std(axis=0) > 0) if n else np.zeros(x.shape[1], bool)
        columns = mean_columns(mean, int(varying.sum()))
        if n < columns + 2:
            raise CalibrationError(
                f"{n} samples are too few for a {mean} mean in {x.shape[1]} channels",
                f"give at least {columns + 2}",
            )
        if not varying.any():
            raise CalibrationError(
                "no channel changes between the targets", "check that the LEDs are connected and see the eye"
            )
        dropped = tuple(int(j) for j in np.flatnonzero(~varying))
        if dropped:
            names = ", ".join(f"s{j}" for j in dropped)
            warnings.warn(f"constant channel dropped: {names}", stacklevel=depth + 1)
        scale = _each("noise_scale", np.ones(n) if noise_scale is None else noise_scale, n).astype(float)
        if not (np.isfinite(scale).all() and np.all(scale >= 0)):
            raise CalibrationError("noise_scale must be a variance, 0 or more", "give finite numbers")
        labels = np.arange(n)
        if groups is not None:
            labels = np.unique(_each("groups", groups, n), return_inverse=True)[1]
        order = np.lexsort(np.column_stack([labels, y, x]).T)
        if n > rows_max:
            warnings.warn(f"{n} samples given, {rows_max} of them kept, evenly spread", stacklevel=depth + 1)
            order = order[spread(n, rows_max)]
        return cls(x[order], y[order], scale[order], labels[order], dropped, n)


def mean_columns(mean, channels):
    """Columns of h(x) for a mean of that name."""
    try:
        return {"zero": 0, "constant": 1, "linear": 1 + channels}[mean]
    except KeyError:
        raise ValueError(f"mean {mean!r} is none of zero, constant, linear") from None


def spread(n, most):
    """Indices of at most `most` of n rows, evenly spread."""
    return np.arange(n) if n <= most else np.linspace(0, n - 1, most).astype(int)


def _each(name, values, n):
    values = np.asarray(values)
    if values.shape != (n,):
        raise CalibrationError(f"{name} has shape {values.shape}", f"give one for each of the {n} samples")
    return values
