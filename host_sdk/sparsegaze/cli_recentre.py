# SPDX-License-Identifier: Apache-2.0
"""The command recentre."""

import click

from .cli_device import json_option, port_argument
from .cli_gaze import open_screen, screen_options, window_of
from .console import Console


@click.command()
@port_argument
@click.option(
    "--points",
    "n_points",
    type=click.IntRange(1, 9),
    default=1,
    show_default=True,
    help="Points to look at: 1 moves the offset; 3 to 9 fit a gain too, where that helps.",
)
@click.option("--clear", is_flag=True, help="Take offset and gain away instead.")
@screen_options
@json_option
def recentre(port, n_points, clear, distance_mm, width_mm, windowed, as_json):
    """Put a shifted headset right: look at the centre for two seconds, and the gaze there becomes (0, 0).

    With --points 5, say, look at five dots: gaze = g + offset + G g of the model's output g, where G
    stretches and shears it. Each point is left out in turn to see whether that helps; if it does not, all
    stays as it was ("applied": "none"). Offset and gain are kept in the device until --clear or the next
    recentre; one point leaves the gain alone.

    \b
    Example:
        sparsegaze recentre /dev/ttyUSB0 --points 5
    """
    from . import recentre as module
    from .device import Device

    if n_points == 2:
        why = "2 points cannot tell a gain from noise: 1, or 3 to 9"
        raise click.BadParameter(why, param_hint="--points")
    console = Console(as_json)
    with Device(port) as device:
        if clear:
            before = device.recentre()
            after = module.keep(device)
            data = {
                "before_deg": [before.azimuth_deg, before.elevation_deg],
                "after_deg": [after.azimuth_deg, after.elevation_deg],
                "before_gain": before.affine.gain,
                "after_gain": after.affine.gain,
            }
            console.result(data, "offset was %+.2f %+.2f deg, is 0 now" % tuple(data["before_deg"]))
            return
        with (
            open_screen(device, window_of(distance_mm, width_mm, windowed)) as shown,
            console.progress() as progress,
        ):
            if n_points == 1:
                report = module.run(device, shown, progress=progress)
            else:
                report = module.run_points(device, shown, n_points, progress)
    for row in report.points:
        if row["reason"]:
            why = row["reason"].split(";")[0]
            console.warn("point %+.0f %+.0f deg is left out: " % row["target_deg"] + why)
    console.result(report._asdict(), *_recentre_lines(report))


def _recentre_lines(report):
    if not report.points:
        yield "gaze was %+.2f %+.2f deg at the centre" % report.gaze_deg
    else:
        yield (
            f"error on the points was {report.error_deg:.2f} deg; expected now "
            f"{report.predicted_error_deg:.2f} deg (leave-one-out), with an offset alone "
            f"{report.offset_error_deg:.2f} deg"
        )
        if report.applied == "none":
            yield "no correction would help: all stays as it was"
    yield "offset %+.2f %+.2f deg" % report.before_deg + ", now %+.2f %+.2f deg" % report.after_deg
    if report.points or report.after_gain != ((0.0, 0.0), (0.0, 0.0)):
        yield "gain, percent: " + " ".join("%+.1f" % (100 * v) for row in report.after_gain for v in row)


COMMANDS = {"recentre": recentre}
