# SPDX-License-Identifier: Apache-2.0
"""Ridge regression on all monomials of the scaled inputs up to a degree, in Horner's form in float C.

    gaze(x) = c + sum_i x_i (c_i + sum_{j >= i} x_j (c_ij + sum_{k >= j} x_k (...)))

which takes one multiplication and one addition a term and output, the least that floats allow.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .candidate import c_array, scaling

HEAD = """#include <avr/pgmspace.h>

#include "peer.h"

{scaling}
static const float term[{terms}][2] PROGMEM = {table};

void peer_predict(const uint16_t *feature, float *gaze_deg)
{{
    float x[PEER_CHANNELS];
    const float *next = term[0];
    peer_scale(feature, x);
{body}    gaze_deg[0] = a0;
    gaze_deg[1] = e0;
}}
"""


@dataclass
class Polynomial:
    """origin [d], gain [d] of the inputs; degree; terms {exponents as a sorted tuple of channels: [2]}."""

    origin: np.ndarray
    gain: np.ndarray
    degree: int
    terms: dict

    @classmethod
    def fit(cls, features, gaze_deg, degree, ridge, origin, gain):
        """Least squares with ridge (relative to the mean diagonal); the constant is not held back."""
        x = (np.asarray(features, float) - origin) * gain
        names = monomials(x.shape[1], degree)
        basis = columns(x, names)
        level, middle = gaze_deg.mean(axis=0), basis.mean(axis=0)
        normal = (basis - middle).T @ (basis - middle)
        right = (basis - middle).T @ (gaze_deg - level)
        normal[np.diag_indices(len(names))] += ridge * np.trace(normal) / len(names)
        found = cho_solve(cho_factor(normal), right)
        terms = {(): level - middle @ found, **dict(zip(names, found, strict=True))}
        return cls(np.float32(origin), np.float32(gain), degree, terms)

    def predict(self, features):
        """Degrees [m, 2], in float64."""
        x = (np.asarray(features, float) - self.origin) * self.gain
        names = list(self.terms)
        return columns(x, names) @ np.array([self.terms[name] for name in names])

    def source(self):
        """C text that defines peer_predict: the terms in the order in which the loops need them."""
        d, order, body = len(self.origin), [], []

        def loops(prefix):
            order.append(prefix)
            if len(prefix) < self.degree:
                for j in range(prefix[-1] if prefix else 0, d):
                    loops((*prefix, j))

        loops(())
        for depth in range(self.degree + 1):
            tab = "    " * (depth + 1)
            body.append(f"{tab}float a{depth} = pgm_read_float(next++), e{depth} = pgm_read_float(next++);\n")
            if depth < self.degree:
                i, first = f"i{depth}", f"i{depth - 1}" if depth else "0"
                body.append(f"{tab}for (uint8_t {i} = {first}; {i} < PEER_CHANNELS; {i}++) {{\n")
        for depth in range(self.degree, 0, -1):
            tab = "    " * (depth + 1)
            body.append(f"{tab}a{depth - 1} += x[i{depth - 1}] * a{depth};\n")
            body.append(f"{tab}e{depth - 1} += x[i{depth - 1}] * e{depth};\n{tab[4:]}}}\n")
        table = c_array([self.terms[name] for name in order])
        text = scaling(self.origin, self.gain)
        return HEAD.format(scaling=text, terms=len(order), table=table, body="".join(body))


def monomials(channels, degree):
    """Sorted tuples of channels of all monomials of degree 1 to `degree`."""
    return [m for k in range(1, degree + 1) for m in combinations_with_replacement(range(channels), k)]


def columns(x, names):
    """Values of monomials at x [n, d]: [n, len(names)]."""
    made = np.ones((len(x), len(names)))
    for k, name in enumerate(names):
        for j in name:
            made[:, k] *= x[:, j]
    return made
