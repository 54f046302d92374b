# SPDX-License-Identifier: Apache-2.0
"""The command `map`: what each sensor of a headset receives over gaze, on a simulated person."""

import click

from .cli_device import json_option
from .console import Console, pairs

BITS = {"float": "float", "16": 16, "8": 8}


def person_of(text):
    """A Person from what was typed: a seed, the path of a person file, or nothing (nominal)."""
    from .person import draw_person, load_person, nominal_person

    if text is None:
        return nominal_person()
    if text.isdigit():
        return draw_person(int(text))
    return load_person(text)


class Triple(click.ParamType):
    """x,y,z: three numbers."""

    name = "x,y,z"

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 3:
            self.fail(f"{value!r} is not three numbers with commas between, for example 0.5,0,-1", param, ctx)
        return numbers


@click.command("map")
@click.argument("headset", type=click.Path(dir_okay=False))
@click.option("-o", "--output", type=click.Path(dir_okay=False), required=True, help="File to write, .npz.")
@click.option(
    "--person",
    metavar="FILE|SEED",
    help="A person file (see persons/), or the seed of a drawn one.  [default: nominal]",
)
@click.option("--half-angle", type=float, default=25.0, show_default=True, help="Gaze reaches, deg, 0..45.")
@click.option(
    "--grid",
    type=int,
    default=None,
    help="Gazes along each axis, 1..181 (a sweep: its points).  [default: 41; 401]",
)
@click.option(
    "--tol", type=float, default=1e-4, show_default=True, help="Error allowed, rms, of the mean response."
)
@click.option(
    "--pupil", type=float, multiple=True, help="Diameter, mm; repeat for more states.  [default: 3.5]"
)
@click.option(
    "--lids", type=float, multiple=True, help="Opening, 0 closed .. 1 open; repeatable.  [default: 1]"
)
@click.option("--slip", type=Triple(), multiple=True, help="Headset moved, mm; repeatable.  [default: 0,0,0]")
@click.option("--sweep", type=click.Choice(["azimuth", "elevation"]), help="One row or column as a curve.")
@click.option("--elevation", type=float, help="Of an azimuth sweep, deg.  [default: 0]")
@click.option("--azimuth", type=float, help="Of an elevation sweep, deg.  [default: 0]")
@click.option("--png", type=click.Path(dir_okay=False), help="Picture to write beside (needs matplotlib).")
@click.option("--parts", is_flag=True, help="Keep face, sclera, iris and glint apart in the file.")
@click.option(
    "--method",
    type=click.Choice(["exact", "image"]),
    default="exact",
    show_default=True,
    help="Integrals over surfaces, or rendered images times window, summed.",
)
@click.option("--pixels", type=click.IntRange(8, 4096), help="Width of the images.  [default: 128]")
@click.option("--bits", type=click.Choice(list(BITS)), help="Of a pixel.  [default: float]")
@click.option("--clip", is_flag=True, help="Images saturate as a camera's do.")
@click.option("--renderer", type=click.Choice(["embree", "osmesa"]), help="Of the images.  [default: embree]")
@click.option("--workers", type=click.IntRange(1, 256), help="Threads.  [default: 2]")
@json_option
def map_command(
    headset,
    output,
    person,
    half_angle,
    grid,
    tol,
    pupil,
    lids,
    slip,
    sweep,
    elevation,
    azimuth,
    png,
    parts,
    method,
    pixels,
    bits,
    clip,
    renderer,
    workers,
    as_json,
):
    """Compute what every sensor receives from every emitter over gaze, on a simulated person.

    The error is bounded: the cheapest integration is taken that meets --tol, and what was left out or
    simplified is said. --pupil, --lids and --slip are walked in step: `--lids 1 --lids 0.5` makes two states,
    with `--pupil 2 --pupil 6` the first has 2 mm and open lids. The file holds response (state, sensor,
    emitter, elevation, azimuth) and everything that it was made from; numpy.load reads it.

    \b
    Example:
        sparsegaze map headsets/led2gaze.toml -o map.npz --png map.png
        sparsegaze map headsets/led2gaze.toml --person persons/deep-set.toml --lids 0.5 -o map.npz
        sparsegaze map headsets/led2gaze.toml --sweep azimuth --elevation 0 -o row.npz --png row.png
        sparsegaze map headsets/led2gaze.toml --method image --pixels 64 --bits 8 -o image.npz
    """
    from . import maps
    from .output import check_output

    _refuse_misfits(sweep, elevation, azimuth, method, pixels, bits, clip, renderer)
    check_output(output, ".npz", (headset, person))
    if png:
        from .mapfigure import picture_kind

        check_output(png, None, (headset, person, output))
        picture_kind(png)
    console = Console(as_json)
    common = dict(
        half_angle_deg=half_angle,
        tol=tol,
        pupil_mm=pupil or (3.5,),
        lid_opening=lids or (1.0,),
        slip_mm=slip or ((0.0, 0.0, 0.0),),
        workers=workers,
    )
    who = person_of(person)
    with console.progress() as bar:

        def progress(done):
            bar("map", round(1000 * done), 1000)

        if sweep:
            at = elevation if sweep == "azimuth" else azimuth
            made = maps.compute_sweep(
                headset, who, sweep, at or 0.0, points=grid or 401, progress=progress, **common
            )
        else:
            image = dict(pixels=pixels or 128, bits=BITS[bits or "float"], clip=clip)
            made = maps.compute_map(
                headset,
                who,
                grid=maps.GRID if grid is None else grid,
                method=method,
                renderer=renderer or "embree",
                progress=progress,
                **image,
                **common,
            )
    made.save(output, parts=parts or bool(sweep))
    if png:
        from . import mapfigure

        mapfigure.save_figure(made, png)
    console.result(_report(made, output, png), *_words(made, output, png))


def _refuse_misfits(sweep, elevation, azimuth, method, pixels, bits, clip, renderer):
    if elevation is not None and sweep != "azimuth":
        raise click.UsageError("--elevation goes with --sweep azimuth")
    if azimuth is not None and sweep != "elevation":
        raise click.UsageError("--azimuth goes with --sweep elevation")
    if sweep and method != "exact":
        raise click.UsageError("--sweep is computed exactly; --method image makes whole maps")
    if method == "exact" and (pixels or bits or clip or renderer):
        raise click.UsageError("--pixels, --bits, --clip and --renderer go with --method image")


def _report(made, output, png):
    """The command's result as data."""
    from .ring import ring_of_sensors

    states, n, m, rows, columns = made.response.shape
    known = made.method == "exact"
    return {
        "file": output,
        "picture": png,
        "method": made.method,
        "states": states,
        "sensors": n,
        "emitters": m,
        "gazes": rows * columns,
        "mean": made.mean,
        "rings": ring_of_sensors(made),
        "estimate_rms": made.estimate_rms,
        "tolerance_met": bool(made.estimate_rms["total"] <= made.tol) if known else None,
        "error_bound": float(made.error_estimate.max() / made.mean) if known and made.mean else None,
        "left_out": made.left_out,
        "seconds": made.seconds,
        "responses_per_second": made.response.size / made.seconds,
    }


def _words(made, output, png):
    """The same in words."""
    data = _report(made, output, png)
    items = [
        (
            "map",
            f"{data['states']} state(s), {data['sensors']} sensors x {data['emitters']} emitters, "
            f"{data['gazes']} gazes",
        ),
        ("mean", f"{made.mean:.3e} /mm2 of a pair"),
    ]
    if data["rings"]:
        best = max(data["rings"], key=lambda ring: (ring["within"], ring["glint_percent"]))
        items.append(
            (
                "glint",
                f"brightest for sensor {best['sensor']} at azimuth {best['azimuth_deg']:.1f}, elevation "
                f"{best['elevation_deg']:.1f} deg{'' if best['within'] else ' (the border)'}: "
                f"{best['glint_percent']:.0f} % of the rest",
            )
        )
    if data["error_bound"] is not None:
        items.append(
            (
                "error",
                f"expected {made.estimate_rms['total']:.1e} rms of the mean; guaranteed below "
                f"{data['error_bound']:.1e} for every pair and gaze",
            )
        )
        if made.estimate_rms["total"] > made.tol:
            items.append(("", f"this is more than the {made.tol:.0e} asked for"))
    items += [("left out", sentence) if not k else ("", sentence) for k, sentence in enumerate(made.left_out)]
    items.append(("time", f"{made.seconds:.2f} s, {data['responses_per_second']:.0f} responses/s"))
    items.append(("written", output + (f" and {png}" if png else "")))
    return pairs(items)


COMMANDS = {"map": map_command}
