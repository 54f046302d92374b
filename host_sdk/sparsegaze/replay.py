# SPDX-License-Identifier: Apache-2.0
"""The firmware's core on the host, over recorded frames: the same bits as the device.

One C function, sg_track_infer, is what the device calls for every frame; here it runs through
sparsegaze._core.
"""

import csv
import os
from typing import NamedTuple

import numpy as np

from .errors import ModelError, RecordingError

DEG_Q7 = 128.0
GAIN_Q9 = 512.0
CHANNELS = 6
AFFINE = np.dtype([("offset_q7", "<i2", (2,)), ("gain_q9", "i1", (4,))])  # struct sg_affine
AFFINE_COLUMNS = {
    "offset_q7": ("recentre_az_deg", "recentre_el_deg"),
    "gain_q9": ("recentre_az_az", "recentre_az_el", "recentre_el_az", "recentre_el_el"),
}


class Gazes(NamedTuple):
    """What the device sends of n frames: q7 int16 [n, 2] azimuth and elevation, 1/128 deg; flags and
    sigma_log2_q4 uint8 [n] as in struct sg_gaze."""

    q7: np.ndarray
    flags: np.ndarray
    sigma_log2_q4: np.ndarray


def infer(model, features, raw_flags=None, recentre=None):
    """Gaze of every frame, as the device computes it.

    model        DeviceModel, or None for a device without one
    features     uint16 [n, d], d <= 6
    raw_flags    uint8 [n], flags of the raw frames; None: 0
    recentre     AFFINE [n] or one, correction in force; None: none
    Returns Gazes. Raises ModelError.
    """
    from . import _core

    ffi, lib = _core.ffi, _core.lib
    features = np.asarray(features)
    n = len(features)
    six = np.zeros((n, CHANNELS), np.uint16)
    six[:, : features.shape[1]] = features
    flags = np.zeros(n, np.uint8) if raw_flags is None else np.ascontiguousarray(raw_flags, np.uint8)
    affine = np.zeros((), AFFINE) if recentre is None else np.asarray(recentre, AFFINE)
    affine = np.ascontiguousarray(np.broadcast_to(affine, n))
    view = ffi.NULL
    if model is not None:
        image = ffi.from_buffer("uint8_t[]", model.image)
        view = ffi.new("struct sg_model_view *")
        status = lib.sg_model_open(view, image, len(model.image), 0)
        if status < 0:
            raise ModelError(f"the core refuses this model (error {status})", "fit the recording again")
    size = ffi.sizeof("struct sg_gaze")
    out = ffi.new("struct sg_gaze[]", max(n, 1))
    # The core takes one correction per batch: cut where it changes.
    edges = np.flatnonzero(np.diff(affine.view("<u8"))) + 1
    for begin, end in zip([0, *edges], [*edges, n]):
        if end > begin:
            # A saturated gaze is reported as SG_E_RANGE and holds what the device sends too.
            lib.sg_batch_infer(
                view,
                ffi.from_buffer("uint16_t[]", six[begin:end]),
                ffi.from_buffer("uint8_t[]", flags[begin:end]),
                ffi.cast("struct sg_affine *", ffi.from_buffer(affine[begin:end])),
                out + int(begin),
                int(end - begin),
            )
    layout = np.dtype(
        [("t_us", "<u4"), ("q7", "<i2", (2,)), ("infer_us", "<u2"), ("flags", "u1"), ("sigma", "u1")]
    )
    assert layout.itemsize == size
    frames = np.frombuffer(ffi.buffer(out, n * size), layout) if n else np.zeros(0, layout)
    return Gazes(frames["q7"].copy(), frames["flags"].copy(), frames["sigma"].copy())


def sigma_code(sigma_deg):
    """Degrees as a stream's CSV has them -> sg_gaze.sigma_log2_q4; NaN is 0, unknown."""
    known = np.isfinite(sigma_deg) & (sigma_deg > 0)
    return np.where(known, np.round(16.0 * (np.log2(np.where(known, sigma_deg, 1.0)) + 8.0)), 0)


class Replay:
    """Outcome of `run`: arrays t_us [n], gaze_deg float64 [n, 2] (NaN where not valid), gaze_q7, flags, valid
    [n]; compared, differing: device gaze frames held against, and how many were not the same bits; identical
    None|bool.
    """

    def __init__(self, t_us, gaze_q7, flags, valid_bit, compared, differing):
        self.t_us, self.gaze_q7, self.flags = t_us, gaze_q7, flags
        self.valid = (flags & valid_bit) != 0
        self.gaze_deg = np.where(self.valid[:, None], gaze_q7 / DEG_Q7, np.nan)
        self.compared, self.differing = compared, differing
        self.identical = None if compared == 0 else differing == 0


def run(path, model):
    """Compute every frame of a recording or of a stream's CSV again, and compare with the gaze in it, if any.

    path   CSV with columns t_us and s0..; of a stream's CSV also azimuth_deg, elevation_deg, flags,
           recentre_* and sigma_deg (a file of an earlier version has no gains and no sigma)
    model  DeviceModel
    Returns Replay. Raises RecordingError (naming line and column), ModelError.
    """
    from . import _core

    lib = _core.lib
    columns, lines = read_columns(path)
    features = feature_columns(path, columns, lines)
    n, d = features.shape
    if d < model.channels:
        raise ModelError(
            f"the model has {model.channels} channels, {path} has {d}",
            "use the model that was fitted to recordings of this headset",
        )
    t_us = integers(path, columns, lines, "t_us", 0, 2**63 - 1) if "t_us" in columns else np.arange(n)
    # Everything in a gaze's flags but what the inference itself finds comes from the raw frame.
    carried = 0xFF & ~(lib.SG_FLAG_VALID | lib.SG_FLAG_NO_MODEL | lib.SG_FLAG_OUT_OF_RANGE)
    device = all(name in columns for name in ("azimuth_deg", "elevation_deg", "flags"))
    flags = integers(path, columns, lines, "flags", 0, 255) if device else np.zeros(n, np.int64)
    recentre = np.zeros(n, AFFINE)
    for field, unit in (("offset_q7", DEG_Q7), ("gain_q9", GAIN_Q9)):
        for k, name in enumerate(AFFINE_COLUMNS[field]):
            if name in columns:
                recentre[field][:, k] = np.round(numbers(path, columns, lines, name) * unit)
    gaze_q7, out, sigma = infer(model, features, flags & carried, recentre)
    compared = differing = 0
    if device:
        said = np.column_stack(
            [numbers(path, columns, lines, name) for name in ("azimuth_deg", "elevation_deg")]
        )
        have = np.isfinite(said).all(axis=1)
        same = (np.round(np.where(have[:, None], said, 0.0) * DEG_Q7) == gaze_q7).all(axis=1) & (flags == out)
        if "sigma_deg" in columns:
            same &= sigma_code(numbers(path, columns, lines, "sigma_deg")) == sigma
        compared, differing = int(have.sum()), int(np.sum(have & ~same))
    return Replay(t_us, gaze_q7, out, lib.SG_FLAG_VALID, compared, differing)


def write(done, path):
    """Write a Replay as CSV: t_us, azimuth_deg, elevation_deg (nan where not valid), flags."""
    part = f"{path}.part"
    try:
        with open(part, "w", encoding="utf-8", newline="\n") as file:
            file.write("t_us,azimuth_deg,elevation_deg,flags\n")
            for t_us, (azimuth, elevation), flags in zip(done.t_us, done.gaze_deg, done.flags):
                file.write(f"{t_us},{azimuth:.7f},{elevation:.7f},{flags}\n")
        os.replace(part, path)
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror}", "choose another place with -o"
        ) from None


def read_columns(path):
    """CSV with # comments -> ({name: list of strings}, list of line numbers). Raises RecordingError."""
    rows, lines, header = [], [], None
    try:
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, 1):
                if not line.strip() or line.startswith("#"):
                    continue
                cells = [cell.strip() for cell in next(csv.reader([line]))]
                if header is None:
                    header = cells
                elif len(cells) != len(header):
                    raise RecordingError(
                        f"{path}, line {number}: {len(cells)} cells under {len(header)} columns",
                        "the file was cut or edited: record again, or remove that line",
                    )
                else:
                    rows.append(cells)
                    lines.append(number)
    except OSError as error:
        raise RecordingError(
            f"cannot read {path}: {error.strerror}",
            "name a file made by sparsegaze record or sparsegaze stream --csv",
        ) from None
    except csv.Error as error:
        raise RecordingError(f"{path} is not a CSV file ({error})", "name a recording") from None
    if header is None:
        raise RecordingError(f"{path} is empty", "record again")
    return {name: [row[i] for row in rows] for i, name in enumerate(header)}, lines


def numbers(path, columns, lines, name):
    """One column as float64 [n]; NaN allowed. Raises RecordingError naming the line."""
    try:
        return np.array(columns[name], float)
    except ValueError:
        for line, text in zip(lines, columns[name]):
            try:
                float(text)
            except ValueError:
                raise RecordingError(
                    f"{path}, line {line}, column {name}: {text!r} is no number", "repair or remove that line"
                ) from None
        raise


def integers(path, columns, lines, name, low, high):
    """One column as int64 [n] within low..high. Raises RecordingError naming the line."""
    try:
        values = np.array([int(text) for text in columns[name]], np.int64).reshape(-1)
        bad = np.flatnonzero((values < low) | (values > high))
    except (ValueError, OverflowError):
        bad = [
            next(
                i for i, text in enumerate(columns[name]) if not text.lstrip("-").isdigit() or len(text) > 18
            )
        ]
    if len(bad):
        raise RecordingError(
            f"{path}, line {lines[bad[0]]}, column {name}: {columns[name][bad[0]]!r} is not a whole "
            f"number from {low} to {high}",
            "repair or remove that line",
        )
    return values


def feature_columns(path, columns, lines):
    """Columns s0, s1, ... as uint16 [n, d]. Raises RecordingError."""
    d = 0
    while f"s{d}" in columns:
        d += 1
    if not 1 <= d <= CHANNELS:
        raise RecordingError(
            f"{path} has {d or 'no'} feature columns s0..s{CHANNELS - 1}",
            "name a file made by sparsegaze record or sparsegaze stream --csv",
        )
    if not lines:
        raise RecordingError(f"{path} has a header but no frames", "record again")
    return np.column_stack([integers(path, columns, lines, f"s{i}", 0, 65535) for i in range(d)]).astype(
        np.uint16
    )
