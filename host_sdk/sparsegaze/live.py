# SPDX-License-Identifier: Apache-2.0
"""A gaze stream as it arrives: counted, shown, kept."""

from .gazefile import GazeCsv
from .wire import lib


class Tally:
    """Counts of a stream: frames, valid, lost, incomplete, bad; rate in device time."""

    def __init__(self):
        self.frames = self.valid = self.lost = self.incomplete = self.bad = self.faulty = 0
        self.first_us = self.last_us = None
        self.gaze = None  # the latest, valid or not
        self.without_model = 0
        self.clock_drift = 0.0

    def add(self, frame, device):
        """Take a device.Frame that has just arrived."""
        self.frames += 1
        self.first_us = frame.t_us if self.first_us is None else self.first_us
        self.last_us = frame.t_us
        self.gaze = frame.gaze
        self.valid += frame.gaze is not None and frame.gaze.valid
        self.without_model += frame.gaze is not None and bool(frame.gaze.flags & lib.SG_FLAG_NO_MODEL)
        self.faulty += frame.gaze is not None and bool(frame.gaze.flags & lib.SG_FLAG_FAULT)
        self.lost, self.incomplete, self.bad = device.lost, device.incomplete, device.bad
        self.clock_drift = device.clock.drift

    @property
    def seconds(self):
        """Device time between the first and the last frame."""
        return (self.last_us - self.first_us) * 1e-6 if self.frames > 1 else 0.0

    @property
    def rate_hz(self):
        """Frames per second of device time."""
        return (self.frames - 1) / self.seconds if self.seconds > 0 else 0.0

    def text(self):
        """One line about now."""
        if self.gaze is None:
            where = "no gaze" + " " * 20
        elif self.gaze.valid:
            where = f"azimuth {self.gaze.azimuth_deg:+7.2f}  elevation {self.gaze.elevation_deg:+7.2f} deg"
        else:
            where = f"no valid gaze ({self._why()})".ljust(42)
        return f"{where}   {self.rate_hz:6.1f} Hz   {self.seconds:7.1f} s   lost {self.lost}"

    def _why(self):
        flags = self.gaze.flags
        if self.without_model == self.frames:
            return "the device has no model"
        if flags & lib.SG_FLAG_FAULT:
            return "a fault: see sparsegaze status"
        if flags & lib.SG_FLAG_SATURATED:
            return "too much light"
        if flags & lib.SG_FLAG_STARVED:
            return "too little light"
        if flags & lib.SG_FLAG_EXPOSURE:
            return "exposures follow the light"
        return "blink, or a headset that moved"

    def report(self):
        """Plain numbers."""
        return {
            "seconds": self.seconds,
            "frames": self.frames,
            "rate_hz": self.rate_hz,
            "lost": self.lost,
            "incomplete": self.incomplete,
            "bad_crc": self.bad,
            "valid": self.valid,
            "faulty": self.faulty,
            "valid_percent": 100.0 * self.valid / self.frames if self.frames else 0.0,
            "clock_drift_ppm": self.clock_drift * 1e6,
        }


def run(device, tally, seconds=None, csv=None, shown=None, counts=False):
    """Stream from an open device until `seconds` of device time have passed (None: until interrupted).

    tally  Tally to keep up to date; csv: path or open text file for every frame; shown: called after every
           frame; counts: also what the converter read, in the CSV
    The CSV is complete whatever ends the stream. Raises NoDeviceError, DisconnectedError, RecordingError.
    """
    writer = None if csv is None else GazeCsv(csv, counts=counts)
    try:
        device.set_stream(raw=writer is not None, gaze=True, counts=counts and writer is not None)
        for frame in device.frames():
            if (
                seconds is not None
                and tally.first_us is not None
                and frame.t_us - tally.first_us >= seconds * 1e6
            ):
                break
            tally.add(frame, device)
            if writer is not None:
                writer.add(frame)
            if shown is not None:
                shown()
        device.set_stream()
    finally:
        if writer is not None:
            writer.close()
