# SPDX-License-Identifier: Apache-2.0
"""The section device: simulated persons on virtual Nanos with the shipped firmware, and the worst of them.

Each person is calibrated by the product's own calibration at each light, in lockstep; everything else is
measured on those models: in ambient light, on steps, in flicker and with held exposures on the one
calibrated in the dark at nominal light.
"""

import json
import os
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import frontend_bound
import frontend_measures as measures
import frontend_persons
import numpy as np
from frontend_board import Board, calibrated
from frontend_physics import P

LIGHTS = ("nominal", "dim", "bright")
SLOW_REPEATS = 4  # cycles a frame: 250 Hz
STREAM_S, STEPS = 60.0, 30
QUICK_STREAM_S, QUICK_STEPS = 3.0, 8


def measure(seeds, folder, quick, say, jobs=None):
    """{"device": rows by person, and the issue's keys: the worst of them} of the persons `seeds`."""
    maps = frontend_persons.maps(seeds, say)
    jobs = min(jobs or os.cpu_count() or 1, 2, len(seeds))
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the processes are as many as the cores
    rows = []
    if jobs == 1:
        rows = [person(seed, str(folder), str(maps[seed]), quick, say) for seed in seeds]
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            running = [pool.submit(person, seed, str(folder), str(maps[seed]), quick) for seed in seeds]
            for finished in as_completed(running):
                rows.append(finished.result())
                say(line_of(rows[-1]))
    rows.sort(key=lambda row: row["seed"])
    return {"device": rows, **worst(rows)}


def person(seed, folder, map_path, quick, say=None):
    """Everything measured on one person: a dict. `say` defaults to a line on the standard output."""
    say = say or (lambda text: print("           device   " + text, flush=True))
    folder, row = Path(folder), {"seed": seed}
    rng = np.random.default_rng([0xF5, seed])
    with tempfile.TemporaryDirectory(prefix="sgf-") as temporary:
        for light in LIGHTS[:1] if quick else LIGHTS:
            kept, row.setdefault("calibration", {})[light] = calibrated(seed, light, folder, say)
            state = Path(temporary) / light
            shutil.copytree(kept, state)
            with Board(seed, state, light=light) as board:
                board.still()
                board.look(0, 0)
                board.frames(0.3)
                row.setdefault("precision", {})[light] = measures.precision(board)
                row.setdefault("noise", {})[light] = frontend_bound.noise(board, map_path, light)
                if light == "nominal":
                    _nominal(board, row, quick, rng, Path(temporary))
                    _bounds(row, map_path)
            say(f"person {seed}, {light}: " + json.dumps(_short(row["precision"][light])))
    return row


def _nominal(board, row, quick, rng, folder):
    """What is measured on the model of the dark at nominal light."""
    names = measures.AMBIENTS[1:]
    row["ambient"] = {"dark": row["precision"]["nominal"]}
    row["ambient"].update({name: measures.ambient(board, name) for name in names})
    dark = measures.ambient(board, "dark", SLOW_REPEATS)
    row["ambient_250"] = {"dark": dark}
    row["ambient_250"].update({name: measures.ambient(board, name, SLOW_REPEATS) for name in names})
    board.control.set("ambient", "dark")
    row["flicker"] = measures.flicker(board)
    row["flicker_250"] = measures.flicker(board, SLOW_REPEATS)
    row["shift"] = measures.exposure_shift(board)
    count = QUICK_STEPS if quick else STEPS
    row["step"] = measures.steps(board, count, rng)
    row["step_250"] = measures.steps(board, count, rng, SLOW_REPEATS)
    row["stream"] = measures.stream(board, QUICK_STREAM_S if quick else STREAM_S, rng, folder / "frames.csv")


def _bounds(row, map_path):
    """The physical limit beside the precision in steady light: room and bright room flicker, which costs
    more."""
    noise = row["noise"]["nominal"]
    for name, na in (
        ("room", P.ambient.room_na),
        ("bright_room", P.ambient.bright_room_na),
        ("sun_gap", P.ambient.sun_gap_na),
    ):
        for table, repeats in (("ambient", 1), ("ambient_250", SLOW_REPEATS)):
            found = row[table][name]
            bound = frontend_bound.in_ambient(noise, map_path, noise["pupil_mm"], found["exposure_us"], na)
            found["bound_deg"] = bound / np.sqrt(repeats)


def _short(found):
    return {key: round(found[key], 3) for key in ("s2s_deg", "s2s_250_deg", "error_deg", "valid")}


def line_of(row):
    """One line of a person's figures."""
    stream, ambient = row["stream"], row["ambient"]
    ratio = {
        name: ambient[name]["error_deg"] / ambient["dark"]["error_deg"] for name in measures.AMBIENTS[1:]
    }
    return (
        f"person {row['seed']}: {stream['rate_hz']:.1f} Hz, late {stream['late']}, lost {stream['lost']}, "
        + ", ".join(f"{name} x{value:.2f}" for name, value in ratio.items())
        + f", shift {row['shift']['exposure_shift_deg']:.3f} deg"
    )


def worst(rows):
    """The issue's keys: of every figure the worst person's."""

    def most(get):
        values = [get(row) for row in rows]
        return None if any(value is None or np.isnan(value) for value in values) else max(values)

    def ratios(row, key, field):
        table = row[key]
        return {name: table[name][field] / table["dark"][field] for name in measures.AMBIENTS[1:]}

    lights = list(rows[0]["precision"])
    out = {
        "rate_hz": min(row["stream"]["rate_hz"] for row in rows),
        "stream_seconds": min(row["stream"]["seconds"] for row in rows),
        "late": most(lambda row: row["stream"]["late"]),
        "lost": most(lambda row: row["stream"]["lost"]),
        "n_vectors": min(row["calibration"]["nominal"]["vectors"] for row in rows),
        "truth_ratio": most(lambda row: row["calibration"]["nominal"]["truth_ratio"]["ratio"]),
        "frame_cycles_max": most(lambda row: row["stream"]["frame_cycles_max"]),
        "stack_free": min(row["stream"]["stack_free"] for row in rows),
        "exposure_shift_deg": most(lambda row: row["shift"]["exposure_shift_deg"]),
        "exposure_shift_over_s2s": most(
            lambda row: row["shift"]["exposure_shift_deg"] / row["shift"]["s2s_deg"]
        ),
    }
    for key in (
        "latency_mean_ms",
        "latency_mean_max_ms",
        "latency_last_ms",
        "latency_last_max_ms",
        "jitter_cycles",
    ):
        out[key] = most(lambda row, key=key: row["stream"]["latency"][key])
    for key in ("s2s_deg", "s2s_250_deg"):
        out[key] = most(lambda row, key=key: row["precision"]["nominal"][key])
        for light in lights[1:]:
            out[f"{key}_{light}"] = most(lambda row, key=key, light=light: row["precision"][light][key])
    for light in lights:
        out[f"bound_deg_{light}"] = most(lambda row, light=light: row["noise"][light]["bound_deg"])
    for name in measures.AMBIENTS[1:]:
        for key, table, field in (
            ("error_ratio", "ambient", "error_deg"),
            ("error_ratio_250", "ambient_250", "error_deg"),
        ):
            value = most(lambda row, t=table, f=field, n=name: ratios(row, t, f)[n])
            out.setdefault(key, {})[name] = value
        for key, table in (("valid", "ambient"), ("valid_250", "ambient_250")):
            out.setdefault(key, {})[name] = min(row[table][name]["valid"] for row in rows)
        for key, table in (("saturated_after", "ambient"), ("saturated_after_250", "ambient_250")):
            value = most(lambda row, t=table, n=name: row[t][n]["saturated_after"])
            out.setdefault(key, {})[name] = value
            for field in ("late", "lost"):
                value = most(lambda row, t=table, n=name, f=field: row[t][n][f])
                out.setdefault(key.replace("saturated_after", f"{field}_in"), {})[name] = value
    for table in ("step", "step_250"):
        out[table] = {
            key: most(lambda row, t=table, k=key: _larger(row[t]["up"][k], row[t]["down"][k]))
            for key in ("saturated_frames", "settle_frames")
        }
    for key, table in (("flicker_ratio", "flicker"), ("flicker_ratio_250", "flicker_250")):
        out[key] = most(lambda row, t=table: flicker_ratio(row[t]))
    # An error or a noise of frames that hardly ever are valid would be none.
    out["valid_nominal"] = min(row["precision"]["nominal"]["valid"] for row in rows)
    out["valid_flicker_250"] = min(row["flicker_250"][hz]["valid"] for row in rows for hz in ("100", "120"))
    judged = [[row["precision"]["nominal"], *row["ambient_250"].values(), *row["flicker_250"].values()]
              for row in rows]
    out["places"] = min(found["places"] for tables in judged for found in tables)
    return out


def flicker_ratio(table):
    """Worse of both frequencies over steady light of the same mean."""
    return max(table[hz]["error_deg"] for hz in ("100", "120")) / table["steady"]["error_deg"]


def _larger(first, second):
    return None if first is None or second is None else max(first, second)
