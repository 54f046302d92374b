# SPDX-License-Identifier: Apache-2.0
"""The command `study`: maps of many placements on many people."""

import click

from .cli_device import json_option
from .console import Console, pairs


class Seeds(click.ParamType):
    """0-19,25: seeds of drawn people, and ranges of them."""

    name = "seeds"
    most = 100_000

    def convert(self, value, param, ctx):
        if isinstance(value, list):
            return value
        seeds = []
        for part in value.split(","):
            first, dash, last = part.strip().partition("-")
            if not first.isdigit() or (dash and not last.isdigit()):
                self.fail(f"{part!r} is neither a seed nor a range, for example 0-19,25", param, ctx)
            first, last = int(first), int(last) if dash else int(first)
            if last < first or last - first >= self.most:
                self.fail(f"{part!r} is no range of at most {self.most} people", param, ctx)
            seeds += range(first, last + 1)
        return list(dict.fromkeys(seeds))


@click.command("study")
@click.argument("headsets", nargs=-1, required=True, metavar="HEADSET...", type=click.Path(dir_okay=False))
@click.option("-o", "--output", type=click.Path(dir_okay=False), required=True, help="File to write, .npz.")
@click.option(
    "--persons", type=Seeds(), default="0-19", show_default=True, metavar="SEEDS", help="Whom to simulate."
)
@click.option("--workers", type=click.IntRange(1, 1024), help="Processes.  [default: one per core]")
@click.option(
    "--grid", type=click.IntRange(1, 181), default=21, show_default=True, help="Gazes along each axis."
)
@click.option("--half-angle", type=float, default=25.0, show_default=True, help="Gaze reaches, deg, 0..45.")
@click.option(
    "--tol", type=float, default=1e-4, show_default=True, help="Error allowed, rms, of the mean response."
)
@click.option(
    "--pupil", type=float, multiple=True, help="Diameter, mm; repeat for more states.  [default: 3.5]"
)
@click.option(
    "--lids", type=float, multiple=True, help="Opening, 0 closed .. 1 open; repeatable.  [default: 1]"
)
@click.option(
    "--directory",
    type=click.Path(file_okay=False),
    help="Where finished items are kept.  [default: the output's name with .items]",
)
@json_option
def study(headsets, output, persons, workers, grid, half_angle, tol, pupil, lids, directory, as_json):
    """Compute the maps of every HEADSET on every simulated person, on all cores.

    Ctrl-C keeps what is finished; the same command again goes on from there, and with more people or headsets
    it computes only those. A placement that is impossible on somebody is reported and left out (NaN). The
    file holds response (headset, person, state, sensor, emitter, elevation, azimuth); numpy.load reads it.

    \b
    Example:
        sparsegaze study headsets/led2gaze.toml --persons 0-19 -o study.npz
        sparsegaze study a.toml b.toml --persons 0-4 --lids 1 --lids 0.5 -o both.npz --json
    """
    from .output import check_output
    from .study import sweep

    check_output(output, ".npz", headsets)
    console = Console(as_json)
    with console.progress() as bar:
        made = sweep(
            headsets,
            persons,
            directory=directory or output + ".items",
            workers=workers,
            progress=lambda done, total, name: bar("items", done, total),
            half_angle_deg=half_angle,
            grid=grid,
            tol=tol,
            pupil_mm=pupil or (3.5,),
            lid_opening=lids or (1.0,),
        )
    made.save(output)
    for failure in made.failures:
        console.warn(f"{failure.headset} on {failure.person}: {failure.reason}")
    items = len(made.headsets) * len(made.persons)
    there = items - made.computed - len(made.failures)
    data = {
        "file": output,
        "headsets": made.headsets.tolist(),
        "persons": made.persons.tolist(),
        "shape": list(made.response.shape),
        "items": items,
        "computed": made.computed,
        "failures": [failure._asdict() for failure in made.failures],
    }
    console.result(
        data,
        *pairs(
            [
                ("study", f"{len(made.headsets)} headset(s) on {len(made.persons)} person(s)"),
                ("items", f"{made.computed} computed, {there} were there"),
                ("failed", len(made.failures)),
                ("response", " x ".join(map(str, made.response.shape))),
                ("written", output),
            ]
        ),
    )


COMMANDS = {"study": study}
