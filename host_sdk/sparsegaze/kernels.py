# SPDX-License-Identifier: Apache-2.0
"""Covariance functions of the distance measures that LED2Gaze section 5.2 compares, each in a PD form.

    name            k(x, x') / s^2                                      positive definite (PD), because
    rbf             exp(-r^2 / 2),  r^2 = sum_j ((x_j - x'_j) / l_j)^2   Schoenberg 1938
    matern52        (1 + a + a^2 / 3) exp(-a),  a = sqrt(5) r           R & W equation 4.17
    laplace         exp(-sum_j |x_j - x'_j| / l_j)                      minkowski with p = 1
    minkowski p<=2  exp(-D^q),  D^p = sum_j (|x_j - x'_j| / l_j)^p      Schoenberg, for 0 < q <= p; q = p here
    minkowski p>2   exp(-D^q),  q = 1                                   NOT in 3 or more channels, at any q
                                                                        (Misiewicz 1989, Koldobsky 1991)
    canberra        exp(-sum_j |x_j - x'_j| / (x_j + x'_j) / l_j)       Polya: |x-x'|/(x+x') is
                                                                        tanh(|log x - log x'| / 2)
    cosine          exp((cos(x, x') - 1) / l^2)                         exp of an inner product

With p > 2 it is PD in 2 channels, and in 1, where it is laplace. With p < 1 the measure is no metric (a
detour is shorter), but the kernel needs none: it is a product of covariances of one channel each.
A measure that has a PD form is given that form and refused in others (exp(-D^2 / 2 l^2) on L1, L1.5 or
Canberra misses by up to 18 deg, silently). p > 2 has none: gp.py repairs its matrix and says so.
"""

import numpy as np

from .errors import CalibrationError

NAMES = ("rbf", "matern52", "laplace", "minkowski", "canberra", "cosine")
PAIRS_MOST = 400  # rows used to find a measure's natural unit


def kernel(name="rbf", p=None, exponent=None):
    """The Kernel called `name`. Raises CalibrationError for what is not a covariance, and says why.

    p         order of the Minkowski distance, > 0, inf for the largest difference; with "minkowski" only
    exponent  q of exp(-D^q) for laplace, minkowski and canberra; default the largest that is safe
    """
    if name not in NAMES:
        raise CalibrationError(f"there is no kernel {name!r}", f"use one of {', '.join(NAMES)}")
    if name == "minkowski":
        if p is None or not float(p) > 0:
            raise CalibrationError(
                "the Minkowski kernel needs its order p, above 0" + ("" if p is None else f", not {p}"),
                "give p, for example 1.5",
            )
    elif p is not None:
        raise CalibrationError(f"the kernel {name} has no order p", "leave p out, or use minkowski")
    if name in ("rbf", "matern52", "cosine"):
        if exponent is not None:
            raise CalibrationError(f"the exponent of the kernel {name} is fixed", "leave the exponent out")
        return {"rbf": Rbf, "matern52": Matern52, "cosine": Cosine}[name]()
    p = 1.0 if p is None else float(p)
    most = 1.0 if name == "canberra" or p > 2 else p
    q = most if exponent is None else float(exponent)
    if not 0 < q <= most:
        measure = {"canberra": "the Canberra distance", "laplace": "the Manhattan distance"}.get(
            name, f"the Minkowski distance of p = {p:g}"
        )
        raise CalibrationError(
            f"exp(-D^{q:g}) is no covariance for {measure}: some weights would be meaningless",
            f"use an exponent above 0 and at most {most:g}, or the kernel rbf, which may be squared",
        )
    if name == "canberra":
        return Canberra(q)
    return Steep(p, q) if p > 2 else Power(name, p, q)


class Kernel:
    """A stationary shape of a sum over channels: k = shape(u), u = sum_j c_j A_j(x, x'), c_j = l_j^-degree.

    All methods take features [n, d] in feature units, channels that were dropped removed, and lengths [d]
    ([1] if not `per_channel`), and keep at most two [n, m] arrays beside their result.
    """

    name = ""
    p = None
    exponent = None
    degree = 1.0
    per_channel = True
    additive = True  # u is a weighted sum of terms that do not depend on the lengths
    length_unit = "feature units"
    start = 3.0  # length in natural units from which a search begins

    def definite(self, channels):
        """Whether it is positive definite in this many channels, by theorem."""
        return True

    def check(self, features):
        """Raise CalibrationError where the measure is not defined."""

    def natural(self, x):
        """Coordinates to learn in, and the natural unit of each length there and in features: (z, [L], [L]).

        Here: channels standardised, so that lengths are in standard deviations of their channel.
        """
        spread = x.std(axis=0)
        return (x - x.mean(axis=0)) / spread, np.ones(len(spread)), spread

    def coordinates(self, x):
        """What the terms are computed from."""
        return x

    def term(self, a, b):
        """A_j [n, m] of one column a [n], b [m]."""
        raise NotImplementedError

    def term_slope(self, a, b):
        """Derivative of A_j in a; 0 at a = b where there is a cusp."""
        raise NotImplementedError

    def shape(self, u):
        """k / s^2 at u."""
        return np.exp(-u)

    def fall(self, u):
        """-d shape / d u; 0 at u = 0 where it is infinite."""
        return np.exp(-u)

    def terms(self, a, b):
        """Iterate over A_j [n, m], one per length."""
        for j in range(a.shape[1]):
            yield self.term(a[:, j], b[:, j])

    def distance(self, a, b, length):
        """u [n, m]."""
        a, b = self.coordinates(a), self.coordinates(b)
        u = 0.0
        for c, term in zip(np.asarray(length) ** -self.degree, self.terms(a, b)):
            u = u + c * term
        return u

    def value(self, a, b, length):
        """k / s^2 [n, m]."""
        return self.shape(self.distance(a, b, length))

    def length_sums(self, weight, a, length, u):
        """sum_ik weight_ik du_ik / d log l_j, negated, for all j: [len(length)]. weight, u [n, n]."""
        a = self.coordinates(a)
        sums = [np.vdot(weight, term) for term in self.terms(a, a)]
        return self.degree * np.asarray(length) ** -self.degree * sums

    def slope(self, query, x, length, alpha):
        """d/d query of sum_i alpha_io k(query, x_i) / s^2: [m, outputs, d]."""
        fall = self.fall(self.distance(query, x, length))
        c = np.asarray(length) ** -self.degree
        out = np.empty((len(query), alpha.shape[1], query.shape[1]))
        for j in range(query.shape[1]):
            out[:, :, j] = -c[j] * (fall * self.term_slope(query[:, j], x[:, j])) @ alpha
        return out

    def rounding(self, x, length):
        """Error of a value in float64: (g, h), |error| <= eps (g k + h s^2)."""
        return 4.0, 4.0 + 0.4 * (x.shape[1] + 8)

    def formula(self):
        """The kernel in one line of text."""
        raise NotImplementedError


class Rbf(Kernel):
    """exp(-r^2 / 2); the squared distance by matrix product, about the mean of the data."""

    name, degree = "rbf", 2.0

    def shape(self, u):
        return np.exp(-0.5 * u)

    def fall(self, u):
        return 0.5 * np.exp(-0.5 * u)

    def term(self, a, b):
        return (a[:, None] - b) ** 2

    def term_slope(self, a, b):
        return 2.0 * (a[:, None] - b)

    def distance(self, a, b, length):
        a, b = a / length, b / length
        centre = b.mean(axis=0)  # the squared distance below cancels; keep the numbers small
        a, b = a - centre, b - centre
        return np.maximum(np.sum(a**2, 1)[:, None] + np.sum(b**2, 1) - 2.0 * a @ b.T, 0.0)

    def length_sums(self, weight, a, length, u):
        a = (a - a.mean(axis=0)) / length
        row = weight.sum(axis=1) + weight.sum(axis=0)
        return self.degree * (row @ a**2 - 2.0 * np.sum(a * (weight @ a), axis=0))

    def rounding(self, x, length):
        x = (x - x.mean(axis=0)) / length
        return 4.0 + 2.0 * (x.shape[1] + 4) * float(np.max(np.sum(x * x, axis=1), initial=0.0)), 4.0

    def formula(self):
        return "exp(-r^2/2), r^2 = sum_j ((x_j-y_j)/l_j)^2"


class Matern52(Rbf):
    """(1 + a + a^2/3) exp(-a), a = sqrt(5) r: twice differentiable, so rougher than rbf."""

    name = "matern52"

    def shape(self, u):
        a = np.sqrt(5.0 * u)
        return (1.0 + a + 5.0 / 3.0 * u) * np.exp(-a)

    def fall(self, u):
        a = np.sqrt(5.0 * u)
        return 5.0 / 6.0 * (1.0 + a) * np.exp(-a)

    def formula(self):
        return "(1+a+a^2/3) exp(-a), a^2 = 5 sum_j ((x_j-y_j)/l_j)^2"


class Power(Kernel):
    """exp(-D^q) with D^p = sum_j (|x_j - x'_j| / l_j)^p and 0 < q <= p <= 2."""

    def __init__(self, name, p, q):
        self.name, self.p, self.exponent, self.degree = name, p, q, p
        self.start = 3.0 if p > 1.5 and q > 1.5 else 10.0  # rough kernels want long lengths

    def shape(self, u):
        return np.exp(-(u if self.exponent == self.p else u ** (self.exponent / self.p)))

    def fall(self, u):
        ratio = self.exponent / self.p
        if ratio == 1.0:
            return np.exp(-u)
        safe = np.where(u > 0, u, 1.0)
        return np.where(u > 0, ratio * safe ** (ratio - 1.0) * np.exp(-(safe**ratio)), 0.0)

    def term(self, a, b):
        gap = np.abs(a[:, None] - b)
        if self.p == 1.0:
            return gap
        return gap * gap if self.p == 2.0 else gap * np.sqrt(gap) if self.p == 1.5 else gap**self.p

    def term_slope(self, a, b):
        gap = a[:, None] - b
        size = np.abs(gap)
        if self.p >= 1.0:
            return self.p * np.sign(gap) * size ** (self.p - 1.0)
        return self.p * np.sign(gap) * np.where(size > 0, size, 1.0) ** (self.p - 1.0)

    def formula(self):
        power = "" if self.exponent == self.p else f"^{self.exponent / self.p:g}"
        inner = "|x_j-y_j|/l_j" if self.p == 1 else f"(|x_j-y_j|/l_j)^{self.p:g}"
        return f"exp(-(sum_j {inner}){power})" if power else f"exp(-sum_j {inner})"


class Steep(Kernel):
    """exp(-D^q) with the Minkowski distance of p > 2: no covariance in 3 or more channels, see gp.py.

    Scaled by the largest difference, so that no power overflows at any p; p = inf is that difference alone.
    """

    name, start, additive = "minkowski", 10.0, False

    def __init__(self, p, q):
        self.p, self.exponent = p, q

    def definite(self, channels):
        return channels <= 2

    def _largest(self, a, b, length):
        top = np.zeros((len(a), len(b)))
        for j in range(a.shape[1]):
            np.maximum(top, np.abs(a[:, j, None] - b[:, j]) / length[j], out=top)
        return top

    def _norm(self, a, b, length):
        top = self._largest(a, b, length)
        if np.isinf(self.p):
            return top
        safe, total = np.where(top > 0, top, 1.0), 0.0
        for j in range(a.shape[1]):
            total = total + (np.abs(a[:, j, None] - b[:, j]) / length[j] / safe) ** self.p
        return top * total ** (1.0 / self.p)

    def distance(self, a, b, length):
        return self._norm(a, b, length) ** self.exponent

    def _ratio(self, gap, length, norm, power):
        """(gap / l / D)^power; for p = inf 1 where the channel is the largest."""
        ratio = np.abs(gap) / length / np.where(norm > 0, norm, 1.0)
        return (ratio >= 1.0).astype(float) if np.isinf(self.p) else ratio**power

    def length_sums(self, weight, a, length, u):
        norm = self._norm(a, a, length)
        weight = self.exponent * weight * u
        return np.array(
            [
                np.vdot(weight, self._ratio(a[:, j, None] - a[:, j], length[j], norm, self.p))
                for j in range(a.shape[1])
            ]
        )

    def slope(self, query, x, length, alpha):
        norm = self._norm(query, x, length)
        safe = np.where(norm > 0, norm, 1.0)
        fall = np.where(norm > 0, self.exponent * safe ** (self.exponent - 1.0), 0.0)
        fall *= self.fall(norm**self.exponent)
        out = np.empty((len(query), alpha.shape[1], query.shape[1]))
        for j in range(query.shape[1]):
            gap = query[:, j, None] - x[:, j]
            share = np.sign(gap) * self._ratio(gap, length[j], norm, self.p - 1.0)
            out[:, :, j] = -(fall * share) @ alpha / length[j]
        return out

    def formula(self):
        power = "" if self.exponent == 1 else f"^{self.exponent:g}"
        if np.isinf(self.p):
            return f"exp(-D{power}), D = max_j |x_j-y_j|/l_j"
        return f"exp(-D{power}), D = (sum_j (|x_j-y_j|/l_j)^{self.p:g})^(1/{self.p:g})"


class Canberra(Kernel):
    """exp(-D^q), D = sum_j |x_j - x'_j| / (x_j + x'_j) / l_j, features >= 0, 0/0 = 0, 0 < q <= 1."""

    name, length_unit, start = "canberra", "1 (a Canberra distance)", 10.0

    def __init__(self, q):
        self.exponent = q

    shape, fall = Power.shape, Power.fall
    p = 1.0

    def check(self, features):
        if np.any(features < 0):
            raise CalibrationError(
                "the Canberra distance is not defined for features below 0",
                "use features as the device sends them, or the kernel laplace",
            )

    def natural(self, x):
        few = _few(x)
        unit = np.sqrt([np.mean(term**2) or 1.0 for term in self.terms(few, few)])
        return x, unit, unit

    def term(self, a, b):
        total = a[:, None] + b
        return np.abs(a[:, None] - b) / np.where(total > 0, total, 1.0)

    def term_slope(self, a, b):
        total = a[:, None] + b
        return np.sign(a[:, None] - b) * 2.0 * b / np.where(total > 0, total, 1.0) ** 2

    def formula(self):
        total = "sum_j |x_j-y_j|/(x_j+y_j)/l_j"
        return f"exp(-{total})" if self.exponent == 1 else f"exp(-({total})^{self.exponent:g})"


class Cosine(Kernel):
    """exp((cos - 1) / l^2), from half the squared chord of unit vectors: 1 - cos cancels, the chord does not.

    One length for all channels, in radians: a length per channel would bend the angle itself.
    """

    name, degree, per_channel, length_unit = "cosine", 2.0, False, "rad"

    shape, fall = Rbf.shape, Rbf.fall

    def check(self, features):
        if not np.all(np.any(features != 0, axis=1)):
            raise CalibrationError(
                "the cosine of a sample whose features are all 0 is not defined",
                "mark those rows valid = 0, or use another kernel",
            )

    def coordinates(self, x):
        x = x / np.abs(x).max(axis=1, keepdims=True)  # no overflow, no underflow
        return x / np.sqrt(np.sum(x * x, axis=1, keepdims=True))

    def natural(self, x):
        few = self.coordinates(_few(x))
        unit = np.sqrt([np.mean(next(self.terms(few, few))) or 1.0])
        return x, unit, unit

    def terms(self, a, b):
        total = 0.0
        for j in range(a.shape[1]):
            total = total + (a[:, j, None] - b[:, j]) ** 2
        yield total

    def slope(self, query, x, length, alpha):
        unit_query, unit_x = self.coordinates(query), self.coordinates(x)
        fall = self.fall(self.distance(query, x, length)) * -2.0 * length[0] ** -2.0
        out = np.empty((len(query), alpha.shape[1], query.shape[1]))
        for j in range(query.shape[1]):
            out[:, :, j] = (fall * (unit_query[:, j, None] - unit_x[:, j])) @ alpha
        along = np.einsum("moj,mj->mo", out, unit_query)
        norm = np.sqrt(np.sum(query * query, axis=1))[:, None, None]
        return (out - along[:, :, None] * unit_query[:, None]) / norm

    def rounding(self, x, length):
        return 4.0, 4.0 + 4.0 * np.sqrt(x.shape[1]) / float(length[0])

    def formula(self):
        return "exp((cos(x,y)-1)/l^2)"


def _few(x):
    return x if len(x) <= PAIRS_MOST else x[np.linspace(0, len(x) - 1, PAIRS_MOST).astype(int)]
