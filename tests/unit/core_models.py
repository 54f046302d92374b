# SPDX-License-Identifier: Apache-2.0
"""Stored models for tests of the core, packed through the core's own structs, and their arithmetic in numpy
integers, written from the header of sg_model.h and not from its code."""
import binascii
import math
from dataclasses import dataclass, field

import numpy as np

from sparsegaze._core import ffi, lib

U = 64.0
LEVEL = np.array([min(65535, math.floor(65536 * math.exp(-i / 64))) for i in range(769)], np.int64)


@dataclass
class Parts:
    """All that a model holds, as integers. n vectors, d channels, g guards, a grid of [high, wide] nodes."""
    offset: np.ndarray          # [d] feature units
    gain_q12: np.ndarray        # [d]
    bias: np.ndarray            # [2]
    trend: np.ndarray           # [2, d]
    centre: np.ndarray          # [n, d] 0..255
    weight: np.ndarray          # [n, 2]
    weight_frac_bits: int = 9
    guard: list = field(default_factory=list)       # (base, low, high, row [d])
    expected: np.ndarray = None                     # [high, wide, g]; None: 0
    sigma: np.ndarray = None                        # [high, wide]; None: 0
    origin: tuple = (-2560, -2560)
    scale: tuple = (64, 64)
    limit: int = 65535
    sigma_gain: int = 0
    generation: int = 1

    def __post_init__(self):
        if self.sigma is None:
            self.sigma = np.zeros((2, 2), np.int64)
        if self.expected is None:
            self.expected = np.zeros((*self.sigma.shape, len(self.guard)), np.int64)

    @property
    def d(self):
        """Channels."""
        return len(self.offset)

    @property
    def half_c2(self):
        """[n], as stored: 8 sum c^2 in units of 256, rounded up."""
        return -(-(self.centre.astype(np.int64) ** 2).sum(axis=1) // 32)

    def image(self):
        """The stored model, sealed."""
        n, d = self.centre.shape
        head, page = ffi.new("struct sg_model_head *"), ffi.new("struct sg_model_trust *")
        head.magic, head.version, head.vectors, head.channels = lib.SG_MODEL_MAGIC, 2, n, d
        grid = b""
        page.nodes = [self.sigma.shape[1], self.sigma.shape[0]]
        guards = len(self.guard)
        for sigma, expected in zip(self.sigma.ravel(), self.expected.reshape(self.sigma.size, guards)):
            grid += bytes(int(v) for v in expected) + bytes(4 - guards) + bytes([int(sigma)])
        head.generation, head.length = self.generation, 256 + len(grid) + 12 * n
        head.weight_frac_bits = self.weight_frac_bits
        head.bias = [int(v) for v in self.bias]
        for j in range(d):
            head.offset[j], head.gain_q12[j] = int(self.offset[j]), int(self.gain_q12[j])
            for i in range(2):
                head.trend[i][j] = int(self.trend[i][j])
        page.guards, page.limit, page.sigma_gain = len(self.guard), self.limit, self.sigma_gain
        page.origin_deg_q7, page.scale = list(map(int, self.origin)), list(map(int, self.scale))
        for i, (base, low, high, row) in enumerate(self.guard):
            page.guard[i].base, page.guard[i].low, page.guard[i].high = int(base), int(low), int(high)
            for j in range(d):
                page.guard[i].row[j] = int(row[j])
        records = bytearray()
        for c, half, w in zip(self.centre, self.half_c2, self.weight):
            records += int(half).to_bytes(2, "little") + bytes(int(v) for v in c) + bytes(6 - d)
            records += b"".join(int(v).to_bytes(2, "little", signed=True) for v in w)
        return seal(bytes(ffi.buffer(head)) + bytes(ffi.buffer(page)) + grid + bytes(records))


def seal(image):
    """The image with the CRC that belongs to it (by binascii, not by the core)."""
    return image[:4] + binascii.crc32(image[8:]).to_bytes(4, "little") + image[8:]


def random_parts(rng, n, d=6, guards=3, grid=(5, 4), **more):
    """A model whose every field is drawn over most of its range, but whose features are not all clamped.

    guards 0..4; grid (high, wide)."""
    centre = rng.integers(0, 256, (n, d))
    row = [rng.integers(-10, 11, d) for _ in range(guards)]
    more.setdefault("expected", rng.integers(0, 256, (*grid, guards)))
    more.setdefault("sigma", rng.integers(1, 200, grid))
    more.setdefault("sigma_gain", 3)
    return Parts(offset=rng.integers(0, 40000, d), gain_q12=rng.integers(300, 3000, d),
                 bias=rng.integers(-2 ** 22, 2 ** 22, 2), trend=rng.integers(-300, 300, (2, d)),
                 centre=centre, weight=rng.integers(-32768, 32768, (n, 2)),
                 guard=[(-1000, -2 ** 12, 2 ** 12, r) for r in row], **more)


def features_near(rng, parts, count):
    """uint16 [count, 6] features that the model does not clamp."""
    s = rng.integers(0, 4096, (count, parts.d))
    x = np.zeros((count, 6), np.uint16)
    x[:, :parts.d] = np.clip(parts.offset + (s * 4096 + 2048) // parts.gain_q12, 0, 65535)
    return x


def scaled(parts, feature):
    """s int64 [count, d] in u8.4, and clamped bool [count]."""
    free = ((feature[:, :parts.d].astype(np.int64) - parts.offset) * parts.gain_q12) >> 12
    s = np.clip(free, 0, 4095)
    return s, (s != free).any(axis=1)


def kernel(parts, s):
    """k int64 [count, n] at s."""
    t = (((s * s).sum(axis=1) + 31) >> 5)[:, None] + 256 * parts.half_c2 - s @ parts.centre.T.astype(np.int64)
    assert (t >= 0).all()
    level = LEVEL[np.minimum(t >> 10, 768)]
    return level - (((level >> 8) * ((t >> 2) & 255)) >> 6)


def twin(parts, feature):
    """The device's answer: deg_q7 int64 [count, 2] before it saturates, flagged bool [count] by ranges,
    guards and doubt (not by saturation), doubt [count], sigma [count] as if the angles had not saturated."""
    s, outside = scaled(parts, feature)
    acc = (parts.bias + s @ parts.trend.T.astype(np.int64)) >> 4
    k = kernel(parts, s)
    for i in range(len(parts.weight)):
        w = parts.weight[i].astype(np.int64)
        acc = acc + (k[:, i, None] * w - (k[:, i, None] & 255) * (w & 255)) // 256
    acc = (acc + 2 ** 23) % 2 ** 24 - 2 ** 23
    shift = parts.weight_frac_bits + 1
    deg = (acc + (1 << (shift - 1))) >> shift
    total = _corners(parts, np.clip(deg, -32768, 32767))
    doubt = np.zeros(len(s), np.int64)
    for i, (base, low, high, row) in enumerate(parts.guard):
        p = (s >> 4) @ np.asarray(row, np.int64)
        outside |= (p < low) | (p > high)
        r = p - base - (total(parts.expected[..., i]) >> 4)
        doubt += np.clip(r, -127, 127) ** 2
    outside |= doubt > parts.limit
    sigma = np.minimum(255, (total(parts.sigma) >> 7) + ((doubt * parts.sigma_gain) >> 12))
    return deg, outside, doubt, np.where(outside, 255, sigma)


def _corners(parts, deg):
    """Function: node values [high, wide] -> 128 times their blend at deg [count, 2]."""
    cell, f = [], []
    for axis in range(2):
        most = (parts.sigma.shape[1 - axis] - 1) * 65536 - 1
        t = np.clip((deg[:, axis] - parts.origin[axis]) * parts.scale[axis], 0, most)
        cell.append(t >> 16)
        f.append((t >> 9) & 127)
    w11 = (f[0] * f[1]) >> 7
    w10, w01 = f[0] - w11, f[1] - w11
    w00 = 128 - f[0] - w01

    def total(node):
        x, y = cell
        return w00 * node[y, x] + w10 * node[y, x + 1] + w01 * node[y + 1, x] + w11 * node[y + 1, x + 1]

    return total


def real_mean_deg(parts, feature):
    """The real-number mean at the same s and the same half_c2, degrees [count, 2]."""
    s, _ = scaled(parts, feature)
    t = (s * s).sum(axis=1)[:, None] / 32 + 256 * parts.half_c2 - s @ parts.centre.T
    unit = 2.0 ** -(parts.weight_frac_bits + 12)
    weight = parts.weight * 2.0 ** -parts.weight_frac_bits
    return (parts.bias + s @ parts.trend.T) * unit + np.exp(-t / 65536) @ weight


def bound_deg(parts):
    """The error bound that sg_gp.h states, degrees [2]."""
    weights = np.abs(parts.weight).sum(axis=0) * 2.0 ** -parts.weight_frac_bits
    left_out = (parts.weight & 255).sum(axis=0) * 2.0 ** -(parts.weight_frac_bits + 8)
    return 10.0 * 2.0 ** -16 * weights + left_out + 2.0 ** -(parts.weight_frac_bits + 8) + 2.0 ** -8


class View:
    """An opened image that keeps its bytes alive."""

    def __init__(self, image):
        self.bytes = ffi.new("uint8_t[]", image)
        self.view = ffi.new("struct sg_model_view *")
        self.verdict = lib.sg_model_open(self.view, self.bytes, len(image), 0)

    def predict(self, feature):
        """sg_gp_predict over uint16 [count, 6]: deg_q7 int64 [count, 2], flags [count], results [count],
        doubt [count], sigma [count]."""
        point = ffi.new("struct sg_gp_point *")
        rows = []
        for row in np.ascontiguousarray(feature, np.uint16):
            result = lib.sg_gp_predict(self.view, ffi.from_buffer("uint16_t[]", row), point)
            rows.append((*point.deg_q7, point.flags, result, point.doubt, point.sigma_log2_q4))
        table = np.array(rows, np.int64).reshape(-1, 6)
        return table[:, :2], table[:, 2], table[:, 3], table[:, 4], table[:, 5]
