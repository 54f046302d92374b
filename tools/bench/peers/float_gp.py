# SPDX-License-Identifier: Apache-2.0
"""Gaussian-process mean as most people write it for a microcontroller: float, exp(), tables in flash.

    gaze(x) = bias + sum_i weight_i exp(-1/2 sum_j ((x_j - centre_ij) / length_j)^2)  [+ sum_j trend_j x_j]

The centres are a subset of the calibration; the weights either those of the process on that subset alone
("subset"), or the ones that the whole calibration gives the same centres and a linear trend ("inducing":
subset of regressors, Quinonero-Candela & Rasmussen 2005, section 5), which costs the device hardly more.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .candidate import c_array, c_float

JITTER = 1e-10  # of the signal's variance
TEMPLATE = """#include <avr/pgmspace.h>
#include <math.h>

#include "peer.h"

enum {{ CENTRES = {n}, CHANNELS = {d} }};

static const float origin[CHANNELS] = {origin};
static const float inverse_length[CHANNELS] = {inverse_length};
static const float centre[CENTRES][CHANNELS] PROGMEM = {centre};
static const float weight[CENTRES][2] PROGMEM = {weight};

void peer_predict(const uint16_t *feature, float *gaze_deg)
{{
    float x[CHANNELS];
    for (uint8_t j = 0; j < CHANNELS; j++)
        x[j] = (feature[j] - origin[j]) * inverse_length[j];
    float azimuth = {bias[0]}, elevation = {bias[1]};
{trend}    for (uint16_t i = 0; i < CENTRES; i++) {{
        float squared = 0;
        for (uint8_t j = 0; j < CHANNELS; j++) {{
            const float difference = x[j] - pgm_read_float(&centre[i][j]);
            squared += difference * difference;
        }}
        const float kernel = exp(-0.5f * squared);
        azimuth += pgm_read_float(&weight[i][0]) * kernel;
        elevation += pgm_read_float(&weight[i][1]) * kernel;
    }}
    gaze_deg[0] = azimuth;
    gaze_deg[1] = elevation;
}}
"""

TREND = """    static const float trend[CHANNELS][2] = {trend};
    for (uint8_t j = 0; j < CHANNELS; j++) {{
        azimuth += trend[j][0] * x[j];
        elevation += trend[j][1] * x[j];
    }}
"""


@dataclass
class FloatGP:
    """origin [d] and length [d] of the inputs in feature units, centre [n, d] scaled, weight [n, 2], bias [2]
    in degrees; all float32. trend [d, 2] in degrees a length, or None."""

    origin: np.ndarray
    length: np.ndarray
    centre: np.ndarray
    weight: np.ndarray
    bias: np.ndarray
    trend: np.ndarray = None

    def predict(self, features):
        """Degrees float32 [m, 2] at features [m, d], computed in float32."""
        x = (np.asarray(features, np.float32) - self.origin) * (np.float32(1) / self.length)
        gaze = np.tile(self.bias, (len(x), 1))
        if self.trend is not None:
            gaze += x @ self.trend
        for centre, weight in zip(self.centre, self.weight, strict=True):
            squared = np.sum((x - centre) ** 2, axis=1, dtype=np.float32)
            gaze += np.exp(np.float32(-0.5) * squared)[:, None] * weight
        return gaze

    def source(self):
        """C text that defines peer_predict."""
        return TEMPLATE.format(
            n=len(self.centre),
            d=len(self.origin),
            origin=c_array(self.origin),
            inverse_length=c_array(np.float32(1) / self.length),
            centre=c_array(self.centre),
            weight=c_array(self.weight),
            bias=[c_float(b) for b in self.bias],
            trend="" if self.trend is None else TREND.format(trend=c_array(self.trend)),
        )


def fit(features, gaze_deg, n_centres, length, signal_deg, noise_deg, kind="inducing"):
    """A FloatGP with n_centres of the calibration (features [n, d], gaze_deg [n, 2]).

    length [d] in feature units; centres are spread evenly over the scaled inputs (farthest point first)
    """
    x, y = np.asarray(features, float), np.asarray(gaze_deg, float)
    origin, length = np.float32(x.mean(axis=0)), np.float32(length)
    scaled = (x - origin) / length
    chosen = farthest(scaled, n_centres)
    centre = scaled[chosen]
    bias = y.mean(axis=0)
    among = signal_deg**2 * kernel(centre, centre)
    among[np.diag_indices(len(centre))] += JITTER * signal_deg**2
    if kind == "subset":
        among[np.diag_indices(len(centre))] += noise_deg**2
        weight = signal_deg**2 * cho_solve(cho_factor(among), y[chosen] - bias)
        return FloatGP(origin, length, np.float32(centre), np.float32(weight), np.float32(bias))
    # min |y - cross w - h b|^2 + noise^2 w' among w, as least squares: the normal equations would square the
    # condition number.
    basis = np.column_stack([signal_deg**2 * kernel(scaled, centre), np.ones(len(x)), scaled])
    prior = noise_deg * np.linalg.cholesky(among).T
    stack = np.vstack([basis, np.hstack([prior, np.zeros((len(centre), basis.shape[1] - len(centre)))])])
    right = np.vstack([y, np.zeros((len(centre), 2))])
    found = np.linalg.lstsq(stack, right, rcond=1e-13)[0]
    weight, bias, trend = np.split(found, [len(centre), len(centre) + 1])
    weight = signal_deg**2 * weight
    return FloatGP(origin, length, *(np.float32(v) for v in (centre, weight, bias[0], trend)))


def kernel(a, b):
    """exp(-|a - b|^2 / 2) of scaled inputs [n, d], [m, d]: [n, m]."""
    squared = np.sum(a**2, 1)[:, None] + np.sum(b**2, 1) - 2 * a @ b.T
    return np.exp(-0.5 * np.maximum(squared, 0))


def farthest(x, count):
    """Indices of up to count rows of x [n, d]: the one nearest to the mean, then always the farthest from all
    before."""
    first = int(np.argmin(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))
    chosen, gap = [first], np.sum((x - x[first]) ** 2, axis=1)
    while len(chosen) < min(count, len(x)) and gap.max() > 0:
        chosen.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
    return np.array(chosen)
