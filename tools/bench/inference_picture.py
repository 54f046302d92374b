# SPDX-License-Identifier: Apache-2.0
"""inference.png: what the benchmark of inference measured, for somebody who would rather look than read."""

import inference_judge
import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

BLUE, RED, GREY, GREEN, GOLD, PLUM = "#2f6690", "#c8553d", "#9aa5b1", "#588157", "#d9a441", "#7d4e57"
INK = "#3d4852"
KINDS = {  # colour, words
    "simulated": (BLUE, "simulated persons"),
    "smooth": (GREEN, "smooth synthetic sets"),
    "sharp": (GOLD, "the same with a sharp ring"),
}
PEER_COLOURS = (("naive float", RED), ("emlearn", PLUM), ("m2cgen", GOLD), ("micromlgen", GREEN), ("", GREY))
LABEL_WIDTH, LABEL_HEIGHT, LABEL_SHIFTS = 4.0, 8.0, (-3, 6, -12, 15, -21)  # points


def draw(path, report):
    """Five panels into a PNG; a section that was not run leaves its panel empty.

    report    dict of tools/bench/bench_inference.py, with a frontier
    """
    figure = pyplot.figure(figsize=(19, 12.5), constrained_layout=True)
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.45, 1.0))
    left, right = top.subplots(1, 2)
    _distance(left, report)
    _truth(right, report)
    people, knowing, bars = bottom.subplots(1, 3, width_ratios=(1.0, 0.95, 1.35))
    for axis, key, panel in (
        (people, "frontier", _people),
        (knowing, "variance", _knowing),
        (bars, "bars", _bars),
    ):
        if report.get(key):
            panel(axis, report)
        else:
            axis.set_axis_off()
            axis.text(0.5, 0.5, key + ": not run", ha="center", color=GREY, transform=axis.transAxes)
    persons = len(inference_judge.by_dataset(report["frontier"], "simulated"))
    words = f"{persons} simulated persons" if persons != 1 else "one simulated person"
    quick = ", quick run" if report["quick"] else ""
    figure.suptitle(
        f"Gaussian-process gaze on an ATmega328P at 16 MHz: cycles against error, {words}{quick}",
        fontsize=17,
        color=INK,
    )
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _lines(axis, report, key, kinds):
    """A faint line a data set, the median of each kind bold, sizes written along it."""
    for kind in kinds:
        colour, words = KINDS[kind]
        sets = inference_judge.by_dataset(report["frontier"], kind)
        for rows in sets.values():
            rows = [row for row in rows if row[key] is not None]
            axis.plot(
                [row["cycles"] for row in rows],
                [row[key] for row in rows],
                "-",
                color=colour,
                lw=0.8,
                alpha=0.3 if len(sets) > 1 else 0.8,
            )
        sizes = sorted({row["n"] for rows in sets.values() for row in rows})
        middle = []
        for n in sizes:
            same = [row for rows in sets.values() for row in rows if row["n"] == n and row[key] is not None]
            if same:
                middle.append(
                    (n, np.median([row["cycles"] for row in same]), np.median([row[key] for row in same]))
                )
        if not middle:
            continue
        n, cycles, value = np.array(middle).T
        label = f"{words}, median of {len(sets)}"
        axis.plot(cycles, value, "o-", color=colour, lw=2.6, ms=6, label=label, zorder=4)
        if kind == kinds[0]:
            for at in range(len(n)):
                axis.annotate(
                    f"{n[at]:.0f}",
                    (cycles[at], value[at]),
                    textcoords="offset points",
                    xytext=(4, 7),
                    fontsize=9,
                    color=colour,
                    fontweight="bold",
                    zorder=5,
                )


def _cycles_axis(axis):
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axis.grid(alpha=0.22)
    for limit, words, style in (
        (inference_judge.CYCLES_AIM, "aim", ":"),
        (inference_judge.CYCLES_BAR, "bar", "--"),
    ):
        axis.axvline(limit, color=GREY, ls=style, lw=1.2, zorder=1)
        axis.text(
            limit,
            0.012,
            f"{words}: {limit:,} ",
            rotation=90,
            va="bottom",
            ha="right",
            fontsize=9,
            color=GREY,
            transform=axis.get_xaxis_transform(),
        )


def _distance(axis, report):
    _lines(axis, report, "rms_to_gp_deg", ("simulated", "smooth", "sharp"))
    axis.set_yscale("log")
    _cycles_axis(axis)
    for limit, words, style, colour in (
        (inference_judge.RMS_BAR_DEG, "bar, persons", "--", BLUE),
        (inference_judge.RMS_AIM_DEG, "aim, persons", ":", BLUE),
        (inference_judge.SMOOTH_BAR_DEG, "bar, smooth sets", "--", GREEN),
    ):
        axis.axhline(limit, color=colour, ls=style, lw=1.2, alpha=0.7, zorder=1)
        axis.text(
            0.995,
            limit,
            words + " ",
            ha="right",
            va="bottom",
            fontsize=8,
            color=colour,
            transform=axis.get_yaxis_transform(),
        )
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set(
        xlabel="cycles a prediction, features in to gaze out (worst row, counted); numbers: vectors",
        ylabel="rms distance to the full float64 process (deg)",
    )
    axis.set_title("How close the device comes to the full process", color=INK)
    axis.legend(fontsize=9, loc="upper right", framealpha=0.9)


def _truth(axis, report):
    kinds = ("simulated", "smooth")
    _lines(axis, report, "truth_mean_deg", kinds)
    for kind in kinds:
        own = [row["gp64_truth_mean_deg"] for row in report["frontier"] if row["kind"] == kind]
        own = [value for value in own if value is not None]
        if own:
            axis.axhline(np.median(own), color=KINDS[kind][0], ls="-.", lw=1.2, alpha=0.8, zorder=1)
            axis.text(
                0.005,
                np.median(own),
                " full process, float64",
                fontsize=8,
                va="bottom",
                color=KINDS[kind][0],
                transform=axis.get_yaxis_transform(),
            )
    _cycles_axis(axis)
    peers = [row for row in report.get("peers", []) if row["cycles"] and row["truth_mean_deg"]]
    by_name = {}
    for row in peers:
        kind = "simulated" if row["dataset"].startswith("sim") else "smooth"
        by_name.setdefault((row["name"], kind), []).append(row)
    drawn = []
    for (name, kind), rows in by_name.items():
        colour = next(colour for begin, colour in PEER_COLOURS if name.startswith(begin))
        at = np.median([row["cycles"] for row in rows]), np.median([row["truth_mean_deg"] for row in rows])
        fits = all(row["fits"] for row in rows)
        axis.plot(
            *at,
            "s" if kind == "simulated" else "^",
            color=colour,
            ms=8,
            mfc=colour if fits else "white",
            zorder=3,
        )
        drawn.append((at, name, colour))
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    peers_words = "squares: peers on persons, triangles: on smooth sets, hollow: do not fit" if peers else ""
    axis.set(xlabel="cycles a prediction", ylabel="mean error to where the eye really looked (deg)")
    axis.set_title("What it is worth" + (f"\n{peers_words}" if peers_words else ""), color=INK, fontsize=11)
    axis.legend(fontsize=9, loc="upper right", framealpha=0.9)
    if drawn:
        axis.set_xlim(right=12 * max(at[0] for at, _, _ in drawn))  # room for names
        axis.xaxis.set_major_locator(LogLocator(numticks=20))
        _labelled(axis, drawn)


def _labelled(axis, drawn):
    """Write names beside points, (place, name, colour) each, moved up or down off one another."""
    axis.figure.canvas.draw()
    scale, taken = 72.0 / axis.figure.dpi, []  # points per pixel
    boxes = [scale * axis.transData.transform(at) for at, _, _ in drawn]
    for (at, name, colour), (x, y) in sorted(zip(drawn, boxes), key=lambda pair: tuple(pair[1])):
        words = name.replace("naive float C", "naive float")[:46]
        for shift in LABEL_SHIFTS:
            box = (x + 7, y + shift, x + 7 + LABEL_WIDTH * len(words), y + shift + LABEL_HEIGHT)
            if not any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
                place = dict(textcoords="offset points", xytext=(7, shift), fontsize=7.5)
                axis.annotate(words, at, color=colour, zorder=3, **place)
                taken.append(box)
                break


def _people(axis, report):
    chosen = []
    for cycles, colour, word in (
        (inference_judge.CYCLES_BAR, BLUE, "bar"),
        (inference_judge.CYCLES_AIM, GOLD, "aim"),
    ):
        sets = inference_judge.by_dataset(report["frontier"], "simulated")
        best = [inference_judge.within(rows, cycles) for rows in sets.values()]
        best = [row for row in best if row is not None and row["rms_to_gp_deg"]]
        if best:
            x, y = [row["rms_to_gp_deg"] for row in best], [inference_judge.ratio(row) for row in best]
            axis.plot(x, y, "o", color=colour, ms=7, alpha=0.8, label=f"within {cycles:,} cycles ({word})")
            chosen += y
    axis.axhline(inference_judge.RATIO_BAR, color=GREY, ls="--", lw=1.2)
    axis.axhline(1.0, color=GREY, lw=0.8)
    axis.axvline(inference_judge.RMS_BAR_DEG, color=GREY, ls="--", lw=1.2)
    axis.axvline(inference_judge.RMS_AIM_DEG, color=GREY, ls=":", lw=1.2)
    axis.set(
        xscale="log",
        xlabel="rms distance to the full process (deg)",
        ylabel="truth error, over that of the full process",
    )
    axis.set_title("Each simulated person, best model within a budget", color=INK)
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.22)
    if chosen:
        axis.legend(fontsize=9, loc="best")


def _knowing(axis, report):
    known = report["variance"]
    names, values, wanted = [], [], []
    for key, words, goal in (
        ("coverage68", "device: target within 1 sigma", 0.6827),
        ("coverage95", "device: target within 1.96", 0.95),
        ("truth_coverage68", "device: true gaze within 1 sigma", 0.6827),
        ("gp64_coverage68", "float64 process: target within 1", 0.6827),
        ("gp64_coverage95", "float64 process: target within 1.96", 0.95),
        ("shut_flagged", "shut lids flagged", 1.0),
        ("half_flagged", "half-shut lids flagged", 1.0),
        ("narrow_flagged", "narrowed lids flagged", 1.0),
        ("false_alarms", "open lids flagged", 0.0),
    ):
        if known.get(key) is not None:
            names.append(words)
            values.append(known[key])
            wanted.append(goal)
    y = np.arange(len(names))[::-1]
    axis.barh(
        y, values, color=[BLUE if "flagged" not in name else PLUM for name in names], height=0.62, alpha=0.85
    )
    axis.plot(wanted, y, "|", color=RED, ms=18, mew=2.2, label="as it should be")
    for at, value, goal in zip(y, values, wanted):
        axis.text(
            goal + 0.02 if 0 <= goal - value < 0.1 else value + 0.015,
            at,
            f"{100 * value:.1f} %",
            va="center",
            fontsize=9,
            color=INK,
        )
    axis.set(yticks=y, xlim=(0, 1.15), xlabel="share of frames, mean of the persons")
    axis.set_yticklabels(names, fontsize=9)
    axis.set_title("Knowing when it does not know", color=INK)
    axis.legend(fontsize=8, loc="lower right")
    axis.grid(alpha=0.22, axis="x")


def _bars(axis, report):
    axis.set_axis_off()
    rows = report["bars"]
    axis.set_title("Bars and aims", color=INK)
    step = min(0.075, 1.0 / max(1, len(rows)))
    for at, row in enumerate(rows):
        word = "met" if row["met"] else "MISSED" if row["kind"] == "bar" else "short"
        colour = {"met": GREEN, "MISSED": RED, "short": GOLD}[word]
        y = 1.0 - (at + 0.6) * step
        value = "none" if row["value"] is None else f"{row['value']:.4g}"
        axis.text(0.0, y, word, color=colour, fontsize=8.8, fontweight="bold", transform=axis.transAxes)
        axis.text(0.105, y, row["name"], color=INK, fontsize=8.8, transform=axis.transAxes)
        axis.text(0.86, y, value, color=INK, fontsize=8.8, ha="right", transform=axis.transAxes)
        axis.text(
            0.88, y, f"{row['kind']} {row['limit']}", color=GREY, fontsize=8.8, transform=axis.transAxes
        )
