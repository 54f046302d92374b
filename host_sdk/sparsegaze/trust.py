# SPDX-License-Identifier: Apache-2.0
"""Does any gaze explain these features? The stored form of a model's guards and grid, and their arithmetic.

The formulas stand in firmware/core/sg_model.h, under "Trust"; here they are stated a second time, in numpy
integers. `trustfit.learn` makes a Trust from a calibration.
"""

from dataclasses import dataclass, field

import numpy as np

from .errors import ModelError
from .fields import put

CHANNELS, GUARDS, NODES_MAX, NODE_BYTES = 6, 4, 24, 5
PAGE_BYTES = 128
RESIDUAL_SD = 16  # steps of a guard's residual that are one standard deviation
DOUBT_UNIT = RESIDUAL_SD**2
SIGMA_HUGE = 255
ORIGIN_MAX, BASE_MAX, ROW_MAX = 1 << 14, 14336, 63  # ROW_MAX: sum of magnitudes

GUARD = np.dtype([("base", "<i2"), ("low", "<i2"), ("high", "<i2"), ("row", "i1", (CHANNELS,))])
PAGE = np.dtype(
    [
        ("guard", GUARD, (GUARDS,)),
        ("origin_deg_q7", "<i2", (2,)),
        ("limit", "<u2"),
        ("scale", "u1", (2,)),
        ("nodes", "u1", (2,)),
        ("guards", "u1"),
        ("sigma_gain", "u1"),
        ("pad", "u1", (68,)),
    ]
)


def _none(*shape):
    return field(default_factory=lambda: np.zeros(shape, np.int64))


@dataclass(frozen=True)
class Trust:
    """Guards and grid, integers as stored; without arguments: no guards, sigma unknown.

    row [g, d], base, low, high [g]; g of 0..4
    expected [nodes elevation, nodes azimuth, g] 0..255, sigma [nodes elevation, nodes azimuth] codes 0..255
    origin_deg_q7 [2], scale [2] (azimuth, elevation), limit of m, sigma_gain
    """

    row: np.ndarray = _none(0, 0)
    base: np.ndarray = _none(0)
    low: np.ndarray = _none(0)
    high: np.ndarray = _none(0)
    expected: np.ndarray = _none(2, 2, 0)
    sigma: np.ndarray = _none(2, 2)
    origin_deg_q7: np.ndarray = _none(2)
    scale: np.ndarray = field(default_factory=lambda: np.ones(2, np.int64))
    limit: int = 65535
    sigma_gain: int = 0

    guards = property(lambda self: len(self.base))

    def pack(self, channels):
        """(trust page, grid), bytes, for a model of so many channels. Raises ModelError."""
        page = np.zeros(1, PAGE)
        g = self.guards
        if g > GUARDS:
            raise ModelError(f"{g} guards do not fit a page of {GUARDS}", "use fewer guards")
        guard = np.zeros(GUARDS, GUARD)
        for i in range(g):
            for name in ("base", "low", "high"):
                put(guard[i : i + 1], name, np.asarray(getattr(self, name))[i : i + 1], (1,))
            put(guard[i : i + 1], "row", np.asarray(self.row)[i : i + 1], (1, channels))
        page["guard"] = guard
        put(page, "origin_deg_q7", self.origin_deg_q7, (2,))
        put(page, "scale", self.scale, (2,))
        put(page, "nodes", np.array(self.sigma.shape[::-1]), (2,))
        for name in ("limit", "guards", "sigma_gain"):
            put(page, name, getattr(self, name), ())
        grid = np.zeros(self.sigma.size, [("expected", "u1", (GUARDS,)), ("sigma", "u1")])
        put(grid, "expected", np.asarray(self.expected).reshape(len(grid), g), (len(grid), g))
        put(grid, "sigma", np.asarray(self.sigma).reshape(-1), (len(grid),))
        return page.tobytes(), grid.tobytes()

    @classmethod
    def unpack(cls, data):
        """From the bytes behind a model's header page, which may be nonsense: `sound` judges them."""
        page = np.frombuffer(data, PAGE, 1)[0]
        g = min(int(page["guards"]), GUARDS)
        guard = page["guard"][:g]
        wide, high = (int(v) for v in page["nodes"])
        if wide > NODES_MAX or high > NODES_MAX or len(data) < PAGE_BYTES + wide * high * NODE_BYTES:
            wide = high = 0
        node = np.frombuffer(data, np.uint8, wide * high * NODE_BYTES, PAGE_BYTES)
        node = node.reshape(high, wide, NODE_BYTES).astype(np.int64)
        return cls(
            guard["row"].astype(np.int64),
            *(guard[name].astype(np.int64) for name in ("base", "low", "high")),
            node[..., :g],
            node[..., GUARDS],
            page["origin_deg_q7"].astype(np.int64),
            page["scale"].astype(np.int64),
            int(page["limit"]),
            int(page["sigma_gain"]),
        )

    def sound(self, data, channels):
        """Whether stored bytes (page and grid) are what sg_model_open accepts."""
        page = np.frombuffer(data, PAGE, 1)[0]
        if page["guards"] > GUARDS or tuple(page["nodes"]) != self.sigma.shape[::-1]:
            return False
        node = np.frombuffer(data, np.uint8, self.sigma.size * NODE_BYTES, PAGE_BYTES).reshape(-1, NODE_BYTES)
        return not (
            min(self.sigma.shape) < 2
            or np.any(page["pad"])
            or page["guard"][self.guards :].tobytes().strip(b"\0")
            or np.any(self.low > self.high)
            or np.any(np.abs(self.base) > BASE_MAX)
            or np.any(np.abs(self.row).sum(axis=1) > ROW_MAX)
            or np.any(self.row[:, channels:])
            or np.any(np.abs(self.origin_deg_q7) > ORIGIN_MAX)
            or np.any(self.scale == 0)
            or np.any(node[:, self.guards : GUARDS])
        )

    def judge(self, s, gaze_q7, outside):
        """(outside bool [n], doubt int64 [n], sigma code int64 [n]) of points.

        s int64 [n, 6] inputs of the kernel; gaze_q7 int64 [n, 2]; outside [n]: known to be already.
        """
        row = np.zeros((self.guards, s.shape[1]), np.int64)
        row[:, : self.row.shape[1]] = self.row
        projection = (s >> 4) @ row.T
        outside = outside | np.any((projection < self.low) | (projection > self.high), axis=1)
        expected, sigma = self._at(gaze_q7)
        miss = np.clip(projection - self.base - (expected >> 4), -127, 127)
        doubt = np.sum(miss * miss, axis=1)
        outside = outside | (doubt > self.limit)
        code = (sigma >> 7) + (doubt * self.sigma_gain >> 12)
        return outside, doubt, np.where(outside, SIGMA_HUGE, np.minimum(code, SIGMA_HUGE))

    def _at(self, gaze_q7):
        """128 times the expectations [n, g] and the sigma code [n] at gazes."""
        cell, part = [], []
        for axis in range(2):
            last = self.sigma.shape[1 - axis] - 2
            t = np.maximum(gaze_q7[:, axis] - self.origin_deg_q7[axis], 0) * self.scale[axis]
            beyond = t >> 16 > last
            cell.append(np.where(beyond, last, t >> 16))
            part.append(np.where(beyond, 127, t >> 9 & 127))
        both = part[0] * part[1] >> 7
        shares = (128 - part[0] - (part[1] - both), part[0] - both, part[1] - both, both)
        node = np.concatenate([self.expected, self.sigma[..., None]], axis=2)
        total = np.zeros((len(gaze_q7), node.shape[2]), np.int64)
        for corner, share in enumerate(shares):
            total += share[:, None] * node[cell[1] + corner // 2, cell[0] + corner % 2]
        return total[:, :-1], total[:, -1]


def grid_bytes(page):
    """Bytes of the grid that a stored trust page states."""
    wide, high = (int(v) for v in np.frombuffer(page, PAGE, 1)[0]["nodes"])
    return wide * high * NODE_BYTES


def sigma_deg(code):
    """Standard deviation of each angle, deg, from sigma_log2_q4 (number or array); NaN for 0 (unknown)."""
    code = np.asarray(code, float)
    return np.where(code == 0, np.nan, 2.0 ** (code / 16.0 - 8.0))
