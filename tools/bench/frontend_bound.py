# SPDX-License-Identifier: Apache-2.0
"""The physical limit of precision: Cramer-Rao bound from a person's map with the converter's noise.

The bound is that of an unbiased estimate of azimuth and elevation from the six photocurrents of one frame,
the pupil known. Photocurrents are those measured (part spread and all), their relative slopes the map's
with nominal parts, their noise that of frontend_methods.closed_form at the exposures in force. A model
that smooths is not unbiased and may be quieter; one that spends light on telling the pupil is louder.
"""

import frontend_methods
import frontend_node
import frontend_physics as physics
import numpy as np
from frontend_board import grid_places
from frontend_persons import HEADSET

from sparsegaze import simulate
from sparsegaze.headset import load_headset

FEATURE_UNIT_NA = 0.0625  # of a feature of 0 (sg_expose.h)
STEP_DEG = 0.25
ADC_KHZ = 250
PLACE_S, SKIP_S = 0.16, 0.06


def noise(board, map_path, light):
    """Measured noise of the features beside the expected, and the bound: a dict.

    ratio [6]   measured over expected RMS, mean over the grid; bound_deg, bound_250_deg   RMS-S2S, mean
    over the grid
    """
    frames, _, index = board.grid(dwell_s=PLACE_S, skip_s=SKIP_S, gaze=False, raw=True)
    exposure = np.array(board.device.exposure().exposure_us)
    pupil = board.control.state().pupil_mm
    places = grid_places()
    measured, expected, bounds, current = [], [], [], []
    for k, place in enumerate(places):
        features = frames["features"][index == k].astype(float)
        if len(features) < 20:
            continue
        # Of successive frames: what exposures and averages that still settle add is slower.
        spread = np.diff(features, axis=0).std(axis=0) / np.sqrt(2)
        na = current_na(features.mean(axis=0))
        relative = relative_noise(na, exposure)
        measured.append(spread)
        expected.append(4096 / np.log(2) * relative)
        bounds.append(bound_deg(map_path, place, pupil, relative))
        current.append(na)
    measured, expected = np.array(measured), np.array(expected)
    found = float(np.mean(bounds))
    return {
        "exposure_us": exposure.tolist(),
        "current_na": np.mean(current, axis=0).tolist(),
        "measured": measured.mean(axis=0).tolist(),
        "expected": expected.mean(axis=0).tolist(),
        "ratio": (measured.mean(axis=0) / expected.mean(axis=0)).tolist(),
        "place_na": np.array(current).tolist(),
        "bound_deg": found,
        "bound_250_deg": found / 2,
        "light": light,
        "pupil_mm": pupil,
    }


def current_na(features):
    """Photocurrents of features, 4096 log2 of FEATURE_UNIT_NA."""
    return FEATURE_UNIT_NA * 2.0 ** (np.asarray(features) / 4096)


def in_ambient(found, map_path, pupil_mm, exposure_us, ambient_na):
    """The bound in steady ambient light at these exposures, nominal sensors, of what noise() found."""
    relative = [relative_noise(np.array(na), np.array(exposure_us), ambient_na) for na in found["place_na"]]
    places = zip(grid_places(), relative)
    return float(np.mean([bound_deg(map_path, place, pupil_mm, one) for place, one in places]))


def relative_noise(na, exposure_us, ambient_na=0.0):
    """RMS over photocurrent of one frame at nominal capacitances, in steady light, [6]."""
    node = frontend_node.node_of(frontend_node.RAIL)
    charge, ambient = na * exposure_us * 1e-3, ambient_na * exposure_us * 1e-3
    lit = frontend_methods.charge_noise(frontend_node.RAIL, node, ADC_KHZ, charge + ambient)
    dark = frontend_methods.charge_noise(frontend_node.RAIL, node, ADC_KHZ, ambient)
    light = physics.emission_noise(frontend_node.RAIL.headroom_v, exposure_us)
    return np.hypot(np.hypot(lit, dark / np.sqrt(frontend_methods.UNLIT_MEAN)) / charge, light)


def slopes(map_path, place, pupil_mm):
    """d log photocurrent / d degree, [6, 2], of the default headset with nominal parts."""
    headset = load_headset(HEADSET)
    moves = STEP_DEG * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    states = np.column_stack([np.asarray(place) + moves, np.full(4, pupil_mm)])
    logs = np.log(headset.collect(simulate.evaluate(map_path, states)))
    return np.stack([logs[0] - logs[1], logs[2] - logs[3]], axis=1) / (2 * STEP_DEG)


def bound_deg(map_path, place, pupil_mm, relative):
    """Least RMS-S2S of an unbiased estimate from readings with that relative noise [6], degrees."""
    scaled = slopes(map_path, place, pupil_mm) / relative[:, None]
    return float(np.sqrt(2 * np.trace(np.linalg.inv(scaled.T @ scaled))))
