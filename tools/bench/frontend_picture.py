# SPDX-License-Identifier: Apache-2.0
"""frontend.png: what bench_frontend.py measured, one panel a question; a section not run leaves its panels
out."""

import frontend_methods
import matplotlib
from frontend_node import METHODS

matplotlib.use("Agg")
import numpy as np  # noqa: E402
from matplotlib import pyplot  # noqa: E402

BLUE, RED, GREY, GREEN, ORANGE = "#2f6690", "#c8553d", "#9aa5b1", "#588157", "#e09f3e"
SHOWN = {
    "cathode_5v": RED,
    "cathode_1v1": "#7a4419",
    "anode_supply": ORANGE,
    "zero_bias": "#8e6c8a",
    "rail": BLUE,
    "rail_x4": "#7fb2d6",
    "comparator_divider": GREEN,
    "comparator_bandgap": "#a3b18a",
}
CLOCK_COLOURS = {125: GREY, 250: BLUE, 500: GREEN, 1000: RED}


def draw(path, report):
    """The panels of a report (dict of bench_frontend.run) into a PNG."""
    panels = []
    if report.get("bits"):
        panels += [_methods, _light, _clocks, _static]
    if report.get("patterns"):
        panels.append(_patterns)
    if report.get("device"):
        import frontend_panels

        panels += frontend_panels.PANELS
    if report.get("safety"):
        panels.append(_safety)
    if not panels:
        return
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(6.2 * columns, 4.6 * rows), squeeze=False)
    for axis in axes.ravel()[len(panels) :]:
        axis.axis("off")
    for panel, axis in zip(panels, axes.ravel()):
        panel(axis, report)
    figure.suptitle(f"The LED front end; simulated persons {report['seeds']}", fontsize=13)
    figure.tight_layout(rect=(0, 0, 1, 0.985))
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def _rows(report, method, adc_khz, light):
    return [
        row
        for row in report["bits"]
        if row["method"] == method
        and row["adc_khz"] in (adc_khz, 0)
        and (row["photocurrent_na"], row["ambient_na"]) == light
        and row["random_bits"]
    ]


def _line(axis, rows, colour, label):
    """Bits of noise over exposure: a strong line as far as six channels make 1000 frames/s, then a faint
    one."""
    t, b = np.array([[row["exposure_us"], row["random_bits"]] for row in rows]).T
    fits = np.array([row["feasible_at_1khz"] for row in rows])
    axis.plot(t, b, "-", color=colour, lw=0.8, alpha=0.6)
    axis.plot(t[fits], b[fits], "o-", color=colour, lw=2.0, ms=4)
    axis.plot([], [], "o-", color=colour, label=label)


def _bits_axis(axis, title):
    axis.set(
        xscale="log",
        xlabel="exposure (us)",
        ylabel="effective bits (random noise)",
        title=title,
        ylim=(0, 9.5),
    )
    shown = [t for t in frontend_methods.EXPOSURES_US if t not in (103, 159)]
    axis.set_xticks(shown, labels=[str(t) for t in shown], fontsize=7)
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7, loc="upper left")


def _mark(axis, report, light):
    name, adc_khz, exposure_us = frontend_methods.CHOSEN
    for row in _rows(report, name, adc_khz, light):
        if row["exposure_us"] == exposure_us:
            axis.plot(exposure_us, row["random_bits"], "*", color="black", ms=15, zorder=5)
            axis.annotate(
                "chosen", (exposure_us, row["random_bits"]), (exposure_us * 1.25, row["random_bits"] - 1.1)
            )


def _methods(axis, report, light=(200, 0)):
    for method in METHODS:
        rows = _rows(report, method.name, 250, light)
        if method.name in SHOWN and rows:
            _line(axis, rows, SHOWN[method.name], method.title)
    _mark(axis, report, light)
    _bits_axis(axis, "Methods at 200 nA, dark, ADC clock 250 kHz\n(strong: six channels at 1000 frames/s)")


def _light(axis, report):
    name, adc_khz, exposure_us = frontend_methods.CHOSEN
    colours = (BLUE, GREY, GREEN, RED)
    for light, colour in zip(frontend_methods.LIGHTS, colours):
        rows = _rows(report, name, adc_khz, light)
        if rows:
            _line(
                axis,
                rows,
                colour,
                f"{light[0]} nA" + (f" beside {light[1]} nA ambient" if light[1] else ", dark"),
            )
    _bits_axis(axis, "The chosen method by light")


def _clocks(axis, report):
    for adc_khz, colour in CLOCK_COLOURS.items():
        rows = _rows(report, "rail", adc_khz, (200, 0))
        slots = "fits" if any(row["feasible_at_1khz"] for row in rows) else "does not fit"
        _line(axis, rows, colour, f"ADC at {adc_khz} kHz ({slots} at 1000 frames/s)")
    _mark(axis, report, (200, 0))
    _bits_axis(axis, "ADC clocks, chosen circuit, 200 nA, dark")


def _static(axis, report):
    exposure = frontend_methods.CHOSEN[2]
    names, before, after = [], [], []
    for method in METHODS:
        for row in _rows(report, method.name, 250, (200, 0)):
            if row["exposure_us"] == exposure and row["static_bits"] is not None:
                names.append(method.title)
                before.append(row["static_raw_bits"])
                after.append(row["static_bits"])
    place = np.arange(len(names))
    axis.barh(place + 0.2, after, 0.4, color=BLUE, label="after self-calibration")
    axis.barh(place - 0.2, before, 0.4, color=GREY, label="as the parts come")
    axis.set_yticks(place, labels=names, fontsize=7)
    axis.set(
        xlabel="effective bits (static error)", title=f"Static error, 200 nA for {exposure} us", xlim=(0, 16)
    )
    axis.invert_yaxis()
    axis.legend(fontsize=7)


def _patterns(axis, report):
    rows = report["patterns"]
    place = np.arange(len(rows))
    colours = [BLUE if row["chosen"] else GREY for row in rows]
    axis.barh(place, [row["s2s_mean_deg"] for row in rows], color=colours)
    axis.plot([row["s2s_worst_deg"] for row in rows], place, "k|", ms=10, label="worst person")
    axis.axvline(0.35, color=RED, ls="--", lw=1, label="bar")
    axis.set_yticks(place, labels=[row["pattern"] for row in rows], fontsize=8)
    axis.set(xlabel="RMS-S2S (deg), simulated persons", title="Who emits while who senses", xlim=(0, 1.5))
    axis.invert_yaxis()
    axis.legend(fontsize=7)


def _safety(axis, report):
    """How far each quantity is from its limit, in every case."""
    rows = [row for row in report["safety"]["rows"] if row["margin"]]
    place = np.arange(len(rows))
    colours = {"normal": GREEN, "any command": BLUE, "any fault": ORANGE}
    axis.barh(place, [row["margin"] for row in rows], color=[colours.get(row["case"], GREY) for row in rows])
    axis.axvline(1.0, color=RED, ls="--", lw=1)
    axis.set_yticks(place, labels=[f"{row['case']}: {row['quantity']}" for row in rows], fontsize=7)
    axis.set(xscale="log", xlabel="limit over value", title="IEC 62471, exempt group (dashed: the limit)")
    axis.set_xlim(0.5, None)
    axis.invert_yaxis()
