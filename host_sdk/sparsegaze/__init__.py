# SPDX-License-Identifier: Apache-2.0
"""sparsegaze: gaze from six LEDs, computed on the microcontroller that reads them.

    from sparsegaze import Device
    with Device("/dev/ttyUSB0") as device:
        device.set_stream(gaze=True)
        for frame in device.frames():
            print(frame.t_us, frame.gaze.azimuth_deg, frame.gaze.elevation_deg)
"""

import importlib

from .errors import (CalibrationError, DeviceError, DisconnectedError, FlashError, ModelError, NoDeviceError,
                     PortError, ProtocolError, RecordingError, SceneError, SparsegazeError, VirtualError)

__version__ = "0.1.0"

# Loaded on first use, so that reading a recording needs no serial port and flashing needs no numerics.
_LAZY = {
    "Device": "device", "Frame": "device", "Gaze": "device",
    "open_link": "transport", "ports": "registry",
    "flash_hex": "flash", "upload": "store",
    "VirtualNano": "virtual", "VirtualControl": "virtual",
    "DeviceModel": "model", "Recording": "recording",
}

__all__ = sorted(_LAZY) + [
    "CalibrationError", "DeviceError", "DisconnectedError", "FlashError", "ModelError", "NoDeviceError",
    "PortError",
    "ProtocolError", "RecordingError", "SceneError", "SparsegazeError", "VirtualError"]


def __getattr__(name):
    if name in _LAZY:
        return getattr(importlib.import_module("." + _LAZY[name], __name__), name)
    raise AttributeError(f"module 'sparsegaze' has no attribute {name!r}")


def __dir__():
    return sorted(list(globals()) + list(_LAZY))
