# SPDX-License-Identifier: Apache-2.0
"""Commands about the gaze stream: stream, replay."""

import sys

import click

from .cli_device import Number, json_option, port_argument
from .console import Console


@click.command()
@port_argument
@click.option(
    "--seconds",
    type=Number(min=0.0, min_open=True),
    help="Stop after this long, device time.  [default: until Ctrl-C]",
)
@click.option(
    "--csv",
    type=click.Path(dir_okay=False, allow_dash=True),
    help="Write every frame to this file ('-': stdout).",
)
@click.option(
    "--counts",
    is_flag=True,
    help="With --csv, also the converter's codes, lit and unlit, and the exposures of every frame.",
)
@click.option(
    "--baud",
    type=click.Choice(["1000000", "500000"]),
    help="Speed of the line until the board restarts; the slower one for poor cables.  [default: 1000000]",
)
@json_option
def stream(port, seconds, csv, counts, baud, as_json):
    """The gaze computed on the device at PORT, live.

    A terminal shows one line: gaze in degrees (azimuth + right, elevation + up), rate in device time, lost
    frames. CSV columns: t_us, host_time_s, seq, azimuth_deg, elevation_deg, flags, s0..s5, recentre_az_deg,
    recentre_el_deg, recentre_az_az .. el_el (the correction in force), sigma_deg. A gaze whose flags lack
    bit 0 (valid) is no gaze: a blink, a headset that moved, a fault (bit 6).

    Every frame is sent. Where the line or the chip cannot keep up (--csv adds the features, 40 bytes a frame,
    --counts 48 more) the device lowers its rate: `sparsegaze settings PORT` shows what fits at which rate.

    \b
    Example:
        sparsegaze stream /dev/ttyUSB0 --seconds 20 --csv gaze.csv
    """
    from . import live
    from .device import Device

    if csv == "-" and as_json:
        raise click.UsageError("--csv - and --json both want stdout")
    if counts and not csv:
        raise click.UsageError("--counts are columns of the file: give --csv too")
    console = Console(as_json)
    line = console.live()
    tally = live.Tally()
    stopped = None
    with Device(port) as device:
        if baud:
            device.set_baud(int(baud))
        try:
            live.run(
                device,
                tally,
                seconds,
                sys.stdout if csv == "-" else csv,
                lambda: line(tally.text()) if line.due else None,
                counts,
            )
        except KeyboardInterrupt as error:
            stopped = error
        finally:
            line.end()
    data = {**tally.report(), "csv": csv, "interrupted": stopped is not None}
    text = (
        f"{data['frames']} frames in {data['seconds']:.1f} s ({data['rate_hz']:.1f} Hz), "
        f"{data['lost']} lost, {data['valid_percent']:.1f} % valid"
    )
    if tally.frames and tally.without_model == tally.frames:
        text += f"\nthe device has no model: run `sparsegaze calibrate {port}`"
    elif tally.frames and not tally.valid and not tally.faulty:
        text += f"\nno gaze was valid: see `sparsegaze doctor {port}`; if all is well there (another person, "
        text += f"a headset that moved) run `sparsegaze calibrate {port}`"
    if tally.faulty:
        text += f"\n{tally.faulty} frames with a fault: `sparsegaze status {port}` names it"
    if csv == "-":
        console.note(text)
    else:
        console.result(data, text)
    if stopped is not None:
        return 143 if type(stopped).__name__ == "Terminated" else 130
    return 0


@click.command()
@click.argument("file", type=click.Path(dir_okay=False))
@click.option(
    "--model", "model_path", type=click.Path(dir_okay=False), required=True, help="Model file (.sgm)."
)
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False), help="Write the gaze of every frame to this CSV file."
)
@json_option
def replay(file, model_path, output, as_json):
    """Compute the gaze of every frame in FILE again, with the very code that runs on the device.

    FILE is a recording or the CSV of `stream`. Of the latter the device's own gaze is compared, and the exit
    code is 1 unless every frame is the same to the bit. Gaze is in degrees, exact multiples of 1/128; null
    where not valid.

    \b
    Example:
        sparsegaze stream PORT --seconds 20 --csv gaze.csv
        sparsegaze replay gaze.csv --model eye.sgm
    """
    from . import replay as module
    from .model import DeviceModel

    console = Console(as_json)
    model = DeviceModel.load(model_path)
    done = module.run(file, model)
    if output:
        module.write(done, output)
    data = {
        "frames": len(done.t_us),
        "valid": int(done.valid.sum()),
        "compared": done.compared,
        "differing": done.differing,
        "identical": done.identical,
        "model_crc": model.crc,
        "output": output,
    }
    if as_json and not output:
        data.update(
            t_us=done.t_us,
            azimuth_deg=done.gaze_deg[:, 0],
            elevation_deg=done.gaze_deg[:, 1],
            flags=done.flags,
        )
    said = {
        None: "no device gaze in the file to compare with",
        True: f"all {done.compared} identical to the device's",
        False: f"{done.differing} of {done.compared} DIFFER from the device's",
    }[done.identical]
    console.result(data, f"{data['frames']} frames, {data['valid']} with a valid gaze; {said}")
    return 1 if done.identical is False else 0


COMMANDS = {"stream": stream, "replay": replay}
