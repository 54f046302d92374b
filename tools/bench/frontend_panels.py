# SPDX-License-Identifier: Apache-2.0
"""Panels of frontend.png about the device: precision, ambient light, steps, flicker and shift, rate,
light."""

import numpy as np
from frontend_measures import AMBIENTS, STEADY
from frontend_run import flicker_ratio

BLUE, RED, GREY, GREEN, ORANGE = "#2f6690", "#c8553d", "#9aa5b1", "#588157", "#e09f3e"
LIGHT_COLOURS = {"nominal": BLUE, "dim": GREY, "bright": ORANGE}
RATIO_BARS = {"room": 1.1, "bright_room": 1.5, "sun_gap": 3.0}


def _precision(axis, report):
    rows = report["device"]
    for light, colour in LIGHT_COLOURS.items():
        at = [k for k, row in enumerate(rows) if light in row["precision"]]
        for key, mark in (("s2s_deg", "o"), ("s2s_250_deg", "s")):
            values = [rows[k]["precision"][light][key] for k in at]
            axis.plot(at, values, mark, color=colour, label=f"{light}, {'each' if mark == 'o' else '250 Hz'}")
        axis.plot(at, [rows[k]["noise"][light]["bound_deg"] for k in at], "_", color=colour, ms=14)
    axis.axhline(0.35, color=RED, ls="--", lw=1)
    axis.axhline(0.18, color=RED, ls=":", lw=1)
    _persons(axis, rows)
    axis.set(
        ylabel="RMS-S2S (deg)", title="Precision within +-20 deg (dashes: Cramer-Rao bound)", ylim=(0, None)
    )
    axis.legend(fontsize=7, ncol=3)


def _persons(axis, rows):
    axis.set_xticks(range(len(rows)), labels=[str(row["seed"]) for row in rows])
    axis.set_xlabel("simulated person")
    axis.grid(alpha=0.3)


def _noise(axis, report):
    for row in report["device"]:
        for light, found in row["noise"].items():
            label = light if row is report["device"][0] else None
            style = {"color": LIGHT_COLOURS[light], "ms": 4, "label": label}
            axis.plot(found["expected"], found["measured"], "o", **style)
    most = max(axis.get_xlim()[1], axis.get_ylim()[1])
    axis.plot([0, most], [0, most], "-", color=GREY, lw=1)
    axis.set(
        xlabel="expected RMS of a feature (1/4096 octave)",
        ylabel="measured",
        title="Noise of the six features by the closed form",
    )
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)


def _ambient(axis, report):
    names = AMBIENTS[1:]
    for k, row in enumerate(report["device"]):
        for table, colour, shift in (("ambient", BLUE, -0.12), ("ambient_250", GREEN, 0.12)):
            ratio = [row[table][name]["error_deg"] / row[table]["dark"]["error_deg"] for name in names]
            label = {"ambient": "1000 Hz", "ambient_250": "250 Hz"}[table] if k == 0 else None
            axis.plot(np.arange(len(names)) + shift, ratio, "o", color=colour, alpha=0.8, label=label)
    for k, name in enumerate(names):
        axis.plot([k - 0.3, k + 0.3], [RATIO_BARS[name]] * 2, "--", color=RED)
    axis.set_xticks(range(len(names)), labels=[name.replace("_", " ") for name in names])
    axis.set(
        ylabel="error over the dark's", title="Gaze error in ambient light (dashed: bars)", ylim=(0.5, None)
    )
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)


def _steps(axis, report):
    for name, colour in (("up", RED), ("down", BLUE)):
        for k, row in enumerate(report["device"]):
            step = row["step"][name]
            course = [np.nan if value is None else value / step["steady_deg"] for value in step["course_deg"]]
            axis.plot(
                course[: STEADY.start], color=colour, lw=0.9, label=f"{name} 1000:1" if k == 0 else None
            )
    axis.axhline(1.1, color="black", ls="--", lw=1)
    axis.axvline(10, color="black", ls=":", lw=1)
    ticks = (0.5, 1, 2, 5, 10)
    axis.set(
        xlabel="frame after the step",
        ylabel="error over the new level's",
        title="Steps of ambient light (gaps: flagged frames;\ndashes: settled, within 10 frames is the bar)",
        yscale="log",
    )
    axis.set_yticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)


def _shift(axis, report):
    rows = report["device"]
    place = np.arange(len(rows))
    for table, shift, colour in (("flicker", -0.27, GREY), ("flicker_250", 0.0, ORANGE)):
        ratio = [flicker_ratio(row[table]) for row in rows]
        name = "250 Hz" if table == "flicker_250" else "1000 Hz"
        axis.bar(
            place + shift, ratio, 0.27, color=colour, label=f"flicker over steady light, {name} (bar 1.2)"
        )
    moved = [row["shift"]["exposure_shift_deg"] / row["shift"]["s2s_deg"] for row in rows]
    axis.bar(place + 0.27, moved, 0.27, color=GREEN, label="moved by exposures, over RMS-S2S (bar 1)")
    axis.axhline(1.2, color=ORANGE, ls="--", lw=1)
    axis.axhline(1.0, color=GREEN, ls="--", lw=1)
    _persons(axis, rows)
    most = max(axis.get_ylim()[1], 1.3)
    axis.set(ylabel="ratio", title="Flicker of the signal's size; held exposures", ylim=(0, 1.35 * most))
    axis.legend(fontsize=8, loc="upper center")


def _stream(axis, report):
    rows = report["device"]
    place = np.arange(len(rows))
    for key, colour, bar in (("latency_mean", BLUE, 2.5), ("latency_last", GREEN, 1.5)):
        found = [row["stream"]["latency"] for row in rows]
        values = [one[key + "_ms"] for one in found]
        most = [one[key + "_max_ms"] for one in found]
        label = f"from the {'mean sample time' if key == 'latency_mean' else 'last sample'} (bar {bar} ms)"
        axis.plot(place, values, "o", color=colour, label=label)
        axis.plot(place, most, "_", color=colour, ms=16)
        axis.axhline(bar, color=colour, ls="--", lw=1)
    _persons(axis, rows)
    rate = min(row["stream"]["rate_hz"] for row in rows)
    axis.set(
        ylabel="ms of device time",
        title=f"Latency to the last byte (dash: maximum), {rate:.1f} Hz",
        ylim=(0, None),
    )
    axis.legend(fontsize=8)


PANELS = [_precision, _noise, _ambient, _steps, _shift, _stream]
