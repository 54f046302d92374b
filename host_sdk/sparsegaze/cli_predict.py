# SPDX-License-Identifier: Apache-2.0
"""Command predict: a model's answers from the binary of a target, over a file of features."""

import os

import click

from .cli_device import json_option
from .console import Console, pairs

CLOCK_HZ = {"nano": 16_000_000, "cortex-m4": 168_000_000}


@click.command()
@click.argument("model_path", metavar="MODEL", type=click.Path(dir_okay=False))
@click.argument("file", type=click.Path(dir_okay=False))
@click.option(
    "--on",
    "target",
    type=click.Choice(["host", "nano", "cortex-m4"]),
    default="host",
    show_default=True,
    help="Whose binary answers: this computer's core, a virtual Nano's firmware, or the same firmware on a "
    "Cortex-M4 in QEMU.",
)
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False), help="Write the predictions to this CSV file."
)
@json_option
def predict(model_path, file, target, output, as_json):
    """Predict the gaze of every valid row in FILE with MODEL, by the very binary of a target.

    FILE is a recording, or any CSV with columns s0, s1, ...; with targets in it the error is told. Angles are
    degrees, exact multiples of 1/128; flags are those of the firmware (1 valid, 4 out of range). A row out of
    range keeps its numbers: its flags say that they are no gaze. output_crc is the CRC-32 over all answers,
    the same on every target.

    \b
    nano        exact cycles of the inference on the ATmega328P, 16 MHz
    cortex-m4   QEMU counts instructions, not cycles; a real Cortex-M4 takes at least a cycle for each

    \b
    Example:
        sparsegaze predict eye.sgm eye.csv --on nano -o gaze.csv
    """
    from . import predict as module
    from .model import DeviceModel
    from .output import check_output

    console = Console(as_json)
    if output:
        check_output(output, inputs=(model_path, file))
    model = DeviceModel.load(model_path)
    rows = module.read_rows(file)
    with console.progress() as progress:
        done = module.predict(model, rows.features, target, progress if target != "host" else None)
    report = {**done.report(), "output": output}
    error = module.target_error(done, rows)
    if error is not None:
        report["error"] = {"mean_deg": error.mean_deg, "median_deg": error.median_deg,
                           "p95_deg": error.p95_deg, "rows": error.frames}
    if output:
        module.write(done, output)
    console.result(report, *_lines(done, rows, error, output))


def _lines(done, rows, error, output):
    n, flagged = len(done.gaze), int((~done.valid).sum())
    items = [("target", done.target), ("rows", f"{n}, {100 * flagged / max(n, 1):.1f} % flagged as no gaze")]
    if error is not None and error.frames:
        items.append(("error to target", f"mean {error.mean_deg:.2f}, median {error.median_deg:.2f}, 95 % "
                                         f"{error.p95_deg:.2f} deg, rows not flagged"))
    known = done.sigma_deg[done.sigma_deg == done.sigma_deg]
    if len(known):
        items.append(("sigma", f"median {sorted(known)[len(known) // 2]:.2f} deg, predicted"))
    if done.cycle_kind:
        hertz = CLOCK_HZ[done.target]
        unit = "cycles, exact" if done.cycle_kind == "cycles (exact)" else "instructions"
        items.append(("inference", f"{done.cycles_min:,} to {done.cycles_max:,} {unit}"))
        bound = "" if unit != "instructions" else "at most "
        items.append(("rate that leaves", f"{bound}{hertz // done.cycles_max:,} a second at "
                                          f"{hertz // 1_000_000} MHz"))
    items += [("model crc", f"0x{done.model_crc:08X}"), ("output crc", f"0x{done.crc:08X}")]
    if output:
        items.append(("written", os.fspath(output)))
    return pairs(items)


COMMANDS = {"predict": predict}
