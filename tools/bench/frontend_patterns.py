# SPDX-License-Identifier: Apache-2.0
"""Which LEDs emit while which sense: patterns compared on simulated persons, at 1000 frames/s.

A pattern is a list of phases (sensors, in the order of their samples). Six channels are lit and read, then
read unlit, phase by phase; slots follow each other as fast as the converter can at 250 kHz. The fewer
phases, the longer the exposures, but the fewer LEDs emit. Every pattern gets the exposures that its slots
allow, and automatic exposure: the geometric mean of a channel's light swings its node by GOAL_V, its
brightest gaze by no more than MOST_V. Noise is that of frontend_methods.closed_form (rail); persons are
calibrated with CALIBRATION noisy targets and judged by a Gaussian process in float64.
"""

import warnings

import frontend_methods
import frontend_node
import frontend_physics as physics
import numpy as np
from frontend_physics import P
from threadpoolctl import threadpool_limits

from sparsegaze import simulate
from sparsegaze.gp import GaussianProcess
from sparsegaze.targets import calibration_plan, validation_plan

ADC_KHZ, GOAL_V, MOST_V = 250, 0.55, 1.0
CALIBRATION, HELD_OUT, DRAWS, AVERAGED = 120, 49, 20, 36  # frames averaged at a calibration target
MARGIN_US = 7.5
PAIRS = {
    "2/4 (5,0)(1,4)(2,3)": [(5, 0), (1, 4), (2, 3)],
    "2/4 (0,1)(2,3)(4,5)": [(0, 1), (2, 3), (4, 5)],
    "2/4 (0,3)(1,4)(2,5)": [(0, 3), (1, 4), (2, 5)],
    "2/4 (0,2)(1,4)(3,5)": [(0, 2), (1, 4), (3, 5)],
    "2/4 (1,2)(3,4)(0,5)": [(1, 2), (3, 4), (0, 5)],
    "3/3 (0,2,4)(1,3,5)": [(0, 2, 4), (1, 3, 5)],
    "3/3 (0,1,3)(2,4,5)": [(0, 1, 3), (2, 4, 5)],
    "3/3 (0,2,3)(1,4,5)": [(0, 2, 3), (1, 4, 5)],
    "3/3 (0,1,2)(3,4,5)": [(0, 1, 2), (3, 4, 5)],
    "5/1 ground": [(k,) for k in range(6)],
    "5/1 no ground": [(k,) for k in range(6)],
}
CHOSEN = "2/4 (5,0)(1,4)(2,3)"


def longest_us(name):
    """[6] longest exposure of every channel, lit and unlit alike, at 1000 frames/s."""
    phases = PAIRS[name]
    size = len(phases[0])
    if size == 1 and "no ground" in name:
        slots, places = 2, [1]
    elif size == 1:
        slots, places = 3, [1]  # ground, lit, unlit: the unlit one follows the lit at once
    else:
        slots, places = 2 * (size + 1), [2 + k for k in range(size)]
    slot = 1000.0 / (len(phases) * slots)
    if slot < physics.conversion_us(ADC_KHZ) + frontend_methods.SERVICE_US:
        raise ValueError(f"{name} does not fit at {ADC_KHZ} kHz")
    most = np.empty(6)
    for phase in phases:
        for sensor, place in zip(phase, places):
            most[sensor] = place * slot - MARGIN_US
    return most


def collected(response, name, sensor, emitter):
    """Photocurrents [n, 6], nA, of responses [n, sensor, emitter] under a pattern; parts: factors [6],
    [6]."""
    out = np.empty((len(response), 6))
    for phase in PAIRS[name]:
        lit = [k for k in range(6) if k not in phase]
        for k in phase:
            out[:, k] = sensor[k] * (response[:, k, lit] * emitter[lit]).sum(axis=1)
    return out * P.photocurrent.nominal_na / simulate.REFERENCE_MEAN


def relative_noise(current_na, exposure_us):
    """RMS of a reading over the photocurrent, [n, 6], in the dark; exposures [6]."""
    node = frontend_node.node_of(frontend_node.RAIL)
    charge = current_na * exposure_us * 1e-3
    noise = frontend_methods.charge_noise(frontend_node.RAIL, node, ADC_KHZ, charge)
    dark = frontend_methods.charge_noise(frontend_node.RAIL, node, ADC_KHZ, 0.0 * charge)
    light = physics.emission_noise(frontend_node.RAIL.headroom_v, exposure_us)
    return np.hypot(np.hypot(noise, dark / np.sqrt(frontend_methods.UNLIT_MEAN)) / charge, light)


def exposures(current_na, most_us):
    """[6] exposures that automatic exposure takes for photocurrents [n, 6]."""
    node = frontend_node.node_of(frontend_node.RAIL)
    goal = node.charge(GOAL_V) / np.exp(np.log(current_na).mean(axis=0))
    top = node.charge(MOST_V) / current_na.max(axis=0)
    return np.minimum(most_us, np.minimum(goal, top) * 1e3)


def looks(path, seed):
    """(calibration responses, targets, held-out responses) of a person: where the eye really looks,
    drawn."""
    rng = np.random.default_rng([seed, 7])
    pupil = float(np.clip(P.eye.pupil_mm + 0.8 * rng.normal(), 2.4, 5.5))
    plan = calibration_plan(CALIBRATION, seed).target_deg
    held = validation_plan(HELD_OUT, seed).target_deg

    def responses(target_deg):
        gaze = target_deg + P.eye.fixation_bias_deg * rng.normal(size=target_deg.shape)
        pupils = pupil + 0.33 * rng.normal(size=len(gaze))
        return simulate.evaluate(path, np.column_stack([gaze, pupils]))

    return responses(plan), plan, responses(held)


def judge(path, seed, name):
    """RMS-S2S (deg, root mean square over held-out gazes) and least photocurrent of one person and
    pattern."""
    known, plan, held = looks(path, seed)
    rng = np.random.default_rng([seed, 99])
    spread = np.sqrt(np.log1p(P.photocurrent.part_spread**2))
    sensor, emitter = np.exp(spread * rng.normal(size=(2, 6)) - spread**2 / 2)
    lit, held = collected(known, name, sensor, emitter), collected(held, name, sensor, emitter)
    exposure = exposures(np.vstack([lit, held]), longest_us(name))
    noisy = lit * (1 + relative_noise(lit, exposure) * rng.normal(size=lit.shape) / np.sqrt(AVERAGED))
    features = 4096 * np.log2(noisy)
    middle = features.mean(axis=0)
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore")
        process = GaussianProcess.fit(features - middle, plan, mean="linear", restarts=1)
        clean = np.asarray(process.predict(4096 * np.log2(held) - middle))
        noise = relative_noise(held, exposure)
        apart = []
        for _ in range(DRAWS):
            drawn = np.maximum(held * (1 + noise * rng.normal(size=held.shape)), 0.02 * held)
            apart.append(np.asarray(process.predict(4096 * np.log2(drawn) - middle)) - clean)
    jitter = (np.array(apart) ** 2).sum(axis=-1).mean(axis=0)
    return {
        "s2s_deg": float(np.sqrt(2 * jitter.mean())),
        "s2s_median_deg": float(np.sqrt(2 * np.median(jitter))),
        "noise": float(np.median(noise)),
        "exposure_us": float(exposure.mean()),
        "least_na": float(lit.min()),
    }


def table(paths, say=lambda text: None):
    """Rows by pattern over persons {seed: map path}: mean and worst s2s_deg, exposures, noise; best
    first."""
    rows = []
    for name in PAIRS:
        each = [judge(path, seed, name) for seed, path in paths.items()]
        row = {"pattern": name, "chosen": name == CHOSEN, "persons": len(each)}
        row["s2s_mean_deg"] = float(np.mean([one["s2s_median_deg"] for one in each]))
        row["s2s_worst_deg"] = max(one["s2s_median_deg"] for one in each)
        row["s2s_rms_deg"] = float(np.mean([one["s2s_deg"] for one in each]))
        for key in ("noise", "exposure_us"):
            row[key] = float(np.mean([one[key] for one in each]))
        row["least_na"] = min(one["least_na"] for one in each)
        rows.append(row)
        say(f"{name:22} S2S {row['s2s_mean_deg']:.3f} deg, worst {row['s2s_worst_deg']:.3f}")
    return sorted(rows, key=lambda row: row["s2s_mean_deg"])
