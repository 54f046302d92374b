# SPDX-License-Identifier: Apache-2.0
"""The data that inference is judged on: simulated recordings of many persons, and smooth synthetic sets.

    python tools/bench/inference_data.py [--persons 20] [--jobs 2] [--out build/bench/inference]

One folder a data set: calibration.csv and held_out.csv (recordings, see sparsegaze.recording), truth.npz and
key.json. truth.npz has, for each row of both files, under the names calibration_* and held_out_*:

    gaze_deg     float64 [n, 2]  where the simulated eye looked at t_us; its target stands in the CSV
    lid_opening  float64 [n]     1 open, 0 shut
    pupil_mm     float64 [n]
    settled      bool [n]        from settle_s after the target's onset on: rows that are judged
    raw_flags    uint8 [n]       flags of the raw frame (saturated, starved, exposure)

Simulated persons (`sim-2000`, ...): the default headset's response map on a person whom no placement search
has seen; parts, noise, pupil, blinks and gaze of tools/vheadset/physics.toml, sensed by the shipped firmware
on the virtual Nano, in lockstep. Calibration is the product's, 120 targets; then the power is cycled (other
noise, other pupil, other blinks) and held-out targets are shown, none within a degree of a calibrated one.

Synthetic sets (`smooth-0`, ..., `sharp-0`, ...): see `synthetic`.

A data set is made again when anything it depends on has changed; key.json names the hash of all that.
"""

import argparse
import ast
import hashlib
import json
import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from sparsegaze import capture, person, simulate, targets, virtual
from sparsegaze.device import Device
from sparsegaze.errors import SparsegazeError
from sparsegaze.headset import load_headset
from sparsegaze.recording import Recording
from sparsegaze.screen import screen_for
from sparsegaze.virtual import VirtualNano

ROOT = Path(__file__).resolve().parents[2]
HEADSET = ROOT / "headsets" / "led2gaze.toml"
FIRMWARE = ROOT / "host_sdk" / "sparsegaze" / "data" / "firmware.hex"
FOLDER = ROOT / "build" / "bench" / "inference"
FIRST_PERSON, PERSONS = 2000, 20
CALIBRATION_TARGETS, HELD_OUT_TARGETS = 120, 49
SYNTHETIC_SEEDS = (0, 1, 2)
MAP_ERROR = 1e-4  # most that a map may state of itself, rms of the mean response, lids open

GRID, TEST_POINTS = 17, 2000  # of the synthetic sets
REACH_DEG, TEST_DEG = 20.0, 19.0
NOISE_LSB, COUNT_MAX = 1.5, 1023
RING_WIDTH_DEG = {"smooth": (3.5, 5.0), "sharp": (1.2, 1.8)}  # standard deviation across the ring


@dataclass
class DataSet:
    """name; kind "simulated", "smooth" or "sharp"; calibration, held_out (Recording); truth {name: array}."""

    name: str
    kind: str
    calibration: Recording
    held_out: Recording
    truth: dict
    key: dict

    @classmethod
    def load(cls, folder):
        """Read a folder that `make` has made."""
        folder = Path(folder)
        key = json.loads((folder / "key.json").read_text(encoding="utf-8"))
        with np.load(folder / "truth.npz") as stored:
            truth = {name: stored[name] for name in stored.files}
        parts = (Recording.read(folder / f"{part}.csv") for part in ("calibration", "held_out"))
        return cls(folder.name, kind_of(folder.name), *parts, truth, key)

    def save(self, folder):
        """Write the folder whole, or leave what was there."""
        folder = Path(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = folder.with_name(f"{folder.name}.{os.getpid()}.part")
        shutil.rmtree(draft, ignore_errors=True)
        try:
            draft.mkdir()
            self.calibration.write(draft / "calibration.csv")
            self.held_out.write(draft / "held_out.csv")
            np.savez_compressed(draft / "truth.npz", **self.truth)
            (draft / "key.json").write_text(json.dumps(self.key, indent=1) + "\n", encoding="utf-8")
            shutil.rmtree(folder, ignore_errors=True)
            draft.rename(folder)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def kind_of(name):
    """Kind of a data set by its name: sim-2000 -> simulated, smooth-0 -> smooth, sharp-0 -> sharp."""
    return {"sim": "simulated"}.get(name.split("-")[0], name.split("-")[0])


def names(persons=PERSONS):
    """Names of all data sets with that many simulated persons."""
    sets = [f"{kind}-{seed}" for kind in ("smooth", "sharp") for seed in SYNTHETIC_SEEDS]
    return [f"sim-{FIRST_PERSON + i}" for i in range(persons)] + sets


def synthetic(kind, seed):
    """A synthetic DataSet: six channels of a smooth response with a ring, ten bits, noise of 1.5 LSB.

    kind "smooth" or "sharp" (the ring is a third as wide); seed draws the response and the noise. Channel j
    at gaze g (azimuth, elevation, degrees):

        count_j = a_j + b_j exp(-|g - p_j|^2 / (2 w_j^2)) + r_j exp(-(|g - q_j| - R_j)^2 / (2 v_j^2)) + noise

    a 100..200 LSB, b 300..450 LSB, w 13..17 deg, p every 60 degrees on a circle of 14 deg and 1.5 deg rms
    off it; r 60..120 LSB, R 15..19 deg, v 3.5..5 deg (sharp: 1.2..1.8), q 5 deg from the centre towards p and
    1 deg rms off; all uniform. Noise is normal, 1.5 LSB rms, independent; counts are rounded, cut to 0..1023.
    Calibration: one sample at each of 17 x 17 gazes, +-20 deg. Held out: one sample at each of 2000 gazes,
    uniform in +-19 deg. Targets are exact.
    """
    rng = np.random.default_rng([0x5E7, ("smooth", "sharp").index(kind), seed])
    response = channels(rng, RING_WIDTH_DEG[kind])
    axis = np.linspace(-REACH_DEG, REACH_DEG, GRID)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    test = rng.uniform(-TEST_DEG, TEST_DEG, (TEST_POINTS, 2))
    parts, truth = [], {}
    for part, gaze in (("calibration", grid), ("held_out", test)):
        noisy = response(gaze) + rng.normal(0.0, NOISE_LSB, (len(gaze), 6))
        count = np.clip(np.rint(noisy), 0, COUNT_MAX).astype(np.uint16)
        meta = {"synthetic": f"{kind}, seed {seed}", "part": part}
        parts.append(Recording(np.arange(len(gaze)) * 1_000_000, count, gaze, np.ones(len(gaze), bool), meta))
        truth.update(_truth(part, gaze, np.ones(len(gaze)), np.full(len(gaze), np.nan)))
    return DataSet(f"{kind}-{seed}", kind, *parts, truth, _synthetic_key(kind, seed))


def channels(rng, ring_width_deg):
    """The noise-free response of `synthetic`: a function of gaze [n, 2] to counts [n, 6], drawn from rng."""
    angle = np.deg2rad(60.0 * np.arange(6))
    toward = np.column_stack([np.cos(angle), np.sin(angle)])
    base, bump = rng.uniform(100, 200, 6), rng.uniform(300, 450, 6)
    wide, peak = rng.uniform(13, 17, 6), 14.0 * toward + rng.normal(0, 1.5, (6, 2))
    bright, radius = rng.uniform(60, 120, 6), rng.uniform(15, 19, 6)
    width, middle = rng.uniform(*ring_width_deg, 6), 5.0 * toward + rng.normal(0, 1.0, (6, 2))

    def response(gaze):
        far = np.linalg.norm(gaze[:, None] - peak, axis=2)
        off = np.linalg.norm(gaze[:, None] - middle, axis=2) - radius
        return base + bump * np.exp(-0.5 * (far / wide) ** 2) + bright * np.exp(-0.5 * (off / width) ** 2)

    return response


def simulated(seed, key, progress=None, workers=1):
    """DataSet of the simulated person `seed`; progress(stage, done, total).

    Raises what VirtualNano and capture.run raise; SparsegazeError when the map is not good to MAP_ERROR.
    """
    share = None if progress is None else lambda done: progress("map", done, 1.0)
    path = simulate.response_map(load_headset(HEADSET), person.draw_person(seed), share, workers=workers)
    with simulate.ResponseMap(path) as opened:
        stated = opened.error_estimate
    if not stated.open_rms <= MAP_ERROR:
        raise SparsegazeError(
            f"the map of person {seed} states an error of {stated.open_rms:.1e}",
            "leave this person out, or mend the simulator",
        )
    calibration_plan = targets.calibration_plan(CALIBRATION_TARGETS, seed)
    held_out_plan = targets.validation_plan(HELD_OUT_TARGETS, seed, avoid_deg=calibration_plan.target_deg)
    parts, truth = [], {}
    with tempfile.TemporaryDirectory(prefix="sgd-") as folder:
        for part, plan in (("calibration", calibration_plan), ("held_out", held_out_plan)):
            log = Path(folder) / f"{part}-truth.csv"
            # A power-on each, over one state: the second session's behaviour and noise are not the first's.
            options = {"unpaced": True, "app": FIRMWARE, "state_dir": Path(folder) / "nano"}
            with VirtualNano(HEADSET, seed, **options) as nano:
                with Device(nano.port) as device:
                    nano.control.truth(log)
                    meta = {"simulated_person": seed, "part": part, "map_error": f"{stated.open_rms:.2e}"}
                    taken = capture.run(device, screen_for(device), plan, meta=meta, progress=progress)
                    nano.control.truth(None)
            run, inside = taken.run, taken.run.target_index >= 0
            state = read_state(log, run.frames["t_us"][inside] - run.offset_us)
            parts.append(taken.recording)
            truth.update(
                _truth(
                    part,
                    state[:, :2],
                    state[:, 3],
                    state[:, 2],
                    run.settled[inside],
                    run.frames["raw_flags"][inside],
                )
            )
    key = {**key, "map_error": stated._asdict()}
    return DataSet(f"sim-{seed}", "simulated", *parts, truth, key)


def read_state(path, at_us):
    """State of the simulated eye at virtual times [n]: azimuth, elevation (deg), pupil (mm), lids; [n, 4].

    Between the milliseconds of the virtual Nano's log, linear.
    """
    table = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(5), ndmin=2)
    return np.column_stack([np.interp(at_us, table[:, 0], table[:, i]) for i in range(1, 5)])


def _truth(part, gaze_deg, lid_opening, pupil_mm, settled=None, raw_flags=None):
    n = len(gaze_deg)
    settled = np.ones(n, bool) if settled is None else settled
    raw_flags = np.zeros(n, np.uint8) if raw_flags is None else raw_flags
    columns = {
        "gaze_deg": gaze_deg,
        "lid_opening": lid_opening,
        "pupil_mm": pupil_mm,
        "settled": settled,
        "raw_flags": raw_flags,
    }
    return {f"{part}_{name}": np.array(value) for name, value in columns.items()}


def key_of(name):
    """What the data set depends on: {"hash": ..., and the inputs in words}."""
    kind, seed = kind_of(name), int(name.split("-")[1])
    return _simulated_key(seed) if kind == "simulated" else _synthetic_key(kind, seed)


def _simulated_key(seed):
    package, nano = ROOT / "host_sdk" / "sparsegaze", ROOT / "tools" / "vheadset"
    modules = ("targets", "selection", "session", "capture", "screen", "recording", "device", "virtual")
    sources = [FIRMWARE, Path(virtual.locate_bootloader()[1]), nano / "physics.toml", Path(__file__)]
    sources += sorted(nano.glob("*.[ch]")) + [package / f"{module}.py" for module in modules]
    drawn = simulate.map_name(load_headset(HEADSET), person.draw_person(seed))
    return {"hash": file_hash(sources, drawn, seed), "person": seed, "map": drawn}


def _synthetic_key(kind, seed):
    return {"hash": file_hash([Path(__file__)], kind, seed), "synthetic": f"{kind}, seed {seed}"}


def file_hash(paths, *words):
    """SHA-256 over files and words, 16 digits of it. Comments and layout of Python do not count."""
    digest = hashlib.sha256(repr(words).encode())
    for path in paths:
        text = path.read_bytes()
        if path.suffix == ".py":
            text = ast.dump(ast.parse(text)).encode()
        digest.update(path.name.encode() + b"\0" + text)
    return digest.hexdigest()[:16]


def is_current(folder, name):
    """True when the folder holds the data set and nothing that it depends on has changed."""
    try:
        made = json.loads((Path(folder) / "key.json").read_text(encoding="utf-8"))["hash"]
    except (OSError, ValueError, KeyError):
        return False
    return made == key_of(name)["hash"]


def make_one(folder, name, workers=1, progress=None):
    """Make one data set in `folder`/`name`. Returns (name, seconds)."""
    began = time.perf_counter()
    kind, seed = kind_of(name), int(name.split("-")[1])
    if kind == "simulated":
        made = simulated(seed, key_of(name), progress, workers)
    else:
        made = synthetic(kind, seed)
    made.save(Path(folder) / name)
    return name, time.perf_counter() - began


def make(wanted, folder=FOLDER, jobs=2, say=print):
    """Make what is missing or stale of the wanted data sets, two at a time. Returns their folders, in order.

    say    called with a line of progress after each data set
    """
    folder = Path(folder)
    stale = [name for name in wanted if not is_current(folder / name, name)]
    began, done = time.perf_counter(), 0
    if stale:
        mapped = sum(kind_of(name) == "simulated" for name in stale)
        cost = (
            f", {mapped} of persons: 80 s of one core each whose response map is not in the cache, else 15 s"
        )
        say(f"{len(stale)} of {len(wanted)} sets to make" + (cost if mapped else ""))
    for name, seconds in _in_turn(folder, stale, jobs):
        done += 1
        left = (time.perf_counter() - began) / done * (len(stale) - done)
        say(f"{name} in {seconds:.1f} s, {done} of {len(stale)}, about {left:.0f} s left")
    return [folder / name for name in wanted]


def _in_turn(folder, stale, jobs):
    if jobs == 1 or len(stale) < 2:
        yield from (make_one(folder, name) for name in stale)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        running = [pool.submit(make_one, folder, name) for name in stale]
        yield from (finished.result() for finished in as_completed(running))


def main():
    """Parse the command line, make the data. Returns the exit code."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--persons", type=int, default=PERSONS, help=f"simulated persons (default {PERSONS})")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes (default 2)")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder (default build/bench/inference)")
    options = parser.parse_args()
    try:
        make(names(options.persons), options.out, options.jobs)
    except SparsegazeError as error:
        print(f"inference_data: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
