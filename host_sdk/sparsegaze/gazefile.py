# SPDX-License-Identifier: Apache-2.0
"""The CSV of a gaze stream: gaze and the features it came from, one line per frame, exact.

Columns: t_us (device time, mean sample time), host_time_s (when it arrived), seq, azimuth_deg, elevation_deg
(exact multiples of 1/128 deg; nan where no gaze came), flags (bits of enum sg_flag), s0..s5 (features),
recentre_az_deg, recentre_el_deg, recentre_az_az, recentre_az_el, recentre_el_az, recentre_el_el (the
correction included in the gaze: offset, and gains in multiples of 1/512), sigma_deg (standard deviation by
the model's own account; nan where it gives none). With counts also lit0..5 and unlit0..5, converter codes of
the frame's last cycle with our light and without (nothing where none came), and exposure0_us..5, of both.
`replay` computes the gaze of such a file again and compares the bits.
"""

import os

from .errors import RecordingError
from .replay import AFFINE_COLUMNS, DEG_Q7, GAIN_Q9

COLUMNS = (
    "t_us",
    "host_time_s",
    "seq",
    "azimuth_deg",
    "elevation_deg",
    "flags",
    "s0",
    "s1",
    "s2",
    "s3",
    "s4",
    "s5",
    *AFFINE_COLUMNS["offset_q7"],
    *AFFINE_COLUMNS["gain_q9"],
    "sigma_deg",
)


COUNT_COLUMNS = (
    *(f"lit{i}" for i in range(6)),
    *(f"unlit{i}" for i in range(6)),
    *(f"exposure{i}_us" for i in range(6)),
)


class GazeCsv:
    """Writes a stream's CSV while it arrives, in whole lines. A context manager.

    path    file name, or an open text file (then not closed here);  counts: frames have counts, keep them
    Raises RecordingError; BrokenPipeError of a pipe.
    """

    def __init__(self, path, meta=None, flush_rows=64, counts=False):
        self.rows, self._flush_rows, self._lines, self._crc = 0, flush_rows, [], None
        self._counts = counts
        self._owned = not hasattr(path, "write")
        self.path = os.fspath(path) if self._owned else getattr(path, "name", "the output")
        try:
            self._file = open(path, "w", encoding="utf-8", newline="\n") if self._owned else path
        except OSError as error:
            raise self._unwritable(error) from None
        for key, value in (meta or {}).items():
            self._lines.append(f"# {key}: {' '.join(str(value).split())}\n")
        self._lines.append(",".join(COLUMNS + COUNT_COLUMNS * counts) + "\n")
        self.flush()

    def add(self, frame):
        """Append a device.Frame; one without raw data could not be replayed and is left out."""
        raw, gaze = frame.raw, frame.gaze
        if raw is None:
            return
        if raw.model_crc != self._crc:
            self._crc = raw.model_crc
            self._lines.append(f"# model_crc: 0x{self._crc:08X}\n")
        angles = (
            "%.7f,%.7f,%d" % (gaze.azimuth_deg_q7 / DEG_Q7, gaze.elevation_deg_q7 / DEG_Q7, gaze.flags)
            if gaze is not None
            else f"nan,nan,{raw.flags}"
        )
        self._lines.append(
            "%d,%.6f,%d,%s,%s,%.7f,%.7f,%.9f,%.9f,%.9f,%.9f,%s%s\n"
            % (
                frame.t_us,
                frame.host_time,
                frame.seq,
                angles,
                ",".join("%d" % v for v in raw.feature),
                *(value / DEG_Q7 for value in raw.recentre.offset_deg_q7),
                *(value / GAIN_Q9 for value in raw.recentre.gain_q9),
                f"{gaze.sigma_deg:.6g}" if gaze is not None else "nan",
                _counts(frame.counts) if self._counts else "",
            )
        )
        self.rows += 1
        if len(self._lines) >= self._flush_rows:
            self.flush()

    def flush(self):
        """Hand all rows so far to the operating system."""
        lines, self._lines = self._lines, []
        try:
            self._file.write("".join(lines))
            self._file.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            raise self._unwritable(error) from None

    def close(self):
        """Flush, and close what was opened here; harmless when closed already."""
        if not self._file.closed:
            try:
                self.flush()
            finally:
                if self._owned:
                    self._file.close()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    def _unwritable(self, error):
        return RecordingError(
            f"cannot write {self.path}: {error.strerror}", "choose another place with --csv"
        )


def _counts(counts):
    if counts is None:
        return "," * len(COUNT_COLUMNS)
    values = (*counts.lit_code, *counts.unlit_code, *("%.4f" % us for us in counts.exposure_us))
    return "".join(",%s" % value for value in values)
