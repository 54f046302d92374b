# SPDX-License-Identifier: Apache-2.0
"""The command `view`: what one sensor of a headset sees of a simulated person."""

import os

import click

from .cli_device import Number, json_option
from .cli_map import person_of
from .console import Console, pairs


class Gaze(click.ParamType):
    """azimuth,elevation: two numbers."""

    name = "AZ,EL"

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        try:
            azimuth, elevation = (float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"{value!r} is not two numbers with a comma between, for example 27,-20", param, ctx)
        return azimuth, elevation


@click.command("view")
@click.argument("headset", type=click.Path(dir_okay=False))
@click.option("--sensor", type=int, required=True, help="Number of the sensor, from 0.")
@click.option(
    "--gaze", type=Gaze(), default="0,0", show_default=True, help="Azimuth + temporal, elevation + up, deg."
)
@click.option(
    "--person",
    metavar="FILE|SEED",
    help="A person file (see persons/), or the seed of a drawn one.  [default: nominal]",
)
@click.option("--pupil", type=float, default=3.5, show_default=True, help="Diameter, mm.")
@click.option("--lids", type=float, default=1.0, show_default=True, help="Opening, 0 closed .. 1 open.")
@click.option(
    "--emitter",
    type=int,
    multiple=True,
    help="One that is lit; repeatable.  [default: those of its phase]",
)
@click.option(
    "--pixels", type=click.IntRange(16, 4096), default=512, show_default=True, help="Of the image's side."
)
@click.option(
    "--samples",
    type=click.IntRange(1, 8),
    default=2,
    show_default=True,
    help="A pixel is the mean of so many squared points in it: smooth edges. 1 is quicker.",
)
@click.option(
    "--reach",
    type=Number(0.1, 20.0),
    default=3.0,
    show_default=True,
    help="The image covers +- so many sigma of the sensor's window.",
)
@click.option(
    "--renderer",
    type=click.Choice(["embree", "osmesa"]),
    default="embree",
    show_default=True,
    help="64-bit with ray-traced face, or 32-bit in a fragment shader (needs libosmesa6).",
)
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False), required=True, help="Picture: .png, .pdf or .svg."
)
@click.option("--npz", type=click.Path(dir_okay=False), help="Write the linear image, part by part, as well.")
@json_option
def view_command(
    headset,
    sensor,
    gaze,
    person,
    pupil,
    lids,
    emitter,
    pixels,
    samples,
    reach,
    renderer,
    output,
    npz,
    as_json,
):
    """Draw what one sensor sees of a simulated eye, and what of that makes its signal.

    The picture: the near-infrared scene as a pinhole camera at the sensor sees it, toned for the eye, with
    circles where the sensor is down to 61 % (1 sigma) and 14 % (2 sigma) of its sensitivity and each
    emitter's glint numbered; beside it the same image times the sensor's window, whose sum is the signal,
    and that signal by parts. Look here when a map has a spike: a glint that crosses the edge of the cornea
    is smeared along it.

    \b
    Example:
        sparsegaze view headsets/led2gaze.toml --sensor 3 --gaze 27,-20 -o view.png
        sparsegaze view headsets/led2gaze.toml --sensor 0 --emitter 4 --gaze 30,-6 -o smeared.png
        sparsegaze view headsets/led2gaze.toml --sensor 4 --lids 0.6 -o lids.png --npz lids.npz

    --npz FILE holds the linear floats: radiance and part_face .. part_glint (emitter, row, column; row 0 on
    top), window and solid_angle (row, column), edges_tan. The signal of emitter e is
    (radiance[e] * window * solid_angle).sum().
    """
    from .headset import load_headset
    from .image import view
    from .mapfigure import picture_kind
    from .output import check_output

    picture_kind(output)
    check_output(output, None, (headset, person))
    if npz:
        check_output(npz, ".npz", (headset, person, output))
    console = Console(as_json)
    worn = load_headset(headset)
    who = person_of(person)
    seen = view(
        worn,
        who,
        sensor,
        *gaze,
        pupil_mm=pupil,
        lid_opening=lids,
        emitters=emitter or None,
        pixels=pixels,
        half_width_sigmas=reach,
        renderer=renderer,
        samples=samples,
    )
    from .viewfigure import save_view, write_whole

    save_view(seen, output, worn.name, _called(person))
    if npz:
        write_whole(npz, seen.save)
    sums = {name: float(value.sum()) for name, value in seen.sums().items()}
    data = {
        "picture": output,
        "file": npz,
        "sensor": seen.sensor,
        "emitters": list(seen.emitters),
        "azimuth_deg": seen.azimuth_deg,
        "elevation_deg": seen.elevation_deg,
        "pupil_mm": seen.pupil_mm,
        "lid_opening": seen.lid_opening,
        "renderer": renderer,
        "pixels": pixels,
        "signal_per_mm2": sums,
        "brightest_per_mm2": float(seen.radiance.sum(0).max()),
    }
    total = sums["total"]
    share = ", ".join(f"{name} {100 * sums[name] / total:.1f} %" for name in seen.parts) if total else "dark"
    console.result(
        data,
        *pairs(
            [
                ("signal", f"{total:.3e} /mm2 of axial intensity: {share}"),
                ("image", f"{pixels} x {pixels} pixels over +-{reach:g} sigma, {renderer}"),
                ("written", output + (f" and {npz}" if npz else "")),
            ]
        ),
    )


def _called(person):
    if person is None:
        return "nominal simulated person"
    if person.isdigit():
        return "simulated person %s" % person
    return "simulated person of %s" % os.path.basename(person)


COMMANDS = {"view": view_command}
