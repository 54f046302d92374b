# SPDX-License-Identifier: Apache-2.0
"""The stored model: the image that lives in a flash slot or in a .sgm file, and its arithmetic.

Layout and meaning stand in firmware/core/sg_model.h. `DeviceModel` packs, checks and evaluates such an image;
evaluation runs the firmware's own C through sparsegaze._core. `quantise`, `kernel_q16` and `emulate` state
the same arithmetic a second time in numpy integers: the distiller fits weights on them, and tests hold the
two against each other bit for bit.
"""

import zlib
from typing import NamedTuple

import numpy as np

from . import imagefile
from .errors import ModelError
from .fields import put
from .trust import Trust, grid_bytes, sigma_deg

MAGIC = 0x4D475A47
VERSION = 2
PAGE_BYTES = 128
HEAD_BYTES = 2 * PAGE_BYTES
RECORD_BYTES = 12
CHANNELS = 6
SLOT_BYTES = 3072
VECTORS_MAX = (SLOT_BYTES - HEAD_BYTES - 20) // RECORD_BYTES  # beside the least grid
WEIGHT_FRAC_BITS = range(5, 10)
BIAS_MAX = 1 << 30
KERNEL_RBF = 0

S_MAX = 4095  # largest input, u8.4
S_FRAC = 16  # input steps per centre step
U_STEPS = 64.0  # centre steps per length scale: T >> 16 then counts e-folds
TABLE_END = 710  # of T >> 10: the kernel is 0 from here on

FLAG_VALID, FLAG_NO_MODEL, FLAG_OUT_OF_RANGE = 1, 2, 4
FLAG_SATURATED, FLAG_STARVED = 8, 16
DEG_Q7 = 128.0  # output steps per degree

HEAD = np.dtype(
    [
        ("magic", "<u4"),
        ("crc", "<u4"),
        ("generation", "<u4"),
        ("length", "<u4"),
        ("bias", "<i4", (2,)),
        ("trend", "<i2", (2, CHANNELS)),
        ("offset", "<u2", (CHANNELS,)),
        ("gain_q12", "<u2", (CHANNELS,)),
        ("version", "<u2"),
        ("vectors", "u1"),
        ("channels", "u1"),
        ("kernel", "u1"),
        ("weight_frac_bits", "u1"),
        ("pad", "u1", (50,)),
    ]
)
RECORD = np.dtype([("half_c2", "<u2"), ("c", "u1", (CHANNELS,)), ("weight", "<i2", (2,))])

GAZE = np.dtype(
    [
        ("t_us", "<u4"),
        ("azimuth_deg_q7", "<i2"),
        ("elevation_deg_q7", "<i2"),
        ("infer_us", "<u2"),
        ("flags", "u1"),
        ("sigma_log2_q4", "u1"),
    ]
)
POINT = np.dtype([("deg_q7", "<i2", (2,)), ("doubt", "<u2"), ("sigma", "u1"), ("flags", "u1")])

_REFIT = "fit the recording again (sparsegaze fit) or copy the file again"


class Judged(NamedTuple):
    """gaze_deg float64 [n, 2]; outside bool [n]; sigma_deg [n] of each angle (nan unknown);
    doubt [n], squared distance from what gaze explains, in standard deviations.
    """

    gaze_deg: np.ndarray
    outside: np.ndarray
    sigma_deg: np.ndarray
    doubt: np.ndarray


class DeviceModel:
    """One stored model, checked.

    image   bytes of the whole image; what follows the length that its header states (erased flash) is cut off
    Raises ModelError when the image is not a whole, undamaged model of this format version.
    """

    def __init__(self, image):
        self.image = _checked(bytes(image))
        self._head = np.frombuffer(self.image, HEAD, 1)[0]
        self._records = np.frombuffer(
            self.image, RECORD, self.vectors, len(self.image) - self.vectors * RECORD_BYTES
        )
        self._view = None

    @classmethod
    def from_parts(
        cls, offset, gain_q12, bias, trend, centres, weights, weight_frac_bits, trust=None, generation=0
    ):
        """Pack a model.

        offset, gain_q12   [d] feature units and s steps per feature step (Q4.12); gain 0 drops the channel
        bias, trend        [2], [2, d] integers, 2^-(weight_frac_bits + 12) deg (trend: 16 bits, per
                           step of s)
        centres            [n, d] 0..255;  weights [n, 2] signed 16 bit, unit 2^-weight_frac_bits deg
        trust              trust.Trust, or None for a model that flags only what leaves the box
        Raises ModelError for a value that its field cannot hold.
        """
        centres, weights = np.asarray(centres), np.asarray(weights)
        if centres.ndim != 2 or not 1 <= centres.shape[1] <= CHANNELS:
            raise ModelError(
                f"a model has 1 to {CHANNELS} channels, not {centres.shape[1:]}",
                "record with a board of at most six LEDs",
            )
        n, d = centres.shape
        trust = trust or Trust()
        page, grid = trust.pack(d)
        room = (SLOT_BYTES - HEAD_BYTES - len(grid)) // RECORD_BYTES
        if not 1 <= n <= room:
            raise ModelError(
                f"{n} calibration vectors do not fit a slot of {room}", f"ask for 1 to {room} vectors"
            )
        head = np.zeros(1, HEAD)
        head["magic"], head["version"], head["kernel"] = MAGIC, VERSION, KERNEL_RBF
        head["length"] = HEAD_BYTES + len(grid) + n * RECORD_BYTES
        head["vectors"], head["channels"] = n, d
        put(head, "generation", generation, ())
        put(head, "weight_frac_bits", weight_frac_bits, ())
        put(head, "bias", bias, (2,))
        put(head, "trend", trend, (2, d))
        put(head, "offset", offset, (d,))
        put(head, "gain_q12", gain_q12, (d,))
        records = np.zeros(n, RECORD)
        put(records, "c", centres, (n, d))
        put(records, "weight", weights, (n, 2))
        records["half_c2"] = half_squares(centres)
        return cls(imagefile.sealed(head.tobytes() + page + grid + records.tobytes()))

    @classmethod
    def load(cls, path):
        """Read a .sgm file. Raises ModelError, naming the file."""
        return imagefile.load(cls, path, SLOT_BYTES, "a model file made by sparsegaze fit", _REFIT)

    def save(self, path):
        """Write a .sgm file: whole, or not at all. Raises ModelError when the place cannot be written."""
        imagefile.save(path, self.image)

    def with_generation(self, generation):
        """The same model with another generation number (0..2^32-1) and the CRC that belongs to it."""
        head = np.frombuffer(self.image, HEAD, 1).copy()
        put(head, "generation", generation, ())
        return DeviceModel(imagefile.sealed(head.tobytes() + self.image[PAGE_BYTES:]))

    crc = property(lambda self: int(self._head["crc"]))
    generation = property(lambda self: int(self._head["generation"]))
    vectors = property(lambda self: int(self._head["vectors"]))
    channels = property(lambda self: int(self._head["channels"]))
    weight_frac_bits = property(lambda self: int(self._head["weight_frac_bits"]))
    offset = property(lambda self: self._head["offset"].astype(np.int64))
    gain_q12 = property(lambda self: self._head["gain_q12"].astype(np.int64))
    bias = property(lambda self: self._head["bias"].astype(np.int64))
    trend = property(lambda self: self._head["trend"].astype(np.int64))
    centres = property(lambda self: self._records["c"].astype(np.int64))
    weights = property(lambda self: self._records["weight"].astype(np.int64))
    trust = property(
        lambda self: Trust.unpack(self.image[PAGE_BYTES : len(self.image) - self.vectors * RECORD_BYTES]))

    def predict(self, features, recentre_deg=(0.0, 0.0)):
        """Gaze by the firmware's own code.

        features       uint16 [n, d], d = .channels or 6
        recentre_deg   azimuth and elevation added to the output, rounded to 1/128 deg
        Returns (azimuth_deg [n], elevation_deg [n], flags uint8 [n]); without FLAG_VALID it means nothing.
        `judge` tells sigma too.
        Raises ModelError when d does not fit the model.
        """
        from . import _core

        ffi, lib = _core.ffi, _core.lib
        features = self._six(features)
        out = np.zeros(len(features), GAZE)
        recentre = ffi.new("struct sg_affine *", {"offset_deg_q7": recentre_q7(recentre_deg).tolist()})
        gaze = ffi.cast("struct sg_gaze *", ffi.from_buffer(out, require_writable=True))
        lib.sg_batch_infer(
            self._opened(), ffi.from_buffer("uint16_t[]", features), ffi.NULL, recentre, gaze, len(features)
        )
        return out["azimuth_deg_q7"] / DEG_Q7, out["elevation_deg_q7"] / DEG_Q7, out["flags"].copy()

    def judge(self, features):
        """Gaze and what the device knows of its error, by the firmware's code: Judged. Features as above."""
        from . import _core

        ffi, lib = _core.ffi, _core.lib
        features = self._six(features)
        out = np.zeros(len(features), POINT)
        points = ffi.cast("struct sg_gp_point *", ffi.from_buffer(out, require_writable=True))
        lib.sg_batch_predict(self._opened(), ffi.from_buffer("uint16_t[]", features), points, len(features))
        return Judged(
            out["deg_q7"] / DEG_Q7,
            (out["flags"] & FLAG_OUT_OF_RANGE) != 0,
            sigma_deg(out["sigma"]),
            out["doubt"] / 256.0,
        )

    def _opened(self):
        from . import _core

        ffi, lib = _core.ffi, _core.lib
        if self._view is None:
            buffer = ffi.from_buffer("uint8_t[]", self.image)
            view = ffi.new("struct sg_model_view *")
            status = lib.sg_model_open(view, buffer, len(self.image), 0)
            if status < 0:
                raise ModelError(f"the core refuses this model (error {status})", _REFIT)
            self._view = (view, buffer)  # the view borrows the image
        return self._view[0]

    def _six(self, features):
        features = np.asarray(features)
        if features.ndim != 2 or features.shape[1] not in (self.channels, CHANNELS):
            raise ModelError(
                f"the model has {self.channels} channels, the features {features.shape[-1]}",
                "use the model that was fitted to recordings of this headset",
            )
        six = np.zeros((len(features), CHANNELS), np.uint16)
        six[:, : features.shape[1]] = features
        return np.ascontiguousarray(six)


def quantise(features, offset, gain_q12):
    """Features -> inputs of the kernel.

    features uint16 [n, d]; offset, gain_q12 [d].  Returns (s int64 [n, d] u8.4 in 0..4095, clamped bool [n]).
    """
    scaled = (np.asarray(features).astype(np.int64) - offset) * gain_q12 >> 12
    s = np.clip(scaled, 0, S_MAX)
    return s, np.any(s != scaled, axis=1)


def half_squares(centres):
    """8 sum c^2 of centres [m, d] in units of 256, rounded up: int64 [m]. Weights take the difference."""
    return (np.sum(np.asarray(centres, np.int64) ** 2, axis=1) + 31) >> 5


def kernel_table():
    """The kernel's table over T >> 10, int64 [TABLE_END + 1]; it ends in zeros."""
    level = np.floor(65536.0 * np.exp(-np.arange(TABLE_END + 1) / 64.0)).astype(np.int64)
    return np.minimum(level, 65535)


_LEVEL = kernel_table()


def kernel_q16(s, centres):
    """Kernel values as the device computes them.

    s [n, d] u8.4, centres [m, d] 0..255.  Returns int64 [n, m], Q0.16.
    """
    s, centres = np.asarray(s, np.int64), np.asarray(centres, np.int64)
    # Exact in float64: every product is below 2^20 and every sum below 2^24.
    cross = (s.astype(float) @ centres.T.astype(float)).astype(np.int64)
    t = ((np.sum(s * s, axis=1) + 31) >> 5)[:, None] + 256 * half_squares(centres) - cross
    level = _LEVEL[np.minimum(t >> 10, TABLE_END)]
    return level - ((level >> 8) * (t >> 2 & 255) >> 6)


def weighed(k, weights):
    """sum of weight * k as the device forms it, without the products of the low bytes.

    k int64 [n, m] Q0.16, weights int64 [m, 2].  Returns int64 [n, 2], unit 2^-(weight_frac_bits + 8) deg.
    """
    whole = k @ weights - (k & 255) @ (weights & 255)
    return whole >> 8  # a multiple of 256


def emulate(model, features, recentre_deg=(0.0, 0.0)):
    """The device's answer in numpy integers, written from sg_model.h alone.

    Returns (azimuth_q7 int64 [n], elevation_q7 int64 [n], flags uint8 [n]) as struct sg_gaze has them.
    """
    q7, outside, _, _ = emulate_point(model, features)
    model_gaze = np.clip(q7, -32768, 32767)
    moved = model_gaze + recentre_q7(recentre_deg)
    gaze = np.clip(moved, -32768, 32767)
    outside = outside | np.any(moved != gaze, axis=1)
    flags = np.where(outside, FLAG_OUT_OF_RANGE, FLAG_VALID).astype(np.uint8)
    return gaze[:, 0], gaze[:, 1], flags


def emulate_point(model, features):
    """What struct sg_gp_point holds: (q7 [n, 2], outside bool [n], doubt [n], sigma code [n]), else int64.

    q7 before it saturates.
    """
    s, outside = quantise(model._six(features), model._head["offset"], model._head["gain_q12"])
    centres = model._records["c"].astype(np.int64)
    trend = model._head["trend"].astype(np.int64)
    total = (model.bias + s @ trend.T) >> 4
    total = total + weighed(kernel_q16(s, centres), model.weights)
    total = (total + 2**23) % 2**24 - 2**23
    shift = model.weight_frac_bits + 1
    q7 = (total + (1 << shift - 1)) >> shift
    gaze = np.clip(q7, -32768, 32767)
    outside = outside | np.any(q7 != gaze, axis=1)
    return (q7, *model.trust.judge(s, gaze, outside))


def recentre_q7(recentre_deg):
    """Degrees -> int64 [2] in 1/128 deg. Raises ModelError when they do not fit 16 bits."""
    value = np.floor(np.asarray(recentre_deg, float) * DEG_Q7 + 0.5)
    if value.shape != (2,) or not np.all(np.abs(value) <= 32767):
        raise ModelError(
            f"a recentre offset of {recentre_deg} deg is no angle", "recentre while looking at the target"
        )
    return value.astype(np.int64)


def _checked(image):
    if len(image) < 4 or int.from_bytes(image[:4], "little") != MAGIC:
        raise ModelError("not a sparsegaze model", "name a file made by sparsegaze fit")
    if len(image) < HEAD_BYTES:
        raise ModelError(f"the model is cut off after {len(image)} bytes", _REFIT)
    head = np.frombuffer(image, HEAD, 1)[0]
    if head["version"] != VERSION:
        raise ModelError(
            f"the model has format version {head['version']}, this program reads {VERSION}",
            "fit the recording again with this version of sparsegaze",
        )
    length, n, d = int(head["length"]), int(head["vectors"]), int(head["channels"])
    grid = grid_bytes(image[PAGE_BYTES:HEAD_BYTES])
    if not 1 <= n <= VECTORS_MAX or length != HEAD_BYTES + grid + n * RECORD_BYTES or length > SLOT_BYTES:
        raise ModelError(f"the model states {n} vectors in {length} bytes, which cannot be", _REFIT)
    if not 1 <= d <= CHANNELS:
        raise ModelError(
            f"the model states {d} channels; there are 1 to {CHANNELS}", "use a model fitted for this board"
        )
    if len(image) < length:
        raise ModelError(f"the model is cut off: {len(image)} of {length} bytes", _REFIT)
    image = image[:length]
    if zlib.crc32(image[8:]) != int(head["crc"]):
        raise ModelError("the model is damaged (its checksum does not match)", _REFIT)
    unused = slice(d, CHANNELS)
    records = np.frombuffer(image, RECORD, n, HEAD_BYTES + grid)
    trust = Trust.unpack(image[PAGE_BYTES : HEAD_BYTES + grid])
    if (
        head["kernel"] != KERNEL_RBF
        or head["weight_frac_bits"] not in WEIGHT_FRAC_BITS
        or np.any(np.abs(head["bias"].astype(np.int64)) > BIAS_MAX)
        or np.any(head["pad"])
        or np.any(head["offset"][head["gain_q12"] == 0])
        or np.any(head["gain_q12"][unused])
        or np.any(head["trend"][:, unused])
        or np.any(records["c"][:, unused])
        or np.any(records["half_c2"] != half_squares(records["c"]))
        or not trust.sound(image[PAGE_BYTES : HEAD_BYTES + grid], d)
    ):
        raise ModelError("the model has fields that this format does not allow", _REFIT)
    return image
