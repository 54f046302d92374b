# SPDX-License-Identifier: Apache-2.0
"""Typed exceptions. Every one says what is wrong and what to do about it, one line each."""


class SparsegazeError(Exception):
    """Base of everything this package raises on purpose.

    message   what is wrong, one line
    remedy    what the reader can do, one line; may be empty
    """

    def __init__(self, message, remedy=""):
        self.message = _one_line(message)
        self.remedy = _one_line(remedy)
        super().__init__(self.message, self.remedy)

    def __str__(self):
        return f"{self.message}: {self.remedy}" if self.remedy else self.message


class PortError(SparsegazeError):
    """The port does not exist, is taken, or may not be opened."""


class NoDeviceError(SparsegazeError):
    """The port opens, but no sparsegaze firmware answers behind it."""


class ProtocolError(SparsegazeError):
    """The device speaks another protocol version, or sent what the protocol forbids."""


class DeviceError(SparsegazeError):
    """The device refused a request.

    code   enum sg_err of the refusal, negative
    """

    def __init__(self, code, message, remedy=""):
        self.code = int(code)
        super().__init__(message, remedy)
        self.args = (self.code, self.message, self.remedy)    # so that it pickles


class DisconnectedError(PortError):
    """The port was there and is gone: cable pulled, device closed."""


class FlashError(SparsegazeError):
    """A hex file that cannot be flashed, or a flashing that failed."""


class ModelError(SparsegazeError):
    """A stored model that is damaged, or that this device cannot take."""


class RecordingError(SparsegazeError):
    """A recording that cannot be read or fitted."""


class CalibrationError(SparsegazeError):
    """A calibration that did not yield a usable model."""


class SceneError(SparsegazeError):
    """A headset or person description that cannot be simulated."""


class VirtualError(SparsegazeError):
    """The virtual Nano cannot be built, started or controlled."""


def one_of(names, value, what, error=ValueError):
    """`value`, if it is one of the names. Raises `error`, one line that lists them, if it is not."""
    if value not in tuple(names):
        raise error(f"{what} is one of {', '.join(map(str, names))}, not {value!r}")
    return value


def _one_line(text):
    return " ".join(str(text).split())
