# SPDX-License-Identifier: Apache-2.0
"""What recentring is worth: simulated persons whose headset slips after calibration.

    python tools/bench/recentre_slip.py [--persons 4] [--slips 0.5 1.0] [--out build/bench/recentre.json]

Each person is calibrated as the product does it (120 targets) and judged on held-out targets. Then the
headset moves by so many mm, in a direction drawn per person, the power is cycled, and the same model is
judged again: as it is, after `recentre` with one point, and with five. All of it is the shipped firmware on
the virtual Nano; a slip is another response map. Held-out targets are the same in all runs of a person and
none of the points. Errors are mean angles to the target per frame, over targets within +-20 deg; loss is what
had no valid gaze.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from sparsegaze import calibrate, person, recentre, simulate, validate
from sparsegaze.device import Device
from sparsegaze.errors import SparsegazeError
from sparsegaze.headset import load_headset
from sparsegaze.screen import screen_for
from sparsegaze.virtual import VirtualNano

ROOT = Path(__file__).resolve().parents[2]
HEADSET = ROOT / "headsets" / "led2gaze.toml"
FIRMWARE = ROOT / "host_sdk" / "sparsegaze" / "data" / "firmware.hex"
FIRST_PERSON = 2000
TARGETS, HELD_OUT = 120, 25
# Coarser than the product's map: lids and pupil matter little here, and each slip takes a map of its own.
COARSE = {"pupil_mm": (2.0, 3.5, 5.0, 8.0), "smooth_nodes": 21, "lid_opening": np.linspace(0, 1, 11),
          "check_states": 10}


def direction(seed):
    """Unit vector of a person's slip (x right, y up, z towards the face), uniform on the sphere."""
    v = np.random.default_rng([0x511B, seed]).normal(size=3)
    return v / np.linalg.norm(v)


def map_of(seed, slip_mm):
    """Path of the response map of a person with the headset moved by slip_mm [3]."""
    grid = simulate.Grid(slip_mm=tuple((float(v),) for v in slip_mm), **COARSE)
    return simulate.response_map(load_headset(HEADSET), person.draw_person(seed), grid=grid, workers=1)


def judge(port, seed):
    """{mean_deg, loss_percent, per_target (target, mean gaze; deg)} of the gaze on the held-out targets."""
    done = validate.run(port, HELD_OUT, seed)
    if not done.bit_identical:
        raise SparsegazeError("host and device differ", "this is a bug")
    found = done.report()["accuracy"]
    targets = [[row[name] for name in ("target_az_deg", "target_el_deg", "gaze_az_deg", "gaze_el_deg")]
               for row in done.per_target()]
    return {"mean_deg": found["mean_deg"], "loss_percent": found["data_loss_percent"], "per_target": targets}


def corrected(port, seed, n_points):
    """The same after recentring with so many points, from no correction; what it reported beside it."""
    try:
        with Device(port) as device:
            recentre.keep(device)
            screen = screen_for(device)
            done = (recentre.run(device, screen) if n_points == 1
                    else recentre.run_points(device, screen, n_points))
    except SparsegazeError as error:
        return {"refused": error.message, **judge(port, seed)}
    said = {"applied": done.applied, "predicted_deg": done.predicted_error_deg, "offset_deg": done.after_deg,
            "gain": done.after_gain, "points": done.points}
    return {**said, **judge(port, seed)}


def of_person(seed, slips_mm, n_points, say):
    """Tells rows {person, slip_mm, before, after_1, after_N} of one person; slip 0 is the calibrated seat."""
    with tempfile.TemporaryDirectory(prefix="sgr-") as folder:
        options = {"unpaced": True, "app": FIRMWARE, "state_dir": Path(folder) / "nano"}
        for size in (0.0, *slips_mm):
            slip = size * direction(seed)
            with VirtualNano(HEADSET, seed, map=map_of(seed, slip), **options) as nano:
                if size == 0.0:
                    calibrate.run(nano.port, TARGETS, seed=seed, n_validation=0, folder=Path(folder) / "kept")
                row = {"person": seed, "slip_mm": size, "direction": slip.tolist()}
                row["before"] = judge(nano.port, seed)
                for n in (1, *n_points):
                    row[f"after_{n}"] = corrected(nano.port, seed, n)
                with Device(nano.port) as device:
                    recentre.keep(device)
            say(row)


def line(row):
    """One row as text."""
    cells = [f"{row['before']['mean_deg']:.2f} ({row['before']['loss_percent']:.0f} % lost)"]
    for name in [name for name in row if name.startswith("after_")]:
        after = row[name]
        word = "refused" if "refused" in after else after["applied"]
        cells.append(f"{name[6:]} pt {after['mean_deg']:.2f} ({after['loss_percent']:.0f} %, {word})")
    return f"person {row['person']} slip {row['slip_mm']:.1f} mm: {'; '.join(cells)}"


def main():
    """Parse the command line, run, write and print. Returns the exit code."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--persons", type=int, default=4)
    parser.add_argument("--first", type=int, default=FIRST_PERSON)
    parser.add_argument("--slips", type=float, nargs="+", default=[0.5, 1.0], help="mm")
    parser.add_argument("--points", type=int, nargs="+", default=[5])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench" / "recentre.json")
    chosen = parser.parse_args()
    rows = []

    def say(row):
        rows.append(row)
        print(line(row), flush=True)
        part = chosen.out.with_name(f"{chosen.out.name}.{os.getpid()}.part")
        part.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        part.replace(chosen.out)

    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    try:
        for seed in range(chosen.first, chosen.first + chosen.persons):
            of_person(seed, chosen.slips, chosen.points, say)
    except SparsegazeError as error:
        print(f"recentre_slip: {error}", file=sys.stderr)
        return 1
    for size in (0.0, *chosen.slips):
        of_size = [row for row in rows if row["slip_mm"] == size]
        means = [f"{name} {np.nanmean([row[name]['mean_deg'] for row in of_size]):.2f}"
                 for name in of_size[0] if name not in ("person", "slip_mm", "direction")]
        print(f"slip {size:.1f} mm, mean over {len(of_size)} simulated persons, deg: " + ", ".join(means))
    return 0


if __name__ == "__main__":
    sys.exit(main())
