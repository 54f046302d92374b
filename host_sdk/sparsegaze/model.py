# SPDX-License-Identifier: Apache-2.0
"""The stored model: the image that lives in a flash slot or in a .sgm file, and its arithmetic.

Layout and meaning stand in firmware/core/sg_model.h. `DeviceModel` packs, checks and evaluates such an image;
evaluation runs the firmware's own C through sparsegaze._core. `quantise`, `kernel_q16` and `emulate` state
the same arithmetic a second time in numpy integers: the distiller fits weights on them, and tests hold the
two against each other bit for bit.
"""

import os
import zlib

import numpy as np

from .errors import ModelError

MAGIC = 0x4D475A47
VERSION = 1
PAGE_BYTES = 128
HEAD_BYTES = 2 * PAGE_BYTES
RECORD_BYTES = 13
CHANNELS = 6
SLOT_BYTES = 3072
VECTORS_MAX = (SLOT_BYTES - HEAD_BYTES) // RECORD_BYTES
GUARDS_MAX = 8
WEIGHT_FRAC_BITS = range(6, 11)
KERNEL_RBF = 0

S_MAX = 4095  # largest input, u8.4
S_FRAC = 16  # input steps per centre step
U_STEPS = np.sqrt(4096.0 / np.log(2.0))  # centre steps per length scale: T >> 16 then counts halvings
T_END = 1 << 20  # the kernel is 0 from here on

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
        ("trend", "<i4", (2, CHANNELS)),
        ("offset", "<u2", (CHANNELS,)),
        ("gain_q12", "<u2", (CHANNELS,)),
        ("version", "<u2"),
        ("vectors", "u1"),
        ("channels", "u1"),
        ("kernel", "u1"),
        ("weight_frac_bits", "u1"),
        ("guards", "u1"),
        ("reserved", "u1"),
        ("pad", "u1", (24,)),
    ]
)
GUARD = np.dtype([("low", "<i4"), ("high", "<i4"), ("row", "i1", (CHANNELS,)), ("reserved", "u1", (2,))])
RECORD = np.dtype([("half_c2", "u1", (3,)), ("c", "u1", (CHANNELS,)), ("weight", "<i2", (2,))])

_REFIT = "fit the recording again (sparsegaze fit) or copy the file again"


class DeviceModel:
    """One stored model, checked.

    image   bytes of the whole image; what follows the length that its header states (erased flash) is cut off
    Raises ModelError when the image is not a whole, undamaged model of this format version.
    """

    def __init__(self, image):
        self.image = _checked(bytes(image))
        self._head = np.frombuffer(self.image, HEAD, 1)[0]
        self._guards = np.frombuffer(self.image, GUARD, GUARDS_MAX, PAGE_BYTES)[: int(self._head["guards"])]
        self._records = np.frombuffer(self.image, RECORD, self.vectors, HEAD_BYTES)
        self._view = None

    @classmethod
    def from_parts(
        cls, offset, gain_q12, bias, trend, centres, weights, weight_frac_bits, guards=(), generation=0
    ):
        """Pack a model.

        offset, gain_q12   [d] feature units and s steps per feature step (Q4.12); gain 0 drops the channel
        bias, trend        [2], [2, d] signed 32 bit, 2^-(weight_frac_bits + 16) deg (trend: per step of s)
        centres            [n, d] 0..255;  weights [n, 2] signed 16 bit, unit 2^-weight_frac_bits deg
        guards             up to 8 of (low, high, row [d] signed 8 bit)
        Raises ModelError for a value that its field cannot hold.
        """
        centres, weights = np.asarray(centres), np.asarray(weights)
        if centres.ndim != 2 or not 1 <= centres.shape[1] <= CHANNELS:
            raise ModelError(
                f"a model has 1 to {CHANNELS} channels, not {centres.shape[1:]}",
                "record with a board of at most six LEDs",
            )
        n, d = centres.shape
        if not 1 <= n <= VECTORS_MAX:
            raise ModelError(
                f"{n} calibration vectors do not fit a slot of {VECTORS_MAX}", "ask for fewer vectors"
            )
        if len(guards) > GUARDS_MAX:
            raise ModelError(f"{len(guards)} guards do not fit a page of {GUARDS_MAX}", "use fewer guards")
        head = np.zeros(1, HEAD)
        head["magic"], head["version"], head["kernel"] = MAGIC, VERSION, KERNEL_RBF
        head["length"] = HEAD_BYTES + n * RECORD_BYTES
        head["vectors"], head["channels"], head["guards"] = n, d, len(guards)
        _put(head, "generation", generation, ())
        _put(head, "weight_frac_bits", weight_frac_bits, ())
        _put(head, "bias", bias, (2,))
        _put(head, "trend", trend, (2, d))
        _put(head, "offset", offset, (d,))
        _put(head, "gain_q12", gain_q12, (d,))
        guard_page = np.zeros(GUARDS_MAX, GUARD)
        for row, (low, high, coefficients) in zip(guard_page, guards):
            _put(row, "low", low, ())
            _put(row, "high", high, ())
            _put(row, "row", coefficients, (d,))
        records = np.zeros(n, RECORD)
        _put(records, "c", centres, (n, d))
        _put(records, "weight", weights, (n, 2))
        half = 8 * np.sum(centres.astype(np.int64) ** 2, axis=1)
        records["half_c2"] = np.stack([half & 255, half >> 8 & 255, half >> 16], axis=1)
        return cls(_sealed(head.tobytes() + guard_page.tobytes() + records.tobytes()))

    @classmethod
    def load(cls, path):
        """Read a .sgm file. Raises ModelError, naming the file."""
        try:
            with open(path, "rb") as file:
                image = file.read(SLOT_BYTES + 1)
        except OSError as error:
            raise ModelError(
                f"cannot read {path}: {error.strerror}", "name a model file made by sparsegaze fit"
            ) from None
        try:
            model = cls(image)
        except ModelError as error:
            raise ModelError(f"{path}: {error.message}", error.remedy) from None
        if len(model.image) != len(image):
            raise ModelError(
                f"{path}: {len(image) - len(model.image)} bytes too many behind the model", _REFIT
            )
        return model

    def save(self, path):
        """Write a .sgm file: whole, or not at all. Raises ModelError when the place cannot be written."""
        part = f"{os.fspath(path)}.{os.getpid()}.part"
        try:
            with open(part, "wb") as file:
                file.write(self.image)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        except OSError as error:
            if os.path.exists(part):
                os.remove(part)
            raise ModelError(
                f"cannot write {path}: {error.strerror}", "choose another place with -o"
            ) from None

    def with_generation(self, generation):
        """The same model with another generation number (0..2^32-1) and the CRC that belongs to it."""
        head = np.frombuffer(self.image, HEAD, 1).copy()
        _put(head, "generation", generation, ())
        return DeviceModel(_sealed(head.tobytes() + self.image[PAGE_BYTES:]))

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
    half_c2 = property(lambda self: self._records["half_c2"].astype(np.int64) @ np.array([1, 256, 65536]))
    guards = property(
        lambda self: [(int(g["low"]), int(g["high"]), g["row"].astype(np.int64)) for g in self._guards]
    )

    def predict(self, features, recentre_deg=(0.0, 0.0)):
        """Gaze by the firmware's own code.

        features       uint16 [n, d], d = .channels or 6
        recentre_deg   azimuth and elevation added to the output, rounded to 1/128 deg
        Returns (azimuth_deg [n], elevation_deg [n], flags uint8 [n]); without FLAG_VALID it means nothing.
        Raises ModelError when d does not fit the model.
        """
        from . import _core

        ffi, lib = _core.ffi, _core.lib
        features = self._six(features)
        if self._view is None:
            buffer = ffi.from_buffer("uint8_t[]", self.image)
            view = ffi.new("struct sg_model_view *")
            status = lib.sg_model_open(view, buffer, len(self.image), 0)
            if status < 0:
                raise ModelError(f"the core refuses this model (error {status})", _REFIT)
            self._view = (view, buffer)  # the view borrows the image
        out = np.zeros(
            len(features),
            np.dtype(
                [
                    ("t_us", "<u4"),
                    ("azimuth_deg_q7", "<i2"),
                    ("elevation_deg_q7", "<i2"),
                    ("infer_us", "<u2"),
                    ("flags", "u1"),
                    ("sigma_log2_q4", "u1"),
                ]
            ),
        )
        recentre = ffi.new("struct sg_affine *", {"offset_deg_q7": recentre_q7(recentre_deg).tolist()})
        gaze = ffi.cast("struct sg_gaze *", ffi.from_buffer(out, require_writable=True))
        lib.sg_batch_infer(
            self._view[0], ffi.from_buffer("uint16_t[]", features), ffi.NULL, recentre, gaze, len(features)
        )
        return out["azimuth_deg_q7"] / DEG_Q7, out["elevation_deg_q7"] / DEG_Q7, out["flags"].copy()

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


def kernel_table():
    """The kernel's table over T >> 10: level and 64 times the fall to the next entry, int64 [1024] each.

    The chord lies above the curve, by half of (ln 2 / 64)^2 / 8 on average, and the device floors the
    interpolated fall: both means are taken off the nodes.
    """
    level = 65536.0 * 2.0 ** (-np.arange(1025) / 64.0) * (1.0 - (np.log(2.0) / 64.0) ** 2 / 16.0) - 0.5
    level = np.floor(level + 0.5).astype(np.int64)
    return level[:-1], (level[:-1] - level[1:]) * 64


_LEVEL, _FALL = kernel_table()


def kernel_q16(s, centres, half_c2=None):
    """Kernel values as the device computes them.

    s [n, d] u8.4, centres [m, d] 0..255.  Returns int64 [n, m], Q0.16.
    """
    s, centres = np.asarray(s, np.int64), np.asarray(centres, np.int64)
    if half_c2 is None:
        half_c2 = 8 * np.sum(centres**2, axis=1)
    # Exact in float64: every product is below 2^20 and every sum below 2^24.
    cross = (s.astype(float) @ centres.T.astype(float)).astype(np.int64)
    t = np.maximum((np.sum(s * s, axis=1) >> 5)[:, None] + half_c2 - cross, 0)
    inside = t < T_END
    t = np.where(inside, t, 0)
    k = _LEVEL[t >> 10] - (_FALL[t >> 10] * (t & 1023) >> 16)
    return np.where(inside, k, 0)


def emulate(model, features, recentre_deg=(0.0, 0.0)):
    """The device's answer in numpy integers, written from sg_model.h alone.

    Returns (azimuth_q7 int64 [n], elevation_q7 int64 [n], flags uint8 [n]) as struct sg_gaze has them.
    """
    features = model._six(features)
    s, outside = quantise(features, model.offset, model.gain_q12)
    for low, high, row in model.guards:
        projection = s @ row
        outside |= (projection < low) | (projection > high)
    k = kernel_q16(s, model.centres, model.half_c2)
    total = model.bias + s @ model.trend.T + k @ model.weights
    total = (total + 2**31) % 2**32 - 2**31
    shift = model.weight_frac_bits + 16 - 7
    q7 = (total + (1 << shift - 1)) >> shift
    model_gaze = np.clip(q7, -32768, 32767)
    moved = model_gaze + recentre_q7(recentre_deg)
    gaze = np.clip(moved, -32768, 32767)
    outside |= np.any((q7 != model_gaze) | (moved != gaze), axis=1)
    flags = np.where(outside, FLAG_OUT_OF_RANGE, FLAG_VALID).astype(np.uint8)
    return gaze[:, 0], gaze[:, 1], flags


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
    if not 1 <= n <= VECTORS_MAX or length != HEAD_BYTES + n * RECORD_BYTES:
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
    guards = np.frombuffer(image, GUARD, GUARDS_MAX, PAGE_BYTES)
    idle = image[PAGE_BYTES + int(head["guards"]) * GUARD.itemsize : HEAD_BYTES]
    records = np.frombuffer(image, RECORD, n, HEAD_BYTES)
    if (
        head["kernel"] != KERNEL_RBF
        or head["weight_frac_bits"] not in WEIGHT_FRAC_BITS
        or head["guards"] > GUARDS_MAX
        or head["reserved"]
        or np.any(head["pad"])
        or np.any(guards["reserved"])
        or any(idle)
        or np.any(guards["low"] > guards["high"])
        or np.any(guards["row"][:, unused])
        or np.any(head["offset"][unused])
        or np.any(head["gain_q12"][unused])
        or np.any(head["trend"][:, unused])
        or np.any(records["c"][:, unused])
        or np.any(records["half_c2"][:, 2] >= 0x40)
    ):
        raise ModelError("the model has fields that this format does not allow", _REFIT)
    return image


def _sealed(image):
    return image[:4] + zlib.crc32(image[8:]).to_bytes(4, "little") + image[8:]


def _put(target, field, value, shape):
    """Assign integers to the leading part of a field; ModelError instead of wrapping round."""
    value = np.asarray(value)
    if value.shape != shape or not np.issubdtype(value.dtype, np.integer):
        raise ModelError(
            f"{field} must be integers of shape {shape}, not {value.dtype} {value.shape}",
            "this is a bug: report it with the recording",
        )
    limits = np.iinfo(target[field].dtype)
    if value.size and (value.min() < limits.min or value.max() > limits.max):
        raise ModelError(
            f"{field} reaches {value.min()}..{value.max()}; it holds {limits.min}..{limits.max}",
            "this is a bug: report it with the recording",
        )
    if shape == ():
        target[field] = value
    else:
        target[field][..., : shape[-1]] = value
