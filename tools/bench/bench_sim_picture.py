# SPDX-License-Identifier: Apache-2.0
"""sim.png: what the benchmark of the simulator measured, for somebody who would rather look than read."""

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot
from matplotlib.ticker import LogLocator, NullFormatter

BLUE, RED, GREY, GREEN, GOLD, PLUM = "#2f6690", "#c8553d", "#9aa5b1", "#588157", "#d9a441", "#7d4e57"
STYLE = {  # colour, marker, line, words
    "sparsegaze": (BLUE, "o", "-", "ours: whole maps, the peers' scene"),
    "sparsegaze, whole scene": (BLUE, "o", ":", "ours: whole maps, the default headset"),
    "tables": (GREEN, "D", "", "ours: tables between their nodes, made before"),
    "image method": (GOLD, "s", "-", "our image method, the peers' scene"),
    "image method, whole scene": (GOLD, "s", ":", "our image method, the default headset"),
    "Mitsuba 3 llvm_ad_mono": (RED, "^", "", "Mitsuba 3, llvm"),
    "Mitsuba 3 scalar_rgb": (PLUM, "v", "", "Mitsuba 3, scalar"),
}


def draw(path, report):
    """Six panels into a PNG; a section that was not run leaves its panel empty.

    report    dict of tools/bench/bench_sim.py
    """
    figure, axes = pyplot.subplots(2, 3, figsize=(19, 11), constrained_layout=True)
    for axis, key, panel in (
        (axes[0, 0], "curves", _curves),
        (axes[0, 1], "scenes", _scenes),
        (axes[0, 2], "ring", _ring),
        (axes[1, 0], "scaling", _scaling),
        (axes[1, 1], "images", _images),
        (axes[1, 2], "bars", _bars),
    ):
        if report.get(key):
            panel(axis, report)
        else:
            axis.set_axis_off()
            axis.text(0.5, 0.5, key + ": not run", ha="center", color=GREY, transform=axis.transAxes)
    machine = report["machine"]
    figure.suptitle(
        "sparsegaze simulator: %s, %s, %d cores%s"
        % (report["headset"], machine["cpu"], machine["cores"], ", quick run" if report["quick"] else ""),
        fontsize=15,
    )
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _curves(axis, report):
    curves = report["curves"]
    for name, rows in curves.items():
        colour, marker, line, words = STYLE.get(name, (GREY, ".", "", name))
        samplers = {}
        for row in rows:
            samplers.setdefault(row["label"].partition(", ")[2], []).append(row)
        for sampler, members in sorted(samplers.items()):
            x, y = np.array(sorted((row["seconds"], row["rms"]) for row in members)).T
            inside = "white" if sampler == "independent" or line == ":" else colour
            label = words + (", " + sampler if sampler else "")
            axis.plot(x, y, marker + line, color=colour, ms=7, lw=1.6, mfc=inside, label=label)
        for row in rows if line == "-" else []:
            place = (row["seconds"], row["rms"])
            axis.annotate(
                row["label"], place, textcoords="offset points", xytext=(8, 3), fontsize=8, color=colour
            )
    axis.axhline(1e-3, color=GREY, ls=":", lw=1)
    axis.axhline(1e-4, color=GREY, ls="--", lw=1)
    axis.text(
        0.99,
        1e-4,
        "bar of the maps ",
        ha="right",
        va="bottom",
        fontsize=8,
        color=GREY,
        transform=axis.get_yaxis_transform(),
    )
    axis.text(
        0.99,
        1e-3,
        "costs are compared here ",
        ha="right",
        va="bottom",
        fontsize=8,
        color=GREY,
        transform=axis.get_yaxis_transform(),
    )
    axis.set(
        title="Speed against error, one response",
        xscale="log",
        yscale="log",
        xlabel="seconds per response (one sensor, one emitter, one gaze; every core)",
        ylabel="rms error (of the mean response)",
    )
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8, loc="lower left")
    axis.set_ylim(bottom=min(row["rms"] for rows in curves.values() for row in rows) / 1000)


def _scenes(axis, report):
    rows = report["scenes"]
    y = np.arange(len(rows))[::-1]
    for key, colour, marker in (
        ("rms_total", BLUE, "o"),
        ("rms_diffuse", GREEN, "|"),
        ("rms_glint", GOLD, "x"),
        ("max_total", RED, ">"),
    ):
        axis.plot(
            [max(row[key], 1e-8) for row in rows],
            y,
            marker,
            color=colour,
            ms=8,
            mew=1.8,
            label=key.replace("_", " of ").replace("max of", "largest of"),
            ls="none",
        )
    for at, row in zip(y, rows):
        if not row["estimate_bounds"]:
            axis.axhspan(at - 0.5, at + 0.5, color=RED, alpha=0.12, lw=0)
    axis.axvline(1e-4, color=GREY, ls="--", lw=1)
    axis.axvline(1e-3, color=GREY, ls=":", lw=1)
    bounded = sum(row["estimate_bounds"] for row in rows)
    axis.set(
        title="Error against adaptive cubature; within our bound: %d of %d" % (bounded, len(rows)),
        xscale="log",
        xlabel="error (of the mean total response); bars: rms 1e-4, largest 1e-3",
        yticks=y,
        ylim=(-0.7, len(rows) - 0.3),
    )
    axis.set_yticklabels([row["name"] for row in rows], fontsize=8)
    axis.grid(alpha=0.25, axis="x")
    axis.legend(fontsize=8, loc="best")


def _ring(axis, report):
    ring = report["ring"]
    axis.plot(
        ring["azimuth_deg"],
        ring["glint_over_median"],
        color=BLUE,
        lw=2,
        label="smooth limbus (blend %.1f mm): %.1f times the median"
        % (ring["limbus_blend_mm"], ring["peak_over_median"]),
    )
    axis.plot(
        ring["azimuth_deg"],
        ring["hard_crease_over_median"],
        color=RED,
        lw=1.4,
        ls="--",
        label="hard crease: %.1f times" % ring["hard_crease_peak_over_median"],
    )
    axis.annotate(
        "peak %.1f deg, %.1f deg wide" % (ring["peak_deg"], ring["fwhm_deg"]),
        (ring["peak_deg"], ring["peak_over_median"]),
        textcoords="offset points",
        xytext=(12, -4),
        fontsize=9,
    )
    axis.set(
        title="The bright ring at the corneal edge, along one row of gazes",
        xlabel="azimuth (deg, + temporal)",
        ylabel="glint over its median",
    )
    axis.set_ylim(0, 1.22 * max(ring["glint_over_median"]))
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8, loc="upper left")


def _scaling(axis, report):
    table = report["scaling"]
    gazes, pairs, seconds = (np.array(table[key]) for key in ("gazes", "pairs", "seconds"))
    memory = np.array(table["peak_mb"]) - np.array(table["base_mb"])
    responses = gazes * pairs
    by_gaze = pairs == 30
    for rows, colour, marker, label in (
        (by_gaze, BLUE, "o", "30 pairs, gazes grow"),
        (gazes == 441, GREEN, "s", "441 gazes, pairs grow"),
    ):
        order = np.flatnonzero(rows)[np.argsort(responses[rows])]
        axis.plot(
            responses[order], seconds[order], marker + "-", color=colour, ms=7, label="seconds: " + label
        )
        axis.plot(
            responses[order],
            memory[order],
            marker + ":",
            color=colour,
            ms=5,
            mfc="white",
            alpha=0.8,
            label="MB above the start: " + label,
        )
    axis.set(
        title="Cost of a map: exponents %s in gazes, %s in pairs"
        % tuple("?" if table[k] is None else "%.2f" % table[k] for k in ("exponent_gazes", "exponent_pairs")),
        xscale="log",
        yscale="log",
        xlabel="responses of the map (gazes x pairs)",
        ylabel="seconds; MB",
    )
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8)


def _images(axis, report):
    images = report["images"]
    axis.plot(images["pixels"], images["rms"], "s-", color=GOLD, ms=8, lw=1.8, label="image against ours")
    axis.axhline(
        images["extrapolated_rms"],
        color=BLUE,
        ls="--",
        label="what the images tend to, against ours: %.1e" % images["extrapolated_rms"],
    )
    axis.set(
        title="Images at rising resolution come to our integrals (order %.1f)" % images["order"],
        xscale="log",
        yscale="log",
        xlabel="pixels along a side",
        ylabel="rms difference (of the mean total response)",
    )
    axis.xaxis.set_major_locator(LogLocator(2))
    axis.set_xticks(images["pixels"], [str(n) for n in images["pixels"]])
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.25)
    axis.legend(fontsize=8)


def _bars(axis, report):
    axis.set_axis_off()
    axis.set(title="Bars and aims", xlim=(0, 1))
    rows = report["bars"]
    for i, row in enumerate(rows):
        y = 1 - (i + 0.7) / (max(len(rows), 24) + 0.5)
        colour = GREEN if row["met"] else (RED if row["kind"] == "bar" else GOLD)
        words = "met" if row["met"] else ("MISSED" if row["kind"] == "bar" else "short of")
        axis.text(0.0, y, row["name"], fontsize=9, transform=axis.transAxes)
        axis.text(0.64, y, "%.3g" % row["value"], fontsize=9, ha="right", transform=axis.transAxes)
        axis.text(
            0.66, y, "%s %s" % (row["kind"], row["limit"]), fontsize=9, color=GREY, transform=axis.transAxes
        )
        axis.text(
            1.0, y, words, fontsize=9, ha="right", color=colour, weight="bold", transform=axis.transAxes
        )
