# SPDX-License-Identifier: Apache-2.0
"""Peers of the device's inference: the same calibration, the same held-out frames, the same simulated chip.

    python inference_peers.py IN.npz OUT.json     trains the peers; run by `measure` with .venv-bench's Python

`measure` has them trained in .venv-bench, compiles what they became for the ATmega328P and runs it in simavr.
What a row says of cycles and of errors is what the chip did. peers/trained.py lists the peers,
peers/training.py says how their settings are chosen, peers/avr_program.py how they are run.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from peers import avr_program, candidate

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / ".venv-bench" / "bin" / "python"
TRAINING_S = 900  # at most
SETUP = "sh tools/bench/setup_bench.sh --without-llvm"


def measure(name, calibration, held_out, truth_deg, gp_mean_deg, workdir, say=lambda text: None, spread=None):
    """Rows of the table of peers for one data set.

    name          of the data set
    calibration   (features uint16 [n, d], target_deg [n, 2]), what peers are trained on
    held_out      (features uint16 [m, d], target_deg [m, 2]); the targets are not used
    truth_deg     [m, 2] where the eye looked; gp_mean_deg [m, 2] the full float64 process's answer
    workdir       folder for what is generated and compiled; say: called with a line now and then
    spread        (features [k, d], target_deg [k, 2]), more rows made of the calibration that peers may
                  choose to be trained on, or None

    Each row: name, version, dataset; cycles (of the slowest prediction) and cycles_min; flash, ram (static,
    stack) in bytes; truth_mean_deg, rms_to_gp_deg (angles between directions; of the chip's own answers, of
    scikit-learn's on the host); fits: the Nano holds it; note (settings, and why it does not fit). None where
    there is no figure.
    The host's row also has fit_s, lml and rows. Without .venv-bench there is one row, which says so.
    """
    missing = avr_program.missing() or ("" if PYTHON.is_file() else f"peers are not installed: {SETUP}")
    if missing:
        return [_row("peers", "-", name, missing)]
    workdir = Path(workdir).resolve()
    workdir.mkdir(parents=True, exist_ok=True)
    truth_deg, gp_mean_deg = np.asarray(truth_deg, float), np.asarray(gp_mean_deg, float)
    features = np.asarray(held_out[0], np.uint16)
    np.savez(
        workdir / "in.npz",
        features=np.asarray(calibration[0], np.uint16),
        target_deg=np.asarray(calibration[1], float),
        held_out=features,
        truth_deg=truth_deg,
        gp_mean_deg=gp_mean_deg,
        **({} if spread is None else {"spread": spread[0], "spread_deg": spread[1]}),
    )
    trained = _train(workdir / "in.npz", workdir / "out.json")
    rows = []
    for number, peer in enumerate(trained):
        rows.append(_measure_one(name, peer, features, truth_deg, gp_mean_deg, workdir / f"peer{number:02d}"))
        say(f"{name}: {peer.name}")
    return rows


def dominated(peer, frontier):
    """Whether a row of the frontier (same dataset) is both faster than a peer's row and nearer to the truth.

    Rows need cycles and truth_mean_deg; a peer without them, which does not run on the Nano at all, is
    dominated. Equal in one and better in the other counts as dominated, equal in both does not.
    """
    cycles, error = peer["cycles"], peer["truth_mean_deg"]
    if cycles is None or error is None:
        return True
    for row in frontier:
        if row["dataset"] != peer["dataset"] or row["cycles"] > cycles or row["truth_mean_deg"] > error:
            continue
        if row["cycles"] < cycles or row["truth_mean_deg"] < error:
            return True
    return False


def _measure_one(dataset, peer, features, truth_deg, gp_mean_deg, folder):
    row = _row(peer.name, peer.version, dataset, peer.note)
    row.update(peer.host)
    if not peer.sources:
        if peer.predicted is not None:
            row.update(_errors(peer.predicted, truth_deg, gp_mean_deg))
        return row
    try:
        program = avr_program.Program(peer.sources, tuple(peer.include))
        figures = avr_program.measure(program, features, folder)
    except avr_program.PeerError as error:
        row["note"] += f"; {error}"
        return row
    row.update(cycles=figures.cycles_max, cycles_min=figures.cycles_min, flash=figures.flash, ram=figures.ram)
    row["fits"] = figures.fits
    notes = [peer.note, figures.reason if figures.fits else f"does not fit: {figures.reason}"]
    if figures.gaze_deg is not None:
        ran = figures.rows
        row.update(_errors(figures.gaze_deg, truth_deg[ran], gp_mean_deg[ran]))
        apart = np.hypot(*(figures.gaze_deg - peer.predicted[ran]).T)
        notes.append(f"{len(ran)} frames on the chip, at most {apart.max():.2g} deg from the PC's answer")
    row["note"] = "; ".join(n for n in notes if n)
    return row


def _row(name, version, dataset, note):
    none = dict.fromkeys(("cycles", "cycles_min", "flash", "ram", "truth_mean_deg", "rms_to_gp_deg"))
    return {"name": name, "version": version, "dataset": dataset, **none, "fits": False, "note": note}


def _errors(gaze_deg, truth_deg, gp_mean_deg):
    from sparsegaze.metrics import frame_errors_deg  # .venv-bench, which trains, has no sparsegaze

    truth = frame_errors_deg(*np.asarray(gaze_deg, float).T, *truth_deg.T)
    gp = frame_errors_deg(*np.asarray(gaze_deg, float).T, *gp_mean_deg.T)
    return {"truth_mean_deg": float(truth.mean()), "rms_to_gp_deg": float(np.sqrt(np.mean(gp**2)))}


def _train(given, made):
    """Have the peers trained by .venv-bench; returns its candidates. Raises avr_program.PeerError."""
    made.unlink(missing_ok=True)
    quiet = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    quiet.pop("PYTHONPATH", None)
    with open(made.with_suffix(".log"), "w", encoding="utf-8") as log:
        done = subprocess.run(
            [str(PYTHON), __file__, str(given), str(made)],
            env=quiet,
            cwd=made.parent,  # emlearn leaves files in tmp/
            stdout=log,
            stderr=subprocess.STDOUT,
            check=False,
            timeout=TRAINING_S,
        )
    if done.returncode != 0 or not made.is_file():
        words = Path(log.name).read_text(encoding="utf-8").strip()[-1000:]
        raise avr_program.PeerError(f"training the peers failed: {words}")
    return candidate.read(made)


def main(arguments):
    """Train: IN.npz -> OUT.json. Runs in .venv-bench."""
    from peers import trained  # needs scikit-learn and the peers: only .venv-bench has them

    given, made = arguments
    with np.load(given) as data:
        arrays = [data[k] for k in ("features", "target_deg", "held_out", "truth_deg", "gp_mean_deg")]
        spread = (data["spread"], data["spread_deg"]) if "spread" in data.files else None
    candidate.write(trained.train(*arrays, spread, lambda text: print(text, flush=True)), made)


if __name__ == "__main__":
    main(sys.argv[1:])
