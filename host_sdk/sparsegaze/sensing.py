# SPDX-License-Identifier: Apache-2.0
"""How the device senses: exposures, timing, what is on the pins, its channels' curves, single emitters."""

import math

from . import wire
from .errors import one_of
from .wire import Curve, Exposure, Probe, Settings, lib


STORE_S = 0.25                  # a record in EEPROM takes less than this
STORE_LIMIT_S = 1.0             # and is begun long before this, if it is: what is stored already is not again
EXPOSURE_REST_S = 2.2           # exposures are stored once they have rested for so long


def wait_stored(device, written, limit_s=STORE_LIMIT_S):
    """Wait until a device has stored its live state, at most limit_s.

    written   device.status().eeprom_writes from before the change. The device writes byte by byte beside its
              other work; a reset meanwhile (another program opens the port) would lose the change. Of a
              change to what is stored already it writes nothing: then limit_s passes.
    """
    link = device.link
    deadline = link.now() + limit_s
    while device.status().eeprom_writes == written and link.now() < deadline:
        link.sleep(0.02)
    link.sleep(STORE_S)     # the record counted may have been an earlier one, still under way


class Sensing:
    """The requests of a Device about its sensors. The device answers with what is in force afterwards."""

    def exposure(self, us=None, auto=None, limit_us=None):
        """Exposure: the exposures in force, rounded to 1/16 us and clipped to what timing and board allow.

        us         six exposures, us, to set and hold;  auto   True: adapt them, False: hold what there is
        limit_us   six exposures, us, that automatic exposure stays at or below
        Raises ValueError when a number does not fit.
        """
        if us is not None:
            return self._exposure(lib.SG_EXPOSURE_SET, us)
        if limit_us is not None:
            return self._exposure(lib.SG_EXPOSURE_LIMIT, limit_us)
        if auto is not None:
            return self._exposure(lib.SG_EXPOSURE_AUTO if auto else lib.SG_EXPOSURE_HOLD)
        return self._exposure(lib.SG_EXPOSURE_GET)

    def settings(self, rate_hz=None, repeats=None, wiring=None, power=None, rolling=None, lights=None):
        """Settings: how the device senses, and the rate that it can reach, after changing what is not None.

        rate_hz   frames a second, 0: as fast as can be; one above the limit is kept as a wish
        repeats   sensing cycles averaged into a frame
        wiring    "leds" or "photodiodes";  power   "normal" or "low"
        rolling   a gaze after every pair of sensors;  lights   False: off until set again
        Raises DeviceError when the device refuses the combination, ValueError when a number does not fit.
        """
        if rate_hz is not None and not 0 <= rate_hz <= 65535:
            raise ValueError(f"a rate is 0 to 65535 Hz, not {rate_hz}")
        wanted = {"rate_hz": rate_hz,
                  "repeats": _number_of(wire.REPEATS, repeats, "the number of cycles in a frame"),
                  "wiring": _number_of(wire.WIRINGS, wiring, "a wiring"),
                  "power": _number_of(wire.POWERS, power, "a power"),
                  "rolling": None if rolling is None else bool(rolling),
                  "lights": None if lights is None else bool(lights)}
        wanted = {name: int(value) for name, value in wanted.items() if value is not None}
        now = self._exchange.request(lib.SG_MSG_SETTINGS, wire.body("struct sg_settings"), Settings)
        if not wanted:
            return now
        # The answer's rate is the one wished for, whatever the limit: so it goes back as it came.
        fields = {name: getattr(now, name) for name in ("rate_hz", "repeats", "wiring", "power", "rolling",
                                                         "lights")}
        fields.update(wanted, op=lib.SG_SETTINGS_SET)
        return self._exchange.request(lib.SG_MSG_SETTINGS, wire.body("struct sg_settings", **fields),
                                      Settings)

    def settings_back(self, before):
        """Settings as they were: `before` is a Settings of this device. Returns Settings."""
        return self.settings(
            rate_hz=before.rate_hz, repeats=before.repeats, wiring=before.wiring_text,
            power=before.power_text, rolling=before.rolling, lights=before.lights)

    def curve(self, curve=None, zero_codes=None):
        """Curve: each channel's curvature, charge = code (1 + curve code / 1024), and the converter's zero.

        curve        six numbers of -0.125 to 0.124 to store, rounded to 1/1024; None: leave them
        zero_codes   -32 to 0, rounded to 1/4: what the converter would read at 0 V; None: leave it
        Raises ValueError when one does not fit.
        """
        now = self._exchange.request(lib.SG_MSG_CURVE, wire.body("struct sg_curve"), Curve)
        if curve is None and zero_codes is None:
            return now
        steps = now.curve_q10 if curve is None else _rounded(1024, curve)
        zero, = (now.zero_q2,) if zero_codes is None else _rounded(4, [zero_codes])
        if len(steps) != lib.SG_WIRE_CHANNELS or min(steps) < -128 or max(steps) > 127:
            raise ValueError(f"curves are {lib.SG_WIRE_CHANNELS} numbers of -0.125 to 0.124")
        if not -128 <= zero <= 0:
            raise ValueError(f"a converter's zero is -32 to 0 codes, not {zero_codes}")
        body = wire.body("struct sg_curve", op=lib.SG_SETTINGS_SET, curve_q10=list(steps), zero_q2=zero)
        return self._exchange.request(lib.SG_MSG_CURVE, body, Curve)

    def probe(self, emitter):
        """Probe: what every sensor receives with one emitter (0..5) alone lit. ValueError for another."""
        one_of(range(lib.SG_WIRE_CHANNELS), emitter, "an emitter")
        return self._exchange.request(lib.SG_MSG_PROBE, wire.body("struct sg_mode", mode=emitter), Probe)

    def _exposure(self, op, us=(0.0,) * lib.SG_WIRE_CHANNELS):
        steps = _rounded(wire.EXPOSURE_STEPS_US, us)
        if len(steps) != lib.SG_WIRE_CHANNELS or min(steps) < 0 or max(steps) > 65535:
            most = 65535 // wire.EXPOSURE_STEPS_US
            raise ValueError(f"exposures are {lib.SG_WIRE_CHANNELS} values of 0..{most} us")
        body = wire.body("struct sg_exposure", op=op, exposure_us_q4=steps)
        return self._exchange.request(lib.SG_MSG_EXPOSURE, body, Exposure)


def _number_of(names, value, what):
    """The number on the wire of one of the names; None of None. Raises ValueError."""
    if value is None:
        return None
    one_of(names, value, what)
    return names[value] if isinstance(names, dict) else value


def _rounded(steps, values):
    """Whole steps of each of the values. Raises ValueError of what is not finite."""
    if not all(math.isfinite(value) for value in values):
        raise ValueError("a number is not finite")
    return [int(round(steps * value)) for value in values]
