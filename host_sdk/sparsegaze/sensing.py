# SPDX-License-Identifier: Apache-2.0
"""How the device senses: exposures, timing, what is on the pins, its channels' curves, single emitters."""

from . import wire
from .wire import Curve, Exposure, Probe, Settings, lib


STORE_S = 0.25                  # a record in EEPROM takes less than this
STORE_LIMIT_S = 4.0
EXPOSURE_REST_S = 2.2           # exposures are stored once they have rested for so long


def wait_stored(device, written, limit_s=STORE_LIMIT_S):
    """Wait until a device has stored its live state, at most limit_s.

    written   device.status().eeprom_writes from before the change. The device writes byte by byte beside its
              other work; a reset meanwhile (another program opens the port) would lose the change.
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

        rate_hz   frames a second, 0: as fast as can be;  repeats   sensing cycles averaged into a frame
        wiring    "leds" or "photodiodes";  power   "normal" or "low"
        rolling   a gaze after every pair of sensors;  lights   False: off until set again
        Raises DeviceError when the device refuses the combination, ValueError when a number does not fit.
        """
        now = self._exchange.request(lib.SG_MSG_SETTINGS, wire.body("struct sg_settings"), Settings)
        wanted = {"rate_hz": rate_hz, "repeats": repeats,
                  "wiring": None if wiring is None else wire.WIRINGS[wiring],
                  "power": None if power is None else wire.POWERS[power],
                  "rolling": None if rolling is None else int(bool(rolling)),
                  "lights": None if lights is None else int(bool(lights))}
        wanted = {name: int(value) for name, value in wanted.items() if value is not None}
        if not wanted:
            return now
        if not 0 <= wanted.get("rate_hz", 0) <= 65535:
            raise ValueError(f"a rate is 0 to 65535 Hz, not {rate_hz}")
        if wanted.get("repeats", 1) not in wire.REPEATS:
            raise ValueError(f"a frame averages 1, 2, 4, 8 or 16 cycles, not {repeats}")
        fields = {name: getattr(now, name) for name in ("rate_hz", "repeats", "wiring", "power", "rolling",
                                                         "lights")}
        if now.rate_hz >= now.rate_limit_hz:
            fields["rate_hz"] = 0       # as fast as could be: so it stays when the limit moves
        fields.update(wanted, op=lib.SG_SETTINGS_SET)
        return self._exchange.request(lib.SG_MSG_SETTINGS, wire.body("struct sg_settings", **fields),
                                      Settings)

    def settings_back(self, before):
        """Settings as they were: `before` is a Settings of this device. Returns Settings."""
        return self.settings(
            rate_hz=0 if before.rate_hz >= before.rate_limit_hz else before.rate_hz, repeats=before.repeats,
            wiring=before.wiring_text, power=before.power_text, rolling=before.rolling, lights=before.lights)

    def curve(self, curve=None, zero_codes=None):
        """Curve: each channel's curvature, charge = code (1 + curve code / 1024), and the converter's zero.

        curve        six numbers of -0.125 to 0.124 to store, rounded to 1/1024; None: leave them
        zero_codes   -32 to 0, rounded to 1/4: what the converter would read at 0 V; None: leave it
        Raises ValueError when one does not fit.
        """
        now = self._exchange.request(lib.SG_MSG_CURVE, wire.body("struct sg_curve"), Curve)
        if curve is None and zero_codes is None:
            return now
        steps = now.curve_q10 if curve is None else [int(round(1024 * value)) for value in curve]
        zero = now.zero_q2 if zero_codes is None else int(round(4 * zero_codes))
        if len(steps) != lib.SG_WIRE_CHANNELS or min(steps) < -128 or max(steps) > 127:
            raise ValueError(f"curves are {lib.SG_WIRE_CHANNELS} numbers of -0.125 to 0.124")
        if not -128 <= zero <= 0:
            raise ValueError(f"a converter's zero is -32 to 0 codes, not {zero_codes}")
        body = wire.body("struct sg_curve", op=lib.SG_SETTINGS_SET, curve_q10=list(steps), zero_q2=zero)
        return self._exchange.request(lib.SG_MSG_CURVE, body, Curve)

    def probe(self, emitter):
        """Probe: what every sensor receives with one emitter (0..5) alone lit."""
        return self._exchange.request(lib.SG_MSG_PROBE, wire.body("struct sg_mode", mode=emitter), Probe)

    def _exposure(self, op, us=(0.0,) * lib.SG_WIRE_CHANNELS):
        steps = [int(round(wire.EXPOSURE_STEPS_US * value)) for value in us]
        if len(steps) != lib.SG_WIRE_CHANNELS or min(steps) < 0 or max(steps) > 65535:
            most = 65535 // wire.EXPOSURE_STEPS_US
            raise ValueError(f"exposures are {lib.SG_WIRE_CHANNELS} values of 0..{most} us")
        body = wire.body("struct sg_exposure", op=op, exposure_us_q4=steps)
        return self._exchange.request(lib.SG_MSG_EXPOSURE, body, Exposure)
