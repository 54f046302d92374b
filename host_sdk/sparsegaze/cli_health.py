# SPDX-License-Identifier: Apache-2.0
"""Commands about the health of a board: status, linearity, probe."""

import click

from .cli_device import json_option, port_argument
from .console import Console, pairs, table

COUNTERS = (
    "late_frames",
    "late_slots",
    "tx_dropped",
    "rx_bad",
    "rx_rejected",
    "rx_overrun",
    "saturated",
    "starved",
    "exposure_changes",
    "eeprom_writes",
)


def fault_report(found):
    """faults.Fault list as plain values."""
    return [fault._asdict() for fault in found]


@click.command()
@port_argument
@json_option
def status(port, as_json):
    """Is the device at PORT well? Faults by name with a remedy, supply, lights, rate, exposures, counters.

    Exit code 1 when something is at fault.

    \b
    Example:
        sparsegaze status /dev/ttyUSB0
    """
    from . import faults
    from .device import Device
    from .doctor_port import settle

    with Device(port) as device:
        settle(device)
        now, exposure, settings, hello = device.status(), device.exposure(), device.settings(), device.hello
    found = faults.of(now, port)
    counters = {name: getattr(now, name) for name in COUNTERS}
    budget = hello.cpu_hz * settings.frame_period_us // 1_000_000
    data = {
        "ok": not found,
        "faults": fault_report(found),
        "supply_volts": now.supply_volts,
        "lights": bool(settings.lights),
        "rate_hz": settings.frame_hz,
        "exposure_us": list(exposure.exposure_us),
        "exposure_automatic": exposure.automatic,
        "work_cycles_max": now.cycles_max,
        "frame_cycles": budget,
        "up_s": now.t_us * 1e-6,
        "frames": now.frames,
        "boot_count": now.boot_count,
        "reset_cause": now.reset_text,
        "stack_free_bytes": now.stack_free,
        "counters": counters,
    }
    # The chip's own reference is within 10 %: how the supply moves says more than where it stands.
    volts = "not measured" if now.supply_volts is None else f"{now.supply_volts:.2f} V, give or take 10 %"
    held = "automatic" if exposure.automatic else "held"
    lines = faults.lines(found) or ["no fault"]
    note = faults.held(exposure, port)
    lines += [f"note: exposures are {note[0]}: `{note[1]}`"] if note else []
    lines += [""] + pairs(
        [
            ("supply", volts),
            ("lights", "on" if settings.lights else "OFF"),
            ("rate", f"{settings.frame_hz:.1f} Hz"),
            ("exposures", " ".join(f"{value:.2f}" for value in exposure.exposure_us) + f" us, {held}"),
            ("work", f"at most {now.cycles_max} of {budget} cycles a frame"),
            ("up", f"{now.t_us * 1e-6:.1f} s, {now.frames} frames"),
            ("boots", f"{now.boot_count}, last by {now.reset_text}"),
            (
                "counters",
                ", ".join(f"{name} {value}" for name, value in counters.items() if value) or "all zero",
            ),
        ]
    )
    Console(as_json).result(data, *lines)
    return 1 if found else 0


@click.command()
@port_argument
@json_option
def linearity(port, as_json):
    """Self-calibration: measure and store how charge and converter code bend at each sensor of PORT.

    Takes 35 s, best before `calibrate`, with the headset on and looking straight ahead, or before white
    paper: the light must be steady. Exposures alternate between long ones and fractions of these;
    what a sensor then reads must not change. Shifts are of a quarter of the exposure against the whole, in
    percent of the light and in octaves.

    \b
    Example:
        sparsegaze linearity /dev/ttyUSB0
    """
    from . import linearity as module
    from .device import Device

    console = Console(as_json)
    with Device(port) as device:
        with console.progress() as progress:
            done = module.run(device, progress)
        from .wire import lib

        modelled = device.model_info().active != lib.SG_SLOT_NONE
    before, after = module.percent(done.before), module.percent(done.after)
    rows = [
        [
            f"A{i}",
            f"{before[i]:+.2f} %",
            f"{done.before[i]:+.4f}",
            f"{after[i]:+.2f} %",
            f"{done.after[i]:+.4f}",
            f"{done.noise[i]:.4f}",
            f"{done.old[i]:+.4f} -> {done.curve[i]:+.4f}",
        ]
        for i in range(6)
    ]
    head = ["sensor", "shift before", "octaves", "after", "octaves", "noise", "curve"]
    said = "the curves are stored" if done.kept else "the new curves were no better: the old ones stay"
    zero = f"the converter's zero: {done.old_zero:+.2f} -> {done.zero:+.2f} codes"
    lines = [*table(head, rows), zero, "", said]
    moved = done.kept and (abs(done.curve - done.old).max() > 0.004 or abs(done.zero - done.old_zero) > 0.5)
    if modelled and moved:
        lines.append(f"the stored model was made with other curves: run `sparsegaze calibrate {port}` again")
    console.result({**done.report(), "calibrate_again": bool(modelled and moved)}, *lines)
    return 0


@click.command()
@port_argument
@click.option(
    "--reference",
    type=click.Path(dir_okay=False),
    help="Matrix to compare with: a file of --save, or the report.json of `calibrate --save`.  "
    "[default: the headset's, simulated]",
)
@click.option(
    "--headset", type=click.Path(dir_okay=False), help="Headset description, TOML.  [default: led2gaze]"
)
@click.option("--save", type=click.Path(dir_okay=False), help="Write the matrix to this file, JSON.")
@json_option
def probe(port, reference, headset, save, as_json):
    """Who sees whom: each LED lit alone, what every other receives; names swapped, dead and covered LEDs.

    The 6 x 6 matrix is compared with the one kept at calibration (--reference), or with a simulated face's.
    Exit code 1 when something is found. Numbers are octaves (factors of two) over the matrix's median.

    \b
    Example:
        sparsegaze probe /dev/ttyUSB0
        sparsegaze probe /dev/ttyUSB0 --reference kept/report.json
    """
    import numpy as np

    from . import faults
    from . import probe as module
    from .device import Device

    if reference and headset:
        raise click.UsageError("--reference and --headset exclude each other")
    console = Console(as_json)
    against = module.load(reference) if reference else module.simulated(headset)
    with Device(port) as device:
        with console.progress() as progress:
            measured = module.measure(device, progress=progress)
        dead = [fault for fault in faults.of(device.status(), port) if fault.name in ("open", "short")]
    if save:
        module.save(save, measured)
    found = module.compare(measured, against, stored=bool(reference))
    middle = np.nanmedian(measured) if np.isfinite(measured).any() else 0.0
    rows = [
        [f"A{i} senses"] + ["" if i == j else _octaves(v - middle) for j, v in enumerate(row)]
        for i, row in enumerate(measured)
    ]
    lines = table(["", *(f"A{j} lit" for j in range(6))], rows) + [""]
    # What the board knows of a dead part is better than what the matrix makes of it.
    findings = [row for row in found.findings if not any(f"LED {fault.channel} " in row[0] for fault in dead)]
    findings += [(fault.text, fault.remedy) for fault in dead]
    lines += [line for text, remedy in findings for line in (text, f"  -> {remedy}")] or [
        f"all six LEDs are where they belong (misfit {found.misfit_octaves:.2f} octaves)"
    ]
    data = {
        "ok": not findings,
        "findings": [{"text": text, "remedy": remedy} for text, remedy in findings],
        "probe": measured,
        "place": found.place,
        "sensor_octaves": found.sensor,
        "emitter_octaves": found.emitter,
        "misfit_octaves": found.misfit_octaves,
        "saved": save,
    }
    console.result(data, *lines)
    return 1 if findings else 0


def _octaves(value):
    return "-" if value != value else f"{value:+.1f}"


COMMANDS = {"status": status, "linearity": linearity, "probe": probe}
