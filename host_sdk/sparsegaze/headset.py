# SPDX-License-Identifier: Apache-2.0
"""A headset as data: where its sensors and emitters are, how they look, and how they are wired.

Frame: OpenXR's axes (+x right, +y up, -z forward), millimetres, origin at the centre of rotation of a
nominal right eye
(+x is temporal); its corneal apex is near z = -13. A headset file (TOML) has any number of

    [[led]]        senses and emits with the same lens     [[sensor]], [[emitter]]    one of the two

each with position_mm = [x, y, z], aim_mm = [x, y, z] (the point it looks at), lens_radius_mm, and
sensitivity_sigma_deg (sensors) or beam_sigma_deg (emitters; for an led the same unless given): the standard
deviation
of a Gaussian in the tangent of the angle off its axis. Emitters also have current_ma. Other keys (pins,
part) are kept.
"""

import os
from dataclasses import dataclass, field
from typing import Dict, Tuple

import numpy as np

from .errors import SceneError
from .person import read_toml

_REMEDY = "see headsets/led2gaze.toml for a complete example"


@dataclass(frozen=True)
class Port:
    """One sensor or one emitter."""

    position_mm: Tuple[float, float, float]  # of the lens's centre, mm, headset frame
    aim: Tuple[float, float, float]  # unit vector along its axis, headset frame, no unit
    sigma_deg: float  # response or beam exp(-tan^2(angle) / (2 tan^2 sigma)), 0.5..85 degrees
    lens_radius_mm: float  # of the part of the lens that glows or collects, mm; 0 = a point
    current_ma: float = 20.0  # an emitter's, mA; the simulator's response is per unit intensity


@dataclass(frozen=True)
class Headset:
    """Sensors and emitters in file order.

    board    the file's [board] table: what drives it, no units
    wiring   each entry's other keys by entry name (pins as text, *_ohm in ohm, *_deg, *_mm, *_ma as named)
    """

    name: str
    sensors: Tuple[Port, ...]
    emitters: Tuple[Port, ...]
    board: Dict[str, object] = field(default_factory=dict, compare=False)
    wiring: Dict[str, Dict[str, object]] = field(default_factory=dict, compare=False)

    def describe(self):
        """Everything optical as nested tuples of numbers: what a cached map depends on."""
        return tuple(
            (p.position_mm, p.aim, p.sigma_deg, p.lens_radius_mm) for p in self.sensors + self.emitters
        ) + (len(self.sensors), len(self.emitters))


def _number(entry, key, where, low, high, default=None):
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SceneError("%s: %s is missing or not a number" % (where, key), _REMEDY)
    if not low <= value <= high:
        raise SceneError("%s: %s = %g is not in %g..%g" % (where, key, value, low, high), _REMEDY)
    return float(value)


def _vector(entry, key, where):
    value = entry.get(key)
    ok = isinstance(value, list) and len(value) == 3
    ok = ok and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
    if not ok or not np.isfinite(value).all():
        raise SceneError("%s: %s must be three finite numbers, millimetres" % (where, key), _REMEDY)
    if np.abs(value).max() > 1e4:
        raise SceneError("%s: %s is more than 10 m away" % (where, key), _REMEDY)
    return tuple(float(v) for v in value)


def _port(entry, where, sigma_key):
    position, aim = _vector(entry, "position_mm", where), _vector(entry, "aim_mm", where)
    direction = np.subtract(aim, position)
    length = float(np.linalg.norm(direction))
    if not length > 1e-6:
        raise SceneError("%s: aim_mm is where it stands" % where, _REMEDY)
    sigma = _number(entry, sigma_key, where, 0.5, 85.0, entry.get("sensitivity_sigma_deg"))
    return Port(
        position,
        tuple(float(v) for v in direction / length),
        sigma,
        _number(entry, "lens_radius_mm", where, 0.0, 20.0),
        _number(entry, "current_ma", where, 0.0, 200.0, 20.0),
    )


def load_headset(path):
    """Read a headset file. Raises SceneError, with the entry and key at fault, when it is not a possible
    headset.
    """
    name, data = os.path.basename(str(path)), read_toml(path)
    sensors, emitters, wiring = [], [], {}
    for kind in ("led", "sensor", "emitter"):
        entries = data.get(kind, [])
        if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
            raise SceneError("%s: %s must be written [[%s]]" % (name, kind, kind), _REMEDY)
        for number, entry in enumerate(entries):
            where = "%s: %s %d" % (name, kind, number)
            if kind != "emitter":
                sensors.append(_port(entry, where, "sensitivity_sigma_deg"))
            if kind != "sensor":
                emitters.append(_port(entry, where, "beam_sigma_deg"))
            wiring[str(entry.get("name", "%s%d" % (kind, number)))] = {
                k: v for k, v in entry.items() if k not in ("position_mm", "aim_mm", "name")
            }
    if not 1 <= len(sensors) <= 32 or not 1 <= len(emitters) <= 32:
        raise SceneError(
            "%s: has %d sensors and %d emitters, wants 1..32 of each" % (name, len(sensors), len(emitters)),
            _REMEDY,
        )
    board = data.get("board", {})
    return Headset(str(data.get("name", name)), tuple(sensors), tuple(emitters), dict(board), wiring)
