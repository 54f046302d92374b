# SPDX-License-Identifier: Apache-2.0
"""How a map's errors are measured, and where they are likeliest."""

import numpy as np


def counted_pairs(pairs):
    """Mask [sensor, emitter] of the pairs of two different places, or of all when there are no other."""
    if pairs[0] != pairs[1] or pairs[0] == 1:
        return np.ones(pairs, bool)
    return ~np.eye(pairs[0], dtype=bool)


def mean_response(response, azimuth_deg, elevation_deg):
    """The unit of errors: mean over gazes within +-20 degrees (all, when there are none) and over the pairs
    that count. response [..., sensor, emitter, elevation, azimuth].
    """
    up, across = np.abs(elevation_deg) <= 20 + 1e-9, np.abs(azimuth_deg) <= 20 + 1e-9
    if up.any() and across.any():
        response = response[..., up, :][..., across]
    return float(np.moveaxis(response, (-4, -3), (0, 1))[counted_pairs(response.shape[-4:-2])].mean())


def scale_of(peak):
    """What a pair's error is measured by: its peak, and a third of the average pair's so that pairs which
    see next to nothing do not count as hard. peak [..., sensor, emitter].
    """
    return peak + 0.3 * peak.mean((-2, -1), keepdims=True) + 1e-300


def bend(table):
    """How sharply a table [state, elevation, azimuth, ...] bends from gaze to gaze; its value on an axis too
    short for that.
    """
    out = np.zeros_like(table)
    for axis in (1, 2):
        if table.shape[axis] > 2:
            inner = tuple(slice(1, -1) if k == axis else slice(None) for k in range(table.ndim))
            out[inner] += np.abs(np.diff(table, 2, axis))
    return out if out.any() else table


def hardest(rough, azimuth, elevation, count, apart_deg=3.0):
    """The `count` highest places (state, row, column) of [state, elevation, azimuth], some way apart."""
    rough, places = rough.copy(), []
    for _ in range(count):
        at = tuple(int(i) for i in np.unravel_index(np.argmax(rough), rough.shape))
        if not rough[at] > 0:
            break
        places.append(at)
        near = (np.abs(elevation - elevation[at[1]]) < apart_deg)[:, None] & (
            np.abs(azimuth - azimuth[at[2]]) < apart_deg
        )
        rough[at[0]][near] = 0
    return places
