# SPDX-License-Identifier: Apache-2.0
"""A headset as data: where its sensors and emitters are, how they look, how they are wired, and who is lit
while whom senses.

Frame: OpenXR's axes (+x right, +y up, -z forward), millimetres, origin at the centre of rotation of a
nominal right eye (+x is temporal); its corneal apex is near z = -13. A headset file (TOML) has any number of

    [[led]]        senses and emits with the same lens     [[sensor]], [[emitter]]    one of the two

each with position_mm = [x, y, z], aim_mm = [x, y, z] (the point it looks at), lens_radius_mm, and
sensitivity_sigma_deg (sensors) or beam_sigma_deg (emitters; for an led the same unless given): the standard
deviation of a Gaussian in the tangent of the angle off its axis. Emitters also have current_ma and, for eye
safety, intensity_mw_sr at that current, wavelength_nm and source_diameter_mm. What is wired to a board has a
`pin` (see wiring.py), and [board] says how.

[[phase]] names who senses at the same time, and who lights meanwhile, in the order of a sensing cycle:

    [[phase]]
    sense = ["led5", "led0"]
    light = ["led1", "led2", "led3", "led4"]

Without [[phase]] every sensor is lit by all emitters that stand elsewhere.
"""

import os
from dataclasses import dataclass, field
from typing import Dict, Optional, Tuple

import numpy as np

from .errors import SceneError
from .person import read_toml
from .wiring import check_wiring

_REMEDY = "see headsets/led2gaze.toml for a complete example"
MOST_LIT = 4  # emitters at a time: the quiet rail sinks no more, and pins of one port deliver no more

_KINDS = ("led", "sensor", "emitter")
_ANYONES = ("name", "position_mm", "aim_mm", "lens_radius_mm", "pin", "part")
_EMITTERS = (
    "beam_sigma_deg",
    "current_ma",
    "series_ohm",
    "intensity_mw_sr",
    "wavelength_nm",
    "source_diameter_mm",
)
_KEYS = {
    "led": _ANYONES + ("sensitivity_sigma_deg",) + _EMITTERS,
    "sensor": _ANYONES + ("sensitivity_sigma_deg",),
    "emitter": _ANYONES + _EMITTERS,
    "phase": ("sense", "light"),
    "board": ("mcu", "model", "wiring", "rail_volts", "rail_ohm", "rail_noise_mv", "supply_pin"),
    "file": ("name", "board", "phase") + _KINDS,
}
_GONE = {
    key: 'every LED is on one pin now: pin = "A0", its cathode on the rail of [board]'
    for key in ("anode_pin", "cathode_pin")
}


@dataclass(frozen=True)
class Port:
    """One sensor or one emitter. What the simulator sees comes first; the rest does not change a map."""

    position_mm: Tuple[float, float, float]  # of the lens's centre, mm, headset frame
    aim: Tuple[float, float, float]  # unit vector along its axis, headset frame, no unit
    sigma_deg: float  # response or beam exp(-tan^2(angle) / (2 tan^2 sigma)), 0.5..85 degrees
    lens_radius_mm: float  # of the part of the lens that glows or collects, mm; 0 = a point
    current_ma: float = 20.0  # an emitter's, mA; the simulator's response is per unit intensity
    name: str = ""
    pin: Optional[str] = None  # "A0"; None: not said
    series_ohm: Optional[float] = None  # resistor of an emitter, ohm
    intensity_mw_sr: Optional[float] = None  # on an emitter's axis at current_ma, the most of any part
    wavelength_nm: Optional[float] = None
    source_diameter_mm: Optional[float] = None  # what glows, as seen from the eye, mm


@dataclass(frozen=True)
class Phase:
    """One part of a sensing cycle: indices of the sensors that sense, in order, and of the emitters lit."""

    sense: Tuple[int, ...]
    light: Tuple[int, ...]


@dataclass(frozen=True)
class Headset:
    """Sensors and emitters in file order.

    board    the file's [board] table: what drives it and how it is wired; volts, ohm, mV as named
    wiring   each entry's other keys by entry name (pins as text, *_ohm in ohm, *_deg, *_mm, *_ma as named)
    phases   of a sensing cycle, in order; empty: see lit_pairs()
    """

    name: str
    sensors: Tuple[Port, ...]
    emitters: Tuple[Port, ...]
    board: Dict[str, object] = field(default_factory=dict, compare=False)
    wiring: Dict[str, Dict[str, object]] = field(default_factory=dict, compare=False)
    phases: Tuple[Phase, ...] = ()

    def describe(self):
        """Everything optical as nested tuples of numbers: what a cached map depends on."""
        return tuple(
            (p.position_mm, p.aim, p.sigma_deg, p.lens_radius_mm) for p in self.sensors + self.emitters
        ) + (len(self.sensors), len(self.emitters))

    @property
    def lit(self):
        """bool [sensor, emitter]: who is lit while a sensor senses."""
        sensors, emitters = ([p.position_mm for p in ports] for ports in (self.sensors, self.emitters))
        return lit_pairs(sensors, emitters, [(phase.sense, phase.light) for phase in self.phases])

    def collect(self, response):
        """What each sensor collects, [..., sensor]: response [..., sensor, emitter] summed over the lit."""
        return np.where(self.lit, response, 0.0).sum(-1)


def lit_pairs(sensors_mm, emitters_mm, phases=()):
    """bool [sensor, emitter]: who is lit while a sensor senses.

    sensors_mm, emitters_mm   positions [n][3], [m][3]
    phases                    (indices that sense, indices that are lit) of each; none: whoever stands
                              elsewhere, or everybody, where nobody does
    """
    if len(phases):
        lit = np.zeros((len(sensors_mm), len(emitters_mm)), bool)
        for sense, light in phases:
            lit[np.ix_(list(sense), list(light))] = True
        return lit
    lit = (np.asarray(sensors_mm, float)[:, None] != np.asarray(emitters_mm, float)[None]).any(-1)
    lit[~lit.any(1)] = True
    return lit


def lit_of(data):
    """lit_pairs() of a headset as plain data (dataclasses.asdict, or JSON of it). AttributeError, IndexError,
    KeyError, TypeError or ValueError when it is none.
    """
    places = ([port["position_mm"] for port in data[kind]] for kind in ("sensors", "emitters"))
    return lit_pairs(*places, [(phase["sense"], phase["light"]) for phase in data.get("phases", ())])


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


def _text(entry, key, where):
    value = entry.get(key)
    if value is not None and not isinstance(value, str):
        raise SceneError("%s: %s is not text" % (where, key), 'put it in quotes: %s = "..."' % key)
    return value


def _known(entry, kind, where):
    """SceneError when a table has a key that it cannot have: nobody would read it."""
    for key in entry:
        if key in _GONE:
            raise SceneError("%s: %s is gone" % (where, key), _GONE[key])
        if key not in _KEYS[kind]:
            raise SceneError(
                "%s: there is no key %s" % (where, key), "it can have " + ", ".join(_KEYS[kind])
            )


def _port(entry, where, name, sigma_key):
    position, aim = _vector(entry, "position_mm", where), _vector(entry, "aim_mm", where)
    direction = np.subtract(aim, position)
    length = float(np.linalg.norm(direction))
    if not length > 1e-6:
        raise SceneError("%s: aim_mm is where it stands" % where, _REMEDY)
    sigma = _number(entry, sigma_key, where, 0.5, 85.0, entry.get("sensitivity_sigma_deg"))

    def known(key, low, high):
        return _number(entry, key, where, low, high) if key in entry else None

    return Port(
        position,
        tuple(float(v) for v in direction / length),
        sigma,
        _number(entry, "lens_radius_mm", where, 0.0, 20.0),
        _number(entry, "current_ma", where, 0.0, 200.0, 20.0),
        name,
        _text(entry, "pin", where),
        known("series_ohm", 0.0, 1e6),
        known("intensity_mw_sr", 0.0, 1e4),
        known("wavelength_nm", 780.0, 1400.0),
        known("source_diameter_mm", 0.05, 40.0),
    )


def _tables(data, kind, file):
    """Entries written [[kind]]."""
    entries = data.get(kind, [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise SceneError("%s: %s must be written [[%s]]" % (file, kind, kind), _REMEDY)
    return entries


def _phases(data, file, sensors, emitters):
    """Phases as the file names them. SceneError unless every sensor senses once, in the dark itself."""
    phases, sensed = [], {}
    indices = [{port.name: k for k, port in enumerate(ports)} for ports in (sensors, emitters)]
    for number, entry in enumerate(_tables(data, "phase", file)):
        where = "%s: phase %d" % (file, number)
        _known(entry, "phase", where)
        lists = []
        for key, what, index in zip(("sense", "light"), ("sensor", "emitter"), indices):
            names = entry.get(key)
            if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
                raise SceneError("%s: %s is not a list of names" % (where, key), _REMEDY)
            for name in names:
                if name not in index:
                    known = "name one of " + ", ".join(index)
                    raise SceneError("%s: there is no %s %s" % (where, what, name), known)
            twice = [name for k, name in enumerate(names) if name in names[:k]]
            if twice:
                raise SceneError("%s: %s names %s twice" % (where, key, twice[0]), "name it once")
            lists.append(names)
        sense, light = lists
        for name in sense:
            if name in light:
                raise SceneError(
                    "%s: %s is lit while it senses" % (where, name), "leave it out of light or of sense"
                )
            if name in sensed:
                raise SceneError(
                    "%s: %s senses already in phase %d" % (where, name, sensed[name]),
                    "each senses once a cycle",
                )
            sensed[name] = number
        if len(light) > MOST_LIT:
            raise SceneError(
                "%s: %d emitters are lit at once" % (where, len(light)),
                "%d are the most that rail and pins can carry" % MOST_LIT,
            )
        phases.append(Phase(tuple(indices[0][n] for n in sense), tuple(indices[1][n] for n in light)))
    idle = [port.name for port in sensors if port.name not in sensed]
    if phases and idle:
        raise SceneError("%s: %s senses in no phase" % (file, idle[0]), "name every sensor in one [[phase]]")
    return tuple(phases)


def load_headset(path):
    """Read a headset file. Raises SceneError, with the entry and key at fault, when it is not a possible
    headset.
    """
    file, data = os.path.basename(str(path)), read_toml(path)
    _known(data, "file", file)
    sensors, emitters, wiring = [], [], {}
    for kind in _KINDS:
        for number, entry in enumerate(_tables(data, kind, file)):
            where = "%s: %s %d" % (file, kind, number)
            _known(entry, kind, where)
            name = _text(entry, "name", where) or "%s%d" % (kind, number)
            if name in wiring:
                raise SceneError("%s: there is a %s already" % (where, name), "give every entry its own name")
            if kind != "emitter":
                sensors.append(_port(entry, where, name, "sensitivity_sigma_deg"))
            if kind != "sensor":
                emitters.append(_port(entry, where, name, "beam_sigma_deg"))
            wiring[name] = {k: v for k, v in entry.items() if k not in ("position_mm", "aim_mm", "name")}
    if not 1 <= len(sensors) <= 32 or not 1 <= len(emitters) <= 32:
        raise SceneError(
            "%s: has %d sensors and %d emitters, wants 1..32 of each" % (file, len(sensors), len(emitters)),
            _REMEDY,
        )
    board = data.get("board", {})
    if not isinstance(board, dict):
        raise SceneError("%s: board must be written [board]" % file, _REMEDY)
    _known(board, "board", file + ": board")
    phases = _phases(data, file, sensors, emitters)
    made = Headset(
        _text(data, "name", file) or file, tuple(sensors), tuple(emitters), dict(board), wiring, phases
    )
    check_wiring(made, file)
    return made
