# SPDX-License-Identifier: Apache-2.0
"""Is a board well: what it says of itself, as the lines of an examination."""

from . import faults
from .doctor import Check
from .errors import SparsegazeError

SETTLE_S = 1.5  # after a reset: exposures find their level, faults show,
LOOK_CYCLES, SETTLE_MOST_S = 260, 6.0  # the last of six sensors after so many sensing cycles
LOOK_S = 0.3
MANY = 3  # sensors at fault together have a common cause
WRONG_READINGS = 1.0  # of the six in a frame that are too dark, or full
# Opening the port restarts most boards, and the firmware compares the supply with what it was at its start.
SUPPLY_VOLTS = (4.5, 5.5)
LATE_SHARE = 0.02  # of all frames: more of them late is worth a word


def examine(port):
    """The checks of the board behind `port`, a list of doctor.Check; what is wrong is among them."""
    from .device import Device

    try:
        with Device(port) as device:
            settle(device)
            before = device.status()
            device.link.sleep(LOOK_S)
            return checks_of(device, port, before)
    except SparsegazeError as error:
        return [Check("board", False, error.message, error.remedy)]


def settle(device):
    """Wait until an open device, maybe just reset, has found its exposures and looked at every sensor."""
    now = device.settings()
    looked_s = LOOK_CYCLES * now.frame_period_us * 1e-6 / max(now.cycles_a_frame, 1)
    device.link.sleep(min(max(SETTLE_S, looked_s), SETTLE_MOST_S))


def checks_of(device, port, before):
    """The checks of an open device; before: its Status of a moment ago."""
    from .wire import lib

    hello, status, settings, info = device.hello, device.status(), device.settings(), device.model_info()
    found = faults.of(status, port)
    checks = [Check("board", True, f"{hello.board_text}, firmware {hello.firmware_text}")]
    checks.append(_supply(status, found))
    dark = [fault for fault in found if fault.name in faults.BOARD]
    checks += [Check("lights", False, fault.text, fault.remedy) for fault in dark]
    channels = [fault for fault in found if fault.channel is not None]
    checks += [Check(f"pin A{fault.channel}", False, fault.text, fault.remedy) for fault in channels]
    if len(channels) >= MANY:
        other = "photodiodes" if settings.wiring_text == "leds" else "leds"
        remedy = f"the rail, if so many are at fault; or sparsegaze settings {port} --wiring {other}"
        checks.append(Check("wiring", None, f"set to {settings.wiring_text}", remedy))
    if not channels and not dark:
        checks.append(_sensors(status, before, settings, port))
    if info.active == lib.SG_SLOT_NONE:
        checks.append(Check("model", None, "none", f"sparsegaze calibrate {port}"))
    else:
        checks.append(Check("model", True, f"{info.vectors[info.active]} vectors"))
    held = faults.held(device.exposure(), port)
    checks += [Check("exposures", None, *held)] if held else []
    checks.append(_rate(status, settings, port))
    bad = status.rx_bad + status.rx_overrun
    checks.append(
        Check("line", None, f"{bad} damaged requests", "use a shorter USB cable, or --baud 500000")
        if bad
        else Check("line", True, "no damaged request")
    )
    if status.reset_cause & (lib.SG_RESET_BROWNOUT | lib.SG_RESET_WATCHDOG):
        weak = status.reset_cause & lib.SG_RESET_BROWNOUT
        remedy = "use another USB port" if weak else f"sparsegaze flash {port}"
        checks.append(Check("last start", None, f"by {status.reset_text}", remedy))
    return checks


def _sensors(status, before, settings, port):
    """Too dark or too bright now, which is no part's fault: nothing before the headset, or other wiring."""
    frames = max(status.frames - before.frames, 1)
    starved, full = (
        (getattr(status, name) - getattr(before, name)) / frames for name in ("starved", "saturated")
    )
    if starved < WRONG_READINGS and full < WRONG_READINGS:
        return Check("sensors", True, "all six read")
    if starved >= full:
        return Check(
            "sensors",
            None,
            f"hardly any light comes back to {min(starved, 6):.0f} of six",
            f"put the headset on, or white paper before it; it is set to {settings.wiring_text}: "
            f"if that is wrong, sparsegaze settings {port} --wiring",
        )
    return Check(
        "sensors", None, f"too much light for {min(full, 6):.0f} of six", "shade the headset from the sun"
    )


def _rate(status, settings, port):
    """Requests, those of the start and of this examination too, make a few frames late."""
    from .wire import lib

    rate = f"{settings.frame_hz:.1f} Hz of at most {settings.most_hz}"
    said = f"frames: {status.late_frames} late, {status.tx_dropped} not sent; "
    said += f"readings: {status.late_slots} late"
    late = status.late_frames > max(10, LATE_SHARE * status.frames)
    slower = max(lib.SG_WIRE_RATE_LEAST_HZ, settings.most_hz * 9 // 10)
    if late or status.late_slots or status.tx_dropped:
        return Check("rate", None, f"{rate}; {said}", f"sparsegaze settings {port} --rate {slower}")
    rate += f"; {said}" if status.late_frames else ", nothing late"
    if 0 < settings.rate_hz < slower:
        remedy = f"if that is not what you want: sparsegaze settings {port} --rate max"
        return Check("rate", None, f"{rate}; set to {settings.rate_hz}", remedy)
    return Check("rate", True, rate)


def _supply(status, found):
    for fault in found:
        if fault.name == "supply":
            return Check("supply", False, fault.text, fault.remedy)
    if status.supply_volts is None:
        return Check("supply", None, "not measured", "wire the divider to A7; only to watch the voltage")
    volts = status.supply_volts
    if not SUPPLY_VOLTS[0] <= volts <= SUPPLY_VOLTS[1]:
        remedy = "measure it; use another USB port or a shorter cable, without a hub"
        return Check("supply", None, f"{volts:.2f} V, give or take 10 %, where 5 V are expected", remedy)
    return Check("supply", True, f"{volts:.2f} V, give or take 10 %")
