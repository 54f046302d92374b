# SPDX-License-Identifier: Apache-2.0
"""The front end: rate, latency, noise, ambient light, exposure, eye safety and size, in one run.

    python tools/bench/bench_frontend.py [--quick] [--seeds 5] [--only methods,...]

Writes frontend.json and frontend.png into build/bench. `make bench-frontend` calls this. Sections: methods
(ways to read a photocurrent, by closed form and Monte Carlo), patterns (which LEDs emit while which
sense), device (the shipped firmware on virtual Nanos, in device time, with simulated persons), faults
(the same persons, with what breaks: named, flagged, never a wild gaze), safety (light on the eye, by the formulae of IEC 62471), size (flash, RAM, stack). A section that is not run keeps
no figure of an earlier run. The worst seed is reported. Maps and calibrations are kept in
build/bench/frontend as long as what made them has not changed. Exits 1 when a bar is missed, naming it.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import frontend_judge
from bench_sim import Clock, machine, plain

from sparsegaze.calibrate import plain as without_nan
from sparsegaze.errors import SparsegazeError

ROOT = Path(__file__).resolve().parents[2]
SECTIONS = ("methods", "patterns", "device", "faults", "safety", "size")
SEEDS = (
    2000,
    2001,
    2002,
    2003,
    2004,
)  # the headset's aims were never searched or tuned on persons from 2000 on


def main(words=None):
    """Parse the command line, run, report. Returns the exit code."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench", help="default build/bench")
    parser.add_argument(
        "--quick", action="store_true", help="one person, everything short: to see that it runs"
    )
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="simulated persons (default 5)")
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, with commas (default all)")
    options = parser.parse_args(words)
    wanted = options.only.split(",")
    if not set(wanted) <= set(SECTIONS):
        parser.error("sections are " + ", ".join(SECTIONS))
    if not 1 <= options.seeds <= 20:
        parser.error("--seeds is 1 to 20")
    options.out.mkdir(parents=True, exist_ok=True)
    for name in ("frontend.json", "frontend.png"):  # those of an earlier run must not pass for this one's
        (options.out / name).unlink(missing_ok=True)
    try:
        report = run(wanted, options)
    except SparsegazeError as error:
        print(f"bench-frontend: {error}", file=sys.stderr)
        return 1
    from frontend_picture import draw

    draw(options.out / "frontend.png", report)
    return frontend_judge.tell(report, options.out)


def run(wanted, options):
    """The report; written after each section, so that an interrupted run leaves what it measured."""
    clock, folder = Clock(), options.out / "frontend"
    folder.mkdir(parents=True, exist_ok=True)
    seeds = [SEEDS[0] + k for k in range(1 if options.quick else options.seeds)]
    report = {
        "quick": options.quick,
        "seeds": seeds,
        "simulated": True,
        "machine": machine(),
        "section_seconds": {},
    }

    def section(name, make):
        if name not in wanted:
            return
        began = time.perf_counter()
        report.update(make(lambda text: clock.say(name, text)))
        report["section_seconds"][name] = round(time.perf_counter() - began, 1)
        report["seconds"] = round(clock.seconds(), 1)
        report["bars"] = frontend_judge.bars(report)
        text = json.dumps(without_nan(report), indent=1) + "\n"
        (options.out / "frontend.json").write_text(text, encoding="utf-8")

    section("methods", lambda say: methods(options.quick, say))
    section("patterns", lambda say: patterns(seeds, say))
    section("device", lambda say: device(seeds, folder, options.quick, say))
    section("faults", lambda say: faults(seeds, folder, options.quick, say))
    section("safety", lambda say: safety())
    section("size", lambda say: size())
    report["bars"] = frontend_judge.bars(report)
    return plain(report)


def methods(quick, say):
    """The section methods: rows of `bits`, and how far Monte Carlo and closed form are apart."""
    import frontend_methods

    draws = 500 if quick else 1000
    rows = frontend_methods.table(draws)
    apart = [row["drawn_bits"] - row["random_bits"] for row in rows if (row["random_bits"] or 0) > 1]
    chosen = next(
        row for row in rows if row["chosen"] and row["photocurrent_na"] == 200 and not row["ambient_na"]
    )
    say(f"{len(rows)} rows; Monte Carlo and closed form at most {max(map(abs, apart)):.2f} bits apart")
    say(
        f"chosen: {chosen['random_bits']} bits of noise, "
        f"{chosen['static_bits']} static after self-calibration"
    )
    return {"bits": rows, "bits_apart": max(map(abs, apart)), "bits_draws": draws}


def patterns(seeds, say):
    """The section patterns: which LEDs emit while which sense."""
    import frontend_patterns
    import frontend_persons

    return {"patterns": frontend_patterns.table(frontend_persons.maps(seeds, say), say)}


def device(seeds, folder, quick, say):
    """The section device: frontend_run.measure."""
    import frontend_run

    return frontend_run.measure(seeds, folder, quick, say)


def faults(seeds, folder, quick, say):
    """The section faults: frontend_faults.measure."""
    import frontend_faults

    return frontend_faults.measure(seeds, folder, quick, say)


def safety():
    """The section safety: frontend_size.safety."""
    import frontend_size

    return frontend_size.safety()


def size():
    """The section size: flash and RAM of the program; the stack's depth is the section device's."""
    import frontend_size

    return frontend_size.size()


if __name__ == "__main__":
    sys.exit(main())
