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
    "rail_ground": "#b56576",
    "rail_any": "#6d6875",
    "rail_x4": "#7fb2d6",
    "comparator_divider": GREEN,
    "comparator_bandgap": "#a3b18a",
}
CLOCK_COLOURS = {125: GREY, 250: BLUE, 500: GREEN, 1000: RED}


def draw(path, report):
    """The panels of a report (dict of bench_frontend.run) into a PNG."""
    panels = []
    if report.get("bits"):
        panels += [_methods, _static, _light, _clocks]
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
    size = (6.2 * columns, 4.8 * rows)
    figure, axes = pyplot.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.ravel()[len(panels) :]:
        axis.axis("off")
    for panel, axis in zip(panels, axes.ravel()):
        panel(axis, report)
    figure.suptitle(f"The LED front end; simulated persons {report['seeds']}", fontsize=13)
    figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)
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


def _line(axis, rows, colour, label, key="random_bits"):
    """Bits over exposure: a strong line where six channels make 1000 frames/s, a faint one elsewhere."""
    t, b = np.array([[row["exposure_us"], row[key]] for row in rows]).T
    fits = np.array([row["feasible_at_1khz"] for row in rows])
    axis.plot(t, b, "-", color=colour, lw=0.9, alpha=0.7)
    axis.plot(t[fits], b[fits], "o-", color=colour, lw=2.0, ms=4, zorder=4 if colour == BLUE else 2)
    mark = {"marker": "o", "lw": 2.0} if fits.any() else {"lw": 0.9}
    axis.plot([], [], "-", color=colour, ms=4, label=label, **mark)


def _bits_axis(axis, title, error="random noise", most=9.5):
    axis.set(xscale="log", xlabel="exposure (us)", title=title)
    axis.set(ylabel=f"effective bits ({error})", ylim=(0, most))
    shown = [t for t in frontend_methods.EXPOSURES_US if t not in (103, 159, 300)]
    axis.set_xticks(shown, labels=[str(t) for t in shown], fontsize=8)
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    # Below the axis: lines fill the panel from corner to corner.
    axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncol=2, frameon=False)


def _mark(axis, report, light, key="random_bits"):
    name, adc_khz, exposure_us = frontend_methods.CHOSEN
    for row in _rows(report, name, adc_khz, light):
        if row["exposure_us"] == exposure_us:
            place = exposure_us, row[key]
            axis.plot(*place, "*", color="black", ms=15, zorder=5)
            box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1}
            words = f"chosen: {row[key]:.1f} bits"
            axis.annotate(words, place, (10, -16), textcoords="offset points", zorder=6, bbox=box)


def _methods(axis, report, light=(200, 0)):
    for method in METHODS:
        rows = _rows(report, method.name, 250, light)
        if method.name in SHOWN and rows:
            _line(axis, rows, SHOWN[method.name], method.title)
        elif method.name in SHOWN:
            axis.plot([], [], "x", color=SHOWN[method.name], label=f"{method.title}: nothing to read")
    _mark(axis, report, light)
    _bits_axis(axis, "Random noise by method, 200 nA, dark, 250 kHz\n(strong: six channels at 1000 frames/s)")


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
    _mark(axis, report, (200, 0))
    _bits_axis(axis, "The chosen method by light")


def _clocks(axis, report):
    for adc_khz, colour in CLOCK_COLOURS.items():
        rows = _rows(report, "rail", adc_khz, (200, 0))
        slots = "fits" if any(row["feasible_at_1khz"] for row in rows) else "does not fit"
        _line(axis, rows, colour, f"ADC at {adc_khz} kHz ({slots} at 1000 frames/s)")
    _mark(axis, report, (200, 0))
    _bits_axis(axis, "ADC clocks, chosen circuit, 200 nA, dark")


def _static(axis, report, light=(200, 0)):
    """Bits of static error over exposure: after self-calibration, and as the parts come (dotted)."""
    for method in METHODS:
        rows = [row for row in _rows(report, method.name, 250, light) if row["static_bits"] is not None]
        if method.name in SHOWN and rows:
            colour = SHOWN[method.name]
            _line(axis, rows, colour, method.title, "static_bits")
            raw = [(row["exposure_us"], row["static_raw_bits"]) for row in rows]
            axis.plot(*np.array(raw).T, ":", color=colour, lw=1.2)
    axis.plot([], [], ":", color="black", label="dotted: as the parts come")
    _mark(axis, report, light, "static_bits")
    title = "Static error by method, after self-calibration\n(strong: six channels at 1000 frames/s)"
    _bits_axis(axis, title, "static error", 16.5)


def _patterns(axis, report):
    rows = report["patterns"]
    place = np.arange(len(rows))
    colours = [BLUE if row["chosen"] else GREY for row in rows]
    axis.barh(place, [row["s2s_mean_deg"] for row in rows], color=colours)
    axis.plot([row["s2s_worst_deg"] for row in rows], place, "k|", ms=10, label="worst person")
    axis.axvline(0.35, color=RED, ls="--", lw=1, label="bar")
    for k, row in enumerate(rows):
        if row["s2s_worst_deg"] > 1.45:
            axis.text(1.46, k, f"worst {row['s2s_worst_deg']:.1f}", va="center", ha="right", fontsize=7)
    axis.set_yticks(place, labels=[row["pattern"] for row in rows], fontsize=8)
    axis.set(title="Who emits while who senses (blue: chosen)")
    axis.set(xlabel="RMS-S2S (deg), simulated persons", xlim=(0, 1.5))
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
    for k, row in enumerate(rows):
        figure = f"{row['margin']:.3g}" if row["margin"] < 1000 else f"{row['margin']:,.0f}"
        axis.text(1.15 * row["margin"], k, figure, va="center", fontsize=7)
    axis.set_xlim(0.5, 30 * max(row["margin"] for row in rows))
    axis.invert_yaxis()
