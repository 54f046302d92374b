# SPDX-License-Identifier: Apache-2.0
"""Stored models for tests of the core, packed through the core's own structs, and their arithmetic in numpy
integers, written from the header of sg_model.h and not from its code."""
import binascii
import math
from dataclasses import dataclass, field

import numpy as np

from sparsegaze._core import ffi, lib

GUARDS = 8
U = math.sqrt(4096 / math.log(2))
_STEP = math.log(2) / 64
LEVEL = np.array([math.floor(2.0 ** (16 - i / 64) * (1 - _STEP ** 2 / 16)) for i in range(1025)], np.int64)


@dataclass
class Parts:
    """Everything a model holds, as integers. n vectors, d channels."""
    offset: np.ndarray          # [d] feature units
    gain_q12: np.ndarray        # [d]
    bias: np.ndarray            # [2]
    trend: np.ndarray           # [2, d]
    centre: np.ndarray          # [n, d] 0..255
    weight: np.ndarray          # [n, 2]
    weight_frac_bits: int = 9
    guard: list = field(default_factory=list)       # (low, high, row [d])
    generation: int = 1
    half_c2: np.ndarray = None  # [n]; None: exact

    def __post_init__(self):
        if self.half_c2 is None:
            self.half_c2 = 8 * (self.centre.astype(np.int64) ** 2).sum(axis=1)

    @property
    def d(self):
        """Channels."""
        return len(self.offset)

    def image(self):
        """The stored model, sealed."""
        n, d = self.centre.shape
        head = ffi.new("struct sg_model_head *")
        head.magic, head.version, head.vectors, head.channels = lib.SG_MODEL_MAGIC, 1, n, d
        head.generation, head.length = self.generation, 256 + 13 * n
        head.weight_frac_bits, head.guards = self.weight_frac_bits, len(self.guard)
        head.bias = [int(v) for v in self.bias]
        for j in range(d):
            head.offset[j], head.gain_q12[j] = int(self.offset[j]), int(self.gain_q12[j])
            for i in range(2):
                head.trend[i][j] = int(self.trend[i][j])
        page = ffi.new("struct sg_model_guard[8]")
        for i, (low, high, row) in enumerate(self.guard):
            page[i].low, page[i].high = int(low), int(high)
            for j in range(d):
                page[i].row[j] = int(row[j])
        records = bytearray()
        for c, half, w in zip(self.centre, self.half_c2, self.weight):
            records += int(half).to_bytes(3, "little") + bytes(int(v) for v in c) + bytes(6 - d)
            records += b"".join(int(v).to_bytes(2, "little", signed=True) for v in w)
        return seal(bytes(ffi.buffer(head)) + bytes(ffi.buffer(page)) + bytes(records))


def seal(image):
    """The image with the CRC that belongs to it (by binascii, not by the core)."""
    return image[:4] + binascii.crc32(image[8:]).to_bytes(4, "little") + image[8:]


def random_parts(rng, n, d=6, guards=3, **more):
    """A model whose every field is drawn over most of its range, but whose features are not all clamped."""
    centre = rng.integers(0, 256, (n, d))
    row = [rng.integers(-128, 128, d) for _ in range(guards)]
    return Parts(offset=rng.integers(0, 40000, d), gain_q12=rng.integers(300, 3000, d),
                 bias=rng.integers(-2 ** 27, 2 ** 27, 2), trend=rng.integers(-20000, 20000, (2, d)),
                 centre=centre, weight=rng.integers(-32768, 32768, (n, 2)),
                 guard=[(-2 ** 20, 2 ** 20, r) for r in row], **more)


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


def twin(parts, feature):
    """The device's answer before it saturates: deg_q7 int64 [count, 2], flagged bool [count]."""
    s, outside = scaled(parts, feature)
    for low, high, row in parts.guard:
        projection = s @ np.asarray(row, np.int64)
        outside |= (projection < low) | (projection > high)
    s2 = (s * s).sum(axis=1) >> 5
    t = np.maximum(s2[:, None] + parts.half_c2 - s @ parts.centre.T.astype(np.int64), 0)
    i = np.minimum(t >> 10, 1023)
    k = LEVEL[i] - ((((LEVEL[i] - LEVEL[i + 1]) << 6) * (t & 1023)) >> 16)
    k[t >= 1 << 20] = 0
    acc = parts.bias + s @ parts.trend.T.astype(np.int64) + k @ parts.weight.astype(np.int64)
    acc = (acc + 2 ** 31) % 2 ** 32 - 2 ** 31
    shift = parts.weight_frac_bits + 9
    return (acc + (1 << (shift - 1))) >> shift, outside


def real_mean_deg(parts, feature):
    """The real-number mean at the same s, degrees [count, 2]; needs exact half_c2."""
    s, _ = scaled(parts, feature)
    squared = ((s[:, None, :] / 16 - parts.centre[None]) ** 2).sum(axis=2)
    k = np.exp(-squared / (2 * U * U))
    unit = 2.0 ** -(parts.weight_frac_bits + 16)
    return (parts.bias + s @ parts.trend.T) * unit + k @ (parts.weight * 2.0 ** -parts.weight_frac_bits)


def bound_deg(parts):
    """The error bound that sg_gp.h states, degrees [2]."""
    weights = np.abs(parts.weight).sum(axis=0) * 2.0 ** -parts.weight_frac_bits
    return 2.2 * 2.0 ** -16 * weights + 2.0 ** -8


class View:
    """An opened image that keeps its bytes alive."""

    def __init__(self, image):
        self.bytes = ffi.new("uint8_t[]", image)
        self.view = ffi.new("struct sg_model_view *")
        self.verdict = lib.sg_model_open(self.view, self.bytes, len(image), 0)

    def predict(self, feature):
        """sg_gp_predict over uint16 [count, 6]: deg_q7 int64 [count, 2], flags [count], results [count]."""
        deg, flags = ffi.new("int16_t[2]"), ffi.new("uint8_t *")
        out = np.zeros((len(feature), 2), np.int64)
        seen = np.zeros(len(feature), np.uint8)
        results = np.zeros(len(feature), np.int64)
        for i, row in enumerate(np.ascontiguousarray(feature, np.uint16)):
            results[i] = lib.sg_gp_predict(self.view, ffi.from_buffer("uint16_t[]", row), deg, flags)
            out[i], seen[i] = (deg[0], deg[1]), flags[0]
        return out, seen, results
