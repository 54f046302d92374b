# SPDX-License-Identifier: Apache-2.0
"""Against others: Mitsuba 3 on scenes that a mesh can express, and our own image method. Agreement, then
what one response costs each at equal error.

All errors are divided by the mean response of the scene. Seconds are wall seconds with every core that this
process may use, per response (one sensor, one emitter, one gaze), without loading, compiling or set-up of the
scene for the peers, and with everything for ours.
"""

import glob
import json
import os
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import peer_scene
from bench_errors import FINE
from error_curve import rms, seconds_at

from sparsegaze import __version__, image, maps
from sparsegaze.person import nominal_person
from sparsegaze.scene import Scene

FOLDER = Path(__file__).resolve().parent
PYTHON = FOLDER.parent.parent / ".venv-bench" / "bin" / "python"
LLVM = "DRJIT_LIBLLVM_PATH"
LLVM_PLACES = ("/usr/lib/*/libLLVM.so.19.1", "/usr/lib/llvm-19/lib/libLLVM.so*")
EQUAL = 1e-3  # the error at which costs are compared
HALF_DEG, GRID = 25.0, 41
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5)
IMAGE_PIXELS = (16, 32, 64, 128, 256, 512)
N_GAZES, SEED = 40, 7
OURS, OURS_WHOLE = "sparsegaze", "sparsegaze, whole scene"


def run(headset, quick, say):
    """{peers, agreement, curves, ratios, versions} of a headset. quick: fewer settings, same keys."""
    eye = peer_scene.point_like(headset, peer_scene.AIM_MM)
    scene = GazeScene("the peers' scene", eye, peer_scene.EYE_PERSON, 3 if quick else 8)
    whole = GazeScene("the default headset", headset, nominal_person(), 0)
    tolerances = TOLERANCES[1:3] if quick else TOLERANCES
    sizes = IMAGE_PIXELS[:4] if quick else IMAGE_PIXELS
    curves = {
        OURS: ours(scene, tolerances, 1 if quick else 2, say),
        OURS_WHOLE: ours(whole, tolerances, 1 if quick else 2, say),
        "image method": image_method(scene, sizes, say),
        "image method, whole scene": image_method(whole, sizes, say),
    }
    result = {"agreement": {}, "versions": {"sparsegaze": __version__}}
    try:
        if missing():
            raise RuntimeError(missing())
        agree, mitsuba_curves, version = mitsuba_figures(scene, headset, quick, say)
        result["agreement"], result["versions"]["mitsuba"] = agree, version
        curves.update(mitsuba_curves)
    except (RuntimeError, subprocess.TimeoutExpired) as error:
        result["without"] = "Mitsuba 3: %s" % error
        say("without Mitsuba 3: %s" % error)
    result["curves"] = curves
    result.update(compare(curves, result["versions"]))
    return result


def missing():
    """Why Mitsuba cannot run, or an empty string."""
    if not PYTHON.is_file():
        return "not installed: sh tools/bench/setup_bench.sh"
    if not llvm():
        return "LLVM 19 is missing (Debian's libllvm19): sh tools/bench/setup_bench.sh"
    return ""


def llvm():
    """Path of LLVM 19's library, or an empty string. Others abort the process in Mitsuba 3.9."""
    found = [os.environ[LLVM]] if LLVM in os.environ else []
    for place in LLVM_PLACES:
        found += sorted(glob.glob(place))
    return found[0] if found else ""


class GazeScene:
    """A scene at gazes that a map of GRID nodes has, with what the finest integration makes of it; and jobs:
    (gaze, sensor, emitter) for who takes them one by one.
    """

    def __init__(self, name, headset, person, n_jobs):
        self.name, self.headset, self.person = name, headset, person
        self.axis = np.linspace(-HALF_DEG, HALF_DEG, GRID)
        self.fine = Scene(headset, person, quality=FINE)
        self.counted = ~np.eye(len(headset.sensors), len(headset.emitters), dtype=bool)
        rng = np.random.default_rng(SEED)
        inner = np.flatnonzero(np.abs(self.axis) <= 20)
        self.nodes = [tuple(rng.choice(inner, 2)) for _ in range(N_GAZES)]
        self.truth = np.array([self.value(*self.gaze(node)) for node in self.nodes])
        self.mean = float(self.truth.sum(1)[:, self.counted].mean())
        pairs = np.argwhere(self.counted)
        self.jobs = [(i // 2, *pairs[rng.integers(len(pairs))]) for i in range(n_jobs)]

    def gaze(self, node):
        """Azimuth and elevation of a node (column, row)."""
        return float(self.axis[node[0]]), float(self.axis[node[1]])

    def value(self, azimuth, elevation):
        """[2 (diffuse, mirror), sensor, emitter] by the finest integration."""
        smooth = self.fine.smooth(azimuth, elevation, 3.5, 1.0)[0, 0]
        return np.array([smooth, self.fine.glint(azimuth, elevation, 1.0)[0]])

    def expected(self):
        """[job, 3]: diffuse, mirror and total of the jobs."""
        parts = np.array([self.truth[node][:, s, e] for node, s, e in self.jobs])
        return np.column_stack([parts, parts.sum(1)])

    def work(self):
        """What mitsuba_peer.py reads."""
        rows = {"sensor": [], "emitter": []}
        for node, s, e in self.jobs:
            axes = peer_scene.eye_axes(self.person, *self.gaze(self.nodes[node]))
            rows["sensor"].append(peer_scene.port_row(self.headset.sensors[s], self.person, axes))
            rows["emitter"].append(peer_scene.port_row(self.headset.emitters[e], self.person, axes))
        mesh = peer_scene.eye_mesh(self.person)
        return dict(
            mesh,
            **{k: np.array(v) for k, v in rows.items()},
            index=self.person.refractive_index,
            roughness=self.person.roughness,
        )


def ours(scene, tolerances, repeats, say):
    """Settings of compute_map, whole maps, the fastest of some: [{label, seconds, rms, max}]."""
    rows = []
    responses = GRID * GRID * int(scene.counted.sum())
    for tolerance in tolerances:
        say("maps of %s, tol %g" % (scene.name, tolerance))
        seconds = np.inf
        for _ in range(repeats):
            began = time.perf_counter()
            made = maps.compute_map(scene.headset, scene.person, HALF_DEG, GRID, tol=tolerance)
            seconds = min(seconds, time.perf_counter() - began)
        got = np.array([made.response[0, :, :, row, column] for column, row in scene.nodes])
        error = (got - scene.truth.sum(1))[:, scene.counted] / scene.mean
        rows.append(
            {
                "label": "tol %g" % tolerance,
                "seconds": seconds / responses,
                "rms": rms(error),
                "max": float(np.abs(error).max()),
            }
        )
    return rows


def image_method(scene, sizes, say):
    """Settings of image.image_response, gazes shared out over the cores: [{label, seconds, rms}]."""
    rows, threads = [], len(os.sched_getaffinity(0))
    for pixels in sizes:
        say("images of %s, %d x %d pixels" % (scene.name, pixels, pixels))
        nodes = range(min(len(scene.nodes), max(2 * threads, 5120 // pixels)))

        def one(node):
            return image.image_response(
                scene.headset, scene.person, *scene.gaze(scene.nodes[node]), 3.5, 1.0, pixels=pixels
            )

        one(0)
        began = time.perf_counter()
        with ThreadPoolExecutor(threads) as pool:
            got = np.array(list(pool.map(one, nodes)))
        seconds = time.perf_counter() - began
        error = (got - scene.truth[: len(got)].sum(1))[:, scene.counted] / scene.mean
        rows.append({"label": "%d^2" % pixels, "seconds": seconds / error.size, "rms": rms(error)})
    return rows


def face_work(headset, n_jobs):
    """What mitsuba_peer.py reads for the face, what we say of it, and the mean over pairs."""
    headset, person = peer_scene.point_like(headset), peer_scene.FACE_PERSON
    values = Scene(headset, person, quality=FINE).smooth(0.0, 0.0, 3.5, 0.0, "face")[0, 0]
    off = ~np.eye(*values.shape, dtype=bool)
    rng = np.random.default_rng(SEED)
    pairs = rng.permutation(np.argwhere(off))[:n_jobs]
    work = dict(peer_scene.face_mesh(person), index=1.0, roughness=0.0)
    work["sensor"] = np.array([peer_scene.port_row(headset.sensors[s], person) for s, _ in pairs])
    work["emitter"] = np.array([peer_scene.port_row(headset.emitters[e], person) for _, e in pairs])
    return work, np.array([values[s, e] for s, e in pairs]), float(values[off].mean())


def mitsuba_figures(scene, headset, quick, say):
    """(agreement by part, curves by variant, version)."""
    jobs = list(range(len(scene.jobs)))
    work = scene.work()
    fine = {"film": 256, "spp": 64, "sampler": "multijitter", "seeds": [1, 2], "jobs": jobs, "warm": False}
    parts = ("diffuse", "mirror", "total")
    settings = curve_settings(quick)
    say(
        "Mitsuba 3 llvm: the eye, %d triangles, %d jobs, %d settings"
        % (len(work["triangle"]), len(jobs), len(settings))
    )
    result = mitsuba(work, [dict(fine, part=part) for part in parts] + settings, "llvm_ad_mono")
    version = result["version"]
    converged = np.array([task["value"] for task in result["tasks"][:3]]).mean(2).T
    agreement = {part: row for part, row in zip(parts, difference(converged, scene.expected(), scene.mean))}
    truth = converged[:, 2]
    curves = {"Mitsuba 3 llvm_ad_mono": curve(result["tasks"][3:], truth, scene.mean)}
    say("Mitsuba 3 scalar: %d settings" % len(settings))
    scalar = [task for task in settings if task["film"] ** 2 * task["spp"] <= 300_000]
    for task in scalar:
        task["seeds"], task["jobs"] = task["seeds"][:3], task["jobs"][:4]
        task.pop("value", None), task.pop("seconds", None)
    result = mitsuba(work, scalar, "scalar_rgb")
    curves["Mitsuba 3 scalar_rgb"] = curve(result["tasks"], truth, scene.mean)
    say("Mitsuba 3 llvm: the face with closed lids")
    work, expected, mean = face_work(headset, 3 if quick else 8)
    tasks = [dict(fine, part="diffuse", jobs=list(range(len(expected))))]
    result = mitsuba(work, tasks, "llvm_ad_mono")
    converged = np.array([result["tasks"][0]["value"]]).mean(2).T
    agreement["face"] = difference(converged, expected[:, None], mean)[0]
    return agreement, curves, version


def curve_settings(quick):
    """Films, samples and samplers from rough to fine; the cheapest at an error is what counts."""
    jobs, seeds = ([0, 1], [1, 2, 3]) if quick else ([0, 3, 4, 7], [1, 2, 3, 4, 5, 6])
    settings = [(64, 4), (64, 16), (64, 64), (128, 4), (128, 16), (256, 1), (256, 4), (256, 16)]
    return [
        {"part": "total", "film": film, "spp": spp, "sampler": sampler, "seeds": seeds, "jobs": jobs}
        for film, spp in (settings[1::3] if quick else settings)
        for sampler in ("independent", "multijitter")
    ]


def mitsuba(work, tasks, variant):
    """Result of mitsuba_peer.py in its own environment."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [os.path.join(folder, name) for name in ("work.npz", "tasks.json", "result.json")]
        np.savez(paths[0], **work)
        Path(paths[1]).write_text(json.dumps(tasks), encoding="utf-8")
        environment = dict(os.environ, **({LLVM: llvm()} if llvm() else {}))
        environment.pop("PYTHONPATH", None)
        done = subprocess.run(
            [str(PYTHON), str(FOLDER / "mitsuba_peer.py"), *paths, "--variant", variant],
            env=environment,
            capture_output=True,
            text=True,
            timeout=900,
        )
        if done.returncode:
            raise RuntimeError("mitsuba_peer.py %s failed: %s" % (variant, done.stderr.strip()[-400:]))
        return json.loads(Path(paths[2]).read_text(encoding="utf-8"))


def difference(theirs, ours_, mean):
    """[{rms, max, jobs}] by column of [job, column], divided by the mean response."""
    error = (theirs - ours_) / mean
    return [
        {"rms": rms(column), "max": float(np.abs(column).max()), "jobs": len(column)} for column in error.T
    ]


def curve(tasks, truth, mean):
    """[{label, seconds, rms}] of Mitsuba's settings: rms over jobs and seeds against its own converged
    values.
    """
    rows = []
    for task in tasks:
        error = (np.array(task["value"]) - truth[task["jobs"]][:, None]) / mean
        rows.append(
            {
                "label": "%d^2 x %d spp, %s" % (task["film"], task["spp"], task["sampler"]),
                "seconds": float(np.median(np.array(task["seconds"]))),
                "rms": rms(error),
            }
        )
    return rows


def compare(curves, versions):
    """{peers, ratios}: what each costs at EQUAL, and how many times ours on the same scene; the same at the
    smallest error that we measured of ours.
    """

    def at(name, error):
        return seconds_at([(row["seconds"], row["rms"]) for row in curves[name]], error)

    peers, ratios = [], {"rms": EQUAL}
    for name in curves:
        mine = OURS_WHOLE if name.endswith("whole scene") else OURS
        seconds, known = at(name, EQUAL)
        if name == mine:
            ratios[name] = {"seconds_per_response": seconds, "known_from": known}
            continue
        best = min(row["rms"] for row in curves[mine])
        at_best, known_at_best = at(name, best)
        peers.append(
            {
                "name": name,
                "version": versions["mitsuba" if name.startswith("Mitsuba") else "sparsegaze"],
                "seconds_per_response": seconds,
                "rms": EQUAL,
                "known_from": known,
                "times_ours": seconds / at(mine, EQUAL)[0],
                "our_best_rms": best,
                "times_ours_at_our_best": at_best / at(mine, best)[0],
                "known_from_at_our_best": known_at_best,
            }
        )
    return {"peers": peers, "ratios": ratios}
