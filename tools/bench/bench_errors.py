# SPDX-License-Identifier: Apache-2.0
"""How wrong the simulator is, by those who do not share its code: the reference of tests/sim (adaptive
cubature) on random and hard scenes, and images at rising resolution. And how honest its own bound on its
error is.

All errors are divided by the mean total response of the scene: over gazes within 20 degrees, over the pairs
of two places, as `GazeMap.mean`.
"""

import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from error_curve import rms

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "sim"))

HALF_DEG, NODES = 25.0, 17
TOL = 1e-4
IMAGE_PIXELS = (64, 128, 256, 512)
# Integration that stands for the truth where many gazes are asked for: within 2e-6 rms, 1.3e-5 at most, of
# one almost twice as fine (default headset, any lids).
FINE = {"sclera": 2.5, "iris": 2.0, "glint": 2.5, "face": 2.0}
DIFFUSE = ("face", "sclera", "iris")


def scenes(count, threads, say):
    """[{name, rms_total, rms_diffuse, rms_glint, max_total, estimate_bounds, seconds, ...}] of
    random_scenes(). A scene that cannot be made or judged has a row that says why, as wrong as no map at all.
    """
    from random_scenes import random_scenes

    cases, rows = random_scenes(count), []
    with ProcessPoolExecutor(threads) as pool:
        truths = [pool.submit(reference_of, case) for case in cases]
        for number, (case, truth) in enumerate(zip(cases, truths)):
            attempt(truth.result)
            say("reference %d of %d: %s" % (number + 1, count, case.name))
    for number, (case, truth) in enumerate(zip(cases, truths)):
        say("scene %d of %d: %s" % (number + 1, count, case.name))
        row, why = attempt(lambda case=case, truth=truth: scene_row(case, truth.result(), threads))
        if why:
            say("%s failed: %s" % (case.name, why))
        rows.append(row or failed(case, why))
    return rows


def attempt(function):
    """(its value, ""), or (None, why it failed)."""
    try:
        return function(), ""
    except Exception as error:  # whatever it is: the other scenes are still to be judged
        return None, "%s: %s" % (type(error).__name__, error)


def failed(case, why):
    """The row of a scene without a map: off by all of the mean response, and nothing bounds that."""
    wrong = dict.fromkeys(("rms_total", "rms_diffuse", "rms_glint", "max_total"), 1.0)
    return dict(wrong, name=case.name, estimate_bounds=False, seconds=0.0, failed=why)


def reference_of(case):
    """{value, doubt: {term: [state, pair]}, seconds} of a case by the reference, pairs of two places."""
    from reference import other_pairs, reference_states

    began = time.process_time()
    value, doubt, _ = reference_states(case.headset, case.person, case.states, other_pairs(case.headset))
    return {"value": value, "doubt": doubt, "seconds": time.process_time() - began}


def scene_row(case, truth, threads=2):
    """One scene: a map whose axes hold the case's gazes, every term against the reference at those."""
    from reference import TERMS, other_pairs

    from sparsegaze.mapmake import Making

    states = np.array(case.states)
    even = np.linspace(-HALF_DEG, HALF_DEG, NODES)
    azimuth, elevation = np.union1d(even, states[:, 0]), np.union1d(even, states[:, 1])
    still = np.zeros((len(states), 3))
    began = time.perf_counter()
    making = Making(
        case.headset, case.person, azimuth, elevation, (states[:, 2], states[:, 3], still), TOL, threads, None
    )
    parts = making.make()
    bound = making.bound(parts)
    seconds = time.perf_counter() - began
    s, e = np.array(other_pairs(case.headset)).T
    at = [(np.searchsorted(elevation, el), np.searchsorted(azimuth, az)) for az, el in states[:, :2]]
    got = {t: np.array([parts[t][i, s, e, row, col] for i, (row, col) in enumerate(at)]) for t in TERMS}
    bounds = np.array([bound[i, s, e] for i in range(len(states))])
    figures = judge(case.name, got, truth["value"], bounds, sum(truth["doubt"].values()), making.mean)
    return figures | {
        "seconds": seconds,
        "responses": len(s) * len(states) * len(azimuth) * len(elevation),
        "estimate_rms": float(np.sqrt(sum(v * v for v in making.rms.values()))),
        "left_out": list(making.left_out()),
        "reference_seconds": truth["seconds"],
    }


def judge(name, got, truth, bound, doubt, mean):
    """Figures of one scene.

    got, truth      {term: [state, pair]}
    bound, doubt    [state, pair]: our own bound of the total's error, and the reference's error estimate
    A bound holds when it exceeds the difference less what the reference itself may be wrong by.
    """
    error = {term: (got[term] - truth[term]) / mean for term in got}
    total = sum(error.values())
    return {
        "name": name,
        "rms_total": rms(total),
        "rms_diffuse": rms(sum(error[term] for term in DIFFUSE)),
        "rms_glint": rms(error["glint"]),
        "max_total": float(np.abs(total).max()),
        "estimate_bounds": bool((np.abs(total) <= (bound + doubt) / mean).all()),
        "bound_over_error": float((bound / mean).max() / max(np.abs(total).max(), 1e-300)),
        "reference_doubt": float((doubt / mean).max()),
        "by_term": {term: {"rms": rms(e), "max": float(np.abs(e).max())} for term, e in error.items()},
        "states": int(total.shape[0]),
        "pairs": int(total.shape[1]),
    }


def images(headset, quick, say):
    """Ours against images at rising resolution, the default headset on three people: {pixels, rms, order,
    extrapolated_rms}; the last against what the two finest images tend to.
    """
    from sparsegaze import image
    from sparsegaze.person import draw_person, nominal_person
    from sparsegaze.scene import Scene

    people = (nominal_person(), draw_person(11), draw_person(23))[: 1 if quick else 3]
    sizes = IMAGE_PIXELS[:2] if quick else IMAGE_PIXELS
    counted = ~np.eye(len(headset.sensors), len(headset.emitters), dtype=bool)
    gazes = ((3.0, -5.0), (-14.0, 8.0))
    ours, theirs = [], []
    for number, person in enumerate(people):
        say("images of person %d of %d, up to %d^2 pixels" % (number + 1, len(people), sizes[-1]))
        scene = Scene(headset, person, quality=FINE)
        for azimuth, elevation in gazes:
            ours.append(scene.response(azimuth, elevation)[counted])
            theirs.append(
                [
                    image.image_response(
                        headset, person, azimuth, elevation, pixels=n, half_width_sigmas=5.0
                    )[counted]
                    for n in sizes
                ]
            )
    return judge_images(np.array(ours), np.array(theirs), sizes)


def judge_images(ours, theirs, sizes):
    """ours [state, pair], theirs [state, size, pair]. The limit assumes that the error falls as 1 /
    pixels^2.
    """
    mean = ours.mean()
    error = [rms((theirs[:, i] - ours) / mean) for i in range(len(sizes))]
    ratio = (sizes[-1] / sizes[-2]) ** 2
    limit = theirs[:, -1] + (theirs[:, -1] - theirs[:, -2]) / (ratio - 1)
    return {
        "pixels": list(sizes),
        "rms": error,
        "order": float(-np.polyfit(np.log(sizes), np.log(error), 1)[0]),
        "extrapolated_rms": rms((limit - ours) / mean),
    }


def offgrid(headset, quick, say):
    """Tables between their nodes: {rms, max, responses_per_second_core, ...}. One response is all pairs at
    one state: gaze within 20 degrees, pupil 2..8 mm, lids open in half of the states, else anything.
    """
    from reference import TERMS, other_pairs, reference_states

    from sparsegaze.person import draw_person
    from sparsegaze.scene import Scene
    from sparsegaze.simulate import ResponseMap, response_map

    person, rng = draw_person(11), np.random.default_rng(5)
    with tempfile.TemporaryDirectory() as cache:
        say("tables of the default headset on one person")
        began = time.perf_counter()
        path = response_map(headset, person, cache=cache)
        table_seconds = time.perf_counter() - began
        with ResponseMap(path) as opened:
            n = 24 if quick else 200
            lid = np.where(rng.random(n) < 0.5, 1.0, rng.uniform(0, 1, n))
            states = np.column_stack([rng.uniform(-20, 20, (n, 2)), rng.uniform(2, 8, n), lid])
            got = opened.evaluate(states)
            many = np.tile(states, (max(1, (1000 if quick else 40000) // n), 1))
            seconds = min(cpu_seconds(lambda: opened.evaluate(many)) for _ in range(3))
            size = os.path.getsize(path)
    say("the same states, directly and finely")
    fine = Scene(headset, person, quality=FINE)
    truth = np.array([fine.response(*state) for state in states])
    counted = ~np.eye(*truth.shape[1:], dtype=bool)
    mean = float(
        np.mean(
            [
                fine.response(a, e)[counted].mean()
                for a in (-20, -10, 0, 10, 20)
                for e in (-20, -10, 0, 10, 20)
            ]
        )
    )
    error = (got - truth)[:, counted] / mean
    few = states[: 4 if quick else 12]
    say("%d of them by the reference" % len(few))
    pairs = other_pairs(headset)
    value, _, _ = reference_states(headset, person, [tuple(state) for state in few], pairs)
    s, e = np.array(pairs).T
    against = (got[: len(few), s, e] - sum(value[t] for t in TERMS)) / mean
    opened_lids = lid == 1.0
    return {
        "rms": rms(error),
        "max": float(np.abs(error).max()),
        "responses_per_second_core": len(many) / seconds,
        "states": n,
        "pairs": len(pairs),
        "rms_lids_open": rms(error[opened_lids]),
        "max_lids_open": float(np.abs(error[opened_lids]).max()),
        "rms_against_reference": rms(against),
        "max_against_reference": float(np.abs(against).max()),
        "reference_states": len(few),
        "table_seconds": table_seconds,
        "table_mb": size / 1e6,
    }


def as_setting(figures, threads):
    """The tables as a setting among others: {label, seconds, rms} of one pair, by every core; the tables made
    before.
    """
    seconds = 1 / figures["responses_per_second_core"] / figures["pairs"] / threads
    return {"label": "tables", "seconds": seconds, "rms": figures["rms"]}


def cpu_seconds(function):
    """CPU seconds of this process that a call takes."""
    began = time.process_time()
    function()
    return time.process_time() - began
