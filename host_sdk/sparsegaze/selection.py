# SPDX-License-Identifier: Apache-2.0
"""Which recorded frames say where the eye looks: settling, blinks and inattention are marked, never deleted.

Features are unsigned 16-bit log2 photocurrents, 4096 per octave, so a change of light by a fixed *ratio* is
the same step everywhere and one threshold serves dark and bright channels alike.
"""

from dataclasses import dataclass

import numpy as np

# Why a frame is not used. 0 is a usable frame.
USED, SETTLING, FLAGGED, BLINK, UNSTABLE, INATTENTIVE, OUTSIDE = range(7)
REASONS = ("used", "settling", "flagged", "blink", "unstable", "inattentive", "outside")

OCTAVE = 4096.0
LAG_US = 15_400  # a lid closes within 50..80 ms; noise averages over such a lag
PAD_US = 23_000  # lids move slowly before and after the part that a derivative shows
FRAME_US = 3_840  # where the times of frames do not say
JUMP_FLOOR = 0.012 * OCTAVE  # steps smaller than this are fixational movement, whatever the noise
LEVEL_FLOOR = 0.020 * OCTAVE
STRONG_JUMP = 0.05 * OCTAVE  # a lid, or a saccade of degrees; microsaccades and drift stay below
STRONG_LEVEL = 0.10 * OCTAVE
JUMP_SIGMAS = 8.0
LEVEL_SIGMAS = 6.0
LEAST_SHARE = 0.25  # of a settled fixation that must survive, or none of it is trusted
LOST_DEG = 6.0  # a fixation this far from where its signals say it is was on another place


@dataclass(frozen=True)
class Selection:
    """valid bool [n]; reason uint8 [n] (index into REASONS); used_targets, n_targets counts."""

    valid: np.ndarray
    reason: np.ndarray
    used_targets: int
    n_targets: int

    def counts(self):
        """{reason: number of frames}, only those that occur."""
        return {
            name: int(np.sum(self.reason == i)) for i, name in enumerate(REASONS) if np.any(self.reason == i)
        }


def noise_of(features):
    """Frame-to-frame noise of each channel, feature units rms [d], blind to slow movement and to blinks."""
    if len(features) < 3:
        return np.ones(features.shape[1])
    step = np.diff(features.astype(float), axis=0)
    return np.maximum(np.median(np.abs(step), axis=0) * 1.4826 / np.sqrt(2.0), 0.5)


def _dilate(mask, n):
    """mask [k] with every true widened by n frames to both sides."""
    if not mask.any():
        return mask
    return np.convolve(mask, np.ones(2 * n + 1), "same") > 0.5


def frame_us(t_us):
    """From frame to frame, us: the median of frames in order of time [n]."""
    step = np.diff(np.asarray(t_us, np.int64))
    step = step[step > 0]
    return float(np.median(step)) if len(step) else float(FRAME_US)


def blinks(features, noise=None, period_us=FRAME_US):
    """Frames of one fixation that are not steady gaze: bool [n], true = blink, saccade or lid in motion.

    features  [n, d], consecutive frames of one settled fixation, period_us apart; noise: noise_of() the whole
              recording.
    Two tests. Derivative: the mean over LAG_US against that over the next LAG_US, any channel.
    Level: the steady rest against its own densest half, any channel, which finds shut lids between two
    movements. What passes a low threshold counts only where it hangs together with something above a high
    one: the slow ends of a blink go with it, a microsaccade stays.
    """
    x = np.asarray(features, float)
    n = len(x)
    lag, pad = (max(1, int(round(span / period_us))) for span in (LAG_US, PAD_US))
    if n < 2 * lag + 1:
        return np.ones(n, bool)
    noise = noise_of(x) if noise is None else noise
    total = np.vstack([np.zeros(x.shape[1]), np.cumsum(x, axis=0)])
    mean = (total[lag:] - total[:-lag]) / lag
    step = np.abs(mean[lag:] - mean[:-lag])
    limit = np.maximum(JUMP_SIGMAS * noise * np.sqrt(2.0 / lag), JUMP_FLOOR)
    moving, strong = np.zeros(n, bool), np.zeros(n, bool)
    at = slice(lag, lag + len(step))
    moving[at] = (step > limit).any(axis=1)
    strong[at] = (step > np.maximum(limit, STRONG_JUMP)).any(axis=1)
    moving = _dilate(moving, pad)
    steady = ~_touched(moving, strong)
    if steady.sum() < LEAST_SHARE * n:
        return np.ones(n, bool)
    centre, spread = _shortest_half(x[steady])
    # A blink widens the densest half too; a resting eye never does by more than twice the floor.
    spread = np.maximum(noise, np.minimum(spread, 2 * LEVEL_FLOOR / LEVEL_SIGMAS))
    limit = np.maximum(LEVEL_SIGMAS * spread, LEVEL_FLOOR)
    off = np.abs(x - centre)
    strong |= (off > np.maximum(limit, STRONG_LEVEL)).any(axis=1)
    return _dilate(_touched(moving | (off > limit).any(axis=1) | strong, strong), pad)


def _touched(weak, strong):
    """The runs of weak [n] that hold a true of strong [n]."""
    edges = np.flatnonzero(np.diff(np.r_[False, weak, False].astype(int)))
    out = np.zeros(len(weak), bool)
    for begin, end in zip(edges[::2], edges[1::2]):
        out[begin:end] = strong[begin:end].any()
    return out


def _shortest_half(x):
    """Centre and standard deviation [d] each of the densest half of x [n, d].

    Unlike median and MAD they do not move while a blink fills up to half of a fixation.
    """
    ordered, half = np.sort(x, axis=0), max(1, len(x) // 2)
    width = ordered[half:] - ordered[:-half]
    at = np.argmin(width, axis=0)
    columns = np.arange(x.shape[1])
    return (ordered[at, columns] + ordered[at + half, columns]) / 2, width[at, columns] / 1.349


def inattentive(centre, target_deg):
    """Fixations whose signals belong to another place: bool [k].

    centre [k, d] steady features per fixation, target_deg [k, 2]. A ridge regression quadratic in the
    principal components predicts each target from the others (closed-form leave-one-out); misses of more than
    LOST_DEG and of 6 robust deviations are dropped one by one, worst first, each time fitting anew.
    """
    k = len(centre)
    lost = np.zeros(k, bool)
    if k < 24:
        return lost
    x = centre - centre.mean(axis=0)
    _, s, vt = np.linalg.svd(x, full_matrices=False)
    p = x @ vt.T[:, : min(4, len(s))]
    p = p / np.maximum(p.std(axis=0), 1.0)
    pairs = [p[:, i] * p[:, j] for i in range(p.shape[1]) for j in range(i + 1)]
    basis = np.column_stack([np.ones(k), p] + pairs)
    for _ in range(k // 10):
        keep = np.flatnonzero(~lost)
        if len(keep) < basis.shape[1] + 4:
            break
        b = basis[keep]
        hat = b @ np.linalg.solve(b.T @ b + 1e-3 * np.eye(b.shape[1]), b.T)
        miss = (target_deg[keep] - hat @ target_deg[keep]) / np.maximum(1.0 - np.diag(hat), 0.05)[:, None]
        miss = np.hypot(miss[:, 0], miss[:, 1])
        worst = int(np.argmax(miss))
        if miss[worst] < max(LOST_DEG, 6.0 * 1.4826 * float(np.median(miss))):
            break
        lost[keep[worst]] = True
    return lost


def select(t_us, features, flagged, target_index, onset_us, target_deg, settle_s):
    """Mark every frame of a run.

    t_us int64 [n], features [n, d], flagged bool [n] (saturated or starved), target_index int [n] (-1 outside
    the plan), onset_us int64 [k] when each target really appeared, target_deg [k, 2], settle_s seconds to
    discard. Returns Selection.
    """
    t_us = np.asarray(t_us, np.int64)
    features = np.asarray(features)
    index = np.asarray(target_index)
    reason = np.full(len(t_us), OUTSIDE, np.uint8)
    noise, period_us = noise_of(features), frame_us(t_us)
    steady = np.full((len(onset_us), features.shape[1]), np.nan)
    for k, onset in enumerate(onset_us):
        mine = np.flatnonzero(index == k)
        reason[mine] = SETTLING
        rows = mine[t_us[mine] >= onset + int(round(settle_s * 1e6))]
        if not len(rows):
            continue
        bad = np.asarray(flagged)[rows].astype(bool)
        blink = blinks(features[rows], noise, period_us)
        reason[rows] = np.where(bad, FLAGGED, np.where(blink, BLINK, USED))
        good = rows[reason[rows] == USED]
        if len(good) < max(5, LEAST_SHARE * len(rows)):
            reason[good] = UNSTABLE
        else:
            steady[k] = np.median(features[good].astype(float), axis=0)
    have = np.flatnonzero(np.isfinite(steady[:, 0])) if len(steady) else np.zeros(0, int)
    for k in have[inattentive(steady[have], np.asarray(target_deg, float)[have])]:
        reason[(index == k) & (reason == USED)] = INATTENTIVE
    valid = reason == USED
    return Selection(valid, reason, len(np.unique(index[valid])), len(onset_us))
