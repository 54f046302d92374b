# SPDX-License-Identifier: Apache-2.0
"""Infrared light that reaches the eye, beside the limits of IEC 62471's exempt group.

    report = examine(load_headset("headsets/led2gaze.toml"))
    report.ok, report.irradiance_w_m2, report.margin

Two hazards. Cornea and lens, 780..3000 nm: irradiance at the cornea. Retina, seen with no visible light
beside it (a weak visual stimulus): radiance of what glows, weighted by R(wavelength), by the angle that it
fills. Both are looked at averaged over the longest exposure and for a single pulse, at the real distances,
in normal use, at the worst of every command and at the worst of every fault. The limits hold for any pupil.

A distance is from an emitter's lens to a point of the cornea, with the eye turned by up to GAZE_DEG and
anywhere within SEAT_MM of its nominal place, per axis. Irradiance is what a meter reads that is turned to
where it reads most.
"""

import itertools
from dataclasses import asdict, dataclass, field, replace
from typing import List

import numpy as np

from . import timing
from .errors import SceneError
from .person import nominal_person
from .timing import Timing

LONG_S = 1000.0  # longer exposures all have the same limit
CORNEA_LONG_W_M2 = 100.0
SEAT_MM = 3.0
GAZE_DEG = 25.0
ALPHA_LEAST, ALPHA_MOST = 0.011, 0.1  # angles of a source outside count as these, rad
DIE_MM = 0.3  # across the bare die of an LED: nothing that glows is smaller
SUPPLY_V, SUPPLY_MOST_V = 5.0, 5.25  # a Nano's 5 V pin: USB less a diode, or a regulator of 2 %
SUPPLY_FAULT_V = 5.5  # the most that the chip may have, and USB at its worst without the diode
FORWARD_V, PIN_OHM = 1.2, 25.0  # of an infrared LED at 20 mA; of a pin that drives

NORMAL, COMMAND, FAULT = "normal", "any command", "any fault"


@dataclass(frozen=True)
class Row:
    """One quantity beside its limit.

    case        NORMAL, COMMAND or FAULT        quantity   what it is, in words
    value, limit, unit                          detail     under which conditions
    margin      limit / value; inf where there is no light
    """

    case: str
    quantity: str
    value: float
    limit: float
    unit: str
    detail: str

    @property
    def margin(self):
        return self.limit / self.value if self.value > 0 else float("inf")

    @property
    def ok(self):
        return bool(self.value <= self.limit)


@dataclass(frozen=True)
class ExemptReport:
    """Every quantity of a headset; exempt when all are within their limits.

    rows                 Row each, normal use first
    assumed              sentences: what was taken for granted
    nearest_mm           from any emitter to a cornea: nominal, and at worst
    """

    rows: List[Row]
    assumed: List[str]
    nearest_mm: tuple
    headset: str = ""
    commands: dict = field(default_factory=dict)  # time-averaged irradiance by command, W/m^2

    @property
    def ok(self):
        return all(row.ok for row in self.rows)

    @property
    def worst(self):
        """The row with the least margin."""
        return min(self.rows, key=lambda row: row.margin)

    @property
    def margin(self):
        """Least of all rows: limit over value."""
        return self.worst.margin

    def of(self, case):
        """The row of the worst long-term irradiance at the cornea in that case."""
        found = [row for row in self.rows if row.case == case and row.quantity.startswith("cornea, average")]
        return max(found, key=lambda row: row.value)

    @property
    def irradiance_w_m2(self):
        """{case: time-averaged irradiance at the cornea}."""
        return {case: self.of(case).value for case in (NORMAL, COMMAND, FAULT)}

    def report(self):
        """Plain values for JSON."""
        rows = [
            dict(asdict(row), margin=row.margin if row.value > 0 else None, ok=row.ok) for row in self.rows
        ]
        return {
            "ok": self.ok,
            "margin": self.margin if self.worst.value > 0 else None,
            "irradiance_w_m2": self.irradiance_w_m2,
            "commands_w_m2": self.commands,
            "nearest_mm": list(self.nearest_mm),
            "rows": rows,
            "assumed": self.assumed,
        }


# limits ---------------------------------------------------------------------------------------------------


def cornea_limit(seconds):
    """Irradiance allowed at the cornea for an exposure of that length, W/m^2."""
    return CORNEA_LONG_W_M2 if seconds > LONG_S else 18000.0 * seconds**-0.75


def retina_limit(seconds, alpha_rad):
    """Weighted radiance allowed, W/m^2/sr, of a source of that angle that is not seen as light."""
    alpha = min(max(alpha_rad, ALPHA_LEAST), ALPHA_MOST)
    return 6000.0 / alpha if seconds > 10.0 else 50000.0 / (alpha * seconds**0.25)


def burn_hazard(wavelength_nm):
    """R of a wavelength from 700 nm on: how much of it counts as a burn of the retina."""
    if wavelength_nm <= 1050.0:
        return 10.0 ** ((700.0 - wavelength_nm) / 500.0)
    return 0.2 * 10.0 ** (0.02 * (1150.0 - min(max(wavelength_nm, 1150.0), 1200.0)))


# geometry -------------------------------------------------------------------------------------------------


def cornea_points(person, gaze_deg=GAZE_DEG):
    """Points of the cornea of a person, [n, 3], mm, headset frame, over all gazes up to that."""
    radius, edge = person.cornea_radius_mm, person.limbus_radius_mm
    centre = np.sqrt(person.globe_radius_mm**2 - edge**2) - np.sqrt(radius**2 - edge**2)
    out = np.linspace(0.0, np.arcsin(edge / radius), 8)
    turn = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    polar, around = (a.ravel() for a in np.meshgrid(out, turn, indexing="ij"))
    side = radius * np.sin(polar)
    cap = np.column_stack([side * np.cos(around), side * np.sin(around), -radius * np.cos(polar) - centre])
    angles = np.radians(np.linspace(-gaze_deg, gaze_deg, 5) if gaze_deg > 0 else [0.0])
    points = []
    for a, e in itertools.product(angles, angles):
        ca, sa, ce, se = np.cos(a), np.sin(a), np.cos(e), np.sin(e)
        up = np.array([[1, 0, 0], [0, ce, -se], [0, se, ce]])
        across = np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])
        points.append(cap @ (across @ up).T)
    return np.concatenate(points) + np.array(person.eye_position_mm)


def seats(reach_mm=SEAT_MM):
    """Where an eye may be off its place: [27, 3], mm."""
    return np.array(list(itertools.product((-reach_mm, 0.0, reach_mm), repeat=3)))


def irradiance(emitters, intensity_mw_sr, points_mm, on_axis):
    """What a meter at each point reads, turned to where it reads most, W/m^2, [n].

    emitters          Ports
    intensity_mw_sr   [m], on their axes; times duty for a time average
    on_axis           True: as if every beam's axis went through the point; False: beams as aimed
    """
    place, aim = np.array([p.position_mm for p in emitters]), np.array([p.aim for p in emitters])
    way = np.asarray(points_mm, float)[:, None] - place
    distance = np.linalg.norm(way, axis=-1)
    toward = way / distance[..., None]
    each = np.asarray(intensity_mw_sr) * 1e-3 / (distance * 1e-3) ** 2
    if not on_axis:
        cosine = (toward * aim).sum(-1)
        spread = np.tan(np.radians([p.sigma_deg for p in emitters]))
        with np.errstate(over="ignore", divide="ignore"):
            window = np.exp(-(1.0 / cosine**2 - 1.0) / (2 * spread**2))
        each = each * np.where(cosine > 0, window, 0.0)
    return np.linalg.norm((each[..., None] * toward).sum(-2), axis=-1)


# the report -----------------------------------------------------------------------------------------------


def currents_ma(headset, supply_v=SUPPLY_V):
    """Current of each lit emitter, mA, [m], from its resistor; as stated where the file does not say how it
    is wired.
    """
    kind, rail = headset.board.get("wiring"), headset.board.get("rail_volts", 0.0)
    across = max(supply_v - FORWARD_V - (rail if kind == "leds" else 0.0), 0.0)
    return np.array(
        [
            p.current_ma if kind is None or p.series_ohm is None else 1e3 * across / (p.series_ohm + PIN_OHM)
            for p in headset.emitters
        ]
    )


def intensities_mw_sr(headset, supply_v=SUPPLY_V):
    """On-axis intensity of each emitter at its current, mW/sr, [m]. SceneError when the file lacks it."""
    for port in headset.emitters:
        for key in ("intensity_mw_sr", "wavelength_nm"):
            if getattr(port, key) is None:
                raise SceneError(
                    "%s: %s has no %s" % (headset.name, port.name or "an emitter", key),
                    "look it up in its data sheet (the most of any part) and write it into the headset file",
                )
    stated = np.array([p.intensity_mw_sr for p in headset.emitters])
    rated = np.array([p.current_ma for p in headset.emitters])
    return stated * currents_ma(headset, supply_v) / np.where(rated > 0, rated, np.inf)


def examine(headset, person=None, default=Timing()):
    """The ExemptReport of a headset on a person (the nominal one), sensing as `default` in normal use.

    Raises SceneError when the file lacks what is needed.
    """
    person = person or nominal_person()
    normal_mw, most_mw = intensities_mw_sr(headset), intensities_mw_sr(headset, SUPPLY_MOST_V)
    points = cornea_points(person)
    near = (points[None] + seats()[:, None]).reshape(-1, 3)
    emitters, lit = headset.emitters, timing.lights(headset)
    place = np.array([p.position_mm for p in emitters])
    nearest = tuple(float(_distances(place, p).min()) for p in (points, near))

    def usual(weight):
        return float(irradiance(emitters, normal_mw * weight, points, False).max())

    def worst(weight, intensity=most_mw):
        return float(irradiance(emitters, intensity * weight, near, True).max())

    rows = []

    def cornea(case, name, value, seconds, detail):
        rows.append(Row(case, "cornea, " + name, value, cornea_limit(seconds), "W/m2", detail))

    def retina(case, name, milliwatts, duty, seconds, distances, smallest, detail):
        each = zip(emitters, milliwatts * duty, distances)
        found = [_radiance(p, mw, seconds, d, smallest) for p, mw, d in each]
        value, limit = max(found, key=lambda pair: pair[0] / pair[1])
        rows.append(Row(case, "retina, " + name, float(value), float(limit), "W/m2/sr", detail))

    always = 2 * LONG_S
    pulse_s, duty = default.lit_s(), default.emitter_duty(headset)
    distance, closest = (_distances(place, p).min(0) for p in (points, near))
    once = np.ones(len(emitters))
    detail = "%.0f frames a second, beams as aimed" % default.rate_hz
    cornea(NORMAL, "average", usual(duty), always, detail)
    cornea(NORMAL, "one pulse", max(usual(row) for row in lit), pulse_s, "%.0f us" % (1e6 * pulse_s))
    retina(NORMAL, "average", normal_mw, duty, always, distance, False, "the brightest emitter")
    retina(NORMAL, "one pulse", normal_mw, once, pulse_s, distance, False, "%.0f us" % (1e6 * pulse_s))

    commands = {name: worst(weight) for name, weight in _commands(headset)}
    name = max(commands, key=commands.get)
    slowest = Timing(timing.SLOT_CYCLES_MAX)
    pulse_s = slowest.lit_s(timing.LATE_CYCLES)
    most = max((weight for _, weight in _commands(headset)), key=lambda weight: weight.max())
    cornea(COMMAND, "average", commands[name], always, name)
    cornea(COMMAND, "one pulse", max(worst(row) for row in lit), pulse_s, "%.0f us" % (1e6 * pulse_s))
    retina(COMMAND, "average", most_mw, most, always, closest, True, "only the die of %.1f mm glows" % DIE_MM)
    retina(COMMAND, "one pulse", most_mw, once, pulse_s, closest, True, "%.0f us" % (1e6 * pulse_s))

    stuck_s = timing.WATCHDOG_MS * 1e-3 * (1 + timing.WATCHDOG_SPREAD)
    dark_s = timing.LOCKOUT_MS * 1e-3 * (1 - timing.CLOCK_SPREAD)
    share = stuck_s / (stuck_s + dark_s)
    both = 1e3 * stuck_s, 1e3 * (stuck_s + dark_s)
    again = "hangs, is reset, hangs again: all lit for %.0f of %.0f ms" % both
    cornea(FAULT, "average", worst(once * share), always, again)
    fault_mw = intensities_mw_sr(headset, SUPPLY_FAULT_V)
    shorted_mw = intensities_mw_sr(replace(headset, board={**headset.board, "rail_volts": 0.0}))
    high = max(worst(weight, fault_mw) for _, weight in _commands(headset))
    shorted = max(worst(weight, shorted_mw) for _, weight in _commands(headset))
    cornea(FAULT, "average, supply", high, always, "%s at %.2f V" % (name, SUPPLY_FAULT_V))
    cornea(FAULT, "one hang", worst(once), stuck_s, "all lit until the watchdog, %.0f ms" % (1e3 * stuck_s))
    retina(FAULT, "average", most_mw, once * share, always, closest, True, again)
    retina(FAULT, "one hang", most_mw, once, stuck_s, closest, True, "%.0f ms" % (1e3 * stuck_s))
    said = _assumptions(headset)
    if shorted > 1.01 * commands[name]:
        said.append(
            "parts are whole: with the rail shorted to ground it would be up to %.0f W/m2 (limit %.0f)"
            % (shorted, CORNEA_LONG_W_M2)
        )
    return ExemptReport(rows, said, nearest, headset.name, commands)


def _commands(headset):
    """(what was commanded, duty of each emitter at most [m]): whatever changes when lights are on."""
    late = timing.LATE_CYCLES
    shortest, longest = Timing(), Timing(timing.SLOT_CYCLES_MAX)
    yield "longest exposures, shortest slots", shortest.emitter_duty(headset, late)
    yield "longest exposures, longest slots", longest.emitter_duty(headset, late)
    for k, port in enumerate(headset.emitters):
        weight = np.zeros(len(headset.emitters))
        weight[k] = timing.PHASES * max(t.phase_duty(late) for t in (shortest, longest))
        yield "probe %s" % (port.name or k), weight


def _distances(place, points):
    return np.linalg.norm(points[:, None] - place, axis=-1)


def _radiance(port, milliwatts_sr, seconds, distance_mm, smallest):
    """(weighted radiance, its limit) of one emitter, seen from that far, W/m^2/sr."""
    across = port.source_diameter_mm or 2 * port.lens_radius_mm or DIE_MM
    across = min(across, DIE_MM) if smallest else across
    radiance = milliwatts_sr * 1e-3 / (np.pi / 4 * (across * 1e-3) ** 2)
    return burn_hazard(port.wavelength_nm) * radiance, retina_limit(seconds, across / distance_mm)


def _assumptions(headset):
    said = [
        "intensity_mw_sr is the most that any LED of the kind emits on its axis at current_ma",
        "normal: nominal eye, beams as aimed, %.2f V; else: eye within %g mm of its place per axis, turned "
        "by up to %g degrees, every beam's axis on the same point of the cornea, %.2f V at the board"
        % (SUPPLY_V, SEAT_MM, GAZE_DEG, SUPPLY_MOST_V),
        "a fault lights every emitter until the watchdog (%d ms, %d %% slow) resets; then %d ms of dark"
        % (timing.WATCHDOG_MS, round(100 * timing.WATCHDOG_SPREAD), timing.LOCKOUT_MS),
    ]
    if headset.board.get("wiring") is None or any(p.series_ohm is None for p in headset.emitters):
        said.append("emitters draw current_ma whatever the supply: the file does not say how they are wired")
    if not headset.phases:
        said.append("every emitter is lit in every phase: the file has no [[phase]]")
    return said
