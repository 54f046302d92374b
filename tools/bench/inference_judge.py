# SPDX-License-Identifier: Apache-2.0
"""How good device models are on a data set, and which bars that meets.

Angles between directions (metrics.frame_errors_deg). *Judged* rows are those that the recording marks as
usable gaze (`valid`) and that the device does not flag; figures over all valid rows, flagged or not, stand
beside them with `all_` before their names. Truth is where the simulated eye really looked, not its target.
"""

import numpy as np

from sparsegaze import metrics
from sparsegaze.predict import predict

CYCLES_BAR, CYCLES_AIM = 11_000, 7_000
RATIO_BAR, RMS_BAR_DEG, RMS_AIM_DEG, SMOOTH_BAR_DEG = 1.05, 0.15, 0.05, 0.02
PERSONS_BAR, MAP_BAR = 20, 1e-4
PORTABLE_BAR = 40_000  # cycles of the portable loop at 64 vectors
HARD_BAR = 16  # kinds of hard cases that are asked for
FIT_BAR_S, PREDICTIONS_BAR, NAIVE_AIM = 20.0, 1e6, 40.0
EQUAL = 1.005  # errors that differ by half a percent are equal: what 2000 rows can tell
TARGETS = ("host", "nano", "cortex-m4")
EQUAL_ERROR = "equal error"  # in the name of the one that needs the full process's error
NAIVE = "naive float"  # how the peers' names of the float C baseline begin
SHARED_ROWS = 400  # slow peers take seconds a row
OPEN, BLINK = 0.99, 0.9  # lid openings: certainly open; a lid that is in the way
FIGURES = ("rms_to_gp_deg", "max_to_gp_deg", "truth_mean_deg", "gp64_truth_mean_deg")
Z95 = 1.959964


def distances_deg(first, second):
    """Angle between gazes [n, 2] and [n, 2], degrees, float64 [n]."""
    return metrics.frame_errors_deg(first[:, 0], first[:, 1], second[:, 0], second[:, 1])


def errors(device_deg, gp_deg, true_deg, rows, prefix=""):
    """Frontier figures over the rows (bool [n]) of gazes [n, 2]; None where there is no row."""
    if not rows.any():
        return dict.fromkeys(prefix + key for key in FIGURES)
    apart = distances_deg(device_deg[rows], gp_deg[rows])
    return {
        prefix + "rms_to_gp_deg": float(np.sqrt(np.mean(apart**2))),
        prefix + "max_to_gp_deg": float(apart.max()),
        prefix + "truth_mean_deg": float(distances_deg(device_deg[rows], true_deg[rows]).mean()),
        prefix + "gp64_truth_mean_deg": float(distances_deg(gp_deg[rows], true_deg[rows]).mean()),
    }


def judge(data, model, gp_deg, shared):
    """Figures of a device model on the held-out rows of a DataSet.

    gp_deg    float64 [n, 2], the full float64 process at every held-out row
    shared    int [m], rows on which peers are judged too
    Returns a dict: errors() of judged rows and of all valid ones, shared_truth_mean_deg, share_flagged (of
    the valid rows), rows.
    """
    device, passed, _ = answers(data, model)
    valid, true = data.held_out.valid, data.truth["held_out_gaze_deg"]
    figures = errors(device, gp_deg, true, valid & passed)
    figures.update(errors(device, gp_deg, true, valid, "all_"))
    figures["shared_truth_mean_deg"] = float(distances_deg(device[shared], true[shared]).mean())
    return {**figures, "share_flagged": float(np.mean(~passed[valid])), "rows": int(valid.sum())}


def answers(data, model):
    """At held-out rows by the device's code: gaze [n, 2] deg, not flagged bool [n], sigma [n] deg or nan."""
    made = predict(model, data.held_out.features)
    return np.column_stack([made.azimuth_deg, made.elevation_deg]), made.valid, made.sigma_deg


def shared_rows(data, most=SHARED_ROWS):
    """int [<= most]: valid held-out rows, evenly spread, on which ours and peers are compared."""
    rows = np.flatnonzero(data.held_out.valid)
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int))]


def coverage(error_deg, sigma_deg):
    """Shares of errors [n, 2] within 1 and 1.96 of their sigma [n], per axis as sigma is; the rms of both."""
    inside = np.abs(error_deg) / sigma_deg[:, None]
    return {
        "coverage68": float(np.mean(inside <= 1.0)),
        "coverage95": float(np.mean(inside <= Z95)),
        "sharpness_deg": float(np.sqrt(np.mean(sigma_deg**2))),
        "error_rms_deg": float(np.sqrt(np.mean(error_deg**2))),
    }


def judge_variance(data, model, gp_deg, gp_std, noise_deg):
    """What a model knows of what it does not know, on a DataSet: a dict.

    gp_deg [n, 2], gp_std [n], noise_deg    the float64 process at every held-out row, and its noise
    Of judged rows with open lids: coverage() of errors to the targets, which is what sigma promises (None
    when the model gives none); with truth_ before the names of errors to the true gaze, and
    sorted_error_ratio(). Of the process the same: gp64_ with its noise in sigma, and gp64_truth_ without. Of
    settled frames: shut, half, narrow _frames and _flagged by the lids' opening, blink_flagged, the error of
    blinks not flagged, false_alarms (open lids, flagged).
    """
    device, passed, sigma = answers(data, model)
    truth = data.truth
    lids, settled, true = truth["held_out_lid_opening"], truth["held_out_settled"], truth["held_out_gaze_deg"]
    rows = data.held_out.valid & passed & (lids >= OPEN)
    figures = {"coverage68": None, "coverage95": None, "sharpness_deg": None, "error_rms_deg": None}
    if np.isfinite(sigma[rows]).all():
        figures = coverage((device - data.held_out.target_deg)[rows], sigma[rows])
        error = (device - true)[rows]
        figures.update({"truth_" + key: value for key, value in coverage(error, sigma[rows]).items()})
        figures["sorted_error_ratio"] = sorted_error_ratio(np.hypot(*error.T), sigma[rows])
    whole = np.hypot(gp_std, noise_deg)
    for name, against, own in (("gp64_", data.held_out.target_deg, whole), ("gp64_truth_", true, gp_std)):
        known = coverage((gp_deg - against)[rows], own[rows])
        figures.update({name + key: value for key, value in known.items()})
    for name, low, high in (("shut", -1.0, 0.3), ("half", 0.3, 0.7), ("narrow", 0.7, BLINK)):
        here = settled & (lids >= low) & (lids < high)
        figures[f"{name}_frames"] = int(here.sum())
        figures[f"{name}_flagged"] = float(np.mean(~passed[here])) if here.any() else None
    blink, clear = settled & (lids < BLINK), settled & (lids >= OPEN)
    missed = blink & passed
    apart = distances_deg(device, true)
    figures["blink_flagged"] = float(np.mean(~passed[blink])) if blink.any() else None
    figures["blink_missed_error_deg"] = float(apart[missed].mean()) if missed.any() else None
    figures["false_alarms"] = float(np.mean(~passed[clear]))
    return figures


def sorted_error_ratio(error_deg, sigma_deg):
    """Mean error of the tenth of rows with the largest sigma over that of the tenth with the smallest."""
    order, tenth = np.argsort(sigma_deg, kind="stable"), max(1, len(sigma_deg) // 10)
    return float(error_deg[order[-tenth:]].mean() / error_deg[order[:tenth]].mean())


def within(rows, cycles):
    """Of frontier rows of one data set, the nearest to the process within so many cycles; or None."""
    cheap = [row for row in rows if row["cycles"] <= cycles and row["rms_to_gp_deg"] is not None]
    return min(cheap, key=lambda row: row["rms_to_gp_deg"], default=None)


def by_dataset(frontier, kind):
    """{dataset: its rows} of one kind of data set."""
    sets = {}
    for row in frontier:
        if row["kind"] == kind:
            sets.setdefault(row["dataset"], []).append(row)
    return sets


def worst(frontier, kind, cycles, figure):
    """Largest figure(row) over data sets of a kind, each by its best row in a budget; None without one."""
    chosen = [within(rows, cycles) for rows in by_dataset(frontier, kind).values()]
    return max(map(figure, chosen)) if chosen and None not in chosen else None


def most_of(rows, figure):
    """Largest figure(row) of frontier rows; None when the device flags every frame of one."""
    return None if any(row["rms_to_gp_deg"] is None for row in rows) else max(map(figure, rows))


def smallest(frontier):
    """{dataset: fewest vectors whose truth error is within RATIO_BAR of the process's; None if none is}."""
    good = {row["dataset"]: None for row in frontier}
    for row in sorted(frontier, key=lambda one: -one["n"]):
        if row["truth_mean_deg"] is not None and ratio(row) <= RATIO_BAR:
            good[row["dataset"]] = row["n"]
    return good


def ratio(row):
    """Truth error over that of the full process, on the same rows."""
    return row["truth_mean_deg"] / row["gp64_truth_mean_deg"]


def rms(row):
    """Distance to the full process, degrees."""
    return row["rms_to_gp_deg"]


def against_peers(frontier, peers):
    """The peers' rows, each with ours beside it: ours_n, ours_cycles, times_ours, dominated.

    Ours is the cheapest model on that data set whose truth error on the shared rows is not larger (within
    EQUAL); None where there is no such model. A peer that did not run on the chip has no cycles and is not
    judged.
    """
    judged = []
    for peer in peers:
        row = {**peer, "ours_n": None, "ours_cycles": None, "times_ours": None, "dominated": None}
        if peer["cycles"] is not None and peer["truth_mean_deg"] is not None:
            most = peer["truth_mean_deg"] * EQUAL
            good = [
                ours
                for ours in frontier
                if ours["dataset"] == peer["dataset"] and ours["shared_truth_mean_deg"] <= most
            ]
            best = min(good, key=lambda ours: ours["cycles"], default=None)
            row["dominated"] = best is not None and best["cycles"] < peer["cycles"]
            if best is not None:
                times = peer["cycles"] / best["cycles"]
                row.update(ours_n=best["n"], ours_cycles=best["cycles"], times_ours=times)
        judged.append(row)
    return judged


def bars(report):
    """[{name, value, limit, met, kind}] of a report's sections; kind: bar, or aim, which is wished for.

    A value that could not be had is None and met by nothing. A section that was not run has no bars.
    """
    rows = []

    def hold(name, value, limit, most, kind):
        met = value is not None and (value <= limit if most else value >= limit)
        words = f"{'<=' if most else '>='} {limit:g}"
        rows.append({"name": name, "value": value, "limit": words, "met": bool(met), "kind": kind})

    def at_most(name, value, limit, kind="bar"):
        hold(name, value, limit, True, kind)

    def at_least(name, value, limit, kind="bar"):
        hold(name, value, limit, False, kind)

    frontier = report.get("frontier")
    if frontier is not None:
        people = by_dataset(frontier, "simulated")
        at_least("simulated persons", len(people), PERSONS_BAR)
        at_most("their maps' stated error, lids open, worst", report["map_error"]["open_rms"], MAP_BAR)
        for cycles, far, kind in ((CYCLES_BAR, RMS_BAR_DEG, "bar"), (CYCLES_AIM, RMS_AIM_DEG, "aim")):
            budget = f"at <= {cycles} cycles"
            at_most(
                f"worst person, truth error over the GP's, {budget}",
                worst(frontier, "simulated", cycles, ratio),
                RATIO_BAR,
                kind,
            )
            at_most(
                f"worst person, rms to the GP (deg), {budget}",
                worst(frontier, "simulated", cycles, rms),
                far,
                kind,
            )
            at_most(
                f"worst smooth set, rms to the GP (deg), {budget}",
                worst(frontier, "smooth", cycles, rms),
                SMOOTH_BAR_DEG,
                kind,
            )
        chosen = [row for row in report.get("default", []) if row["kind"] == "simulated"]
        if chosen:
            words = "default model, worst person, "
            at_most(words + "cycles", max(row["cycles"] for row in chosen), CYCLES_BAR)
            at_most(words + "rms to the GP (deg)", most_of(chosen, rms), RMS_BAR_DEG)
            at_most(words + "truth error over the GP's", most_of(chosen, ratio), RATIO_BAR)
        at_least(
            "models whose every bit is the host's, share",
            float(np.mean([row["identical"] for row in frontier])) if frontier else None,
            1,
        )
    if "portable" in report:
        at_most("portable C at 64 vectors, cycles", report["portable"]["cycles"], PORTABLE_BAR)
    if "peers" in report:
        ran = [row for row in report["peers"] if row["dominated"] is not None]
        float_times = [
            row["times_ours"] for row in ran if row["name"].startswith(NAIVE) and EQUAL_ERROR in row["name"]
        ]
        at_least(
            "cycles of naive float C over ours at equal error",
            min(float_times) if float_times and None not in float_times else None,
            NAIVE_AIM,
            "aim",
        )
        at_least(
            "peers dominated in speed and error, share",
            float(np.mean([row["dominated"] for row in ran])) if ran else None,
            1,
            "aim",
        )
    if "host" in report:
        host = report["host"]
        at_most(
            f"fit of {host['samples']} samples and distillation to 64, processor seconds",
            host["cpu_fit_s"] + host["cpu_distil_s"],
            FIT_BAR_S,
        )
        at_least("predictions a second and core, host", host["predictions_per_second"], PREDICTIONS_BAR)
    if "identity" in report:
        crc = dict(zip(report["identity"]["targets"], report["identity"]["crc"]))
        same = [name for name in TARGETS if name in crc and crc[name] == crc.get(TARGETS[0])]
        at_least(f"of {', '.join(TARGETS)}: same bits", len(same), len(TARGETS))
        at_most("different answers among all targets", len(set(crc.values())), 1)
    if "hard" in report:
        kinds = {row["name"].split("[")[0] for row in report["hard"]}
        at_least("hard cases, parameters aside", len(kinds), HARD_BAR)
        passed = [row["outcome"] == "passed" for row in report["hard"]]
        at_least("hard cases that behave as expected, share", float(np.mean(passed)) if passed else None, 1)
    return rows
