# SPDX-License-Identifier: Apache-2.0
"""Commands with targets: calibrate, record, fit, validate; cli_recentre has recentre."""

import contextlib
import os
import time
import warnings

import click

from .cli_device import Number, json_option, port_argument
from .console import Console, pairs, table

VECTORS = click.IntRange(1, 91)  # choose.ROOM
RATE = click.IntRange(16, 65535)  # SG_WIRE_RATE_LEAST_HZ
VECTORS_HELP = "Calibration vectors of the device's model.  [default: the fewest that do]"
RATE_HELP = (
    "Gazes a second that the Nano is to reach: the most vectors that leave it the time, with the gaze alone "
    "on the line and one cycle a frame. A recentring costs 4 %; streaming features costs more."
)
KERNELS = ("rbf", "matern52", "laplace", "minkowski", "canberra", "cosine")


def screen_options(command):
    """--distance-mm, --width-mm, --windowed: the screen of a real device; a simulated person needs none."""
    for option in (
        click.option("--windowed", is_flag=True, help="Show targets in a window instead of full screen."),
        click.option(
            "--width-mm",
            type=Number(1.0, 10000.0),
            default=530.0,
            show_default=True,
            help="Width of the screen's picture, mm. Real device only.",
        ),
        click.option(
            "--distance-mm",
            type=Number(1.0, 100000.0),
            default=600.0,
            show_default=True,
            help="Distance from the eye to the screen, mm. Real device only.",
        ),
    ):
        command = option(command)
    return command


def window_of(distance_mm, width_mm, windowed):
    return {"distance_mm": distance_mm, "width_mm": width_mm, "full_screen": not windowed}


@contextlib.contextmanager
def open_screen(device, window):
    from .screen import screen_for

    shown = screen_for(device, **window)
    try:
        yield shown
    finally:
        shown.close()


def _has_rows(path):
    """True when a recording holds a frame: behind comments and the line of names."""
    try:
        with open(path, encoding="utf-8") as file:
            return any(line[:1].isdigit() for line in file)
    except OSError:
        return False


def _accuracy_lines(report):
    accuracy, stream = report["accuracy"], report["stream"]
    items = [
        (
            "error to target",
            f"mean {accuracy['mean_deg']:.2f}, median {accuracy['median_deg']:.2f}, 95 % "
            f"{accuracy['p95_deg']:.2f} deg, per frame",
        ),
        ("accuracy", f"{accuracy['accuracy_deg']:.2f} deg (of the mean gaze per target)"),
        ("precision", f"{accuracy['rms_s2s_deg']:.3f} deg RMS-S2S, {accuracy['std_deg']:.3f} deg STD"),
        ("data loss", f"{accuracy['data_loss_percent']:.1f} % of the settled frames"),
    ]
    if "to_true_gaze_mean_deg" in accuracy:
        items.append(
            (
                "error to true gaze",
                f"mean {accuracy['to_true_gaze_mean_deg']:.2f} deg (where the simulated eye "
                "really looked)",
            )
        )
    items += [
        ("stream", f"{stream['frames']} frames, {stream['rate_hz']:.1f} Hz, {stream['lost']} lost"),
        (
            "host and device",
            (
                f"bit-identical on {stream['compared']} frames"
                if stream["bit_identical"]
                else f"DIFFER in {stream['differing']} of {stream['compared']} frames"
            ),
        ),
    ]
    return pairs(items)


@click.command()
@port_argument
@click.option(
    "--targets",
    "n_targets",
    type=click.IntRange(9, 1000),
    default=120,
    show_default=True,
    help="Calibration targets, about one second each.",
)
@click.option(
    "--vectors",
    type=VECTORS,
    help=VECTORS_HELP,
)
@click.option("--rate", "rate_hz", type=RATE, metavar="HZ", help=RATE_HELP)
@click.option(
    "--validation",
    "n_validation",
    type=click.IntRange(0, 1000),
    default=25,
    show_default=True,
    help="Held-out targets afterwards; 0 for none.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the target positions."
)
@click.option(
    "--save",
    type=click.Path(file_okay=False),
    help="Folder for recording.csv, model.sgm and report.json." "  [default: calibrations/<date>-<time>]",
)
@screen_options
@json_option
def calibrate(
    port, n_targets, vectors, rate_hz, n_validation, seed, save, distance_mm, width_mm, windowed, as_json
):
    """Show targets, record, fit, upload the model and validate it: the whole calibration of a device.

    Look at each dot until it moves; blink while it moves. A simulated person does so by itself. Targets cover
    +-22 deg (or what the screen allows). The recording is kept whatever happens later, so nothing has to be
    looked at twice. A new board does well to be measured itself first: `sparsegaze linearity PORT`.

    \b
    Example:
        sparsegaze calibrate /dev/ttyUSB0 --distance-mm 550 --width-mm 598
    """
    from . import calibrate as module
    from . import choose
    from .fitreport import rate_words

    console = Console(as_json)
    folder = save or os.path.join("calibrations", time.strftime("%Y%m%d-%H%M%S"))
    try:
        with console.progress() as progress:
            done = module.run(
                port,
                n_targets,
                vectors,
                seed,
                n_validation,
                folder,
                window=window_of(distance_mm, width_mm, windowed),
                progress=progress,
                rate_hz=rate_hz,
            )
    except BaseException as error:
        kept = os.path.join(folder, module.RECORDING)
        told = getattr(error, "remedy", "") + getattr(error, "message", "")
        if _has_rows(kept) and kept not in told:
            console.note(f"the recording is kept in {kept}: sparsegaze fit takes it")
        raise
    report = done.report()
    for note in report["notes"]:
        console.warn(note)
    lines = pairs(
        [
            ("targets", f"{report['used_targets']} of {report['n_targets']} used"),
            ("model", f"{report['n_vectors']} vectors, crc 0x{report['crc_host']:08X}, kept in {folder}"),
            ("rate", "up to " + rate_words(choose.rates_hz(report["n_vectors"]))),
        ]
    )
    console.result(report, *lines, *(_accuracy_lines(report) if "accuracy" in report else []))


@click.command()
@port_argument
@click.option("-o", "--output", type=click.Path(dir_okay=False), required=True, help="CSV file to write.")
@click.option(
    "--targets",
    "n_targets",
    type=click.IntRange(9, 1000),
    default=120,
    show_default=True,
    help="Targets, about one second each.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the target positions."
)
@screen_options
@json_option
def record(port, output, n_targets, seed, distance_mm, width_mm, windowed, as_json):
    """Record raw features with targets: t_us, s0..s5, target_az_deg, target_el_deg, valid.

    Features are log2 photocurrents, 4096 steps per octave. Frames of settling eyes and blinks stay in the
    file with valid 0. Ctrl-C leaves a complete file of the targets so far.

    \b
    Example:
        sparsegaze record /dev/ttyUSB0 -o eye.csv --targets 60
    """
    from . import capture, targets
    from .device import Device
    from .fixations import TARGETS_NEEDED

    console = Console(as_json)
    with Device(port) as device, open_screen(device, window_of(distance_mm, width_mm, windowed)) as shown:
        plan = targets.calibration_plan(n_targets, seed, reach_deg=shown.reach_deg())
        meta = {"device": device.hello.board_text, "firmware": device.hello.firmware_text, "plan_seed": seed}
        with console.progress() as progress:
            taken = capture.run(device, shown, plan, output, meta, progress)
    chosen = taken.selection
    notes = list(taken.run.notes)
    if chosen.used_targets < TARGETS_NEEDED:
        notes.append(
            f"{chosen.used_targets} usable targets are too few for `sparsegaze fit`, which needs "
            f"{TARGETS_NEEDED}: record again with more --targets"
        )
    for note in notes:
        console.warn(note)
    counts = chosen.counts()
    console.result(
        {
            "file": output,
            "n_targets": chosen.n_targets,
            "used_targets": chosen.used_targets,
            "frames": {"all": len(taken.recording), **counts},
            "lost": taken.run.lost,
            "rate_hz": taken.run.rate_hz,
            "warnings": notes,
        },
        f"{output}: {len(taken.recording)} frames, {counts.get('used', 0)} valid, {chosen.used_targets} of "
        f"{chosen.n_targets} targets, {taken.run.lost} lost",
    )


@click.command()
@click.argument("file", type=click.Path(dir_okay=False))
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False), help="Model file to write.  [default: FILE with .sgm]"
)
@click.option("--vectors", type=VECTORS, help=VECTORS_HELP)
@click.option(
    "--kernel",
    type=click.Choice(KERNELS),
    default="rbf",
    show_default=True,
    help="Distance measure of the full process. The device's own kernel is always the rbf.",
)
@click.option("--p", type=Number(0.0, min_open=True), help="Order of the Minkowski distance.")
@click.option(
    "--budget-cycles",
    type=click.IntRange(min=1),
    help="Most cycles an inference may take on the Nano: as many vectors as fit, unless fewer do as well.",
)
@click.option("--rate", "rate_hz", type=RATE, metavar="HZ", help=RATE_HELP)
@json_option
def fit(file, output, vectors, kernel, p, budget_cycles, rate_hz, as_json):
    """Make a model from a recording: a Gaussian process in float64, distilled to a few fixed-point vectors.

    Any CSV with the columns t_us, s0.., target_az_deg, target_el_deg, valid can be fitted, whoever made it.

    \b
    Example:
        sparsegaze fit eye.csv -o eye.sgm
        sparsegaze fit eye.csv --rate 1000
        sparsegaze fit eye.csv --budget-cycles 7000 --json
    """
    from .fit import fit_recording
    from .fitreport import lines, summary
    from .recording import Recording

    console = Console(as_json)
    recording = Recording.read(file)
    with console.progress() as progress, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        fitted = fit_recording(
            recording,
            vectors,
            kernel=kernel,
            p=p,
            budget_cycles=budget_cycles,
            progress=progress,
            rate_hz=rate_hz,
        )
    doubts = [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]
    if recording.outdated:
        doubts.append(
            "this recording is by older firmware, whose features have another scale: its model fits no board "
            "that runs today's; record again to use it there"
        )
    for doubt in doubts:
        console.warn(doubt)
    output = output or os.path.splitext(file)[0] + ".sgm"
    fitted.model.save(output)
    report = summary(fitted)
    console.result({"file": output, **report, "warnings": doubts}, output, *pairs(lines(report)))


@click.command()
@port_argument
@click.option(
    "--targets",
    "n_targets",
    type=click.IntRange(1, 1000),
    default=25,
    show_default=True,
    help="Held-out targets within +-20 deg, about one second each.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="The seed that was calibrated with: held-out targets keep away from its targets.",
)
@click.option("--csv", type=click.Path(dir_okay=False), help="Keep the whole stream in this file.")
@click.option("--png", type=click.Path(dir_okay=False), help="Draw gaze, targets and errors into this file.")
@screen_options
@json_option
def validate(port, n_targets, seed, csv, png, distance_mm, width_mm, windowed, as_json):
    """Measure the device's gaze on targets that it was not calibrated with.

    Error: angle between gaze and target, per frame, from 0.5 s after each target's onset; frames without a
    valid gaze (blinks) are data loss. Every gaze is also computed again on the host and must be the same to
    the bit; if not, the exit code is 1.

    \b
    Example:
        sparsegaze validate /dev/ttyUSB0 --targets 40 --png validation.png
    """
    from . import validate as module

    console = Console(as_json)
    with console.progress() as progress:
        done = module.run(
            port,
            n_targets,
            seed,
            window=window_of(distance_mm, width_mm, windowed),
            csv=csv,
            progress=progress,
        )
    report, rows = done.report(), done.per_target()
    if png:
        module.picture(done, png)
    for note in report["notes"]:
        console.warn(note)
    head = [
        "target_az_deg",
        "target_el_deg",
        "gaze_az_deg",
        "gaze_el_deg",
        "mean_deg",
        "rms_s2s_deg",
        "data_loss_percent",
    ]
    console.result(
        {**report, "per_target": rows, "csv": csv, "png": png},
        *table(
            ["target az", "el", "gaze az", "el", "error deg", "rms-s2s", "loss %"],
            [[row[name] for name in head] for row in rows],
        ),
        "",
        *_accuracy_lines(report),
    )
    return 0 if done.bit_identical else 1


COMMANDS = {
    "calibrate": calibrate,
    "record": record,
    "fit": fit,
    "validate": validate,
}
