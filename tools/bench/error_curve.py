# SPDX-License-Identifier: Apache-2.0
"""Speed against error: what a method costs at a given error, from a few measured settings."""

import numpy as np


def rms(values):
    """Root mean square of an array."""
    return float(np.sqrt(np.mean(np.square(values))))


def frontier(points):
    """The settings that no other beats in both: [(seconds, rms)] by rising seconds, falling rms."""
    kept = []
    for seconds, error in sorted(points):
        if not kept or error < kept[-1][1]:
            kept.append((float(seconds), float(error)))
    return kept


def seconds_at(points, error):
    """Seconds at which the error is reached, and how that is known: "between" two settings, by interpolating
    both logarithms; "beyond" the finest, by the two finest (no steeper than measured, at least the square
    root of sampling: 1/2); or "cheapest", when the cheapest setting is already better.

    points    [(seconds, rms)] of one method
    """
    kept = frontier(points)
    if not kept:
        raise ValueError("no measured setting")
    if kept[0][1] <= error:
        return kept[0][0], "cheapest"
    for (t0, e0), (t1, e1) in zip(kept, kept[1:]):
        if e1 <= error:
            part = np.log(error / e0) / np.log(e1 / e0)
            return float(np.exp(np.log(t0) + part * np.log(t1 / t0))), "between"
    slope = 0.5
    if len(kept) > 1:
        (t0, e0), (t1, e1) = kept[-2:]
        slope = max(slope, -np.log(e1 / e0) / np.log(t1 / t0))
    t, e = kept[-1]
    return float(t * (e / error) ** (1 / slope)), "beyond"
