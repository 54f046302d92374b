#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How well a placement of LEDs tells gaze, over simulated people; and a search for a better one.

    python tools/placement.py [HEADSET] [--persons 20] [--first 0] [--json FILE]
    python tools/placement.py HEADSET --search 600 [--seed 1] -o BETTER.json

Two figures per person, both from the simulator directly (no map, no virtual Nano):

precision   what a perfect estimator would reach on one frame: square root of the trace of the inverse Fisher
            information of gaze, given the noise of each channel's light and a pupil that wanders by 0.33 mm
            rms, averaged over a grid within +-20 degrees;
learned     what the product's Gaussian process reaches after its 120 calibration fixations, each 0.3
            degrees off per axis (fixation bias) and with another pupil, on single noisy frames of 49 held-out
            targets within +-20 degrees: mean angle to the target, and to where the simulated eye looked.

The search moves one LED's aim at a time (where LEDs sit is the case's choice) and keeps what lowers the
learned error of the mean and of the worst of a few people. The glints' rings are what it mostly avoids: a
placement with the best precision can be twice as hard to learn.

Noise is the light's: a response is a photocurrent of 200 nA times its ratio to REFERENCE_MEAN, so a placement
or a person that returns little light pays for it (`noise`).

The search may only see persons from 1000 on. Nobody draws those by default, so that what is reported of
persons 0, 1, 2, ... was never tuned on; the tool refuses to judge whom it searched on. The aims in
headsets/led2gaze.toml are older than this rule: they were searched on persons 12, 10, 0 and 3, with 0.45 %
noise whatever the light, and judged on persons 0..19, which contain those four. Judge with --first 2000 for
figures of people whom no search has seen.
"""

import argparse
import dataclasses
import json
import os
import sys
import time
import warnings

import numpy as np

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "host_sdk"))

from sparsegaze.gp import GaussianProcess  # noqa: E402
from sparsegaze.headset import load_headset  # noqa: E402
from sparsegaze.person import draw_person  # noqa: E402
from sparsegaze.scene import Scene  # noqa: E402
from sparsegaze.simulate import REFERENCE_MEAN  # noqa: E402
from sparsegaze.targets import calibration_plan, validation_plan  # noqa: E402

NOMINAL_NA = 200.0  # photocurrent of REFERENCE_MEAN: [photocurrent].nominal_na of physics.toml
# Relative noise of one frame at 1001 Hz, measured on the virtual Nano by the firmware's port (no ambient
# light, eye at rest, 216 channels of persons 2000 and 2001): 0.17 % rms at 200 nA, 0.42 % at 75 nA, about
# 0.15 % in strong light. Below 250 nA the exposure is at its cap, so that less light is a smaller step of
# the same converter. The model: a power through the first two readings, almost 1 / I, never below the
# third.
NOISE_NOMINAL, NOISE_POWER, NOISE_FLOOR = 0.0017, 0.93, 0.0015
FIRST_SEARCHED = 1000  # the search sees nobody below this
SEARCHED = (1000, 1001, 1002, 1003)
PUPIL_MM, PUPIL_BETWEEN_MM, PUPIL_WITHIN_MM = 3.5, 0.8, 0.33
BIAS_DEG = 0.3
FRAMES_PER_FIXATION = 40
FEATURE_STEPS = 4096  # per octave, as the device sends
# Coarser than a map: its error of about 1e-3 is smooth and the same for every placement.
QUICK = {"sclera": 0.5, "iris": 0.55, "face": 0.4, "glint": 0.9}


def noise(signal):
    """Relative rms noise of one frame in channels of this response (any shape; response units, > 0)."""
    current = NOMINAL_NA * np.asarray(signal) / REFERENCE_MEAN
    return np.maximum(NOISE_NOMINAL * (NOMINAL_NA / current) ** NOISE_POWER, NOISE_FLOOR)


def precision_deg(scene, step_deg=5.0, half_deg=20.0):
    """Radial rms of the best possible estimate of gaze from one frame, averaged over a grid."""
    collect = scene.headset.collect
    grid, h, errors = np.arange(-half_deg, half_deg + 0.1, step_deg), 0.5, []
    for elevation in grid:
        for azimuth in grid:

            def at(d_az, d_el, d_pupil):
                return np.log(collect(scene.response(azimuth + d_az, elevation + d_el, PUPIL_MM + d_pupil)))

            slopes = [(at(*(h * e)) - at(*(-h * e))) / (2 * h) for e in np.eye(3)]
            slopes = np.array(slopes) / noise(np.exp(at(0, 0, 0)))
            information = slopes @ slopes.T
            information[2, 2] += 1 / PUPIL_WITHIN_MM**2
            errors.append(np.sqrt(np.trace(np.linalg.inv(information)[:2, :2])))
    return float(np.mean(errors))


def learned_deg(scene, seed, n_validation=25):
    """(mean angle to target, to true gaze, 95th percentile to true gaze) of a calibrated process; degrees."""
    collect = scene.headset.collect
    rng = np.random.default_rng([seed, 0x91ACE])
    pupil = float(np.clip(PUPIL_MM + PUPIL_BETWEEN_MM * rng.normal(), 2.4, 5.5))

    def look(targets, frames):
        true = targets + rng.normal(0, BIAS_DEG, targets.shape)
        signal = np.array(
            [collect(scene.response(az, el, pupil + PUPIL_WITHIN_MM * rng.normal())) for az, el in true]
        )
        error = noise(signal) / np.sqrt(frames) * rng.normal(size=signal.shape)
        return FEATURE_STEPS * np.log2(signal * (1 + error)), true

    plan, held_out = calibration_plan(120, seed).target_deg, validation_plan(n_validation, seed).target_deg
    features, _ = look(plan, FRAMES_PER_FIXATION)
    origin = features.mean(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        process = GaussianProcess.fit(features - origin, plan, mean="linear", restarts=1)
    tests, true = look(held_out, 1)
    predicted = np.asarray(process.predict(tests - origin))
    to_true = np.hypot(*(predicted - true).T)
    return (
        float(np.hypot(*(predicted - held_out).T).mean()),
        float(to_true.mean()),
        float(np.quantile(to_true, 0.95)),
    )


def light_na(scene, step_deg=5.0, half_deg=20.0):
    """Photocurrent of each sensor, nominal pupil, nA: mean over gaze by the trapezoidal rule."""
    collect = scene.headset.collect
    grid = np.arange(-half_deg, half_deg + 0.1, step_deg)
    weight = np.ones(len(grid))
    weight[[0, -1]] = 0.5
    seen = [collect(scene.response(azimuth, elevation, PUPIL_MM)) for azimuth in grid for elevation in grid]
    return NOMINAL_NA * np.average(seen, axis=0, weights=np.outer(weight, weight).ravel()) / REFERENCE_MEAN


def judge(headset, persons):
    """One row of figures per person. ValueError when the search has seen one of them."""
    if set(persons) & set(SEARCHED):
        raise ValueError("persons %s are searched on, not judged" % sorted(set(persons) & set(SEARCHED)))
    rows = []
    for seed in persons:
        scene = Scene(headset, draw_person(seed), quality=QUICK)
        target, true, p95 = learned_deg(scene, seed, 49)
        light = light_na(scene)
        rows.append(
            {
                "person": seed,
                "precision_deg": precision_deg(scene),
                "learned_to_target_deg": target,
                "learned_to_true_gaze_deg": true,
                "learned_p95_deg": p95,
                "light_na": float(light.mean()),
                "darkest_channel_na": float(light.min()),
            }
        )
        print(
            "person %2d: precision %.3f deg, learned %.2f deg to target, %.2f to true gaze (p95 %.2f), "
            "%.0f nA, darkest channel %.0f nA"
            % tuple(rows[-1].values()),
            flush=True,
        )
    return rows


def turned(headset, k, aim_mm):
    """The headset with LED k looking at another point."""
    old = headset.sensors[k]
    aim = np.subtract(aim_mm, old.position_mm)
    led = dataclasses.replace(old, aim=tuple(float(v) for v in aim / np.linalg.norm(aim)))
    ports = tuple(led if i == k else p for i, p in enumerate(headset.sensors))
    return dataclasses.replace(headset, sensors=ports, emitters=ports)


def aim_point(port, z_mm=-11.0):
    """Where a port's axis crosses the plane of the limbus."""
    reach = (z_mm - port.position_mm[2]) / port.aim[2]
    return np.array(port.position_mm) + reach * np.array(port.aim)


def search(headset, seconds, seed, persons=SEARCHED):
    """Hill climbing over aims; the best headset found. Headsets of LEDs (sensors = emitters) only.

    ValueError when a person is one that reports are about.
    """
    if min(persons) < FIRST_SEARCHED:
        raise ValueError("the search sees persons from %d on only" % FIRST_SEARCHED)

    def cost(candidate, give_up=np.inf):
        errors = []
        for person in persons:
            errors.append(learned_deg(Scene(candidate, draw_person(person), quality=QUICK), person)[1])
            if np.max(errors) / 2 + np.sum(errors) / len(persons) / 2 > give_up:
                return np.inf
        return np.mean(errors) / 2 + np.max(errors) / 2

    rng, end = np.random.default_rng(seed), time.monotonic() + seconds
    best = cost(headset)
    while time.monotonic() < end:
        k = int(rng.integers(len(headset.sensors)))
        aim = aim_point(headset.sensors[k])
        aim[:2] = np.clip(aim[:2] + rng.normal(0, 2.0, 2), -8, 8)
        candidate = turned(headset, k, aim)
        value = cost(candidate, best)
        if value < best:
            headset, best = candidate, value
            print("%.3f deg: led %d aims at %s" % (best, k, np.round(aim, 1).tolist()), flush=True)
    return headset


def main():
    root = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("headset", nargs="?", default=os.path.join(root, "headsets", "led2gaze.toml"))
    parser.add_argument("--persons", type=int, default=20, help="judge on this many persons")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--json", help="write the figures here")
    parser.add_argument(
        "--search", type=float, default=0.0, metavar="SECONDS", help="look for better aims first"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the search")
    parser.add_argument("-o", "--output", help="write the aims found here (JSON)")
    options = parser.parse_args()
    judged = range(options.first, options.first + options.persons)
    if set(judged) & set(SEARCHED):
        parser.error("persons %d..%d are for the search" % (min(SEARCHED), max(SEARCHED)))
    headset = load_headset(options.headset)
    if options.search > 0:
        headset = search(headset, options.search, options.seed)
        aims = [np.round(aim_point(port), 2).tolist() for port in headset.sensors]
        print(json.dumps({"aim_mm": aims}))
        if options.output:
            with open(options.output, "w", encoding="utf-8") as file:
                json.dump({"aim_mm": aims}, file)
    rows = judge(headset, judged)
    summary = {}
    for key in rows[0]:
        values = [row[key] for row in rows]
        if key != "person":
            summary[key] = {"mean": float(np.mean(values)), "least": min(values), "most": max(values)}
    print(json.dumps(summary, indent=1))
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump({"persons": rows, "summary": summary}, file, indent=1)


if __name__ == "__main__":
    main()
