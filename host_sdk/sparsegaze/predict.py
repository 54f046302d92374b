# SPDX-License-Identifier: Apache-2.0
"""Predictions of a stored model by the binary of a target, fed with given features.

    prediction = predict(DeviceModel.load("eye.sgm"), features, "nano")

Every target answers with the firmware's own struct sg_gaze, one per row of features; `Prediction.crc` is
taken over those bytes, so that equal numbers mean equal bits.
"""

import os
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import numpy as np

from . import replay, wire
from .device import Device
from .errors import ModelError, NoDeviceError, ProtocolError, RecordingError, VirtualError
from .exchange import WINDOW, Exchange
from .flash import FIRMWARE_HEX
from .metrics import frame_error
from .qemu import QemuBoard
from .recording import TARGET_COLUMNS, Recording
from .trust import sigma_deg
from .virtual import VirtualNano
from .wire import ffi, lib

DEG_Q7 = 128.0
# Where the application expects its two model slots in the flash of an ATmega328P; checked against HELLO.
NANO_FLASH_BYTES = 32768
NANO_SLOT_BASE = (0x6C00, 0x7200)
REQUEST_SECTION = 6             # HAL_SECTION_REQUEST of hal_port.h
BATCH_ROWS = 256
QEMU_WINDOW = 32                # its line never loses a byte
CYCLES_EXACT = "cycles (exact)"
INSTRUCTIONS = "instructions"


@dataclass(frozen=True)
class Prediction:
    """Answers of one target.

    target            name in TARGETS
    gaze              structured [n], the fields of struct sg_gaze
    model_crc         of the model's image
    cycle_kind        CYCLES_EXACT, INSTRUCTIONS, or None where nothing was counted
    cycles_min, _max  over the rows: features in to gaze out, everything that the firmware then knows of it
    """

    target: str
    gaze: np.ndarray
    model_crc: int
    cycle_kind: Optional[str] = None
    cycles_min: Optional[int] = None
    cycles_max: Optional[int] = None

    azimuth_deg = property(lambda self: self.gaze["azimuth_deg_q7"] / DEG_Q7)
    elevation_deg = property(lambda self: self.gaze["elevation_deg_q7"] / DEG_Q7)
    flags = property(lambda self: self.gaze["flags"])
    crc = property(lambda self: zlib.crc32(self.gaze.tobytes()))

    @property
    def valid(self):
        """bool [n]: what may be shown as a gaze."""
        return (self.flags & lib.SG_FLAG_VALID) != 0

    @property
    def sigma_deg(self):
        """float64 [n]: predicted standard deviation of the angle, degrees; nan where it is not known."""
        return sigma_deg(self.gaze["sigma_log2_q4"])

    def report(self):
        """Plain values for JSON."""
        return {
            "target": self.target,
            "n": len(self.gaze),
            "model_crc": self.model_crc,
            "output_crc": self.crc,
            "azimuth_deg": self.azimuth_deg.tolist(),
            "elevation_deg": self.elevation_deg.tolist(),
            "flags": self.flags.tolist(),
            "sigma_deg": [None if value != value else value for value in self.sigma_deg.tolist()],
            "cycle_kind": self.cycle_kind,
            "cycles_min": self.cycles_min,
            "cycles_max": self.cycles_max,
        }


@dataclass
class Rows:
    """What a file asks: features uint16 [n, d], target_deg float64 [n, 2] or None."""

    features: np.ndarray
    target_deg: Optional[np.ndarray]


def read_rows(path):
    """Rows of a recording (those with valid = 1), or of any CSV with columns s0, s1, .. (all).

    Raises RecordingError naming file, line and column of the first thing that is wrong.
    """
    columns, lines = replay.read_columns(path)
    if all(name in columns for name in ("t_us", "valid", *TARGET_COLUMNS)):
        recording = Recording.read(path)
        chosen = recording.select(recording.valid)
        if not len(chosen):
            raise RecordingError(f"{path} has no valid row", "record again, with the eye open")
        return Rows(chosen.features, chosen.target_deg)
    return Rows(replay.feature_columns(path, columns, lines), None)


def predict(model, features, target="host", progress=None):
    """Run `features` through `model` on a target.

    model      DeviceModel
    features   uint16 [n, d], log2 photocurrents of 1/4096 octave, d >= the model's channels (d <= 6)
    target     "host", "nano" or "cortex-m4"
    progress   called as progress(stage, done, total)
    Returns Prediction. Raises ModelError, VirtualError, and what a device raises that falls silent.
    """
    features = np.asarray(features)
    if features.ndim != 2 or features.shape[1] > lib.SG_WIRE_CHANNELS or features.shape[1] < model.channels:
        raise ModelError(f"the model has {model.channels} channels, the features {features.shape[-1]}",
                         "use the model that was fitted to recordings of this headset")
    six = np.zeros((len(features), lib.SG_WIRE_CHANNELS), np.uint16)
    six[:, :features.shape[1]] = features
    if target not in TARGETS:
        raise VirtualError(f"there is no target {target!r}", f"name one of {', '.join(TARGETS)}")
    answers, counted = TARGETS[target](model, six, progress or (lambda stage, done, total: None))
    return Prediction(target, np.frombuffer(answers, gaze_layout()), model.crc, *counted)


def target_error(prediction, rows):
    """metrics.FrameError of the valid gazes to the targets of `rows`; None when the file has no targets."""
    if rows.target_deg is None:
        return None
    good = prediction.valid
    return frame_error(prediction.azimuth_deg[good], prediction.elevation_deg[good], *rows.target_deg[good].T)


def write(prediction, path):
    """Write row, azimuth_deg, elevation_deg, flags, sigma_deg as CSV, whole or not at all. RecordingError."""
    part = f"{path}.{os.getpid()}.part"
    try:
        with open(part, "w", encoding="utf-8", newline="\n") as file:
            file.write(f"# target: {prediction.target}\n# model_crc: 0x{prediction.model_crc:08X}\n")
            file.write("row,azimuth_deg,elevation_deg,flags,sigma_deg\n")
            for i, values in enumerate(zip(prediction.azimuth_deg, prediction.elevation_deg, prediction.flags,
                                           prediction.sigma_deg)):
                file.write("%d,%.7f,%.7f,%d,%.6g\n" % (i, *values))
        os.replace(part, path)
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror}",
                             "choose another place with -o") from None
    finally:
        if os.path.exists(part):
            os.remove(part)


def gaze_layout():
    """numpy dtype of struct sg_gaze, taken from the C header."""
    fields = dict(ffi.typeof("struct sg_gaze").fields)
    return np.dtype({"names": list(fields),
                     "formats": [at.type.cname.removesuffix("_t") for at in fields.values()],
                     "offsets": [at.offset for at in fields.values()],
                     "itemsize": ffi.sizeof("struct sg_gaze")})


def ask(link, features, progress, window=WINDOW):
    """Answers, n * sizeof(struct sg_gaze) bytes, of the firmware behind an open link.

    features   uint16 [n, 6]
    window     requests under way at a time
    Raises NoDeviceError when it falls silent, DeviceError when it refuses, ProtocolError for a short answer.
    """
    exchange, answers = Exchange(link), [b""] * len(features)
    size = ffi.sizeof("struct sg_gaze")
    for start in range(0, len(features), BATCH_ROWS):
        progress("predicting", start, len(features))
        bodies = [wire.body("struct sg_infer", feature=row)
                  for row in features[start:start + BATCH_ROWS].tolist()]

        def take(i, body, start=start):
            answers[start + i] = body[:size]

        exchange.request_many(lib.SG_MSG_INFER, bodies, take, window)
    progress("predicting", len(features), len(features))
    whole = b"".join(answers)
    if len(whole) != size * len(features):
        raise ProtocolError("the device sent shorter gazes than this SDK knows",
                            "build both anew: make firmware")
    return whole


def _on_host(model, features, progress):
    view, image = ffi.new("struct sg_model_view *"), ffi.from_buffer("uint8_t[]", model.image)
    status = lib.sg_model_open(view, image, len(model.image), 0)
    if status < 0:
        raise ModelError(f"the core refuses this model (error {status})", "fit the recording again")
    out = ffi.new("struct sg_gaze[]", max(len(features), 1))
    lib.sg_batch_infer(view, ffi.from_buffer("uint16_t[]", features), ffi.NULL,
                       ffi.new("struct sg_affine *"), out, len(features))
    return bytes(ffi.buffer(out, len(features) * ffi.sizeof("struct sg_gaze"))), ()


def _on_nano(model, features, progress):
    room = NANO_SLOT_BASE[1] - NANO_SLOT_BASE[0]
    check_room(model, room)
    if not FIRMWARE_HEX.is_file():
        raise VirtualError(f"there is no firmware at {FIRMWARE_HEX}", "build it: make firmware")
    flash = bytearray(b"\xff" * NANO_FLASH_BYTES)
    flash[NANO_SLOT_BASE[0]:NANO_SLOT_BASE[0] + len(model.image)] = model.image
    with tempfile.TemporaryDirectory(prefix="sgp-") as state:
        (Path(state) / "flash.bin").write_bytes(flash)
        with VirtualNano(map=False, unpaced=True, app=FIRMWARE_HEX, state_dir=state) as nano, \
                Device(nano.port) as device:
            if tuple(device.hello.slot_base) != NANO_SLOT_BASE:
                raise ProtocolError("the firmware keeps its models elsewhere than this SDK thinks",
                                    "build both anew: make firmware")
            check_model(device, model)
            nano.control.markers_clear()
            answers = ask(device.link, features, progress)
            section = nano.control.markers().get(f"{REQUEST_SECTION}n")
    if len(features) == 0:
        return answers, ()
    if section is None or section.count < len(features):
        raise _unmarked()
    return answers, (CYCLES_EXACT, int(section.least), int(section.most))


def _on_cortex_m4(model, features, progress):
    check_room(model, lib.SG_MODEL_SLOT_BYTES)
    with QemuBoard(model.image) as board:
        try:
            with Device(board) as device:
                check_model(device, model)
                answers = ask(board, features, progress, QEMU_WINDOW)
        except NoDeviceError:
            raise VirtualError("the program on the Cortex-M4 in QEMU does not answer",
                               "try again when this computer is less busy; else: make firmware") from None
        taken = board.sections().get(REQUEST_SECTION, ())
    if len(features) == 0:
        return answers, ()
    if len(taken) < len(features):
        raise _unmarked()
    return answers, (INSTRUCTIONS, int(min(taken)), int(max(taken)))


def _unmarked():
    return ProtocolError("the firmware does not mark what it computes for a request",
                         "build it anew: make firmware")


def check_room(model, room):
    """ModelError when the image does not fit `room` bytes, a slot of the target."""
    if len(model.image) > room:
        raise ModelError(f"the model of {len(model.image)} bytes does not fit the target's slot of {room}",
                         "fit it again with fewer --vectors")


def check_model(device, model):
    """ModelError unless the firmware has taken the model in its slot A for use."""
    info = device.model_info()
    if info.active != lib.SG_SLOT_A or info.crc[0] != model.crc:
        why = wire.ERROR_TEXT.get(info.verdict[0], f"error {info.verdict[0]}")
        raise ModelError(f"the target refuses the model ({why})",
                         "fit the recording again, and build the firmware anew: make firmware")


TARGETS = {"host": _on_host, "nano": _on_nano, "cortex-m4": _on_cortex_m4}
