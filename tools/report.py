# SPDX-License-Identifier: Apache-2.0
"""Write README.md's result tables from what `make demo` and the benchmarks measured.

    python tools/report.py             rewrite the demo's table, between its two markers
    python tools/report.py sim         the simulator's
    python tools/report.py inference   the inference's
    python tools/report.py frontend    the front end's
    python tools/report.py --check     exit 1 when the README's table is not what the report says
"""
import argparse
import json
import sys
from pathlib import Path

BEGIN = "<!-- results: written by tools/report.py from build/demo/report.json -->"
END = "<!-- /results -->"


def table_of(rows):
    """The Markdown table of rows of cells; the first row is its head."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def table(report):
    """The Markdown table of a report dict."""
    accuracy, stream, delay, fast = (report[key] for key in ("accuracy", "stream", "latency_ms", "fast"))
    rows = [
        ("mean / median / p95 error to the target",
         f"**{accuracy['mean_deg']:.2f}** / {accuracy['median_deg']:.2f} / {accuracy['p95_deg']:.2f} deg",
         "1.57 / 1.12 / - deg"),
        ("the same by the full float64 GP, on the same samples", f"{accuracy['gp64_mean_deg']:.2f} deg", "-"),
        ("mean error to where the simulated eye really looked",
         f"{accuracy['to_true_gaze_mean_deg']:.2f} deg", "-"),
        ("accuracy, precision RMS-S2S (ETDQualitizer)",
         f"{accuracy['accuracy_deg']:.2f} deg, {accuracy['rms_s2s_deg']:.2f} deg", "-"),
        ("data loss (blinks, out of range)", f"{100 * accuracy['data_loss']:.1f} %", "-"),
        ("gaze rate, device time, with the features beside it", f"{stream['rate_hz']:.1f} Hz", "250 Hz"),
        (f"the same with {fast['n_vectors']} vectors, gaze alone; lost",
         f"{fast['rate_hz']:.1f} Hz; {fast['lost']}", "-"),
        ("frames streamed, lost, differing from the host core",
         f"{stream['frames']}, {stream['lost']}, {stream['differing']}", "-"),
        ("where the gaze is computed",
         f"on the ATmega328P, {report['model']['n_vectors']} vectors", "on a PC"),
        ("inference, all work on a frame (worst)",
         f"{report['inference']['cycles']:,.0f}, {report['frame']['cycles']:,.0f} "
         f"of {report['frame']['period_cycles']:,.0f} cycles", "-"),
        ("its latency to the last byte, from mean sample time, from last sample",
         f"{delay['mean_sample_to_last_byte']:.2f} ms, {delay['last_sample_to_last_byte']:.2f} ms", "-"),
        ("flashed through the stock bootloader, verified",
         f"{report['flash']['bytes']} bytes in {report['flash']['seconds']:.1f} s (device time)", "-"),
    ]
    rows.insert(0, ("figure", f"sparsegaze, simulated person {report['seed']}", "LED2Gaze, people"))
    return table_of(rows)


def figure(value):
    """Three digits, or a whole number: as people write it."""
    if value == int(value) and abs(value) < 1e6:
        return f"{int(value):,}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.2g}" if abs(value) < 1e-2 else f"{value:.3g}"


def bar_rows(head, report):
    """Rows of a benchmark's bars and aims: what was measured, what wanted, is it met. head: first cell."""
    rows = [(head, "measured", "wanted", "met")]
    for row in report["bars"]:
        value = "-" if row["value"] is None else figure(row["value"])
        wanted = f"{row['kind']} {row['limit']}"
        rows.append((row["name"].replace("*", r"\*"), value, wanted, yes(row["met"])))
    return rows


def yes(met):
    """A verdict as a cell; None: there is none."""
    return "-" if met is None else "yes" if met else "**no**"


def simulator_table(report):
    """The Markdown table of sim.json: every bar and aim with what was measured."""
    machine, speed, offgrid, ring = (report[key] for key in ("machine", "speed", "offgrid", "ring"))
    of_map_us = 1e6 * speed["seconds"] / (speed["pairs"] * speed["gazes"])
    between_us = 1e6 / offgrid["responses_per_second_core"] / speed["pairs"]
    hard = ring["hard_crease_peak_over_median"]
    head = f"{machine['cores']} cores, {machine['cpu'] or 'unnamed'}, load {machine['load']:.1f}"
    return table_of([
        *bar_rows(head, report),
        ("a response of that map, microseconds", figure(of_map_us), "-", "-"),
        ("the same between the nodes of a person's map", figure(between_us), "-", "-"),
        ("ring: peak over median, width; with a hard crease",
         f"{ring['peak_over_median']:.2f}, {ring['fwhm_deg']:.1f} deg; {hard:.2f}", "-", "-"),
    ])


def inference_table(report):
    """The Markdown table of inference.json: every bar and aim with what was measured, then the peers."""
    rows = bar_rows("figure", report)
    variance = report.get("variance")
    if variance:
        for name, key in (("target", ""), ("true gaze", "truth_")):
            inside = [variance.get(f"{key}coverage{part}") for part in (68, 95)]    # None: no sigma measured
            inside = ", ".join("-" if part is None else f"{part:.3f}" for part in inside)
            rows.append((f"errors to the {name} inside one sigma, inside 1.96 (0.683 and 0.95 of a Gaussian)",
                         inside, "-", "-"))
        flagged = ", ".join(f"{variance[f'{lids}_flagged']:.3f}" for lids in ("shut", "half", "narrow"))
        rows.append(("frames with shut, half-shut, narrowed lids flagged; false alarms",
                     f"{flagged}; {variance['false_alarms']:.3f}", "-", "-"))
    defaults = [row for row in report.get("default", []) if row["dataset"].startswith("sim-")]
    if defaults:
        n, far = (sorted(row[key] for row in defaults) for key in ("n", "rms_to_gp_deg"))
        rows.append((f"default model of {len(n)} persons: vectors, median rms to the GP",
                     f"{n[0]} to {n[-1]}, {far[len(far) // 2]:.3f} deg", "-", "-"))
    shown = ("sim-2000", "smooth-0")    # the file has them all
    ours = [row for row in report.get("default", []) if row["dataset"] in shown]
    peers = [row for row in report.get("peers", []) if row["cycles"] and row["dataset"] in shown]
    return table_of(rows) + ("\n\n" + peer_table(ours, peers) if peers else "")


def peer_table(ours, peers):
    """The Markdown table of what was measured on the same chip and data: rows of inference.json."""
    rows = [("on the same chip and data", "data", "cycles", "flash, B", "error to the truth", "fits",
             "ours is better in both")]
    for row in ours:
        rows.append((f"**sparsegaze, {row['n']} vectors**", row["dataset"], figure(row["cycles"]),
                     str(row["flash"]), f"{row['truth_mean_deg']:.2f} deg", "yes", "-"))
    for row in peers:
        error = "-" if row["truth_mean_deg"] is None else f"{row['truth_mean_deg']:.2f} deg"
        rows.append((f"{row['name']} {row['version'] or ''}", row["dataset"], figure(row["cycles"]),
                     str(row["flash"]), error, "yes" if row["fits"] else "no", yes(row.get("dominated"))))
    return table_of(rows)


def frontend_table(report):
    """The Markdown table of frontend.json: every bar and aim with what was measured on the worst seed."""
    seeds = report["seeds"]
    head = f"simulated persons {seeds[0]} to {seeds[-1]}, the worst of them; * the default setting"
    return "\n\n".join([table_of(bar_rows(head, report))] + fault_tables(report))


def fault_tables(report):
    """The section faults as a Markdown table, or nothing where it was not run."""
    if "faults" not in report:
        return []
    head = ["what happens to an eye that looks about", "cycles a frame", "times", "named", "after ms (most)",
            "VALID before, while, after", "VALID and wrong by 5 deg, of 10,000 frames", "worst VALID, deg"]
    rows = [head]
    for row in report["faults"]["rows"]:
        share = ", ".join("-" if row[key] is None else f"{row[key]:.2f}"
                          for key in ("valid_before", "valid_while", "valid_after"))
        after = "-" if row["named_ms"] is None else f"{row['named_ms']:.0f} ({row['named_ms_worst']:.0f})"
        named = "-" if row["named"] is None else str(row["named"])
        if row["false_alarms"]:
            named = f"**{row['false_alarms']} false**"
        rows.append([row["kind"], str(row["repeats"]), str(row["episodes"]), named, after, share,
                     f"{row['wild_per_10000']:.1f}", f"{row['worst_deg']:.1f}"])
    return [table_of(rows)]


SIM_BEGIN = "<!-- simulator: written by tools/report.py from build/bench/sim.json -->"
SIM_END = "<!-- /simulator -->"
INFERENCE_BEGIN = "<!-- inference: written by tools/report.py from build/bench/inference.json -->"
INFERENCE_END = "<!-- /inference -->"
FRONTEND_BEGIN = "<!-- frontend: written by tools/report.py from build/bench/frontend.json -->"
FRONTEND_END = "<!-- /frontend -->"
KINDS = {
    "demo": (Path("build/demo/report.json"), BEGIN, END, table, "make demo"),
    "frontend": (Path("build/bench/frontend.json"), FRONTEND_BEGIN, FRONTEND_END, frontend_table,
                 "make bench-frontend"),
    "inference": (Path("build/bench/inference.json"), INFERENCE_BEGIN, INFERENCE_END, inference_table,
                  "make bench-inference"),
    "sim": (Path("build/bench/sim.json"), SIM_BEGIN, SIM_END, simulator_table, "make bench-sim"),
}


def main():
    """Rewrite or check the README. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", nargs="?", choices=KINDS, default="demo")
    parser.add_argument("--report", type=Path, help="default: where the command that measures puts it")
    parser.add_argument("--readme", type=Path, default=Path("README.md"))
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    path, begin, end, draw, command = KINDS[options.kind]
    path = options.report or path
    if not path.is_file():
        print(f"report: {path} is not there: run `{command}` first", file=sys.stderr)
        return 1
    text = options.readme.read_text(encoding="utf-8")
    head, _, rest = text.partition(begin)
    _, found, tail = rest.partition(end)
    if not found:
        print(f"report: {options.readme} lacks the markers of the result table", file=sys.stderr)
        return 1
    wanted = f"{head}{begin}\n{draw(json.loads(path.read_text(encoding='utf-8')))}\n{end}{tail}"
    if options.check:
        return 0 if wanted == text else 1
    options.readme.write_text(wanted, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
