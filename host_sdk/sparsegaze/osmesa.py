# SPDX-License-Identifier: Apache-2.0
"""The images of image.py by Mesa's software OpenGL, in 32-bit floats: sim_c/sim_osmesa.h."""

import threading

import numpy as np

from .errors import SceneError
from .image import PARTS, bad_state, camera_weights
from .scene import simulator


_DRAWING = threading.Lock()


class OsmesaCamera:
    """One sensor's images; threads take turns. SceneError when libOSMesa is missing."""

    def __init__(self, method, sensor, emitters):
        ffi, lib = simulator()
        error = ffi.new("char[200]")
        with _DRAWING:
            made = lib.sim_osmesa_open(
                method.scene._scene,
                sensor,
                list(emitters),
                len(emitters),
                method.pixels,
                method.half_width_sigmas,
                error,
                200,
            )
        if made == ffi.NULL:
            raise SceneError(ffi.string(error).decode(), "apt-get install libosmesa6, or renderer embree")
        self._ffi, self._lib, self._scene = ffi, lib, method.scene
        self._osmesa = ffi.gc(made, lib.sim_osmesa_close)
        self.window, self.solid_angle, self.edges = camera_weights(
            method.headset.sensors[sensor].sigma_deg, method.pixels, method.half_width_sigmas
        )
        self._shape = (len(emitters), method.pixels, method.pixels, len(PARTS))

    def render_parts(self, azimuth_deg, elevation_deg, pupil_mm, lid_opening):
        """{part: [emitter, row, column] float32}"""
        out = np.empty(self._shape, np.float32)
        state = azimuth_deg, elevation_deg, pupil_mm, lid_opening
        with _DRAWING:
            bad = self._lib.sim_osmesa_render(self._osmesa, *state, self._ffi.from_buffer("float[]", out))
        if bad == -1:
            raise bad_state(*state)
        if bad:
            raise SceneError("OpenGL failed while drawing", "fewer pixels, or renderer embree")
        return {name: out[..., k] for k, name in enumerate(PARTS)}

    def render(self, azimuth_deg, elevation_deg, pupil_mm, lid_opening, parts=PARTS):
        """[emitter, row, column] radiance of the sum of the named parts."""
        found = self.render_parts(azimuth_deg, elevation_deg, pupil_mm, lid_opening)
        return sum(found[name] for name in parts)
