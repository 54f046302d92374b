# SPDX-License-Identifier: Apache-2.0
"""Inference on the device: the frontier of cycles against error, with peers, in one run.

    python tools/bench/bench_inference.py [--quick] [--no-peers] [--persons K] [--jobs 2] [--only host,...]

Writes inference.json and inference.png into build/bench. `make bench-inference` calls this after setting up
what the peers need. Sections: frontier, variance, identity, host, peers, hard; one that is not run keeps no
figure of an earlier run. Cycles are counted in simavr, running the device's own code on every valid held-out
row. What was fitted or measured before is taken from build/bench/inference as long as neither its inputs nor
the code that made it have changed. Exits 1 when a bar is missed, naming it; aims are reported, not enforced.
"""

import argparse
import csv
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import inference_cycles
import inference_data
import inference_host
import inference_judge
import numpy as np
from bench_sim import Clock, machine, plain
from inference_pieces import DEFAULT_N, fitted, kept, model_of, row

from sparsegaze import choose
from sparsegaze.errors import SparsegazeError

ROOT = Path(__file__).resolve().parents[2]
SECTIONS = ("frontier", "variance", "identity", "host", "peers", "hard")
# Few; what the bars' 7000 and 11,000 cycles pay for; that of most figures; all that a slot of the Nano holds.
LADDER = (8, choose.most_vectors(7000), choose.most_vectors(11_000), DEFAULT_N, choose.ROOM)
QUICK_LADDER = (16, 64)
PEER_SETS = ("smooth-0", "smooth-1", "smooth-2", "sim-2000", "sim-2001")


def main():
    """Parse the command line, run, report. Returns the exit code."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench", help="default build/bench")
    parser.add_argument("--quick", action="store_true", help="one person, few sizes: to see that it runs")
    parser.add_argument("--no-peers", action="store_true", help="leave the section peers out")
    parser.add_argument("--persons", type=int, default=inference_data.PERSONS, help="simulated (default 20)")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes (default 2)")
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, with commas (default all)")
    options = parser.parse_args()
    wanted = [name for name in options.only.split(",") if not (name == "peers" and options.no_peers)]
    if not set(wanted) <= set(SECTIONS):
        parser.error("sections are " + ", ".join(SECTIONS))
    options.out.mkdir(parents=True, exist_ok=True)
    for name in ("inference.json", "inference.png"):  # those of an earlier run must not pass for this one's
        (options.out / name).unlink(missing_ok=True)
    try:
        report = run(wanted, options)
    except (SparsegazeError, RuntimeError) as error:
        print(f"bench-inference: {error}", file=sys.stderr)
        return 1
    if report.get("frontier"):
        from inference_picture import draw

        draw(options.out / "inference.png", report)
    return tell(report, options.out)


def run(wanted, options):
    """The report; written after each section, so that an interrupted run leaves what it measured."""
    clock, folder = Clock(), options.out / "inference"
    names = inference_data.names(min(options.persons, 1) if options.quick else options.persons)
    if options.quick:
        names = [name for name in names if name.startswith("sim") or name == "smooth-0"]
    ladder = QUICK_LADDER if options.quick else LADDER
    report = {"quick": options.quick, "machine": machine(), "section_seconds": {}, "datasets": names}

    def section(name, make):
        if name not in wanted:
            return
        began = time.perf_counter()
        report.update(make(lambda text: clock.say(name, text)))
        report["section_seconds"][name] = round(time.perf_counter() - began, 1)
        report["seconds"] = round(clock.seconds(), 1)
        report["bars"] = inference_judge.bars(report)
        text = json.dumps(plain(report), indent=1) + "\n"
        (options.out / "inference.json").write_text(text, encoding="utf-8")

    folders = inference_data.make(names, folder, options.jobs, lambda text: clock.say("data", text))
    section("frontier", lambda say: frontier(folders, ladder, options.jobs, say))
    section("variance", lambda say: {"variance": variance(folders, say)})
    section("identity", lambda say: identity(folders[0], folder, say))
    section("host", lambda say: {"host": host(folder / "smooth-0", options.quick)})
    section(
        "peers",
        lambda say: {
            "peers": peers(
                [place for place in folders if place.name in PEER_SETS], report.get("frontier", []), say
            )
        },
    )
    section("hard", lambda say: {"hard": inference_host.hard_cases()})
    report["bars"] = inference_judge.bars(report)
    return plain(report)


def frontier(folders, ladder, jobs, say):
    """Every data set at every size, in `jobs` processes; the portable loop's cycles; the maps' errors."""
    order = [None, *sorted(ladder, key=lambda n: abs(n - DEFAULT_N))]
    wanted = [(place, n) for n in order for place in folders]
    rows, began = [], time.perf_counter()
    for made in in_turn(wanted, jobs):
        rows.append(made)
        if len(rows) % max(1, len(wanted) // 20) == 0:
            left = (time.perf_counter() - began) / len(rows) * (len(wanted) - len(rows))
            say(f"{len(rows)} of {len(wanted)} models, about {left:.0f} s left")
    for stray in folders[0].parent.glob("avr-*"):
        inference_cycles.remove(stray)
    rows.sort(key=lambda one: (one["kind"], one["dataset"], one["n"]))
    default, rows = [one for one in rows if one["default"]], [one for one in rows if not one["default"]]
    data = [inference_data.DataSet.load(place) for place in folders]
    stated = [one.key["map_error"] for one in data if one.kind == "simulated"]
    stated = {name: max((error[name] for error in stated), default=None) for name in ("open_rms", "lids_rms")}
    portable = inference_cycles.Bench(folders[0].parent / "avr", "portable")
    cost = portable.run(model_of(fitted(folders[0], data[0], DEFAULT_N)), data[0].held_out.features[:200])
    return {
        "frontier": rows,
        "default": default,
        "map_error": stated,
        "summary": summary(rows),
        "smallest_n": inference_judge.smallest(rows),
        "portable": {"n": DEFAULT_N, "dataset": data[0].name, "cycles": cost.cycles_max},
    }


def in_turn(wanted, jobs):
    """Yields row(*arguments) of each of the wanted as they get ready, in `jobs` processes; 1: in this one."""
    if jobs == 1:
        yield from (row(*arguments) for arguments in wanted)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # inherited by the processes: they are as many as the cores
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        running = [pool.submit(row, *arguments) for arguments in wanted]
        yield from (finished.result() for finished in as_completed(running))


def summary(rows):
    """By kind and n: cycles, median and worst rms to the process, median and worst ratio of truth errors."""
    table = []
    for kind in ("simulated", "smooth", "sharp"):
        for n in sorted({one["n"] for one in rows if one["kind"] == kind}):
            same = [one for one in rows if one["kind"] == kind and one["n"] == n]
            same = [one for one in same if one["rms_to_gp_deg"] is not None]
            if not same:
                continue
            line = {"kind": kind, "n": n, "sets": len(same)}
            line.update(
                {key: max(one[key] for one in same) for key in ("cycles", "flash", "ram", "share_flagged")}
            )
            ratios = [inference_judge.ratio(one) for one in same]
            for name, values in (
                ("rms", [one["rms_to_gp_deg"] for one in same]),
                ("ratio", ratios),
                ("truth", [one["truth_mean_deg"] for one in same]),
            ):
                line.update({name + "_median": float(np.median(values)), name + "_worst": max(values)})
            table.append(line)
    return table


def variance(folders, say):
    """Coverage of the model's sigma, blinks and false alarms at DEFAULT_N: each set's, and persons' mean."""
    each = {}
    for place in folders:
        data = inference_data.DataSet.load(place)
        piece = fitted(place, data, DEFAULT_N)
        process = piece["gp_deg"], piece["gp_std"], piece["noise_deg"]
        each[data.name] = inference_judge.judge_variance(data, model_of(piece), *process)
        say(data.name)
    people = [figures for name, figures in each.items() if name.startswith("sim")]
    judged = people or list(each.values())
    whole = {key: mean_of([figures.get(key) for figures in judged]) for key in judged[0]}
    return {**whole, "cycles": trust_cycles(), "each": each}


def trust_cycles():
    """Cycles of guards, grid and sigma on the ATmega328P, part of every prediction; None if not known.

    From tests/budget.csv, which a test holds against the binary.
    """
    with open(ROOT / "tests" / "budget.csv", newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if (line["name"], line["target"]) == ("sg_gp_judge", "atmega328p"):
                return int(line["cycles_max"])
    return None


def mean_of(values):
    """Mean of those that are not None; None when none is left."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def identity(place, folder, say):
    """The section identity: one model, every target."""
    data = inference_data.DataSet.load(place)
    model, rows = model_of(fitted(place, data, DEFAULT_N)), data.held_out.features[data.held_out.valid]
    benches = {twin: inference_cycles.Bench(folder / "avr", twin) for twin in inference_cycles.TWINS}
    return {"identity": inference_host.identity(model, rows, benches, say)}


def host(place, quick):
    """The section host, on the 2000 held-out samples of a synthetic set."""
    data = inference_data.DataSet.load(place)
    model = model_of(fitted(place, data, DEFAULT_N))
    return inference_host.speed(data.held_out.features, data.held_out.target_deg, model, quick)


def peers(folders, rows, say):
    """The section peers: inference_peers.measure on each data set, with ours beside it."""
    import inference_peers

    code = sorted(Path(__file__).parent.glob("peers/*")) + [Path(inference_peers.__file__)]
    code = [path for path in code if path.is_file()]
    found = []
    for place in folders:
        data = inference_data.DataSet.load(place)
        piece, shared = fitted(place, data, DEFAULT_N), inference_judge.shared_rows(data)
        known, held = data.calibration.select(data.calibration.valid), data.held_out.select(shared)
        truth = data.truth["held_out_gaze_deg"][shared]
        given = (
            (known.features, known.target_deg),
            (held.features, held.target_deg),
            truth,
            piece["gp_deg"][shared],
        )
        more = [part.tobytes() for part in piece["spread"]]
        key = inference_data.file_hash(code, data.key["hash"], len(shared), piece["gp_deg"].tobytes(), more)
        measure = partial(inference_peers.measure, data.name, *given, place / "peers", say, piece["spread"])
        made = kept(place / "peers.pickle", key, measure)
        if not any(one["cycles"] for one in made):  # nothing ran: they may be installed by the next time
            (place / "peers.pickle").unlink()
        found += made
    return inference_judge.against_peers(rows, found)


def tell(report, folder):
    """Print the tables and the bars. Returns the exit code."""
    if "summary" in report:
        print(
            "data        n   sets  cycles  flash   ram   rms to GP, deg   truth over GP's  flagged\n"
            "                                           median    worst    median   worst    worst"
        )
        for one in report["summary"]:
            print(
                f"{one['kind']:9} {one['n']:4} {one['sets']:5} {one['cycles']:7} {one['flash']:6} "
                f"{one['ram']:5} {one['rms_median']:8.4f} {one['rms_worst']:8.4f} {one['ratio_median']:8.4f} "
                f"{one['ratio_worst']:8.4f} {one['share_flagged']:8.4f}"
            )
    for one in report.get("default", []):
        print(
            f"  default, {one['dataset']:9} n={one['n']:3} {one['cycles']:6} cycles {one['bytes']:5} bytes  "
            f"rms to GP {one['rms_to_gp_deg'] or 0:.4f}  truth {one['truth_mean_deg'] or 0:.4f} "
            f"(GP {one['gp64_truth_mean_deg'] or 0:.4f})"
        )
    for one in report.get("peers", []):
        ours = f"{one['times_ours']:8.1f} times n={one['ours_n']}" if one["times_ours"] else "       -"
        word = {True: "dominated", False: "NOT dominated", None: "did not run"}[one["dominated"]]
        print(f"  {one['dataset']:9} {one['name'][:44]:44} {one['cycles'] or '-':>9} {word:13} {ours}")
    missed = []
    for one in report["bars"]:
        word = "met" if one["met"] else "MISSED" if one["kind"] == "bar" else "short"
        value = "none" if one["value"] is None else f"{one['value']:.4g}"
        print(f"  {word:6} {one['name']:58} {value:>10}   {one['kind']} {one['limit']}")
        if word == "MISSED":
            missed.append(one["name"])
    print(f"{folder}/inference.json and inference.png written, {report['seconds']:.0f} s")
    for name in missed:
        print(f"bench-inference: bar missed: {name}", file=sys.stderr)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
