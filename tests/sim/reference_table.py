# SPDX-License-Identifier: Apache-2.0
"""Simulator against reference, scene by scene: python tests/sim/reference_table.py [--scenes 20] [--tol 3e-6]

Errors as shares of the scene's mean total response; per scene rms and max of face, sclera, iris, glint,
diffuse and total, the reference's own estimates and both sides' CPU seconds.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parent))

from random_scenes import random_scenes
from reference import TERMS, all_pairs, other_pairs, reference_states

from sparsegaze.scene import Scene


def simulator_terms(scene, states):
    """{term: array [state, pair]} of the simulator, pairs flattened."""
    out = {term: [] for term in TERMS}
    for azimuth, elevation, pupil, lid in states:
        for term in TERMS[:3]:
            out[term].append(scene.smooth(azimuth, elevation, pupil, lid, term)[0, 0].ravel())
        out["glint"].append(scene.glint(azimuth, elevation, lid)[0].ravel())
    return {term: np.array(v) for term, v in out.items()}


def mean_total(case, scene=None):
    """Mean total response over gazes within 20 degrees and all pairs of two different places."""
    scene = scene or Scene(case.headset, case.person)
    keep = np.isin(np.arange(scene.shape[0] * scene.shape[1]), _flat(case.headset))
    angles = (-20.0, -10.0, 0.0, 10.0, 20.0)
    return np.mean([scene.response(a, e).ravel()[keep].mean() for a in angles for e in angles])


def _flat(headset):
    everything = all_pairs(headset)
    return [everything.index(p) for p in other_pairs(headset)]


def compare(case, tol=3e-6, quality=None):
    """One scene: {name, scale, rms {part: }, max {part: }, estimate {term: }, seconds {..}, points {..}}."""
    scene = Scene(case.headset, case.person, quality=quality)
    scale, keep = mean_total(case, scene), _flat(case.headset)
    start = time.process_time()
    pairs = other_pairs(case.headset)
    value, error, points = reference_states(case.headset, case.person, case.states, pairs, tol, scale=scale)
    between = time.process_time()
    ours = simulator_terms(scene, case.states)
    seconds = {"reference": between - start, "simulator": time.process_time() - between}
    off = {term: (ours[term][:, keep] - value[term]) / scale for term in TERMS}
    off["diffuse"] = off["face"] + off["sclera"] + off["iris"]
    off["total"] = off["diffuse"] + off["glint"]
    return {
        "name": case.name,
        "scale": scale,
        "rms": {part: float(np.sqrt(np.mean(d**2))) for part, d in off.items()},
        "max": {part: float(np.abs(d).max()) for part, d in off.items()},
        "share": {term: float(value[term].mean() / scale) for term in TERMS},
        "estimate": {term: float(error[term].max() / scale) for term in TERMS},
        "seconds": seconds,
        "points": points,
    }


def main():
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument("--scenes", type=int, default=20)
    parse.add_argument("--only", default="")
    parse.add_argument("--tol", type=float, default=3e-6)
    parse.add_argument("--quality", type=float, default=1.0)
    args = parse.parse_args()
    parts = TERMS + ("diffuse", "total")
    print(
        "%-28s %s  ref est (max)  ref s  sim s"
        % ("rms/max, share of mean", " ".join("%-15s" % p for p in parts))
    )
    quality = {term: args.quality for term in ("sclera", "iris", "glint", "face")}
    for case in random_scenes(args.scenes):
        if args.only not in case.name:
            continue
        row = compare(case, args.tol, quality)
        cells = " ".join("%7.1e/%7.1e" % (row["rms"][p], row["max"][p]) for p in parts)
        estimate = max(row["estimate"].values())
        print(
            "%-28s %s  %7.1e      %6.2f %6.2f"
            % (case.name, cells, estimate, row["seconds"]["reference"], row["seconds"]["simulator"]),
            flush=True,
        )


if __name__ == "__main__":
    main()
