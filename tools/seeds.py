# SPDX-License-Identifier: Apache-2.0
"""The demo on many simulated persons: one row a seed, none left out, into build/seeds/seeds.json.

    .venv/bin/python tools/seeds.py 1 2 3 4 5      (or: make seeds SEEDS="1 2 3 4 5")

About a minute a person, 25 s of which stream in real time. Exits 1 when any seed misses a bar.
"""
import argparse
import json
import subprocess
import sys
from pathlib import Path

COLUMNS = ("mean_deg", "median_deg", "p95_deg", "gp64_mean_deg", "to_true_gaze_mean_deg", "rms_s2s_deg",
           "data_loss")


def main():
    """Run every seed, print and write the table. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", nargs="+", type=int, help="simulated persons")
    parser.add_argument("--out", type=Path, default=Path("build/seeds"),
                        help="folder of the results (default build/seeds)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    print("seed  met  " + "  ".join(f"{name:>12}" for name in COLUMNS), flush=True)
    demo = Path(__file__).with_name("demo.py")
    for seed in options.seeds:
        folder = options.out / str(seed)
        report = folder / "report.json"
        report.unlink(missing_ok=True)      # a report of an earlier run must not pass for this one
        done = subprocess.run([sys.executable, str(demo), "--seed", str(seed), "--out", str(folder)],
                              capture_output=True, text=True)
        if not report.is_file():
            said = done.stderr.strip().splitlines()
            print(f"{seed:4}  no   {said[-1] if said else 'no report'}", flush=True)
            rows.append({"seed": seed, "met": False})
            continue
        measured = json.loads(report.read_text(encoding="utf-8"))
        accuracy = {name: measured["accuracy"][name] for name in COLUMNS}
        rows.append({"seed": seed, "met": done.returncode == 0, **accuracy,
                     "missed": [bar["name"] for bar in measured["bars"] if not bar["met"]]})
        figures = "  ".join(f"{accuracy[name]:12.3f}" for name in COLUMNS)
        print(f"{seed:4}  {'yes' if rows[-1]['met'] else 'NO ':3}  {figures}  {' '.join(rows[-1]['missed'])}",
              flush=True)
    (options.out / "seeds.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    whole = [row for row in rows if "mean_deg" in row]
    if whole:
        means = [row["mean_deg"] for row in whole]
        print(f"{sum(row['met'] for row in rows)} of {len(rows)} simulated persons meet every bar; "
              f"mean error {sum(means) / len(means):.3f} deg, worst {max(means):.3f}")
    return 0 if all(row["met"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
