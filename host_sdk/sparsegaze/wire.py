# SPDX-License-Identifier: Apache-2.0
"""Packets and messages, through the C codec that the firmware itself is built from (sparsegaze._core).

No layout is written down here: every record below takes its fields from the struct of the C header.
"""

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from .errors import ProtocolError, SparsegazeError
from .trust import sigma_deg

try:
    from ._core import ffi, lib
except ImportError as error:
    raise SparsegazeError(f"the compiled core of sparsegaze cannot be loaded ({error})",
                          "run `make setup`, or install the package again") from None

Packet = namedtuple("Packet", "type seq body")

ERROR_TEXT = {
    lib.SG_E_ARG: "an argument is outside its range", lib.SG_E_RANGE: "a result saturated",
    lib.SG_E_MAGIC: "there is no stored model",
    lib.SG_E_VERSION: "the stored model has another format version",
    lib.SG_E_BOUNDS: "a length, count or index is out of bounds", lib.SG_E_CRC: "a checksum does not match",
    lib.SG_E_SHORT: "the data end too early", lib.SG_E_UNKNOWN: "this firmware does not know the request",
    lib.SG_E_STATE: "the request does not fit the present state",
    lib.SG_E_BUSY: "an earlier request is under way",
}

FAULT_NAMES = {lib.SG_FAULT_OPEN: "open", lib.SG_FAULT_SHORT: "short", lib.SG_FAULT_LOW: "low",
               lib.SG_FAULT_HIGH: "high"}
ALARM_NAMES = {lib.SG_ALARM_SUPPLY: "supply", lib.SG_ALARM_LOCKOUT: "lockout",
               lib.SG_ALARM_LIGHTS_OFF: "lights-off"}
EXPOSURE_STEPS_US = 16          # steps of an exposure, a microsecond
REPEATS = (1, 2, 4, 8, 16)
WIRINGS = {"leds": lib.SG_WIRING_LEDS, "photodiodes": lib.SG_WIRING_PHOTODIODES}
POWERS = {"normal": lib.SG_POWER_NORMAL, "low": lib.SG_POWER_LOW}
GAIN_STEPS_MAX = 127  # of 1/512; -128 is legal on the wire, and left out for symmetry


def record(struct, name):
    """A named tuple with the fields of a C struct; arrays become tuples."""
    return namedtuple(name, [field for field, _ in ffi.typeof(struct).fields])


class Hello(record("struct sg_hello", "Hello")):
    """What the device is and can; struct sg_hello."""

    __slots__ = ()

    @property
    def firmware_text(self):
        return f"{self.firmware >> 16}.{self.firmware >> 8 & 255}.{self.firmware & 255}"

    @property
    def board_text(self):
        return {lib.SG_BOARD_TEMPLATE: "template", lib.SG_BOARD_NANO328P: "Arduino Nano (ATmega328P)",
                lib.SG_BOARD_MPS2AN386: "MPS2 AN386 (Cortex-M4, QEMU)"}.get(self.board, f"board {self.board}")


class Status(record("struct sg_status", "Status")):
    """Counters and state; struct sg_status."""

    __slots__ = ()

    @property
    def exposure_us(self):
        return tuple(value / EXPOSURE_STEPS_US for value in self.exposure_us_q4)

    @property
    def faults(self):
        """What is wrong with each channel: a tuple of names (values of FAULT_NAMES) for each of the six."""
        return tuple(_names(FAULT_NAMES, bits) for bits in self.fault)

    @property
    def alarms(self):
        """What is wrong with the board: names, values of ALARM_NAMES."""
        return _names(ALARM_NAMES, self.alarm)

    @property
    def supply_volts(self):
        """Supply voltage, V; None where the board cannot measure it."""
        return self.supply_mv / 1000 if self.supply_mv else None

    @property
    def reset_text(self):
        names = {lib.SG_RESET_POWER: "power", lib.SG_RESET_EXTERNAL: "external",
                 lib.SG_RESET_BROWNOUT: "brown-out", lib.SG_RESET_WATCHDOG: "watchdog"}
        return ", ".join(text for bit, text in names.items() if self.reset_cause & bit) or "unknown"


class Gaze(record("struct sg_gaze", "Gaze")):
    """One gaze; struct sg_gaze. Not to be shown as a gaze unless `valid`."""

    __slots__ = ()

    @property
    def azimuth_deg(self):
        return self.azimuth_deg_q7 / 128

    @property
    def elevation_deg(self):
        return self.elevation_deg_q7 / 128

    @property
    def valid(self):
        return bool(self.flags & lib.SG_FLAG_VALID)

    @property
    def sigma_deg(self):
        """Standard deviation that the model gives its own output, degrees; NaN where it gives none."""
        return float(sigma_deg(self.sigma_log2_q4))


class Exposure(record("struct sg_exposure", "Exposure")):
    """Exposures in force; struct sg_exposure."""

    __slots__ = ()

    @property
    def exposure_us(self):
        return tuple(value / EXPOSURE_STEPS_US for value in self.exposure_us_q4)

    @property
    def automatic(self):
        return self.op == lib.SG_EXPOSURE_AUTO


class Counts(record("struct sg_counts", "Counts")):
    """What the converter read in a frame's last sensing cycle; struct sg_counts."""

    __slots__ = ()

    @property
    def exposure_us(self):
        return tuple(value / EXPOSURE_STEPS_US for value in self.exposure_us_q4)


class Settings(record("struct sg_settings", "Settings")):
    """How the device senses; struct sg_settings. rate_hz is the rate wished for, 0: as fast as can be."""

    __slots__ = ()

    @property
    def frame_hz(self):
        """Frames a second of device time, in force."""
        return 1e6 / self.frame_period_us if self.frame_period_us else 0.0

    @property
    def cycles_a_frame(self):
        """Sensing cycles whose mean a frame is: in normal power those fill the frame's time, 16 at most."""
        if self.power == lib.SG_POWER_LOW or not self.period_us:
            return self.repeats
        return min(max(self.repeats, self.frame_period_us // self.period_us), REPEATS[-1])

    @property
    def most_hz(self):
        """rate_limit_hz, but not below the rate in force: the device rounds the one down, the other up."""
        return max(self.rate_limit_hz, int(self.frame_hz))

    @property
    def wiring_text(self):
        return _name_of(WIRINGS, self.wiring)

    @property
    def power_text(self):
        return _name_of(POWERS, self.power)


class Curve(record("struct sg_curve", "Curve")):
    """Curvature of each channel's charge over its code, in force; struct sg_curve."""

    __slots__ = ()

    @property
    def curve(self):
        """charge = code (1 + curve code / 1024), six numbers."""
        return tuple(value / 1024 for value in self.curve_q10)

    @property
    def zero_codes(self):
        """What the converter would read at 0 V if it could read below 0: codes, 0 or less."""
        return self.zero_q2 / 4


class Probe(record("struct sg_probe", "Probe")):
    """Every sensor's light from one emitter alone; struct sg_probe."""

    __slots__ = ()

    @property
    def octaves(self):
        """log2 photocurrent of each sensor, octaves; None where too little came."""
        return tuple(value / 4096 if value else None for value in self.feature)


class Affine(record("struct sg_affine", "Affine")):
    """Correction of a model's output, gaze = g + offset + G g; struct sg_affine."""

    __slots__ = ()

    @property
    def offset_deg(self):
        """(azimuth, elevation) at g = 0, degrees."""
        return tuple(value / 128 for value in self.offset_deg_q7)

    @property
    def gain(self):
        """G by rows: ((az from az, az from el), (el from az, el from el)), degrees per degree."""
        steps = [value / 512 for value in self.gain_q9]
        return (steps[0], steps[1]), (steps[2], steps[3])


class Recentre(record("struct sg_recentre", "Recentre")):
    """Correction in force; struct sg_recentre."""

    __slots__ = ()

    @property
    def azimuth_deg(self):
        return self.affine.offset_deg[0]

    @property
    def elevation_deg(self):
        return self.affine.offset_deg[1]


Pong = record("struct sg_pong", "Pong")
Raw = record("struct sg_raw", "Raw")
ModelInfo = record("struct sg_model_info", "ModelInfo")
Verdict = record("struct sg_model_verdict", "Verdict")
Mode = record("struct sg_mode", "Mode")
ModelAt = record("struct sg_model_at", "ModelAt")

_STRUCT = {Hello: "struct sg_hello", Status: "struct sg_status", Gaze: "struct sg_gaze",
           Pong: "struct sg_pong",
           Raw: "struct sg_raw", Counts: "struct sg_counts", ModelInfo: "struct sg_model_info",
           Mode: "struct sg_mode",
           Verdict: "struct sg_model_verdict", Exposure: "struct sg_exposure", Recentre: "struct sg_recentre",
           Settings: "struct sg_settings", Curve: "struct sg_curve", Probe: "struct sg_probe",
           ModelAt: "struct sg_model_at"}
_SIZE = {kind: ffi.sizeof(name) for kind, name in _STRUCT.items()}


class HelloPrefix(NamedTuple):
    """What stays in place in the HELLO of every protocol version."""

    firmware_text: str
    wire_version: int           # 0: shorter than any version known


def parse(kind, body):
    """The record `kind` from a message body, any excess ignored. Raises ProtocolError if it is short."""
    if len(body) < _SIZE[kind]:
        raise ProtocolError(f"the device sent {len(body)} bytes where {kind.__name__} takes {_SIZE[kind]}",
                            "flash the firmware that belongs to this SDK: `sparsegaze flash PORT`")
    struct = ffi.from_buffer(_STRUCT[kind] + " *", body)
    return kind(*[_plain(getattr(struct, field)) for field in kind._fields])


def parse_hello_prefix(body):
    """HelloPrefix of a HELLO answer of any version or length."""
    struct = ffi.new("struct sg_hello *")
    ffi.memmove(struct, body, min(len(body), ffi.sizeof("struct sg_hello")))
    hello = Hello(*[_plain(getattr(struct, field)) for field in Hello._fields])
    return HelloPrefix(hello.firmware_text, hello.wire_version)


def body(struct, **fields):
    """The bytes of a C struct with the given fields; the others are zero."""
    value = ffi.new(struct + " *", fields)
    return bytes(ffi.buffer(value))


def data_body(slot, offset, data):
    """The bytes of struct sg_model_data with `data` (at most SG_WIRE_DATA_MAX bytes), no unused room."""
    value = ffi.new("struct sg_model_data *", {"offset": offset, "slot": slot, "length": len(data)})
    ffi.memmove(value.data, data, len(data))
    return bytes(ffi.buffer(value))[:ffi.offsetof("struct sg_model_data", "data") + len(data)]


def parse_data(body_bytes):
    """(slot, offset, data) of struct sg_model_data. Raises ProtocolError when it is shorter than it says."""
    start = ffi.offsetof("struct sg_model_data", "data")
    value = ffi.new("struct sg_model_data *")
    ffi.memmove(value, body_bytes, min(len(body_bytes), ffi.sizeof("struct sg_model_data")))
    if value.length > lib.SG_WIRE_DATA_MAX or len(body_bytes) < start + value.length:
        raise ProtocolError("the device sent less model data than it announced", "try again")
    return value.slot, value.offset, bytes(ffi.buffer(value.data, value.length))


def parse_error(body_bytes):
    """(code, type of the refused request) of struct sg_error."""
    value = ffi.new("struct sg_error *")
    ffi.memmove(value, body_bytes, min(len(body_bytes), ffi.sizeof("struct sg_error")))
    return value.error, value.type


def encode(kind, seq, body_bytes=b""):
    """One packet as bytes on the wire, delimiter included."""
    head = ffi.new("struct sg_head *", {"seq": seq & 0xFFFF, "type": kind})
    out = ffi.new("uint8_t[]", lib.SG_WIRE_FRAME_MAX)
    n = lib.sg_wire_encode(head, ffi.from_buffer(body_bytes), len(body_bytes), out)
    if n < 0:
        raise ProtocolError(f"a message of {len(body_bytes)} bytes does not fit into a packet")
    return bytes(ffi.buffer(out, n))


class Decoder:
    """Byte stream -> packets, resynchronising at every delimiter; the firmware's own receiver (sg_link).

    good     packets returned
    bad      frames dropped for their coding, length or CRC
    heard    the first bytes that arrived before any good packet (at most 64), for messages
    """

    def __init__(self):
        self.good = 0
        self.bad = 0
        self.heard = b""
        self._rx = ffi.new("struct sg_link_rx *")
        self._head = ffi.new("struct sg_head *")
        self._body = ffi.new("uint8_t[]", lib.SG_WIRE_BODY_MAX)
        self._used = ffi.new("size_t *")

    def feed(self, data):
        """Packets completed by `data`, a list of Packet."""
        packets = []
        if not self.good and len(self.heard) < 64:
            self.heard += data[:64 - len(self.heard)]
        start, buffer = 0, ffi.from_buffer("uint8_t[]", data)
        while start < len(data):
            n = lib.sg_link_feed(self._rx, buffer + start, len(data) - start, self._used, self._head,
                                 self._body)
            start += self._used[0]
            if n >= 0:
                self.good += 1
                packets.append(Packet(self._head.type, self._head.seq, bytes(ffi.buffer(self._body, n))))
            elif n != lib.SG_E_BUSY:
                self.bad += 1
        return packets

    def clear(self):
        """Forget a half-received frame."""
        self._rx = ffi.new("struct sg_link_rx *")


def affine(offset_deg, gain=None):
    """Affine of an offset (azimuth, elevation; degrees) and a gain (2 x 2, or None: zero), rounded.

    Raises ValueError when one is not finite or beyond the range of the device's numbers.
    """
    offset = np.floor(np.asarray(offset_deg, float) * 128 + 0.5)
    steps = np.floor((np.zeros((2, 2)) if gain is None else np.asarray(gain, float)) * 512 + 0.5)
    if offset.shape != (2,) or not np.all(np.abs(offset) <= 32767):
        raise ValueError(f"a recentre offset of {offset_deg} deg is not inside +-255 deg")
    if steps.shape != (2, 2) or not np.all(np.abs(steps) <= GAIN_STEPS_MAX):
        raise ValueError(f"a recentre gain of {gain} is not inside +-{GAIN_STEPS_MAX / 512:.3f}")
    return Affine(tuple(int(v) for v in offset), tuple(int(v) for v in steps.ravel()))


def _names(names, bits):
    return tuple(name for bit, name in names.items() if bits & bit)


def _name_of(names, value):
    return next((name for name, number in names.items() if number == value), f"unknown ({value})")


def _plain(value):
    if isinstance(value, int):
        return value
    if ffi.typeof(value) is ffi.typeof("struct sg_affine"):
        return Affine(tuple(value.offset_deg_q7), tuple(value.gain_q9))
    return tuple(value)
