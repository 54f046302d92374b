# SPDX-License-Identifier: Apache-2.0
"""What a device says is wrong with its channels and its board, in words, each with what to do about it."""

from typing import NamedTuple

from .errors import CalibrationError

CHANNEL = {
    "open": (
        "is open, or fully covered: it gives no current at all, lit or not",
        "uncover it; if that is not it, check its two solder joints and the wire to {pin}",
    ),
    "short": (
        "is shorted: full at once, lit or not",
        "look for a solder bridge at {pin}, and whether the part is the wrong way round",
    ),
    "low": (
        "gets far less light than in the calibration: covered, or what lights it is dead",
        "uncover and wipe it; `sparsegaze probe {port}` finds a dead one",
    ),
    "high": (
        "gets far more light than in the calibration: something lies close before it",
        "take it away (a finger, hair, a cloth); if the headset sits differently now, calibrate again",
    ),
}
BOARD = {
    "lockout": (
        "the lights are held off: the watchdog had to restart the firmware",
        "wait a second; if it happens again, run `sparsegaze flash {port}`",
    ),
    "lights-off": (
        "the lights are off by command",
        "switch them on: `sparsegaze settings {port} --lights on`",
    ),
}
_CAUSE = {"low": "open", "high": "short"}


class Fault(NamedTuple):
    """One thing that is wrong.

    channel   0..5, or None: the board
    name      value of wire.FAULT_NAMES or wire.ALARM_NAMES;  text, remedy: one line each
    """

    channel: int
    name: str
    text: str
    remedy: str


def of(status, port="PORT"):
    """The Faults that a wire.Status holds; the board's first."""
    found = []
    for name in status.alarms:
        text, remedy = _supply(status) if name == "supply" else BOARD[name]
        found.append(Fault(None, name, text, remedy.format(port=port)))
    for channel, names in enumerate(status.faults):
        # Nothing at all is also far less than in the calibration, and full at once far more.
        for name in [n for n in names if _CAUSE.get(n) not in names]:
            text, remedy = CHANNEL[name]
            remedy = remedy.format(port=port, pin=f"A{channel}")
            found.append(Fault(channel, name, f"sensor {channel} {text}", remedy))
    return found


def _supply(status):
    remedy = "use another USB port or a shorter cable, without a hub"
    volts = status.supply_volts
    if volts is None:
        return (
            "the supply voltage, measured before, is outside of 3.5 to 6.3 V now, or its wire to A7 is off",
            f"check the divider at A7; {remedy}",
        )
    return f"the supply voltage, {volts:.2f} V, is more than 4 % off what it was at the start", remedy


def refuse(device):
    """Raise CalibrationError if a fault of an open device makes measuring pointless: dead part, no light."""
    port = getattr(device, "port", "PORT")
    for fault in of(device.status(), port):
        # Low and high compare with a calibration, which may be somebody else's; the supply is regulated.
        if fault.name not in ("low", "high", "supply"):
            raise CalibrationError(fault.text, fault.remedy)


def refuse_board(device):
    """Raise CalibrationError if the lights of an open device are out."""
    for fault in of(device.status(), getattr(device, "port", "PORT")):
        if fault.name in BOARD:
            raise CalibrationError(fault.text, fault.remedy)


def held(exposure, port="PORT"):
    """(text, remedy) if exposures (wire.Exposure) are held, else None: no fault, but no light is followed."""
    if exposure.automatic:
        return None
    return "held: they do not follow the light", f"sparsegaze exposure {port} --auto"


def lines(found):
    """Two lines of text for each Fault."""
    return [line for fault in found for line in (fault.text, f"  -> {fault.remedy}")]
