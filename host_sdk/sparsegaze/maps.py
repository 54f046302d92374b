# SPDX-License-Identifier: Apache-2.0
"""Maps of a headset's response over gaze, with a bound on their error, made as cheaply as that allows.

    made = compute_map("headsets/led2gaze.toml", 7)
    made.response[0, 3, 1]      sensor 3 with emitter 1 lit, [elevation, azimuth], 1/mm^2
    made.save("map.npz")

`mapmake` computes, `mapplan` finds how finely, `mapfigure` draws, `simulate` makes the tables that the
virtual Nano interpolates at any gaze.
"""

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from typing import Dict, List

import numpy as np

from . import __version__
from .errors import SceneError, one_of
from .headset import Headset, lit_of, load_headset
from .mapjudge import mean_response
from .mapmake import Making
from .mapstore import read_map, write_npz
from .person import Person, draw_person, load_person
from .ring import ring_figures  # noqa: F401  (part of this module's interface)

HALF_ANGLE_DEG, GRID, TOL = 25.0, 41, 1e-4
MOST_GRID, MOST_SWEEP = 181, 20001
LARGEST_GAZE_DEG = 45.0
UNITS = (
    "response, error_estimate and parts: 1/mm^2 (light at the sensor per axial radiant intensity of the "
    "emitter); azimuth and elevation: degrees, Fick, + temporal and + up; pupil: mm diameter; lid_opening: "
    "0 closed .. 1 open; slip: mm, x temporal, y up, z backward"
)
MODELLED = (
    "skin, sclera and iris Lambertian, one reflection; iris lit and seen through the refracting cornea; "
    "Beckmann glint of the tear film on cornea, limbus and sclera, widened by both lenses; lids that follow "
    "gaze, with thick soft margins; shadows of the face; shadows of the corneal bulge"
)
NOT_MODELLED = (
    "interreflection, the pupil's retro-reflection and decentration, posterior cornea and lens, light under "
    "the skin"
)


@dataclass(frozen=True, eq=False)
class GazeMap:
    """Responses over states and gazes. S states, n sensors, m emitters.

    response         [S, n, m, elevation, azimuth], 1/mm^2, float64; sensor i and emitter i of an LED headset
                     are the same LED
    error_estimate   [S, n, m]: a bound on the error of any gaze of that pair (exact), NaN (image)
    estimate_rms     {term or "total": rms error over gazes and pairs, of the mean response}
    parts            {term: like response}: face, sclera, iris, glint; empty when they were not kept
    left_out         sentences: what was left out or simplified, why, and what that costs
    headset, person  their complete content, as plain data
    mean             of the response, over gazes within 20 degrees and pairs of two places: the unit of errors
    """

    response: np.ndarray
    pupil_mm: np.ndarray
    lid_opening: np.ndarray
    slip_mm: np.ndarray
    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    error_estimate: np.ndarray
    mean: float
    method: str
    headset: dict
    person: dict
    estimate_rms: Dict[str, float] = field(default_factory=dict)
    parts: Dict[str, np.ndarray] = field(default_factory=dict)
    left_out: List[str] = field(default_factory=list)
    tol: float = TOL
    seconds: float = 0.0
    version: str = __version__
    units: str = UNITS
    modelled: str = MODELLED
    not_modelled: str = NOT_MODELLED

    def sensor_maps(self, state=0, part=None):
        """What each sensor collects with its emitters lit, [sensor, elevation, azimuth]. part: of parts."""
        whole = self.parts[one_of(self.parts, part, "a part", SceneError)] if part else self.response
        values = whole[state]
        return np.where(self.lit[:, :, None, None], values, 0.0).sum(1)

    @property
    def lit(self):
        """bool [sensor, emitter]: who is lit while a sensor senses."""
        return lit_of(self.headset)

    def save(self, path, parts=True):
        """Write an .npz file, whole or not at all. OSError when it cannot be written."""
        kept = self if parts else replace(self, parts={})
        write_npz(path, kept)

    @classmethod
    def load(cls, path):
        """Read a file that `save` wrote. SceneError, with what is wrong with it, for any other."""
        return cls(**read_map(path))


def compute_map(
    headset,
    person,
    half_angle_deg=HALF_ANGLE_DEG,
    grid=GRID,
    tol=TOL,
    pupil_mm=(3.5,),
    lid_opening=(1.0,),
    slip_mm=((0.0, 0.0, 0.0),),
    method="exact",
    pixels=128,
    bits="float",
    clip=False,
    renderer="embree",
    workers=None,
    progress=None,
):
    """The map of a headset on a person over a square of gazes.

    headset, person   Headset and Person, their files, or a person's seed
    grid              gazes along each axis, 1..181; 1 is straight ahead
    tol               rms error of the total that is good enough, of the mean response; 1e-6..1e-1
    pupil_mm, lid_opening, slip_mm    states: the three are walked in step, one state per entry; what has one
                      entry has it in every state
    method            "exact": integrals over surfaces; "image": the rendered image times window, summed, with
                      pixels, bits ("float", 16, 8), clip and renderer ("embree", "osmesa"); its error is not
                      known from itself (error_estimate NaN): compare it with an exact map
    workers           threads; None = two, or one on a one-core machine
    progress          called with the finished part, 0..1
    SceneError for an impossible scene, state or argument.
    """
    half, count = _number(half_angle_deg, "the half angle", 0.0, LARGEST_GAZE_DEG), _whole(
        grid, "the grid", MOST_GRID
    )
    axis = np.linspace(-half, half, count) if count > 1 else np.zeros(1)
    if count > 1 and half == 0:
        raise SceneError("a half angle of 0 has one gaze, not %d" % count, "grid 1, or a larger half angle")
    image = dict(pixels=pixels, bits=bits, clip=clip, renderer=renderer)
    return _compute(
        headset, person, axis, axis, tol, (pupil_mm, lid_opening, slip_mm), method, image, workers, progress
    )


def compute_sweep(
    headset,
    person,
    axis="azimuth",
    at_deg=0.0,
    half_angle_deg=HALF_ANGLE_DEG,
    points=201,
    tol=TOL,
    pupil_mm=(3.5,),
    lid_opening=(1.0,),
    slip_mm=((0.0, 0.0, 0.0),),
    workers=None,
    progress=None,
):
    """A map of one row (axis "azimuth", at elevation at_deg) or column ("elevation"): a curve per pair."""
    if axis not in ("azimuth", "elevation"):
        raise SceneError("a sweep is along azimuth or elevation, not %r" % (axis,), "for example azimuth")
    half = _number(half_angle_deg, "the half angle", 1e-3, LARGEST_GAZE_DEG)
    along = np.linspace(-half, half, _whole(points, "the sweep", MOST_SWEEP))
    still = np.array([_number(at_deg, "the gaze across the sweep", -LARGEST_GAZE_DEG, LARGEST_GAZE_DEG)])
    axes = (along, still) if axis == "azimuth" else (still, along)
    return _compute(
        headset, person, *axes, tol, (pupil_mm, lid_opening, slip_mm), "exact", {}, workers, progress
    )


def _compute(headset, person, azimuth, elevation, tol, states, method, image, workers, progress):
    started = time.perf_counter()
    # As simulate.as_headset and as_person, whose module would load what only tables need: 0.3 s.
    headset = headset if isinstance(headset, Headset) else load_headset(headset)
    if not isinstance(person, Person):
        person = (draw_person if isinstance(person, (int, np.integer)) else load_person)(person)
    tol = _number(tol, "the tolerance", 1e-6, 0.1)
    states = _states(*states, person)
    workers = int(workers) if workers else min(2, os.cpu_count() or 1)
    common = dict(
        pupil_mm=states[0],
        lid_opening=states[1],
        slip_mm=states[2],
        azimuth_deg=azimuth,
        elevation_deg=elevation,
        method=method,
        headset=asdict(headset),
        person=asdict(person),
        tol=tol,
    )
    if method == "exact":
        making = Making(headset, person, azimuth, elevation, states, tol, workers, progress)
        parts = making.make()
        response, error = sum(parts.values()), making.bound(parts)
        rms = dict(making.rms, total=float(np.sqrt(sum(v * v for v in making.rms.values()))))
        common.update(parts=parts, estimate_rms=rms, left_out=making.left_out(), mean=making.mean)
    elif method == "image":
        response = _image(headset, person, azimuth, elevation, states, image, workers, progress)
        error = np.full(response.shape[:3], np.nan)
        said = (
            "the integrals over surfaces: pixels of %(renderer)s images, %(pixels)s wide, %(bits)s bits"
            % image
        )
        common.update(
            left_out=[said + (", clipped" if image["clip"] else "") + "; error unknown"],
            mean=mean_response(response, azimuth, elevation),
        )
    else:
        raise SceneError("there is no method %r" % (method,), "exact or image")
    if progress:
        progress(1.0)
    return GazeMap(response=response, error_estimate=error, seconds=time.perf_counter() - started, **common)


def _image(headset, person, azimuth, elevation, states, image, workers, progress):
    from .image import image_response

    out = np.empty(
        (len(states[0]), len(headset.sensors), len(headset.emitters), len(elevation), len(azimuth))
    )
    places = [(s, e, a) for s in range(len(out)) for e in range(len(elevation)) for a in range(len(azimuth))]

    def one(place):
        s, e, a = place
        pupil, lid, slip = (axis[s] for axis in states)
        value = image_response(
            headset, person, azimuth[a], elevation[e], pupil, lid, slip_mm=tuple(slip), **image
        )
        out[s, :, :, e, a] = value

    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(one, place) for place in places]
        try:
            for done, future in enumerate(futures, 1):
                future.result()
                if progress:
                    progress(done / len(futures))
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return out


# arguments --------------------------------------------------------------------------------------------------


def _number(value, what, low, high):
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not low <= number <= high:
        raise SceneError("%s is %s" % (what, value), "a number from %g to %g" % (low, high))
    return number


def _whole(value, what, most):
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= most:
        raise SceneError("%s is %s gazes" % (what, value), "a whole number from 1 to %d" % most)
    return int(value)


def _states(pupil_mm, lid_opening, slip_mm, person):
    """(pupil [S], lid [S], slip [S, 3]) from lists of one length, or of one entry."""
    try:
        pupil, lid = (np.atleast_1d(np.asarray(v, float)) for v in (pupil_mm, lid_opening))
        slip = np.atleast_2d(np.asarray(slip_mm, float))
    except (TypeError, ValueError):
        raise SceneError("a state is not a number", "pupil in mm, lids 0..1, slip as x, y, z in mm")
    lengths = [len(pupil), len(lid), len(slip)]
    count = max(lengths)
    if pupil.ndim != 1 or lid.ndim != 1 or slip.shape[1:] != (3,) or not set(lengths) <= {1, count}:
        raise SceneError(
            "%d pupils, %d lid openings and %d slips do not go together" % tuple(lengths),
            "give each once, or the same number of times: one state each",
        )
    for values, what, low, high in (
        (pupil, "a pupil (mm)", 0.5, 2 * person.limbus_radius_mm - 0.5),
        (lid, "a lid opening", 0.0, 1.0),
        (slip, "a slip (mm)", -50.0, 50.0),
    ):
        for value in values.ravel():
            _number(value, what, low, high)
    return (
        np.ascontiguousarray(np.broadcast_to(pupil, count)),
        np.ascontiguousarray(np.broadcast_to(lid, count)),
        np.ascontiguousarray(np.broadcast_to(slip, (count, 3))),
    )
