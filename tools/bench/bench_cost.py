# SPDX-License-Identifier: Apache-2.0
"""What maps cost: a product-sized map with its error, how cost grows with gazes and pairs, and the bright
ring.

python tools/bench/bench_cost.py --grid 41 --leds 6        one map in this process; prints seconds and peak
memory
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_errors import FINE
from error_curve import rms

GRID, HALF_DEG = 41, 25.0
GAZE_GRIDS = (11, 21, 41, 81)
LED_COUNTS = (3, 4, 6, 9, 12)  # 6, 12, 30, 72, 132 pairs of two places


def speed(headset, threads, quick, say):
    """The map that a user makes, 41 x 41 gazes: {pairs, gazes, seconds, threads, rms_total, ...}. pairs: of
    two places; those of one place are computed too.
    """
    from sparsegaze.maps import compute_map
    from sparsegaze.person import nominal_person
    from sparsegaze.scene import Scene

    person, seconds, cpu = nominal_person(), [], []
    for run in range(1 if quick else 3):
        say("a map of %d x %d gazes, run %d" % (GRID, GRID, run + 1))
        began, began_cpu = time.perf_counter(), time.process_time()
        made = compute_map(headset, person, HALF_DEG, GRID, workers=threads)
        seconds.append(time.perf_counter() - began)
        cpu.append(time.process_time() - began_cpu)
    counted = ~np.eye(len(headset.sensors), len(headset.emitters), dtype=bool)
    rng = np.random.default_rng(3)
    say("the same map against much finer integration, and the reference")
    fine = Scene(headset, person, quality=FINE)
    nodes = rng.integers(0, GRID, (40 if quick else 200, 2))
    truth = np.array([fine.response(made.azimuth_deg[c], made.elevation_deg[r]) for r, c in nodes])
    got = np.array([made.response[0, :, :, r, c] for r, c in nodes])
    against_fine = (got - truth)[:, counted] / made.mean
    nodes = nodes[: 4 if quick else 16]
    error = against_reference(headset, person, made, nodes)
    bound = made.error_estimate[0][counted] / made.mean
    return {
        "pairs": int(counted.sum()),
        "gazes": GRID * GRID,
        "seconds": min(seconds),
        "threads": threads,
        "rms_total": rms(error),
        "max_total": float(np.abs(error).max()),
        "cpu_seconds": min(cpu),
        "tol": made.tol,
        "rms_against_finer": rms(against_fine),
        "max_against_finer": float(np.abs(against_fine).max()),
        "estimate_rms": made.estimate_rms["total"],
        "largest_bound": float(bound.max()),
        "estimate_bounds": bool((np.abs(against_fine) <= bound).all()),
        "left_out": list(made.left_out),
    }


def against_reference(headset, person, made, nodes):
    """[node, pair] of (a map less the reference) / mean at nodes (row, column)."""
    from reference import TERMS, other_pairs, reference_states

    pairs = other_pairs(headset)
    states = [(made.azimuth_deg[c], made.elevation_deg[r], 3.5, 1.0) for r, c in nodes]
    value, _, _ = reference_states(headset, person, states, pairs)
    s, e = np.array(pairs).T
    got = np.array([made.response[0, s, e, r, c] for r, c in nodes])
    return (got - sum(value[term] for term in TERMS)) / made.mean


def scaling(quick, say):
    """{gazes[], pairs[], seconds[], peak_mb[], ...}: one map in a process of its own for each entry, first
    over gazes at six LEDs, then over LEDs at 21 x 21 gazes. Exponents are of seconds over gazes and over
    pairs.
    """
    grids, leds = (GAZE_GRIDS[:2], LED_COUNTS[:2]) if quick else (GAZE_GRIDS, LED_COUNTS)
    rows = [one(grid, 6, say) for grid in grids]
    rows += [one(21, count, say) for count in leds if count != 6]
    return scaling_figures(rows)


def scaling_figures(rows):
    """rows: [{grid, leds, seconds, peak_mb, base_mb}]."""
    gazes = [row["grid"] ** 2 for row in rows]
    pairs = [row["leds"] * (row["leds"] - 1) for row in rows]
    by_gaze = [(g, row["seconds"]) for g, row in zip(gazes, rows) if row["leds"] == 6]
    by_pair = [(p, row["seconds"]) for p, row in zip(pairs, rows) if row["grid"] == 21]
    return {
        "gazes": gazes,
        "pairs": pairs,
        "seconds": [row["seconds"] for row in rows],
        "peak_mb": [row["peak_mb"] for row in rows],
        "base_mb": [row["base_mb"] for row in rows],
        "map_mb": [row["map_mb"] for row in rows],
        "exponent_gazes": exponent(by_gaze),
        "exponent_pairs": exponent(by_pair),
        "working_mb_per_map_mb": (
            float(max((row["peak_mb"] - row["base_mb"]) / row["map_mb"] for row in rows if row["map_mb"] > 1))
            if any(row["map_mb"] > 1 for row in rows)
            else None
        ),
    }


def exponent(points):
    """Slope of log seconds over log size between the smallest and the largest; what set-up costs lowers
    it.
    """
    (x0, y0), (x1, y1) = min(points), max(points)
    return float(np.log(y1 / y0) / np.log(x1 / x0)) if x1 > x0 else None


def one(grid, leds, say):
    """A row of `scaling`, from a child process."""
    say("%d x %d gazes, %d LEDs" % (grid, grid, leds))
    done = subprocess.run(
        [sys.executable, str(Path(__file__).resolve()), "--grid", str(grid), "--leds", str(leds)],
        capture_output=True,
        text=True,
        timeout=600,
    )
    if done.returncode:
        raise RuntimeError("a map of %d LEDs failed: %s" % (leds, done.stderr.strip()[-400:]))
    return json.loads(done.stdout)


def ring_of(count):
    """A headset of so many LEDs on the lower half of a ring."""
    from sparsegaze.headset import Headset, Port

    ports = []
    for angle in np.radians(np.linspace(180, 360, count)):
        position = np.array([16 * np.cos(angle), 16 * np.sin(angle), -28.0])
        aim = np.array([-5 * np.cos(angle), -3 * np.sin(angle), -11.0]) - position
        ports.append(Port(tuple(position), tuple(aim / np.linalg.norm(aim)), 10.0, 1.5))
    return Headset("ring of %d" % count, tuple(ports), tuple(ports))


def peak_mb():
    """Largest memory that this process has had, MB (Linux)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def ring_sweep(say):
    """The bright ring where the cornea ends, along azimuth: ring.ring_figures() and the two curves that it
    judges. Its height is set by the limbus's blend, the tear film's roughness and the LED's radius, stated
    beside it.
    """
    from sparsegaze import ring
    from sparsegaze.person import nominal_person

    say("the bright ring")
    person, headset = nominal_person(), ring.ring_pair()
    azimuth, smooth = ring.glint_sweep(headset, person)
    _, hard = ring.glint_sweep(headset, replace(person, limbus_blend_mm=ring.HARD_BLEND_MM))
    smooth, hard = smooth[:, 0, 0], hard[:, 0, 0]
    return ring.ring_figures() | {
        "limbus_blend_mm": person.limbus_blend_mm,
        "roughness": person.roughness,
        "lens_radius_mm": ring.LENS_RADIUS_MM,
        "azimuth_deg": azimuth,
        "glint_over_median": smooth / np.median(smooth),
        "hard_crease_over_median": hard / np.median(hard),
    }


def main():
    """One map, as a process of its own. Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", type=int, required=True)
    parser.add_argument("--leds", type=int, required=True)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    from sparsegaze.maps import compute_map
    from sparsegaze.person import nominal_person

    headset = ring_of(options.leds)
    # What any map loads is no part of it.
    compute_map(ring_of(2), nominal_person(), 5.0, 3, workers=options.workers)
    base = peak_mb()
    began = time.perf_counter()
    made = compute_map(headset, nominal_person(), HALF_DEG, options.grid, workers=options.workers)
    seconds = time.perf_counter() - began
    held = made.response.nbytes + sum(part.nbytes for part in made.parts.values())
    print(
        json.dumps(
            {
                "grid": options.grid,
                "leds": options.leds,
                "seconds": seconds,
                "peak_mb": peak_mb(),
                "base_mb": base,
                "map_mb": held / 1e6,
            }
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
