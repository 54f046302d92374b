# SPDX-License-Identifier: Apache-2.0
"""Speed against error of the simulator, with peers, in one run: build/bench/sim.json and sim.png.

    python tools/bench/bench_sim.py [--quick] [--no-peers] [--only scenes,speed,...] [--out build/bench]

`make bench-sim` calls this after setting up what the peers need (setup_bench.sh). Sections: scenes, images,
speed, offgrid, scaling, ring, peers. A section that is not run keeps no figure of an earlier run. Errors are
divided by the mean total response of each scene. Exits 1 when a bar is missed, naming it; aims are reported,
not enforced.
"""

import argparse
import json
import os
import platform
import sys
import time
from pathlib import Path

import bench_cost
import bench_errors
import bench_peers
import numpy as np
from bench_sim_picture import draw

from sparsegaze.errors import SparsegazeError
from sparsegaze.headset import load_headset

ROOT = Path(__file__).resolve().parents[2]
HEADSET = ROOT / "headsets" / "led2gaze.toml"
SECTIONS = ("scenes", "images", "speed", "offgrid", "scaling", "ring", "peers")


def main():
    """Parse the command line, run, report. Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "build" / "bench", help="folder (default build/bench)"
    )
    parser.add_argument("--quick", action="store_true", help="few scenes and settings: to see that it runs")
    parser.add_argument("--no-peers", action="store_true", help="leave the section peers out")
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, with commas (default all)")
    options = parser.parse_args()
    wanted = [name for name in options.only.split(",") if not (name == "peers" and options.no_peers)]
    if not set(wanted) <= set(SECTIONS):
        parser.error("sections are " + ", ".join(SECTIONS))
    options.out.mkdir(parents=True, exist_ok=True)
    for name in ("sim.json", "sim.png"):  # those of an earlier run must not pass for this one's
        (options.out / name).unlink(missing_ok=True)
    try:
        report = run(wanted, options.quick, lambda report: write(options.out, report))
    except (SparsegazeError, RuntimeError) as error:
        print("bench-sim: %s" % error, file=sys.stderr)
        return 1
    draw(options.out / "sim.png", report)
    return tell(report, options.out)


def write(folder, report):
    """sim.json."""
    (folder / "sim.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def run(wanted, quick, keep):
    """The report: a dict of every section's figures, bars, machine.

    keep    called with what there is after each section: an interrupted run leaves what it has measured
    """
    headset, clock, threads = load_headset(HEADSET), Clock(), len(os.sched_getaffinity(0))
    threads = min(2, threads)
    sections = {
        "scenes": lambda say: bench_errors.scenes(6 if quick else 20, threads, say),
        "images": lambda say: bench_errors.images(headset, quick, say),
        "speed": lambda say: bench_cost.speed(headset, threads, quick, say),
        "offgrid": lambda say: bench_errors.offgrid(headset, quick, say),
        "scaling": lambda say: bench_cost.scaling(quick, say),
        "ring": lambda say: bench_cost.ring_sweep(say),
        "peers": lambda say: bench_peers.run(headset, quick, say),
    }
    report = {
        "quick": quick,
        "headset": "headsets/" + HEADSET.name,
        "machine": machine(),
        "section_seconds": {},
    }
    for name in ("speed", "scaling", "peers", "ring", "offgrid", "scenes", "images"):
        if name not in wanted:
            continue
        began = time.perf_counter()
        figures = sections[name](lambda text, name=name: clock.say(name, text))
        report.update(figures if name == "peers" else {name: figures})
        report["section_seconds"][name] = round(time.perf_counter() - began, 1)
        if "offgrid" in report and "peers" in report:
            report["curves"]["tables"] = [bench_errors.as_setting(report["offgrid"], threads)]
        report["seconds"] = round(clock.seconds(), 1)
        report["bars"] = bars(report)
        keep(plain(report))
    return plain(report)


class Clock:
    """Progress lines with the time since the start."""

    def __init__(self):
        self._began = time.perf_counter()

    def seconds(self):
        return time.perf_counter() - self._began

    def say(self, section, text):
        print("%6.0f s  %-8s %s" % (self.seconds(), section, text), flush=True)


def machine():
    """What it ran on, for who compares figures."""
    model = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def bars(report):
    """[{name, value, limit, met, kind}]; kind: bar, or aim, which is wished for."""
    rows = []

    def most(name, value, limit, kind="bar"):
        rows.append(
            {"name": name, "value": value, "limit": "<= %g" % limit, "met": value <= limit, "kind": kind}
        )

    def least(name, value, limit, kind="bar"):
        rows.append(
            {"name": name, "value": value, "limit": ">= %g" % limit, "met": value >= limit, "kind": kind}
        )

    if "scenes" in report:
        scenes = report["scenes"]
        for key in ("rms_total", "rms_diffuse", "rms_glint"):
            most("scenes, worst " + key, max(row[key] for row in scenes), 1e-4)
        most("scenes, worst max_total", max(row["max_total"] for row in scenes), 1e-3)
        least("scenes whose error is bounded", sum(row["estimate_bounds"] for row in scenes), len(scenes))
    if "speed" in report:
        most("map of 41 x 41 x 30, seconds", report["speed"]["seconds"], 5.0)
        most("map of 41 x 41 x 30, seconds", report["speed"]["seconds"], 1.0, "aim")
        most("map's rms_total", report["speed"]["rms_total"], 1e-4)
        most("map's max_total", report["speed"]["max_total"], 1e-3)
        least("map's error is bounded", float(report["speed"]["estimate_bounds"]), 1)
    if "offgrid" in report:
        for words, key in (("", ""), (", lids open", "_lids_open")):
            most("off the grid%s, rms" % words, report["offgrid"]["rms" + key], 1e-4)
            most("off the grid%s, max" % words, report["offgrid"]["max" + key], 1e-3)
        most("off the grid against the reference, rms", report["offgrid"]["rms_against_reference"], 1e-4)
        most("off the grid against the reference, max", report["offgrid"]["max_against_reference"], 1e-3)
        least(
            "off the grid, responses a second and core", report["offgrid"]["responses_per_second_core"], 20000
        )
    if "scaling" in report:
        for key in ("exponent_gazes", "exponent_pairs"):
            most("scaling, " + key, report["scaling"][key], 1.1)
    for part, row in report.get("agreement", {}).items():
        most("agreement with Mitsuba, %s, rms" % part, row["rms"], 1e-3)
    if "peers" in report:
        ran = [row for row in report["peers"] if row["name"].startswith("Mitsuba")]
        least("Mitsuba's variants that ran", len(ran), 2)
        for row in report["peers"]:
            limit = 1e2 if row["name"].startswith("image") else 1e4
            least("times ours at rms 1e-3: " + row["name"], row["times_ours"], limit, "aim")
    return rows


def plain(value):
    """The same of Python's own types, as JSON wants them."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def tell(report, folder):
    """Print the bars. Returns the exit code."""
    missed = []
    for row in report["bars"]:
        word = "ok" if row["met"] else "MISS" if row["kind"] == "bar" else "short"
        print("  %-5s %-52s %10.4g   %s %s" % (word, row["name"], row["value"], row["kind"], row["limit"]))
        if word == "MISS":
            missed.append(row)
    print("%s/sim.json and sim.png written, %.0f s" % (folder, report["seconds"]))
    for row in missed:
        print(
            "bench-sim: bar missed: %s is %.4g, needs %s" % (row["name"], row["value"], row["limit"]),
            file=sys.stderr,
        )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
