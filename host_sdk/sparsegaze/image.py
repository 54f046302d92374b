# SPDX-License-Identifier: Apache-2.0
"""The paper's way to a response: the image that a sensor sees, times its window, summed. For comparison with
scene.py, whose integrals are both faster and closer to the truth, and for looking at.

An image errs where scene.py does not: edges and narrow glints fall between its pixels (a pixel must not be
wider than 0.2 of the glint's lobe, about 0.2 * roughness in the tangent of the angle, at 30 mm), light
beyond its border is missing, and a few bits hold either a glint or what is around it. The last is what the
paper warns of; `bits` and `clip` show it.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .errors import SceneError, one_of
from .scene import Scene, simulator

PARTS = {"face": 1, "sclera": 2, "iris": 4, "glint": 8}
OCCLUSION = {"soft": 0, "rays": 1}
RENDERERS = ("embree", "osmesa")
# Of an automatic exposure: this part of the pixels that are not black lies below that part of full scale.
EXPOSED_PIXELS, EXPOSED_LEVEL = 0.99, 0.8


class ImageMethod:
    """Images of one headset on one person, and the responses that they sum to.

    pixels              of each image's side, 2..4096
    half_width_sigmas   what an image covers: +- so many standard deviations of the sensor's window, in
                        tangents. Beyond 3 sigma lie 0.5 % of what the window lets through, beyond 4 0.01 %.
    renderer            "embree": float64, face by Embree's rays. "osmesa": float32, all in a fragment shader.
    occlusion           "soft": as in sim_scene.h. "rays": what a ray meets first, and shadow rays (embree
                        only): to see what soft horizons leave out.
    Raises SceneError when the scene is impossible or the renderer is missing.
    """

    def __init__(
        self,
        headset,
        person,
        slip_mm=(0.0, 0.0, 0.0),
        pixels=128,
        half_width_sigmas=4.0,
        renderer="embree",
        occlusion="soft",
    ):
        if renderer not in RENDERERS:
            raise SceneError("no renderer %r" % (renderer,), "one of: " + ", ".join(RENDERERS))
        if occlusion not in OCCLUSION or (occlusion == "rays" and renderer != "embree"):
            raise SceneError("no occlusion %r with %s" % (occlusion, renderer), "soft, or rays with embree")
        self.headset, self.pixels, self.half_width_sigmas = headset, pixels, half_width_sigmas
        self.renderer, self.occlusion = renderer, occlusion
        self.scene = Scene(headset, person, slip_mm)
        self.shape = self.scene.shape
        self._cameras = {}

    def camera(self, sensor, emitters=None):
        """The Camera of one sensor, for the given emitters (default all); kept for the next call."""
        count = self.shape[1]
        chosen = tuple(range(count)) if emitters is None else tuple(int(e) for e in emitters)
        for what, number, limit in [("sensor", sensor, self.shape[0])] + [
            ("emitter", e, count) for e in chosen
        ]:
            if not 0 <= number < limit:
                raise SceneError(
                    "%s has no %s %d" % (self.headset.name, what, number), "0 to %d" % (limit - 1)
                )
        if not chosen:
            raise SceneError("no emitter is lit", "name at least one")
        key = (int(sensor), chosen)
        if key not in self._cameras:
            made = _EmbreeCamera if self.renderer == "embree" else _osmesa_camera
            self._cameras[key] = made(self, *key)
        return self._cameras[key]

    def response(
        self,
        azimuth_deg,
        elevation_deg,
        pupil_mm=3.5,
        lid_opening=1.0,
        bits="float",
        clip=False,
        cos3=True,
        parts=PARTS,
    ):
        """[sensor, emitter] at one state, in the unit of Scene.response().

        bits    "float", 16 or 8: of the pixels, one exposure for each image (expose())
        cos3    False: the paper's plain sum, in which all pixels weigh the same, not their solid angle
        parts   names of the parts (PARTS) that are there to be seen
        """
        out = np.empty(self.shape)
        for sensor in range(self.shape[0]):
            camera = self.camera(sensor)
            weight = camera.window * (camera.solid_angle if cos3 else camera.solid_angle.max())
            image = camera.render(azimuth_deg, elevation_deg, pupil_mm, lid_opening, parts)
            for emitter in range(self.shape[1]):
                seen = expose(image[emitter], bits, clip)
                out[sensor, emitter] = (seen * weight).sum(dtype=float)
        return out


def expose(image, bits="float", clip=False):
    """An image as it is left by a camera of so many bits, in its own unit again.

    Full scale is the brightest pixel, so that nothing is clipped; or with clip=True the usual automatic
    exposure, which looks after most of the picture: 99 % of the pixels that are not black lie below 80 % of
    full scale, and what is brighter than full scale (glints) saturates. Levels are linear, 0 .. 2^bits - 1,
    rounded to the nearest.
    """
    if bits not in ("float", 8, 16):
        raise SceneError("bits = %r" % (bits,), "float, 16 or 8")
    lit = image[image > 0]
    if lit.size == 0:
        return image
    full = float(lit.max())
    if clip:
        full = min(full, float(np.quantile(lit, EXPOSED_PIXELS)) / EXPOSED_LEVEL)
    seen = np.minimum(image, full)
    if bits == "float":
        return seen
    levels = 2**bits - 1
    return np.rint(seen / full * levels) * (full / levels)


def camera_weights(sigma_deg, pixels, half_width_sigmas):
    """Window [row, column], solid angle [row, column] in sr and the pixels' borders [column + 1] in tangents,
    of a sensor's image.
    """
    sigma = np.tan(np.radians(sigma_deg))
    edges = np.linspace(-1, 1, pixels + 1) * half_width_sigmas * sigma
    middle = (edges[1:] + edges[:-1]) / 2
    tan2 = middle**2 + middle[:, None] ** 2
    pitch = 2 * half_width_sigmas * sigma / pixels
    return np.exp(-tan2 / (2 * sigma**2)), pitch**2 * (1 + tan2) ** -1.5, edges


class _EmbreeCamera:
    """One sensor's images by sim_image.c."""

    def __init__(self, method, sensor, emitters):
        ffi, lib = simulator()
        error = ffi.new("char[200]")
        made = lib.sim_image_open(
            method.scene._scene,
            sensor,
            list(emitters),
            len(emitters),
            method.pixels,
            method.half_width_sigmas,
            OCCLUSION[method.occlusion],
            error,
            200,
        )
        if made == ffi.NULL:
            raise SceneError(ffi.string(error).decode(), "see sparsegaze.image.ImageMethod")
        self._ffi, self._lib, self._scene = ffi, lib, method.scene
        self._image = ffi.gc(made, lib.sim_image_close)
        self._shape = (len(emitters), method.pixels, method.pixels)
        self.window, self.solid_angle, self.edges = camera_weights(
            method.headset.sensors[sensor].sigma_deg, method.pixels, method.half_width_sigmas
        )

    def render(self, azimuth_deg, elevation_deg, pupil_mm, lid_opening, parts=PARTS):
        """[emitter, row, column] radiance of the sum of the named parts."""
        out = np.empty(self._shape)
        terms = sum(PARTS[one_of(PARTS, name, "a part", SceneError)] for name in parts)
        self._render((azimuth_deg, elevation_deg, pupil_mm, lid_opening), terms, out)
        return out

    def render_parts(self, azimuth_deg, elevation_deg, pupil_mm, lid_opening):
        """{part: [emitter, row, column]}"""
        out = np.empty((len(PARTS),) + self._shape)
        terms = sum(PARTS.values()) + self._lib.SIM_IMAGE_APART
        self._render((azimuth_deg, elevation_deg, pupil_mm, lid_opening), terms, out)
        return dict(zip(PARTS, out))

    def _render(self, state, terms, out):
        if self._lib.sim_image_render(self._image, *state, terms, self._ffi.from_buffer("double[]", out)):
            raise bad_state(*state)


def bad_state(azimuth_deg, elevation_deg, pupil_mm, lid_opening):
    """The SceneError of a state that cannot be."""
    return SceneError(
        "no such state: gaze %g, %g, pupil %g mm, lids %g"
        % (azimuth_deg, elevation_deg, pupil_mm, lid_opening),
        "gaze within 60 degrees, a pupil smaller than the iris, lids 0 (closed) to 1 (open)",
    )


def _osmesa_camera(method, sensor, emitters):
    from .osmesa import OsmesaCamera

    return OsmesaCamera(method, sensor, emitters)


@dataclass(frozen=True)
class View:
    """What one sensor sees. Row 0 is on top, up is the head's +y; a right eye's temple is on the left.

    radiance       [emitter, row, column], per unit axial intensity of each emitter, 1/mm^2
    parts          {face, sclera, iris, glint: the same shape}; they add up to radiance
    window         [row, column] the sensor's sensitivity, 1 on its axis
    solid_angle    [row, column] sr
    edges          [column + 1] tangents of the pixels' borders from the sensor's axis, ascending: to the
                   right, and upwards for the rows from the last to the first
    """

    sensor: int
    emitters: tuple
    azimuth_deg: float
    elevation_deg: float
    pupil_mm: float
    lid_opening: float
    renderer: str
    half_width_sigmas: float
    radiance: np.ndarray
    parts: dict
    window: np.ndarray
    solid_angle: np.ndarray
    edges: np.ndarray

    @property
    def sigma_tan(self):
        """Standard deviation of the window, in tangents."""
        return float(self.edges[-1] / self.half_width_sigmas)

    def glints(self):
        """[(emitter, (x, y) tangents)] of the glints that outshine what is around them."""
        found, middle = [], (self.edges[1:] + self.edges[:-1]) / 2
        rest = sum(image for name, image in self.parts.items() if name != "glint").sum(0)
        for number, glint in zip(self.emitters, self.parts["glint"]):
            row, column = np.unravel_index(np.argmax(glint), glint.shape)
            if glint[row, column] > 0.5 * rest[row, column] + 0.05 * rest.max():
                found.append((number, (float(middle[column]), float(-middle[row]))))
        return found

    def save(self, path):
        """Write everything to a file that numpy.load() reads (the name is taken as it is)."""
        with open(path, "wb") as file:
            np.savez_compressed(
                file,
                radiance=self.radiance,
                **{"part_" + name: image for name, image in self.parts.items()},
                window=self.window,
                solid_angle=self.solid_angle,
                edges_tan=self.edges,
                sensor=self.sensor,
                emitters=np.array(self.emitters),
                azimuth_deg=self.azimuth_deg,
                elevation_deg=self.elevation_deg,
                pupil_mm=self.pupil_mm,
                lid_opening=self.lid_opening,
                renderer=self.renderer,
                units="radiance per unit axial intensity, 1/mm^2; solid_angle sr; edges_tan tangents",
            )

    def sums(self):
        """{part: [emitter] its response, 1/mm^2, and total}"""
        weight = self.window * self.solid_angle
        found = {name: (image * weight).sum((1, 2), dtype=float) for name, image in self.parts.items()}
        return {**found, "total": sum(found.values())}


def view(
    headset,
    person,
    sensor,
    azimuth_deg,
    elevation_deg,
    pupil_mm=3.5,
    lid_opening=1.0,
    emitters=None,
    pixels=512,
    half_width_sigmas=3.0,
    renderer="embree",
    slip_mm=(0.0, 0.0, 0.0),
    samples=1,
):
    """The View of one sensor at one state.

    emitters    numbers of those that are lit; default those that are while this sensor senses (Headset.lit)
    samples     a pixel is the mean of samples x samples points in it; pixels * samples <= 4096
    """
    if samples < 1 or pixels * samples > 4096:
        raise SceneError("%d pixels of %d x %d samples" % (pixels, samples, samples), "at most 4096 in a row")
    method = ImageMethod(headset, person, slip_mm, pixels * samples, half_width_sigmas, renderer)
    if emitters is None:
        emitters = _lit(headset, sensor)
    camera = method.camera(sensor, emitters)
    parts = camera.render_parts(azimuth_deg, elevation_deg, pupil_mm, lid_opening)
    blocks = (len(emitters), pixels, samples, pixels, samples)
    parts = {name: image.reshape(blocks).mean((2, 4)) for name, image in parts.items()}
    weights = camera_weights(headset.sensors[sensor].sigma_deg, pixels, half_width_sigmas)
    return View(
        int(sensor),
        tuple(int(e) for e in emitters),
        float(azimuth_deg),
        float(elevation_deg),
        float(pupil_mm),
        float(lid_opening),
        renderer,
        float(half_width_sigmas),
        sum(parts.values()),
        parts,
        *weights,
    )


def _lit(headset, sensor):
    if not 0 <= sensor < len(headset.sensors):
        return range(len(headset.emitters))  # refused by the camera, in its words
    return np.flatnonzero(headset.lit[sensor]).tolist()


@lru_cache(maxsize=4)
def _method(key, headset, person, *rest):
    return ImageMethod(headset, person, *rest)


def image_response(
    headset,
    person,
    azimuth_deg,
    elevation_deg,
    pupil_mm=3.5,
    lid_opening=1.0,
    pixels=128,
    bits="float",
    clip=False,
    renderer="embree",
    slip_mm=(0.0, 0.0, 0.0),
    half_width_sigmas=4.0,
):
    """[sensor, emitter] by images: ImageMethod.response(). What does not depend on the state (the face, its
    shadows) is kept from one call to the next with the same headset, person, slip and image.
    """
    slip = tuple(float(v) for v in slip_mm)
    made = _method(headset.describe(), headset, person, slip, pixels, half_width_sigmas, renderer)
    return made.response(azimuth_deg, elevation_deg, pupil_mm, lid_opening, bits, clip)
