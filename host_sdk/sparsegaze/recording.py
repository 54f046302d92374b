# SPDX-License-Identifier: Apache-2.0
"""Recordings: what the sensors said while the eye looked at known targets, as a CSV file anyone can make.

    # recording_format: 2
    # comment lines, "# key: value" is kept as meta
    t_us,s0,s1,...,s{d-1},target_az_deg,target_el_deg,valid

t_us is device time, s0.. are features as the device sends them (unsigned 16 bit), targets are Fick angles in
degrees, valid is 1 or 0; rows with valid = 0 may hold nan or nothing. Columns may stand in any order; unknown
ones are skipped. recording_format 2 stands for the features of firmware that speaks wire 3; those of 1, and
of files that do not say, may have another circuit's scale. They can be read and fitted alike.
"""

import csv
import math
import os
from dataclasses import dataclass, field

import numpy as np

from .errors import RecordingError

FORMAT = 2
CHANNELS_MAX = 6
TARGET_COLUMNS = ("target_az_deg", "target_el_deg")
ANGLE_MAX_DEG = 90.0
LINE_MAX_BYTES = 4096
_FORM = "the columns are t_us, s0.., target_az_deg, target_el_deg, valid"
_RERECORD = "correct the line, set its valid to 0, or record again"


@dataclass
class Recording:
    """n samples of d channels.

    t_us [n] int64 device microseconds; features [n, d] uint16; target_deg [n, 2] float64, azimuth, elevation
    valid [n] bool: the eye was on the target and open; other rows may hold 0 features and nan targets
    meta: str -> str. Raises RecordingError when the arrays do not fit together.
    """

    t_us: np.ndarray
    features: np.ndarray
    target_deg: np.ndarray
    valid: np.ndarray
    meta: dict = field(default_factory=dict)

    def __post_init__(self):
        self.t_us = np.asarray(self.t_us, np.int64).reshape(-1)
        n = len(self.t_us)
        self.features = np.asarray(self.features, np.uint16)
        self.target_deg = np.asarray(self.target_deg, float)
        self.valid = np.asarray(self.valid, bool).reshape(-1)
        if (
            self.features.ndim != 2
            or len(self.features) != n
            or self.target_deg.shape != (n, 2)
            or len(self.valid) != n
            or not 1 <= self.features.shape[1] <= CHANNELS_MAX
        ):
            raise RecordingError(
                f"{n} rows with features {self.features.shape} and targets {self.target_deg.shape}",
                f"give [n, 1..{CHANNELS_MAX}] features and [n, 2] targets",
            )
        bad = self.valid & ~(np.abs(self.target_deg) <= ANGLE_MAX_DEG).all(axis=1)
        if bad.any():
            raise RecordingError(
                f"row {int(np.flatnonzero(bad)[0])} is valid but its target is no angle",
                "give targets within +-90 deg, or set valid to 0",
            )

    channels = property(lambda self: self.features.shape[1])

    @property
    def outdated(self):
        """True for a recording by older firmware, whose features had another scale: today no board has it."""
        return "firmware" in self.meta and int(self.meta.get("recording_format", 1)) < FORMAT

    def __len__(self):
        return len(self.t_us)

    def select(self, rows):
        """The recording of a subset of rows (index or mask), meta kept."""
        return Recording(
            self.t_us[rows], self.features[rows], self.target_deg[rows], self.valid[rows], dict(self.meta)
        )

    def write(self, path):
        """Write the file whole, or not at all. Raises RecordingError when the place cannot be written."""
        part = f"{os.fspath(path)}.{os.getpid()}.part"
        try:
            with RecordingWriter(part, self.channels, self.meta) as writer:
                writer.write(self.t_us, self.features, self.target_deg, self.valid)
            os.replace(part, path)
        except OSError as error:
            raise _unwritable(path, error) from None
        finally:
            if os.path.exists(part):
                os.remove(part)

    @classmethod
    def read(cls, path):
        """Read a file. Raises RecordingError naming file, line and column of the first thing that is wrong.

        A last line without its newline that does not parse is the trace of an interrupted recording and is
        left out (meta["cut"] = its line number). Time may run backwards (recordings may be concatenated):
        nothing here uses it.
        """
        try:
            with open(path, "rb") as file:
                return _parse(os.fspath(path), file)
        except OSError as error:
            raise RecordingError(
                f"cannot read {path}: {error.strerror}", "name a CSV file made by sparsegaze record"
            ) from None


class RecordingWriter:
    """Writes a recording while it is being made; what was written stays when the program dies.

    Rows go to disk in whole lines and at the latest every `flush_rows` rows. A context manager.
    Raises RecordingError when the place cannot be written.
    """

    def __init__(self, path, channels, meta=None, flush_rows=64):
        if not 1 <= channels <= CHANNELS_MAX:
            raise RecordingError(f"{channels} channels cannot be recorded", f"there are 1 to {CHANNELS_MAX}")
        self.path, self.channels, self.rows = os.fspath(path), channels, 0
        self._flush_rows, self._lines = flush_rows, []
        try:
            self._file = open(path, "w", encoding="utf-8", newline="\n")
        except OSError as error:
            raise _unwritable(path, error) from None
        for key, value in (meta or {}).items():
            self._lines.append("# %s: %s\n" % tuple(" ".join(str(v).split()) for v in (key, value)))
        names = ["t_us"] + [f"s{i}" for i in range(channels)] + list(TARGET_COLUMNS) + ["valid"]
        self._lines.append(",".join(names) + "\n")
        self.flush()

    def write(self, t_us, features, target_deg, valid):
        """Append one row (scalar t_us, [d], [2], bool) or n rows ([n], [n, d], [n, 2], [n])."""
        times = np.atleast_1d(np.asarray(t_us, np.int64))
        features = np.asarray(features).reshape(len(times), self.channels)
        targets = np.asarray(target_deg, float).reshape(len(times), 2)
        for t, row, (az, el), good in zip(
            times.tolist(), features.tolist(), targets.tolist(), np.atleast_1d(valid).tolist()
        ):
            values = ",".join("%d" % v for v in row)
            self._lines.append("%d,%s,%s,%s,%d\n" % (t, values, _angle(az), _angle(el), bool(good)))
            self.rows += 1
            if len(self._lines) >= self._flush_rows:
                self.flush()

    def comment(self, text):
        """Append a comment line."""
        self._lines.append("# " + " ".join(str(text).split()) + "\n")

    def flush(self):
        """Hand all rows so far to the operating system, in whole lines."""
        lines, self._lines = self._lines, []
        try:
            self._file.write("".join(lines))
            self._file.flush()
        except OSError as error:
            raise _unwritable(self.path, error) from None

    def close(self):
        """Flush and close; harmless when closed already."""
        if not self._file.closed:
            try:
                self.flush()
                os.fsync(self._file.fileno())
            except OSError as error:
                raise _unwritable(self.path, error) from None
            finally:
                self._file.close()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()


def _parse(path, file):
    meta, columns, channels, rows, number = {}, None, 0, [], 0
    while True:
        raw = file.readline(LINE_MAX_BYTES + 1)
        if not raw:
            break
        number += 1
        if len(raw) > LINE_MAX_BYTES:
            raise _at(
                path,
                number,
                "longer than any line of a recording",
                "name a CSV file made by sparsegaze record",
            )
        try:
            line = raw.decode("utf-8-sig" if number == 1 else "utf-8").strip()
        except UnicodeDecodeError:
            line = "\0"
        if "\0" in line:
            raise _at(path, number, "not text", "name a CSV file made by sparsegaze record")
        if line.startswith("#"):
            key, colon, value = line[1:].partition(":")
            if colon:
                meta[key.strip()] = value.strip()
            if key.strip() == "recording_format":
                _check_format(path, number, value.strip())
        elif line and columns is None:
            columns, channels = _header(path, number, line)
        elif line:
            try:
                rows.append(_row(path, number, line, columns, channels))
            except RecordingError:
                if raw.endswith(b"\n"):
                    raise
                meta["cut"] = str(number)
    if columns is None:
        raise RecordingError(f"{path}: empty, there is no header line", _FORM)
    if not rows:
        raise RecordingError(f"{path}: a header but no samples", "record again, with targets to look at")
    table = np.array(rows, float)
    return Recording(
        table[:, 0].astype(np.int64),
        table[:, 1 : 1 + channels].astype(np.uint16),
        table[:, 1 + channels : 3 + channels],
        table[:, 3 + channels] == 1,
        meta,
    )


def _check_format(path, number, text):
    if not text.isdecimal() or len(text) > 4:
        raise _at(path, number, f"recording_format {text[:20]!r} is no number", "remove or correct that line")
    if int(text) > FORMAT:
        raise _at(
            path,
            number,
            f"recording_format {text} is newer than this SDK, which reads up to {FORMAT}",
            "update this SDK, or record again with it",
        )


def _header(path, number, line):
    names = [name.strip() for name in next(csv.reader([line]))]
    for name in names:
        if name and names.count(name) > 1:
            raise _at(path, number, f"column {name} twice", _FORM)
    features = [name for name in names if name[:1] == "s" and name[1:].isdigit()]
    channels = len(features)
    wanted = ["t_us"] + [f"s{i}" for i in range(max(channels, 1))] + list(TARGET_COLUMNS) + ["valid"]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise _at(path, number, f"no column {', '.join(missing)}", _FORM)
    if channels > CHANNELS_MAX:
        raise _at(
            path,
            number,
            f"{channels} channels, more than {CHANNELS_MAX}",
            "keep the columns of one board's LEDs",
        )
    return [(name, names.index(name)) for name in wanted], channels


def _row(path, number, line, columns, channels):
    cells = line.split(",")
    text = {}
    for name, index in columns:
        if index >= len(cells):
            raise _at(path, number, f"column {name}: missing ({len(cells)} cells)", _RERECORD)
        text[name] = cells[index].strip()
    if text["valid"] not in ("0", "1"):
        raise _at(path, number, f"column valid: {text['valid'][:20]!r} is neither 0 nor 1", _RERECORD)
    valid = text["valid"] == "1"
    row = [_number(path, number, "t_us", text["t_us"], -(2**62), 2**62, True)]
    for i in range(channels):
        row.append(_number(path, number, f"s{i}", text[f"s{i}"], 0, 65535, valid))
        if row[-1] != row[-1]:
            row[-1] = 0.0
        elif row[-1] != int(row[-1]):
            raise _at(path, number, f"column s{i}: {text[f's{i}'][:20]} is not a whole number", _RERECORD)
    for name in TARGET_COLUMNS:
        row.append(_number(path, number, name, text[name], -ANGLE_MAX_DEG, ANGLE_MAX_DEG, valid))
    return row + [float(valid)]


def _number(path, number, name, text, low, high, required):
    try:
        value = float(text) if text else math.nan
    except ValueError:
        raise _at(path, number, f"column {name}: {text[:20]!r} is not a number", _RERECORD) from None
    if value != value and not required:
        return math.nan
    if value != value:
        raise _at(path, number, f"column {name}: {text or 'nothing'} in a valid row", _RERECORD)
    if not low <= value <= high:
        if not required and math.isinf(value):
            return math.nan
        raise _at(path, number, f"column {name}: {text[:20]} is outside {low:g}..{high:g}", _RERECORD)
    return value


def _angle(value):
    return "nan" if value != value else "%.6g" % value


def _at(path, number, what, remedy):
    return RecordingError(f"{path}, line {number}: {what}", remedy)


def _unwritable(path, error):
    return RecordingError(f"cannot write {path}: {error.strerror}", "choose another place with -o")
