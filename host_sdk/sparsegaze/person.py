# SPDX-License-Identifier: Apache-2.0
"""A simulated person: an eye, its lids and face in near infrared (940 nm), and how the headset sits on them.

Fields and units are those of `struct sim_person` in sim_c/sim_eye.h. Right eye, +x temporal. Means and
spreads are
published anatomy (cornea: Navarro's and Orbscan's; kappa: Orbscan; globe, lids and albedos: usual textbook
values);
the spread of roughness, limbus, face relief and of the headset's seat are assumptions.
"""

import os
from dataclasses import asdict, dataclass, fields
from typing import Tuple

import numpy as np

from .errors import SceneError


MOST_BYTES = 1 << 20  # of a TOML file

# Part of the gaze's elevation that the upper lid's margin follows: [eye].lid_follow_gain of physics.toml.
LID_FOLLOW_GAIN = 0.9


@dataclass(frozen=True)
class Person:
    """The defaults are the nominal person."""

    cornea_radius_mm: float = 7.8
    cornea_asphericity: float = -0.26
    limbus_radius_mm: float = 5.85
    limbus_blend_mm: float = 0.8
    limbus_haze_mm: float = 1.0
    globe_radius_mm: float = 12.0
    iris_depth_mm: float = 3.3
    kappa_azimuth_deg: float = 5.0
    kappa_elevation_deg: float = -1.0
    refractive_index: float = 1.336
    roughness: float = 0.015
    albedo_sclera: float = 0.42
    albedo_iris: float = 0.15
    albedo_skin: float = 0.52
    lid_upper_deg: float = 22.0
    lid_lower_deg: float = -27.0
    canthus_deg: float = 66.0
    canthus_tilt_deg: float = 3.0
    lid_upper_follow: float = LID_FOLLOW_GAIN
    lid_lower_follow: float = 0.5
    lid_close_at: float = 0.12
    lid_thickness_mm: float = 1.6
    lid_softness_mm: float = 0.8
    lid_radius_mm: float = 13.3
    lash_length_mm: float = 8.0
    lash_opacity: float = 0.0
    brow_mm: float = 9.0
    nose_mm: float = 16.0
    cheek_mm: float = 3.0
    eye_position_mm: Tuple[float, float, float] = (0.0, 0.0, 0.0)

    def describe(self):
        """Every number, in field order: what a cached map depends on."""
        return tuple(asdict(self).values())


# Field: (standard deviation, lowest, highest). What has none here is the same in everybody.
_SPREAD = {
    "cornea_radius_mm": (0.26, 7.1, 8.6),
    "cornea_asphericity": (0.14, -0.6, 0.05),
    "limbus_radius_mm": (0.18, 5.4, 6.3),
    "limbus_blend_mm": (0.1, 0.6, 1.1),
    "limbus_haze_mm": (0.12, 0.7, 1.3),
    "globe_radius_mm": (0.4, 11.2, 13.2),
    "iris_depth_mm": (0.25, 2.95, 3.9),
    "kappa_azimuth_deg": (1.33, 1.0, 9.0),
    "kappa_elevation_deg": (1.5, -4.5, 3.0),
    "roughness": (0.003, 0.008, 0.025),
    "albedo_sclera": (0.05, 0.3, 0.55),
    "albedo_iris": (0.03, 0.08, 0.22),
    "albedo_skin": (0.07, 0.35, 0.68),
    "lid_upper_deg": (3.0, 16.0, 30.0),
    "lid_lower_deg": (2.0, -32.0, -22.0),
    "canthus_deg": (2.5, 60.0, 72.0),
    "canthus_tilt_deg": (1.5, -1.0, 7.0),
    "lid_thickness_mm": (0.2, 1.1, 2.1),
    "brow_mm": (1.5, 5.0, 13.0),
    "nose_mm": (2.0, 11.0, 21.0),
    "cheek_mm": (1.2, 0.0, 6.0),
}
# Larger eyes have flatter, wider corneas and deeper chambers; lighter skin goes with a brighter sclera in
# this band.
_CORRELATED = {
    ("globe_radius_mm", "cornea_radius_mm"): 0.4,
    ("globe_radius_mm", "iris_depth_mm"): 0.45,
    ("globe_radius_mm", "limbus_radius_mm"): 0.35,
    ("cornea_radius_mm", "limbus_radius_mm"): 0.35,
    ("albedo_skin", "albedo_sclera"): 0.3,
    ("lid_upper_deg", "lid_lower_deg"): -0.3,
}
_SEAT_SD_MM = 1.0  # how differently a headset sits on different people, per axis


def nominal_person(lid_follow_gain=LID_FOLLOW_GAIN):
    """The person whose every number is the population's mean, wearing the headset centred."""
    return Person(lid_upper_follow=float(lid_follow_gain))


def draw_person(seed, lid_follow_gain=LID_FOLLOW_GAIN):
    """A person from a seed (a non-negative integer): the same seed is always the same person.

    lid_follow_gain    part of the gaze's elevation, 0..2, that the upper lid follows; nobody's draw depends
                       on it. SceneError when seed or gain is impossible.
    """
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise SceneError("a person's seed is a whole number, 0 or more, not %r" % (seed,), "for example 7")
    if not 0.0 <= lid_follow_gain <= 2.0:
        raise SceneError("the lids' gain is %r" % (lid_follow_gain,), "0 to 2; 0.9 is a person's")
    rng = np.random.default_rng([int(seed), 0x5A2E])
    names = list(_SPREAD)
    correlation = np.eye(len(names))
    for (a, b), value in _CORRELATED.items():
        i, j = names.index(a), names.index(b)
        correlation[i, j] = correlation[j, i] = value
    draw = np.linalg.cholesky(correlation) @ rng.standard_normal(len(names))
    nominal = nominal_person(lid_follow_gain)
    values = {"lid_upper_follow": nominal.lid_upper_follow}
    for name, z in zip(names, draw):
        sd, low, high = _SPREAD[name]
        values[name] = float(np.clip(getattr(nominal, name) + sd * z, low, high))
    # Lids lie on the cornea: their outer surface follows the globe's size.
    values["lid_radius_mm"] = nominal.lid_radius_mm + values["globe_radius_mm"] - nominal.globe_radius_mm
    seat = np.clip(rng.normal(0.0, _SEAT_SD_MM, 3), -2.5, 2.5)
    values["eye_position_mm"] = tuple(float(v) for v in seat)
    return Person(**values)


def read_toml(path):
    """Parse a TOML file; SceneError with the file's name when it is missing or malformed."""
    try:
        import tomllib
    except ImportError:  # Python < 3.11
        import tomli as tomllib
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            raise SceneError("%s is not a file" % path, "give the path of a TOML file")
        with open(path, "rb") as file:
            text = file.read(MOST_BYTES + 1)
        if len(text) > MOST_BYTES:
            raise SceneError("%s is larger than 1 MB" % path, "give the path of a TOML file")
        return tomllib.loads(text.decode())
    except OSError as error:
        raise SceneError(
            "%s: %s" % (path, error.strerror or "cannot be read"), "give the path of a TOML file"
        )
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError("%s: %s" % (path, error), "correct the file")


def load_person(path):
    """A person file: a [person] table with any of the fields of `Person`; what is not given is nominal."""
    table = read_toml(path).get("person")
    if not isinstance(table, dict):
        raise SceneError(
            "%s: has no [person] table" % path, "its keys are the fields of sparsegaze.person.Person"
        )
    known = {f.name for f in fields(Person)}
    values = {}
    for key, value in table.items():
        if key not in known:
            raise SceneError("%s: unknown key %s" % (path, key), "known keys: " + ", ".join(sorted(known)))
        parts = value if key == "eye_position_mm" else [value]
        ok = isinstance(parts, list) and len(parts) == (3 if key == "eye_position_mm" else 1)
        ok = ok and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in parts)
        if not ok or not np.isfinite(parts).all():
            raise SceneError("%s: %s is not a finite number" % (path, key), "correct the file")
        values[key] = tuple(map(float, parts)) if key == "eye_position_mm" else float(value)
    return Person(**values)
