# SPDX-License-Identifier: Apache-2.0
"""A stored tanh network: the image that firmware/core/sg_mlp.h describes, and its arithmetic.

`MlpModel` packs, checks and evaluates such an image; evaluation runs the firmware's own C through
sparsegaze._core. `emulate` states the same arithmetic a second time in numpy integers, written from the
header alone, and tests hold the two against each other bit for bit. mlp_train.py makes networks.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from . import imagefile
from .errors import ModelError

MAGIC = 0x4C4D5A47
VERSION = 1
INPUTS_MAX, OUTPUTS_MAX, HIDDEN_MAX, WIDTH_MAX = 8, 8, 4, 64
LENGTH_MAX = 28008
ONE = 32768  # activation steps of 1.0; stored activations are offset by it
OUTPUT_ONE = 128  # output steps of one unit
TANH_ONE = 8192 / np.log(2)  # argument steps of 1.0
HALF = {1: 128, 2: 32768}  # what a weight of so many bytes is stored above
Z_END = 1 << 23
FLAG_OUT_OF_RANGE = 4

HEAD = np.dtype(
    [
        ("magic", "<u4"),
        ("crc", "<u4"),
        ("length", "<u2"),
        ("version", "<u2"),
        ("inputs", "u1"),
        ("outputs", "u1"),
        ("hidden", "u1"),
        ("reserved", "u1"),
        ("width", "u1", (HIDDEN_MAX,)),
        ("weight_bytes", "u1", (HIDDEN_MAX + 1,)),
        ("pad", "u1", (7,)),
        ("input", [("offset", "<u2"), ("gain_q8", "<u2")], (INPUTS_MAX,)),
    ]
)

_REFIT = "train the network again or copy the file again"
_BUG = "this is a bug: report it with the recording"


@dataclass(frozen=True)
class Layer:
    """One layer's integers: weights [r, c] (without what they are stored above), bias [r] 24 bits signed as
    stored, scale [r] 16 bits, weight_bytes 1 or 2."""

    weights: np.ndarray
    bias: np.ndarray
    scale: np.ndarray
    weight_bytes: int

    @property
    def range(self):
        """Bounds of z over all activations, as sg_mlp_open takes them: (low [r], high [r])."""
        up, down = np.maximum(self.weights, 0).sum(axis=1), np.maximum(-self.weights, 0).sum(axis=1)
        columns = self.weights.shape[1]
        return self.bias - 256 * (down + columns), self.bias + 256 * (up + columns)


class MlpModel:
    """One stored network, checked.

    image   bytes of the whole image; what follows the length that its head states is cut off
    Raises ModelError when the image is not a whole, undamaged network of this format version whose sums stay
    inside the device's accumulators.
    """

    def __init__(self, image):
        self.image, self.layers = _opened(bytes(image))
        self._head = np.frombuffer(self.image, HEAD, 1)[0]
        self._view = None

    @classmethod
    def from_layers(cls, offset, gain_q8, layers):
        """Pack a network.

        offset, gain_q8   [inputs] input units; activation steps per input step, Q8.8; gain 0 drops the input
        layers            1 to 5 Layer, the last one linear
        Raises ModelError for a value that its field cannot hold, and for rows that could overflow.
        """
        offset, gain_q8 = np.asarray(offset), np.asarray(gain_q8)
        shapes = [layer.weights.shape for layer in layers]
        rows, columns = [s[0] for s in shapes], [s[1] for s in shapes]
        if not 1 <= len(layers) <= HIDDEN_MAX + 1 or columns != [len(offset), *rows[:-1]]:
            raise ModelError(f"layers of {shapes} for {len(offset)} inputs make no network", _BUG)
        widths = rows[:-1]
        if not (1 <= len(offset) <= INPUTS_MAX and 1 <= rows[-1] <= OUTPUTS_MAX):
            raise ModelError(
                f"{len(offset)} inputs and {rows[-1]} outputs do not fit the device",
                f"give 1 to {INPUTS_MAX} inputs and 1 to {OUTPUTS_MAX} outputs",
            )
        if any(not 1 <= w <= WIDTH_MAX for w in widths):
            raise ModelError(f"hidden layers of {widths} do not fit", f"give widths of 1 to {WIDTH_MAX}")
        head = np.zeros(1, HEAD)
        head["magic"], head["version"] = MAGIC, VERSION
        head["inputs"], head["outputs"], head["hidden"] = len(offset), rows[-1], len(widths)
        head["width"][0, : len(widths)] = widths
        head["weight_bytes"][0, : len(layers)] = [layer.weight_bytes for layer in layers]
        head["input"]["offset"][0, : len(offset)] = _within(offset, 0, 65535, "offset")
        head["input"]["gain_q8"][0, : len(offset)] = _within(gain_q8, 0, 65535, "gain_q8")
        body = b"".join(_packed(layer) for layer in layers)
        head["length"] = HEAD.itemsize + len(body)
        image = head.tobytes() + body
        return cls(imagefile.sealed(image))

    @classmethod
    def load(cls, path):
        """Read a network file. Raises ModelError, naming the file."""
        return imagefile.load(cls, path, LENGTH_MAX, "a network's file", _REFIT)

    def save(self, path):
        """Write a network file: whole, or not at all. Raises ModelError when the place cannot be written."""
        imagefile.save(path, self.image)

    crc = property(lambda self: int(self._head["crc"]))
    inputs = property(lambda self: int(self._head["inputs"]))
    outputs = property(lambda self: int(self._head["outputs"]))
    widths = property(lambda self: tuple(int(w) for w in self._head["width"][: int(self._head["hidden"])]))
    weight_bytes = property(lambda self: tuple(layer.weight_bytes for layer in self.layers))
    offset = property(lambda self: self._head["input"]["offset"][: self.inputs].astype(np.int64))
    gain_q8 = property(lambda self: self._head["input"]["gain_q8"][: self.inputs].astype(np.int64))

    def predict(self, features):
        """Outputs by the firmware's own code.

        features   uint16 [n, inputs]
        Returns (one float array [n] for each output, in the unit trained in, steps of 1/128; at the end flags
        uint8 [n]: FLAG_OUT_OF_RANGE when an input was clamped or an output saturated).
        Raises ModelError when the features do not fit the network.
        """
        from . import _core

        ffi, lib = _core.ffi, _core.lib
        features = checked_inputs(features, self.inputs)
        if self._view is None:
            buffer = ffi.from_buffer("uint8_t[]", self.image)
            view = ffi.new("struct sg_mlp_view *")
            status = lib.sg_mlp_open(view, buffer, len(self.image), 0)
            if status < 0:
                raise ModelError(f"the core refuses this network (error {status})", _REFIT)
            self._view = (view, buffer)  # the view borrows the image
        out = np.zeros((len(features), self.outputs), np.int16)
        flags = np.zeros(len(features), np.uint8)
        lib.sg_batch_mlp(
            self._view[0],
            ffi.from_buffer("uint16_t[]", features),
            ffi.from_buffer("int16_t[]", out, require_writable=True),
            ffi.from_buffer("uint8_t[]", flags, require_writable=True),
            len(features),
        )
        return (*(out.T / OUTPUT_ONE), flags)


def checked_inputs(features, inputs):
    """features as contiguous uint16 [n, inputs]. Raises ModelError when they are anything else."""
    features = np.asarray(features)
    if features.ndim != 2 or features.shape[1] != inputs:
        raise ModelError(
            f"the network has {inputs} inputs, the features {features.shape}",
            "use the network that was trained on recordings of this headset",
        )
    if features.dtype != np.uint16:
        whole = np.isfinite(features) & (features == np.rint(features))
        if not np.all(whole & (features >= 0) & (features <= 65535)):
            raise ModelError("features are whole numbers of 0 to 65535", "round and clip them first")
    return np.ascontiguousarray(features, np.uint16)


def tanh_table():
    """T of sg_mlp.h: int64 [257], 2^-15."""
    step = np.log(2.0) / 32
    t = np.tanh(np.arange(257) * step)
    return np.minimum(np.floor(32768 * (t + t * (1 - t * t) * step**2 / 8) + 0.5), 32767).astype(np.int64)


_TANH = tanh_table()


def activations(model, features):
    """Inputs of the first layer: (a int64 [n, inputs] 0..65535, clamped bool [n])."""
    a = (np.asarray(features).astype(np.int64) - model.offset) * model.gain_q8 >> 8
    inside = np.clip(a, 0, 65535)
    return inside, np.any(inside != a, axis=1)


def sums(layer, a):
    """z of a layer as the device has them: int64 [n, r], 24 bits signed, modulo 2^24."""
    return (whole_sums(layer, a) + Z_END) % (2 * Z_END) - Z_END


def whole_sums(layer, a):
    """The same before the modulo, which sg_mlp_open proves to do nothing."""
    a, half = np.asarray(a, np.int64), HALF[layer.weight_bytes]
    stored = layer.weights.astype(np.int64) + half
    total = a.sum(axis=1, keepdims=True)
    if layer.weight_bytes == 1:
        # every product loses its low byte
        products = (a @ stored.T - _low_bytes(a, stored)) >> 8
        return layer.bias - (total >> 1) + products
    # hi * a + lo * (a >> 8), exact in float64 far below 2^53
    products = _exact(a, stored >> 8) + _exact(a >> 8, stored & 255)
    return layer.bias - 128 * total + ((a & 255).sum(axis=1, keepdims=True) >> 1) + products


def squash(z, scale):
    """A hidden row's activations from its sums: int64, 1..65535."""
    u = np.minimum(np.abs(z) * scale + 128 >> 8, 65535)
    i, f = u >> 8, u & 255
    t = _TANH[i] + ((_TANH[i + 1] - _TANH[i]) * f + 128 >> 8)
    return np.where(z < 0, ONE - t, ONE + t)


def emulate(model, features):
    """The device's answer in numpy integers, written from sg_mlp.h alone.

    Returns (outputs int64 [n, outputs], 1/128 unit; flags uint8 [n]).
    """
    a, clamped = activations(model, checked_inputs(features, model.inputs))
    for layer in model.layers[:-1]:
        a = squash(sums(layer, a), layer.scale)
    last = model.layers[-1]
    z = sums(last, a)
    y = (np.abs(z) * last.scale + 128 >> 8) + 128 >> 8
    saturated = np.any(y > 32767, axis=1)
    y = np.where(z < 0, -1, 1) * np.minimum(y, 32767)
    return y, np.where(clamped | saturated, FLAG_OUT_OF_RANGE, 0).astype(np.uint8)


def _exact(a, b):
    return (a.astype(float) @ b.T.astype(float)).astype(np.int64)


def _low_bytes(a, stored):
    total = np.zeros((len(a), len(stored)), np.int64)
    for j in range(a.shape[1]):
        total += (a[:, j : j + 1] * stored[:, j]) & 255
    return total


def _within(values, low, high, what):
    values = np.asarray(values)
    if not np.issubdtype(values.dtype, np.integer) or values.size and not (
        low <= values.min() and values.max() <= high
    ):
        raise ModelError(f"{what} is no integer of {low}..{high}", _BUG)
    return values


def _packed(layer):
    """A layer's bytes."""
    half = HALF[layer.weight_bytes]
    _within(layer.weights, -half, half - 1, "a weight")
    _within(layer.bias, -Z_END, Z_END - 1, "a bias")
    _within(layer.scale, 0, 65535, "a scale")
    rows, columns = layer.weights.shape
    low, high = layer.range
    if np.any(high >= Z_END) or np.any(low < -Z_END):
        raise ModelError("a sum of this network could leave 24 bits", _BUG)
    padded = rows + rows % 2
    weights = np.full((padded, columns), half, np.int64)
    bias, scale = np.zeros(padded, np.int64), np.zeros(padded, np.int64)
    weights[:rows] += layer.weights
    bias[:rows], scale[:rows] = layer.bias, layer.scale
    out = b""
    for at in range(0, padded, 4):
        group = slice(at, min(at + 4, padded))
        out += b"".join((int(b) & 0xFFFFFF).to_bytes(3, "little") for b in bias[group])
        out += weights[group].T.astype(f"<u{layer.weight_bytes}").tobytes()
        out += scale[group].astype("<u2").tobytes()
    return out


def _unpacked(body, rows, columns, weight_bytes):
    """(Layer of all rows, padded ones included; bytes used)."""
    padded, at = rows + rows % 2, 0
    weights, bias, scale = [], [], []
    for first in range(0, padded, 4):
        n = min(4, padded - first)
        raw = np.frombuffer(body, np.uint8, 3 * n, at).reshape(n, 3).astype(np.int64)
        bias.append(((raw @ [1, 256, 65536]) ^ Z_END) - Z_END)
        at += 3 * n
        part = np.frombuffer(body, f"<u{weight_bytes}", n * columns, at).reshape(columns, n)
        weights.append(part.T.astype(np.int64) - HALF[weight_bytes])
        at += part.nbytes
        scale.append(np.frombuffer(body, "<u2", n, at).astype(np.int64))
        at += 2 * n
    return Layer(np.vstack(weights), np.concatenate(bias), np.concatenate(scale), weight_bytes), at


def _opened(image):
    """(image cut to its length, layers); ModelError for what sg_mlp_open refuses."""
    if len(image) < 4 or int.from_bytes(image[:4], "little") != MAGIC:
        raise ModelError("not a sparsegaze network", "name a file made by MlpModel.save")
    if len(image) < HEAD.itemsize:
        raise ModelError(f"the network is cut off after {len(image)} bytes", _REFIT)
    head = np.frombuffer(image, HEAD, 1)[0]
    if head["version"] != VERSION:
        raise ModelError(
            f"the network has format version {head['version']}, this program reads {VERSION}",
            "train it again with this version of sparsegaze",
        )
    inputs, outputs, hidden = int(head["inputs"]), int(head["outputs"]), int(head["hidden"])
    width, weight_bytes = head["width"].astype(int), head["weight_bytes"].astype(int)
    if (
        not (1 <= inputs <= INPUTS_MAX and 1 <= outputs <= OUTPUTS_MAX and hidden <= HIDDEN_MAX)
        or not np.all((width[:hidden] >= 1) & (width[:hidden] <= WIDTH_MAX))
        or np.any(width[hidden:])
        or not np.all((weight_bytes[: hidden + 1] >= 1) & (weight_bytes[: hidden + 1] <= 2))
        or np.any(weight_bytes[hidden + 1 :])
    ):
        raise ModelError("the network states a shape that this format does not allow", _REFIT)
    columns, rows = [inputs, *width[:hidden]], [*width[:hidden], outputs]
    shape = list(zip(rows, columns, weight_bytes))
    length = HEAD.itemsize + sum((r + r % 2) * (5 + c * b) for r, c, b in shape)
    if int(head["length"]) != length:
        raise ModelError(f"the network states {head['length']} bytes; its shape takes {length}", _REFIT)
    if len(image) < length:
        raise ModelError(f"the network is cut off: {len(image)} of {length} bytes", _REFIT)
    image = image[:length]
    if zlib.crc32(image[8:]) != int(head["crc"]):
        raise ModelError("the network is damaged (its checksum does not match)", _REFIT)
    if head["reserved"] or np.any(head["pad"]) or any(image[32 + 4 * inputs : HEAD.itemsize]):
        raise ModelError("the network has fields that this format does not allow", _REFIT)
    layers, at = [], HEAD.itemsize
    for r, c, b in shape:
        layer, used = _unpacked(image[at:], int(r), int(c), int(b))
        low, high = layer.range
        if np.any(high >= Z_END) or np.any(low < -Z_END):
            raise ModelError("a sum of this network could leave 24 bits on the device", _REFIT)
        if np.any(layer.scale[r:]):
            raise ModelError("the network has a row too many", _REFIT)
        layers.append(Layer(layer.weights[:r], layer.bias[:r], layer.scale[:r], int(b)))
        at += used
    return image, tuple(layers)
