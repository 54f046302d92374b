# SPDX-License-Identifier: Apache-2.0
"""A headset on a person, evaluated directly by sim_c: no grid, no interpolation. See sim_c/sim_scene.h."""

from dataclasses import fields

import numpy as np

from .errors import SceneError
from .person import Person

TERMS = {"face": 1, "sclera": 2, "iris": 4, "eye": 6, "smooth": 7}


def simulator():
    """The compiled simulator (ffi, lib). SceneError when it has not been built."""
    try:
        from . import _sim
    except ImportError as error:
        raise SceneError(
            "the simulator is not built (%s)" % error, "python host_sdk/sparsegaze/_sim_build.py"
        )
    return _sim.ffi, _sim.lib


def c_person(ffi, person):
    """`struct sim_person *` holding a Person."""
    made = ffi.new("struct sim_person *")
    for field in fields(Person):
        value = getattr(person, field.name)
        setattr(made, field.name, list(value) if isinstance(value, tuple) else value)
    return made


def _c_ports(ffi, ports):
    made = ffi.new("struct sim_port[]", len(ports))
    for c, p in zip(made, ports):
        c.position_mm, c.aim, c.sigma_deg, c.radius_mm = p.position_mm, p.aim, p.sigma_deg, p.lens_radius_mm
    return made


class Scene:
    """One headset on one person at one slip.

    quality   {field of struct sim_quality: value} to integrate finer or coarser than the default
    Raises SceneError when the scene is impossible (a sensor in the eye or behind the face, a number that is
    not finite).
    Methods may be called from several threads at once.
    """

    def __init__(self, headset, person, slip_mm=(0.0, 0.0, 0.0), quality=None):
        self._ffi, self._lib = simulator()
        ffi, lib = self._ffi, self._lib
        setting = ffi.new("struct sim_quality *", lib.sim_quality_default())
        for key, value in (quality or {}).items():
            setattr(setting, key, value)
        error = ffi.new("char[200]")
        made = lib.sim_scene_open(
            c_person(ffi, person),
            _c_ports(ffi, headset.sensors),
            len(headset.sensors),
            _c_ports(ffi, headset.emitters),
            len(headset.emitters),
            ffi.new("double[3]", [float(v) for v in slip_mm]),
            setting,
            error,
            200,
        )
        if made == ffi.NULL:
            raise SceneError(
                "impossible scene: " + ffi.string(error).decode(), "correct the headset or the person"
            )
        self._scene = ffi.gc(made, lib.sim_scene_close)
        self.shape = (len(headset.sensors), len(headset.emitters))

    def smooth(self, azimuth_deg, elevation_deg, pupil_mm, lid_opening, terms="smooth"):
        """The slowly varying terms (face, sclera, iris, or all: smooth) at one gaze: [pupil, lid, sensor,
        emitter].

        pupil_mm ascending, lid_opening in 0..1; both may be scalars (then their axis has length 1).
        """
        pupils, lids = np.atleast_1d(np.asarray(pupil_mm, float)), np.atleast_1d(
            np.asarray(lid_opening, float)
        )
        out = np.empty((len(pupils), len(lids)) + self.shape)
        bad = self._lib.sim_scene_smooth(
            self._scene,
            azimuth_deg,
            elevation_deg,
            TERMS[terms],
            self._ffi.from_buffer("double[]", pupils),
            len(pupils),
            self._ffi.from_buffer("double[]", lids),
            len(lids),
            self._ffi.from_buffer("double[]", out),
        )
        if bad:
            raise SceneError(
                "no such state: gaze %g, %g" % (azimuth_deg, elevation_deg), "gaze within 60 degrees"
            )
        return out

    def glint(self, azimuth_deg, elevation_deg, lid_opening):
        """The glint at one gaze: [lid, sensor, emitter]."""
        lids = np.atleast_1d(np.asarray(lid_opening, float))
        out = np.empty((len(lids),) + self.shape)
        bad = self._lib.sim_scene_glint(
            self._scene,
            azimuth_deg,
            elevation_deg,
            self._ffi.from_buffer("double[]", lids),
            len(lids),
            self._ffi.from_buffer("double[]", out),
        )
        if bad:
            raise SceneError(
                "no such state: gaze %g, %g" % (azimuth_deg, elevation_deg), "gaze within 60 degrees"
            )
        return out

    def response(self, azimuth_deg, elevation_deg, pupil_mm=3.5, lid_opening=1.0):
        """All of it at one state: [sensor, emitter]."""
        smooth = self.smooth(azimuth_deg, elevation_deg, pupil_mm, lid_opening)
        return smooth[0, 0] + self.glint(azimuth_deg, elevation_deg, lid_opening)[0]
