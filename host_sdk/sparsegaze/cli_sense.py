# SPDX-License-Identifier: Apache-2.0
"""Commands about how the device senses: settings, exposure."""

import click

from .cli_device import json_option, port_argument
from .console import Console, pairs

CHANNELS = 6
NO_LIMIT_US = 65535 / 16  # FFFF on the wire takes a limit away


class Rate(click.ParamType):
    """Frames a second, or the word max."""

    name = "HZ"

    def convert(self, value, param, ctx):
        if isinstance(value, int):
            return value
        if value.strip().lower() == "max":
            return 0
        from .wire import lib

        least = lib.SG_WIRE_RATE_LEAST_HZ
        try:
            rate = int(value)
        except ValueError:
            rate = 0
        if not least <= rate <= 65535:
            self.fail(f"{value!r} is neither a whole number of at least {least} nor max", param, ctx)
        return rate


class Microseconds(click.ParamType):
    """One number for all channels, or six with commas; with `none` also that word: NO_LIMIT_US."""

    name = "US[,US...]"

    def __init__(self, none=False):
        self.none = none

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        if self.none and value.strip().lower() == "none":
            return (NO_LIMIT_US,) * CHANNELS
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in (1, CHANNELS) or not all(0 < number < 4096 for number in numbers):
            words = f"{value!r} is neither one number of 0 to 4096 microseconds nor {CHANNELS} with commas"
            self.fail(words + (", nor none" if self.none else ""), param, ctx)
        return numbers * (CHANNELS // len(numbers))


def settings_report(now):
    """A wire.Settings as plain values."""
    return {
        "rate_hz": now.frame_hz,
        "rate_wished_hz": now.rate_hz or None,
        "rate_limit_hz": now.rate_limit_hz,
        "repeats": now.repeats,
        "cycles_a_frame": now.cycles_a_frame,
        "period_us": now.period_us,
        "frame_period_us": now.frame_period_us,
        "wiring": now.wiring_text,
        "power": now.power_text,
        "rolling": bool(now.rolling),
        "lights": bool(now.lights),
    }


def settings_lines(now, vectors, limits):
    """A wire.Settings in words; vectors of the model in use, 0: none; limits of rate_limits()."""
    with_model = f"the model of {vectors} vectors" if vectors else "no model"
    count = now.cycles_a_frame
    cycles = "1 cycle" if count == 1 else f"the mean of {count} cycles"
    dark = now.frame_period_us - count * now.period_us
    wish = f"; {now.rate_hz} are wished for" if now.rate_hz > now.most_hz else ""
    pause = f", then {dark} us dark" if dark > count else ""
    return pairs(
        [
            ("rate", f"{now.frame_hz:.1f} Hz of the gaze{wish}"),
            (
                "at most",
                f"{max(limits['gaze'], int(now.frame_hz))} Hz with {with_model}; {limits['features']} Hz "
                f"with the features too (stream --csv), {limits['counts']} Hz with --counts",
            ),
            ("frame", f"{cycles} of {now.period_us} us{pause}; a frame every {now.frame_period_us} us"),
            ("wiring", now.wiring_text),
            ("power", now.power_text),
            ("rolling", "a gaze after every pair of sensors" if now.rolling else "off: one gaze a frame"),
            ("lights", "on" if now.lights else "OFF"),
        ]
    )


@click.command()
@port_argument
@click.option("--rate", type=Rate(), help="Frames a second, or max: as fast as can be.")
@click.option(
    "--repeats",
    type=click.Choice(["1", "2", "4", "8", "16"]),
    help="Sensing cycles averaged into a frame: less noise, lower rate.",
)
@click.option(
    "--power",
    type=click.Choice(["normal", "low"]),
    help="low: dark and asleep between frames. normal: that time goes into more cycles a frame, to average.",
)
@click.option(
    "--wiring",
    type=click.Choice(["leds", "photodiodes"]),
    help="What is on the pins: LEDs that sense and emit, or photodiodes and emitters of their own.",
)
@click.option(
    "--rolling/--no-rolling",
    default=None,
    help="A gaze after every two sensors, three a cycle: the Nano's firmware lacks the time, and refuses.",
)
@click.option("--lights", type=click.Choice(["on", "off"]), help="off: no LED is lit until switched on.")
@json_option
def settings(port, rate, repeats, power, wiring, rolling, lights, as_json):
    """How the device at PORT senses: frame rate, averaging, power, wiring, lights. Without options: shows it.

    What can be reached depends on the model and on what is streamed: the device computes its own limit, and
    never runs faster. Settings survive a restart. What they draw: `sparsegaze doctor HEADSET.toml`.

    \b
    Example:
        sparsegaze settings /dev/ttyUSB0
        sparsegaze settings /dev/ttyUSB0 --rate max --repeats 1
        sparsegaze settings /dev/ttyUSB0 --rate 250 --power low
    """
    from .device import Device

    wanted = {
        "rate_hz": rate,
        "repeats": None if repeats is None else int(repeats),
        "power": power,
        "wiring": wiring,
        "rolling": rolling,
        "lights": None if lights is None else lights == "on",
    }
    wanted = {name: value for name, value in wanted.items() if value is not None}
    if wanted.get("rolling") and wanted.get("repeats", 1) != 1:
        raise click.UsageError("--rolling shows single cycles: it goes with --repeats 1 only")
    with Device(port) as device:
        now, vectors = change(device, port, wanted)
        limits = rate_limits(device)
    data = {**settings_report(now), "limits_hz": limits, "n_vectors": vectors}
    Console(as_json).result(data, *settings_lines(now, vectors, limits))


def rate_limits(device):
    """The rate in Hz that an open device can reach, by what it streams: {"gaze", "features", "counts"}."""
    limits = {}
    for name, more in (("gaze", {}), ("features", {"raw": True}), ("counts", {"raw": True, "counts": True})):
        device.set_stream(gaze=True, **more)
        limits[name] = device.settings().rate_limit_hz
    device.set_stream()
    return limits


def change(device, port, wanted):
    """Apply settings to an open device, all or none: (wire.Settings in force, vectors of the model in use).

    Rate and limit are those of a device that streams its gaze, which it does afterwards.
    Raises SparsegazeError naming the limit when the device cannot do what is asked.
    """
    from .errors import DeviceError, SparsegazeError
    from .sensing import wait_stored
    from .wire import lib

    info = device.model_info()
    vectors = info.vectors[info.active] if info.active <= lib.SG_SLOT_RAM else 0
    device.set_stream(gaze=True)
    before, written = device.settings(), device.status().eeprom_writes
    if not wanted:
        return before, vectors
    try:
        now = device.settings(**wanted)
    except DeviceError as error:
        if error.code not in (lib.SG_E_ARG, lib.SG_E_RANGE, lib.SG_E_STATE):
            raise
        if wanted.get("rolling"):
            raise SparsegazeError(
                "this firmware gives one gaze a frame: a cycle has no time for three inferences",
                f"nothing was changed; the most gazes come by sparsegaze settings {port} --rate max",
            ) from None
        asked = ", ".join(f"{name.replace('_hz', '')} {value}" for name, value in wanted.items())
        raise SparsegazeError(
            f"the device refuses {asked}; it can do at most {before.rate_limit_hz} Hz now",
            "ask for less, or for one thing at a time; nothing was changed",
        ) from None
    rate = wanted.get("rate_hz", 0)
    differs = [
        name
        for name in ("repeats", "rolling", "lights")
        if name in wanted and getattr(now, name) != wanted[name]
    ]
    if rate > now.frame_hz + max(1, rate // 200) or differs:
        limit, repeats = now.rate_limit_hz, now.repeats
        device.settings_back(before)
        if differs:
            raise SparsegazeError(
                f"this firmware does not do {differs[0]} {wanted[differs[0]]}", "nothing was changed"
            )
        model = f"a model of {vectors} vectors" if vectors else "no model"
        cycles = "one cycle" if repeats == 1 else f"{repeats} cycles"
        remedy = f"sparsegaze settings {port} --rate {limit}"
        if repeats > 1:
            remedy += ", or fewer --repeats"
        elif vectors:
            from .choose import vectors_at

            fewer = vectors_at(rate)
            remedy += f", or fit a model with --rate {rate}: {fewer} vectors" if 0 < fewer < vectors else ""
        raise SparsegazeError(
            f"{rate} Hz is too fast: with {model} and {cycles} a frame this device does at most {limit} Hz",
            remedy,
        )
    if now != before._replace(op=now.op):
        wait_stored(device, written)
    return now, vectors


@click.command()
@port_argument
@click.option("--auto", "mode", flag_value="auto", help="Adapt them to the light: a new board's way.")
@click.option("--hold", "mode", flag_value="hold", help="Stay at those in force.")
@click.option("--set", "fixed", type=Microseconds(), help="Hold these: one number for all, or six.")
@click.option(
    "--limit",
    type=Microseconds(none=True),
    help="Automatic exposure stays at or below these; none: no limit.",
)
@json_option
def exposure(port, mode, fixed, limit, as_json):
    """The six exposure times of the device at PORT, in microseconds. Without options: shows them.

    The device keeps them, and what is asked of them here, through a restart: a --limit too, which it does not
    show. It clips them to what board and frame rate allow; steps are 1/16 us.

    \b
    Example:
        sparsegaze exposure /dev/ttyUSB0
        sparsegaze exposure /dev/ttyUSB0 --set 40,40,55.5,60,40,40
        sparsegaze exposure /dev/ttyUSB0 --auto --limit 90
    """
    from .device import Device
    from .sensing import EXPOSURE_REST_S, wait_stored

    if mode and fixed:
        raise click.UsageError(f"--{mode} and --set exclude each other")
    if mode == "hold" and limit:
        raise click.UsageError("--limit is about automatic exposure: it does not go with --hold")
    with Device(port) as device:
        written = device.status().eeprom_writes
        if limit:
            device.exposure(limit_us=limit)
        if fixed:
            device.exposure(us=fixed)
        elif mode:
            device.exposure(auto=mode == "auto")
        now, hello = device.exposure(), device.hello
        if limit or fixed or mode:
            device.link.sleep(EXPOSURE_REST_S)
            wait_stored(device, written)
    clipped = fixed is not None and any(abs(a - b) > 0.05 * b for a, b in zip(now.exposure_us, fixed))
    console = Console(as_json)
    data = {
        "exposure_us": list(now.exposure_us),
        "automatic": now.automatic,
        "least_us": hello.exposure_min_us,
        "most_us": hello.exposure_max_us,
        "clipped": clipped,
    }
    mode = "automatic" if now.automatic else "held"
    least, most = hello.exposure_min_us, hello.exposure_max_us
    console.result(
        data,
        *pairs(
            [
                ("exposures", " ".join(f"{value:.2f}" for value in now.exposure_us) + f" us, {mode}"),
                ("board's limits", f"{least} to {most} us, less at a high rate"),
            ]
        ),
    )
    if clipped:
        console.warn("the device moved the exposures to what it can do at this frame rate")


COMMANDS = {"settings": settings, "exposure": exposure}
