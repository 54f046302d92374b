# SPDX-License-Identifier: Apache-2.0
"""Commands about boards: doctor, list, virtual, flash, info, upload."""

import math
import time

import click

from .console import Console, pairs, table

json_option = click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print exactly one JSON object on stdout; progress goes to stderr.",
)
port_argument = click.argument("port")


class Number(click.FloatRange):
    """A finite number in a range: click's own takes nan for one."""

    def convert(self, value, param, ctx):
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number


@click.command()
@click.argument("what", metavar="[PORT|HEADSET]", required=False)
@json_option
def doctor(what, as_json):
    """What is installed, what is missing and how to get it. With PORT: is that board well, and why not.

    With HEADSET, a description in TOML: is it safe for the eye, and what current does it draw. Exit code 1
    when something is wrong, or is missing without which flashing, calibrating or streaming fails.

    \b
    Example:
        sparsegaze doctor
        sparsegaze doctor /dev/ttyUSB0
        sparsegaze doctor headsets/led2gaze.toml
    """
    if what is None:
        from .doctor import examine

        checks, bad, unsure = examine(), "MISSING", "optional"
    elif what.endswith(".toml"):
        from .cli_headset import examine_headset

        return examine_headset(what, Console(as_json))
    else:
        from .doctor_port import examine

        checks, bad, unsure = examine(what), "FAULT", "note"
    good = all(check.ok is not False for check in checks)
    mark = {True: "ok", None: unsure, False: bad}
    lines = []
    for check in checks:
        lines.append(f"{mark[check.ok]:<9} {check.name}: {check.found}")
        if check.remedy:
            lines.append(f"{'':<9}   -> {check.remedy}")
    Console(as_json).result({"ok": good, "checks": [check._asdict() for check in checks]}, *lines)
    return 0 if good else 1


@click.command("list")
@click.option("--probe", is_flag=True, help="Open each port (this resets most boards) and ask what is there.")
@json_option
def list_ports(probe, as_json):
    """Ports and devices: running virtual Nanos first, then USB, then other serial ports.

    \b
    Example:
        sparsegaze list
        sparsegaze list --probe --json
    """
    from . import registry

    console, rows = Console(as_json), []
    for info in registry.ports():
        row = {"port": info.port, "kind": info.kind, "description": info.description, "virtual": info.virtual}
        if probe:
            row["device"] = _probe(info.port)
        rows.append(row)
    if not rows:
        console.result(
            {"ports": []}, "no ports: plug a Nano in, or start a virtual one with `sparsegaze virtual`"
        )
        return
    head = ["port", "kind", "description"] + ["device"] * probe
    console.result({"ports": rows}, *table(head, [[row[name] for name in head] for row in rows]))


def _probe(port):
    from .device import Device
    from .errors import SparsegazeError

    try:
        with Device(port) as device:
            return f"{device.hello.board_text}, firmware {device.hello.firmware_text}"
    except SparsegazeError as error:
        return error.message


@click.command()
@click.option(
    "--headset", type=click.Path(dir_okay=False), help="Headset description, TOML.  [default: led2gaze]"
)
@click.option(
    "--person",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    metavar="SEED",
    help="Which simulated person, which parts and which noise.",
)
@click.option(
    "--unpaced",
    is_flag=True,
    help="Time passes only while a command waits for it: runs are reproducible and "
    "as fast as the computer allows.",
)
@click.option(
    "--no-reset", is_flag=True, help="A board whose auto-reset is cut: opening the port does not reset it."
)
@click.option(
    "--ambient",
    type=click.Choice(["dark", "room", "bright_room", "sun_gap"]),
    default="dark",
    show_default=True,
    help="Light from outside.",
)
@click.option(
    "--light",
    type=click.Choice(["nominal", "dim", "bright"]),
    default="nominal",
    show_default=True,
    help="Photocurrent of the LEDs: 200, 75 or 600 nA on average.",
)
@click.option(
    "--bootloader",
    type=click.Choice(["optiboot", "atmegaboot"]),
    default="optiboot",
    show_default=True,
    help="Stock bootloader of the board: Optiboot (115200 baud) or the older ATmegaBOOT (57600).",
)
@click.option(
    "--state", type=click.Path(file_okay=False), help="Folder that keeps flash and EEPROM between runs."
)
@click.option(
    "--link", type=click.Path(), help="Also make a symbolic link to the port, for a name that stays."
)
@json_option
def virtual(headset, person, unpaced, no_reset, ambient, light, bootloader, state, link, as_json):
    """Run a virtual Nano with a simulated person: prints its port, runs until Ctrl-C.

    The microcontroller is simulated cycle by cycle and boots its stock bootloader; a fresh one must be
    flashed like a real one. Everything about a person is drawn from SEED.

    \b
    Example:
        sparsegaze virtual --person 7 --link /tmp/nano &
        sparsegaze flash /tmp/nano
    """
    from .virtual import VirtualNano

    console = Console(as_json)
    options = {
        "person": person,
        "unpaced": unpaced,
        "auto_reset": not no_reset,
        "ambient": ambient,
        "light": light,
        "bootloader": bootloader,
        "state_dir": state,
        "link": link,
    }
    if headset:
        options["headset"] = headset
    console.note("preparing the simulated person (the first time takes longer)")
    nano = VirtualNano(**options)
    try:
        console.result(
            {
                "port": str(link or nano.port),
                "pty": nano.port,
                "pid": nano.pid,
                "person": person,
                "unpaced": unpaced,
            },
            str(link or nano.port),
        )
        console.note("virtual Nano running; Ctrl-C stops it")
        while nano.alive:
            time.sleep(0.2)
    except KeyboardInterrupt:
        return 0  # the ordinary way to stop it
    finally:
        nano.stop()
    from .errors import VirtualError

    raise VirtualError(
        "the virtual Nano stopped by itself", "start it again; `sparsegaze doctor` checks its parts"
    )


@click.command()
@port_argument
@click.option(
    "--hex",
    "hex_path",
    type=click.Path(dir_okay=False),
    help="Intel HEX file.  [default: the firmware that came with this package]",
)
@json_option
def flash(port, hex_path, as_json):
    """Put the firmware on the board at PORT through its stock bootloader, and read it back.

    Both bootloaders of the Nano are found by trying (115200, then 57600 baud). Stored models survive. Takes
    about 5 s.

    \b
    Example:
        sparsegaze flash /dev/ttyUSB0
    """
    from .flash import flash_hex

    console = Console(as_json)
    with console.progress() as progress:
        report = flash_hex(port, hex_path, progress)
    console.result(
        report._asdict(),
        f"{report.bytes} bytes flashed and verified in {report.seconds:.1f} s "
        f"({report.bootloader}, {report.baud} baud)",
    )


@click.command()
@port_argument
@json_option
def info(port, as_json):
    """Board, firmware, protocol and model versions, limits, boots, counters, exposures and stored models.

    \b
    Example:
        sparsegaze info /dev/ttyUSB0 --json
    """
    from . import faults
    from .cli_health import COUNTERS, fault_report
    from .cli_sense import settings_report
    from .device import Device
    from .wire import lib

    with Device(port) as device:
        hello, status, models = device.hello, device.status(), device.model_info()
        exposure, recentre, settings = device.exposure(), device.recentre(), device.settings()
        clock = device.sync_clock(4)
    slots = []
    for slot, name in ((lib.SG_SLOT_A, "A"), (lib.SG_SLOT_B, "B"), (lib.SG_SLOT_RAM, "trial")):
        valid = models.verdict[slot] == lib.SG_OK
        slots.append(
            {
                "slot": name,
                "valid": valid,
                "active": models.active == slot,
                "crc": models.crc[slot] if valid else None,
                "generation": models.generation[slot] if valid else None,
                "vectors": models.vectors[slot] if valid else None,
                "channels": models.channels[slot] if valid else None,
            }
        )
    counters = {name: getattr(status, name) for name in COUNTERS}
    found = faults.of(status, port)
    data = {
        "port": port,
        "board": hello.board_text,
        "firmware": hello.firmware_text,
        "protocol_version": hello.wire_version,
        "model_version": hello.model_version,
        "channels": hello.channels,
        "cpu_hz": hello.cpu_hz,
        "frame_period_us": settings.frame_period_us,
        "rate_hz": settings.frame_hz,
        "settings": settings_report(settings),
        "faults": fault_report(found),
        "supply_volts": status.supply_volts,
        "exposure_limits_us": [hello.exposure_min_us, hello.exposure_max_us],
        "slot_bytes": hello.slot_bytes,
        "trial_bytes": hello.trial_bytes,
        "boot_count": status.boot_count,
        "reset_cause": status.reset_text,
        "frames": status.frames,
        "stack_free_bytes": status.stack_free,
        "counters": counters,
        "exposure_us": list(exposure.exposure_us),
        "exposure_automatic": exposure.automatic,
        "recentre_deg": [recentre.azimuth_deg, recentre.elevation_deg],
        "recentre_gain": recentre.affine.gain,
        "models": slots,
        "ping_ms": clock.round_trip_s * 1e3 if clock.round_trip_s is not None else None,
    }
    lines = pairs(
        [
            ("board", data["board"]),
            (
                "firmware",
                f"{data['firmware']}, protocol {hello.wire_version}, model format " f"{hello.model_version}",
            ),
            (
                "frames",
                f"{settings.frame_hz:.1f} Hz (at most {settings.most_hz}), {hello.channels} channels, "
                f"wired as {settings.wiring_text}",
            ),
            ("faults", "; ".join(fault.text for fault in found) or "none"),
            (
                "exposures",
                " ".join(f"{v:.2f}" for v in exposure.exposure_us) + f" us ({hello.exposure_min_us}.."
                f"{hello.exposure_max_us}, {'automatic' if exposure.automatic else 'held'})",
            ),
            (
                "recentre",
                f"{recentre.azimuth_deg:+.2f} {recentre.elevation_deg:+.2f} deg, gain "
                + " ".join(f"{100 * v:+.1f}" for row in recentre.affine.gain for v in row)
                + " %",
            ),
            ("boots", f"{status.boot_count}, last by {status.reset_text}"),
            ("free stack", f"{status.stack_free} bytes"),
            (
                "counters",
                ", ".join(f"{name} {value}" for name, value in counters.items() if value) or "all zero",
            ),
        ]
    )
    Console(as_json).result(
        data,
        *lines,
        "",
        *table(
            ["slot", "valid", "active", "vectors", "generation", "crc"],
            [
                [
                    s["slot"],
                    "yes" if s["valid"] else "no",
                    "yes" if s["active"] else "",
                    s["vectors"],
                    s["generation"],
                    "-" if s["crc"] is None else f"0x{s['crc']:08X}",
                ]
                for s in slots
            ],
        ),
    )


@click.command()
@port_argument
@click.argument("model", type=click.Path(dir_okay=False))
@json_option
def upload(port, model, as_json):
    """Put MODEL (a .sgm file) into the device at PORT and make it the active one.

    The inactive of two flash slots is written, its header last, so that a cut at any moment leaves the old
    model or the new one. The device restarts.

    \b
    Example:
        sparsegaze upload /dev/ttyUSB0 eye.sgm
    """
    from .model import DeviceModel
    from .store import upload as store_upload

    console, loaded = Console(as_json), DeviceModel.load(model)
    with console.progress() as progress:
        report = store_upload(port, loaded, progress)
    console.result(
        report._asdict(),
        f"{report.vectors} vectors in slot {'AB'[report.slot]}, generation "
        f"{report.generation}, crc 0x{report.crc:08X}, {report.seconds:.1f} s",
    )


COMMANDS = {
    "doctor": doctor,
    "list": list_ports,
    "virtual": virtual,
    "flash": flash,
    "info": info,
    "upload": upload,
}
