# SPDX-License-Identifier: Apache-2.0
"""Which bars the front end meets."""

import sys

from frontend_faults import to_name
from frontend_size import RAM_BYTES

RATE_HZ, VECTORS_AIM = 1000.0, 64
TRUTH_RATIO = 1.05  # of the inference benchmark: the device's error over the full process's
LATENCY_MEAN_MS, LATENCY_LAST_MS = 2.5, 1.5
S2S_DEG, S2S_250_DEG = 0.35, 0.18
RATIO = {"room": 1.1, "bright_room": 1.5, "sun_gap": 3.0}
STEP_SATURATED, STEP_SETTLE = 5, 10
# of report keys, in words, and whether the bar is judged at it
LATE = 0.01  # of frames, in ambient light
SETTINGS = (("_250", "4 cycles a frame", "bar"), ("", "default setting", "aim"))
VALID, VALID_NOMINAL = 0.8, 0.95  # what is left out may not be what is wrong
PLACES = 25  # of the grid
FLICKER, IRRADIANCE_W_M2, SPARE = 1.2, 100.0, 0.10
LEGEND = """\
  MISSED: a bar, a figure that is demanded, is not reached by the worst person, or was not measured; the exit
          code is 1. One frame of 60,000 is enough: nothing is rounded in its favour.
  short:  an aim, a figure that is wished for, is not reached. * is the default setting."""
FAULTS = {  # kinds of episodes whose names begin so
    "an LED, a finger": ("open", "short", "covered", "finger"),
    "LEDs swapped": ("swapped",),
    "supply": ("supply",),
    "blinks, looking about, steps of light": ("blinks", "looking", "ambient"),
}
BITS_APART = 0.25  # closed form against Monte Carlo of 500 draws: 5 standard errors


def bars(report):
    """[{name, value, limit, met, kind}] of what was measured; kind: bar, or aim, which is wished for."""
    rows = []

    def most(name, value, limit, kind="bar"):
        met = value is not None and value <= limit
        rows.append({"name": name, "value": value, "limit": f"<= {limit:g}", "met": bool(met), "kind": kind})

    def least(name, value, limit, kind="bar"):
        met = value is not None and value >= limit
        rows.append({"name": name, "value": value, "limit": f">= {limit:g}", "met": bool(met), "kind": kind})

    if "bits" in report:
        most("bits: closed form and Monte Carlo apart", report["bits_apart"], BITS_APART)
        chosen = [row for row in report["bits"] if row["chosen"] and row["feasible_at_1khz"]]
        least("bits: rows of the chosen point", len(chosen), 1)
    if report.get("patterns"):
        best = report["patterns"][0]
        most(
            "patterns: chosen over best, RMS-S2S", _chosen(report)["s2s_mean_deg"] / best["s2s_mean_deg"], 1.0
        )
    if "rate_hz" in report:
        least("* rate_hz, gaze on the wire, device time", report["rate_hz"], RATE_HZ)
        least("* rate: seconds streamed", report["stream_seconds"], 2.9 if report["quick"] else 59.9)
        most("* late slots and frames", report["late"], 0)
        most("* lost frames", report["lost"], 0)
        most("* truth error of the model over the full process's", report["truth_ratio"], TRUTH_RATIO)
        least("* n_vectors", report["n_vectors"], VECTORS_AIM, "aim")
        for key, limit in (("latency_mean", LATENCY_MEAN_MS), ("latency_last", LATENCY_LAST_MS)):
            most(f"* {key}_ms, from the {key[8:]} sample (time) to the last byte", report[key + "_ms"], limit)
            most(f"* {key}_max_ms, of all frames", report[key + "_max_ms"], limit, "aim")
        for key, limit in (("s2s_deg", S2S_DEG), ("s2s_250_deg", S2S_250_DEG)):
            most(f"* {key}, nominal", report[key], limit)
            for light in ("dim", "bright"):
                if f"{key}_{light}" in report:
                    most(f"{key}, {light}", report[f"{key}_{light}"], limit, "aim")
        least("* valid frames, nominal", report["valid_nominal"], VALID_NOMINAL)
        least("places of the grid with a gaze, in every light of a bar", report["places"], PLACES)
        for name, limit in RATIO.items():
            most(f"error_ratio_250.{name}, set to 4 cycles a frame", report["error_ratio_250"][name], limit)
            most(f"error_ratio.{name}, default setting", report["error_ratio"][name], limit, "aim")
            least(f"valid frames, {name}, set to 4 cycles a frame", report["valid_250"][name], VALID)
            least(f"valid frames, {name}, default setting", report["valid"][name], VALID, "aim")
            for key, setting, kind in SETTINGS:
                saturated = report["saturated_after" + key][name]
                most(f"saturated frames after the first 5, {name}, {setting}", saturated, 0, kind)
                if "late_in" in report:  # not in reports of before
                    most(f"share of frames late, {name}, {setting}", report["late_in" + key][name], LATE, "aim")
                    most(f"lost frames of a second, {name}, {setting}", report["lost_in" + key][name], 0, "aim")
        for key, setting, kind in SETTINGS:
            step = report["step" + key]
            most(f"step.saturated_frames, {setting}", step["saturated_frames"], STEP_SATURATED, kind)
            most(f"step.settle_frames, {setting}", step["settle_frames"], STEP_SETTLE, kind)
        most("exposure_shift_deg over RMS-S2S", report["exposure_shift_over_s2s"], 1.0)
        most(
            "flicker_ratio_250, over steady light, set to 4 cycles a frame",
            report["flicker_ratio_250"],
            FLICKER,
        )
        least("valid frames, flicker, set to 4 cycles a frame", report["valid_flicker_250"], VALID)
        most("flicker_ratio, over steady light, default setting", report["flicker_ratio"], FLICKER, "aim")
    if "faults" in report:
        found = report["faults"]["rows"]
        for group, kinds in FAULTS.items():
            for repeats, setting in ((1, "default setting"), (4, "4 cycles a frame")):
                part = [row for row in found if row["repeats"] == repeats and row["kind"].startswith(kinds)]
                if part:
                    wild = sum(row["wild"] for row in part)
                    most(f"faults: wild gazes called VALID, {group}, {setting}", wild, 0)
        due = [row for row in found if to_name(row["kind"])]
        share = sum(row["named"] for row in due) / max(1, sum(row["episodes"] for row in due))
        least("faults: share of those due that status names", share if due else None, 1.0)
        alarms = [row["false_alarms"] for row in found if row["false_alarms"] is not None]
        most("faults: false alarms where nothing is broken", sum(alarms) if alarms else None, 0)
    if "irradiance_w_m2" in report:
        for case, value in report["irradiance_w_m2"].items():
            most(f"irradiance_w_m2, {case}", value, IRRADIANCE_W_M2)
        least("margin of every limit of IEC 62471's exempt group", report["margin"], 1.0)
    if "flash" in report:
        flash = report["flash"]
        least("flash to spare, share, beside Optiboot's 512 B", flash["spare"], SPARE)
        if "spare_old_loader" in flash:  # not in reports of before
            old = flash["spare_old_loader"]
            least("flash to spare, share, beside the older loader's 2 KiB", old, SPARE, "aim")
    if "stack_free" in report:
        least("RAM never touched, share", report["stack_free"] / RAM_BYTES, SPARE)
    return rows


def _chosen(report):
    return next(row for row in report["patterns"] if row["chosen"])


def tell(report, folder):
    """Print the bars. Returns the exit code."""
    missed = []
    for one in report["bars"]:
        word = "met" if one["met"] else "MISSED" if one["kind"] == "bar" else "short"
        value = "none" if one["value"] is None else f"{one['value']:.4g}"
        print(f"  {word:6} {one['name']:58} {value:>10}   {one['kind']} {one['limit']}")
        if word == "MISSED":
            missed.append(one)
    print(LEGEND)
    print(f"{folder}/frontend.json and frontend.png written, {report['seconds']:.0f} s")
    for one in missed:
        value = "none" if one["value"] is None else f"{one['value']:.4g}"
        print(f"bench-frontend: bar missed: {one['name']} is {value}, needs {one['limit']}", file=sys.stderr)
    return 1 if missed else 0
