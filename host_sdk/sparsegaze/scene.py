# SPDX-License-Identifier: Apache-2.0
"""A headset on a person, evaluated directly by sim_c: no grid, no interpolation. See sim_c/sim_scene.h."""

from dataclasses import fields

import numpy as np

from .errors import SceneError, one_of
from .person import Person

TERMS = {"face": 1, "sclera": 2, "iris": 4, "eye": 6, "smooth": 7}

# What Scene.derivatives() knows, with its units, and how it steps.
DERIVATIVES = ("azimuth_deg", "elevation_deg", "slip_x_mm", "slip_y_mm", "slip_z_mm")
GAZE_STEP_DEG, SLIP_STEP_MM = 0.25, 0.2
ROUGHNESS = 1e-5  # of the mean response, by which errors of neighbouring scenes may differ


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


def _listed(names, kinds):
    """Names of ports in words; all of a kind as such."""
    words = []
    for kind, n in kinds:
        of_kind = [name for name in names if name.startswith(kind)]
        words += ["every " + kind] if len(of_kind) == n > 1 else of_kind
    return ", ".join(words)


def _three_numbers(slip_mm):
    try:
        slip = [float(v) for v in slip_mm]
    except (TypeError, ValueError):
        slip = []
    if len(slip) != 3 or not np.isfinite(slip).all():
        raise SceneError("slip_mm is %r" % (slip_mm,), "three finite numbers, millimetres")
    return slip


class Scene:
    """One headset on one person at one slip.

    slip_mm   added to every port's position: [x, y, z], mm
    quality   {field of struct sim_quality: value} to integrate finer or coarser than the default
    Raises SceneError when the scene is impossible (a sensor in the eye or behind the face, a number that is
    not finite).
    Methods may be called from several threads at once.
    """

    def __init__(self, headset, person, slip_mm=(0.0, 0.0, 0.0), quality=None):
        self._ffi, self._lib = simulator()
        ffi, lib = self._ffi, self._lib
        self.headset, self.person, self.quality = headset, person, dict(quality or {})
        self.slip_mm = _three_numbers(slip_mm)
        setting = ffi.new("struct sim_quality *", lib.sim_quality_default())
        for key, value in self.quality.items():
            if key not in dir(setting) or isinstance(value, bool) or not isinstance(value, (int, float)):
                known = ", ".join(dir(setting))
                raise SceneError("no such quality: %s = %r" % (key, value), "a number for one of " + known)
            setattr(setting, key, value)
        error = ffi.new("char[200]")
        made = lib.sim_scene_open(
            c_person(ffi, person),
            _c_ports(ffi, headset.sensors),
            len(headset.sensors),
            _c_ports(ffi, headset.emitters),
            len(headset.emitters),
            ffi.new("double[3]", self.slip_mm),
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
        self._slipped = {}

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
            TERMS[one_of(TERMS, terms, "a term", SceneError)],
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

    def derivatives(self, azimuth_deg, elevation_deg, pupil_mm=3.5, lid_opening=1.0, by=DERIVATIVES):
        """How the response changes with gaze and with the headset's slip, at one state.

        by    of DERIVATIVES: azimuth_deg, elevation_deg (1/mm^2 per degree), slip_x_mm, slip_y_mm, slip_z_mm
              (1/mm^2 per mm)
        Returns (derivative, error), each [len(by), sensor, emitter].

        Central differences over five points, of a scene integrated twice as finely in the eye: the
        integrators are the same sums at all five, so most of their errors cancel; what is left is below
        ROUGHNESS of the mean response. The steps are small against the bright ring (2 degrees, the narrowest
        thing in gaze) and against a lens, and large against the roughness.
        The error stated is the difference to the three-point rule of the same step, an overestimate wherever
        the five-point rule converges, plus the roughness over the step.
        Cost: 4 responses per derivative; once per scene 1 preparation, with slip 13 (0.1 s each).
        """
        unknown = [name for name in by if name not in DERIVATIVES]
        if unknown:
            raise SceneError("no derivative by %s" % unknown[0], "one of " + ", ".join(DERIVATIVES))
        middle = self._at_slip(0, 0.0).response(azimuth_deg, elevation_deg, pupil_mm, lid_opening)
        floor = ROUGHNESS * np.abs(middle).mean()
        values, errors = [], []
        for name in by:
            step = GAZE_STEP_DEG if name.endswith("_deg") else SLIP_STEP_MM
            at = {
                k: self._moved(name, k * step, azimuth_deg, elevation_deg, pupil_mm, lid_opening)
                for k in (-2, -1, 1, 2)
            }
            three = (at[1] - at[-1]) / (2 * step)
            five = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)
            values.append(five)
            errors.append(np.abs(five - three) + floor / step)
        return np.array(values), np.array(errors)

    def _moved(self, name, change, azimuth_deg, elevation_deg, pupil_mm, lid_opening):
        if name == "azimuth_deg":
            azimuth_deg += change
        elif name == "elevation_deg":
            elevation_deg += change
        axis, slip = (0, 0.0) if name.endswith("_deg") else ("xyz".index(name[5]), change)
        scene = self._at_slip(axis, slip)
        return scene.response(azimuth_deg, elevation_deg, pupil_mm, lid_opening)

    def _at_slip(self, axis, change):
        key = (axis, change)
        if key not in self._slipped:
            slip = list(self.slip_mm)
            slip[axis] += change
            eye = ("sclera", "iris", "glint")
            finer = {term: min(16.0, 2.0 * self.quality.get(term, 1.0)) for term in eye}
            self._slipped[key] = Scene(self.headset, self.person, slip, {**self.quality, **finer})
        return self._slipped[key]

    def eye_reach(self, kind, number, alpha_deg, beta_deg):
        """Share of the lens of a port (kind "sensor" or "emitter", number) that the face leaves to the eye in
        the direction alpha_deg (to +x) and beta_deg (up) from its centre of rotation: 0..1.
        """
        share = self._lib.sim_scene_eye_reach(self._scene, kind == "emitter", number, alpha_deg, beta_deg)
        if not share >= 0:
            raise SceneError(
                "no %s %r, or no such direction" % (kind, number), "directions within 90 degrees"
            )
        return share

    def left_out(self):
        """What this scene did not need, or has only so finely: a list of sentences, for reports."""
        kinds = (("sensor", len(self.headset.sensors)), ("emitter", len(self.headset.emitters)))
        facts = self._ffi.new("struct sim_port_facts *")
        clear, unshaded, widened, width_mm = [], [], [], 0.0
        for kind, n in kinds:
            for i in range(n):
                self._lib.sim_scene_port_facts(self._scene, kind == "emitter", i, facts)
                name = "%s %d" % (kind, i)
                clear += [name] * bool(facts.eye_clear)
                unshaded += [name] * bool(facts.skin_clear)
                if facts.widened_mm:
                    width_mm = facts.widened_mm
                    widened.append(name)
        face = self._ffi.new("struct sim_face_facts *")
        self._lib.sim_scene_face_facts(self._scene, face)
        said = []
        if clear:
            said.append(
                "face: hides nothing of the eye from %s at gazes within 30 degrees; no horizon was sought "
                "there" % _listed(clear, kinds)
            )
        if unshaded:
            said.append(
                "face: no shadow's edge lies on lit skin for %s; no penumbra" % _listed(unshaded, kinds)
            )
        if widened:
            said.append(
                "face: shadows for %s have the edges of a lens of %g mm, wider than its own"
                % (_listed(widened, kinds), width_mm)
            )
        if face.panel_tolerance > face.panel_goal:
            said.append(
                "face: too many hard shadows to follow; panels agree to %.1e of the mean response each "
                "instead of %.1e" % (face.panel_tolerance, face.panel_goal)
            )
        if not face.lid_spots:
            said.append(
                "lids: no light falls on skin that open lids uncover; lid poses change nothing of the face"
            )
        if self.person.lash_opacity == 0:
            said.append("lashes: opacity 0, not traced")
        return said
