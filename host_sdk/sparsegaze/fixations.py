# SPDX-License-Identifier: Apache-2.0
"""From the frames of a recording to fixations: which belong together, which are blinks, what each says.

All frames of a fixation share one error (where the eye really rested), so a fixation is one observation,
however many frames it has; and its mean is far less noisy than the single frames that the device will have to
judge.
"""

from dataclasses import dataclass

import numpy as np

from .errors import RecordingError

TARGETS_NEEDED = 9  # a 3 x 3 grid: below that nothing nonlinear can be told
MOVE_DEG = 0.5  # a target that has moved on by this much is another fixation (pursuit)
GAP_US = 2_000_000  # and so is the same target after such a pause
BLINK_SIGMAS = 6.0
FEW_FRAMES = 8  # fewer frames than this have no spread to judge by
NOISE_SHARE = 0.45
# How far the eye rests off its target, only to weigh fixations against each other (noise_scale): a
# target-to-eye bias of 0.2 to 0.5 deg is typical of people. It need not be known well: with 0.15 or 0.6
# instead, the error on left-out targets of three simulated persons changed by less than 0.1 %.
BIAS_DEG = 0.3
NEIGHBOURS, SCALE_MAX = 14, 30.0
STEADY_FLOOR = 8.0  # feature steps; quantised noise-free recordings have a MAD of 0


@dataclass(frozen=True)
class Fixations:
    """Frames sorted into k fixations.

    features [n, d] float64 and target_deg [n, 2] of the frames kept, label int [n] their fixation, in order
    mean [k, d] and target [k, 2] per fixation;  noise [d] rms of one frame about its fixation, feature units
    rejected  frames left out as blinks
    """

    features: np.ndarray
    target_deg: np.ndarray
    label: np.ndarray
    mean: np.ndarray
    target: np.ndarray
    noise: np.ndarray
    rejected: int

    def without(self, fixations):
        """The same without the given fixations (indices)."""
        keep = np.ones(len(self.mean), bool)
        keep[list(fixations)] = False
        rows = keep[self.label]
        label = (np.cumsum(keep) - 1)[self.label[rows]]
        return Fixations(
            self.features[rows],
            self.target_deg[rows],
            label,
            self.mean[keep],
            self.target[keep],
            self.noise,
            self.rejected,
        )

    def frames(self, each):
        """At most `each` frames of every fixation, evenly spread: row indices."""
        starts = np.flatnonzero(np.r_[True, np.diff(self.label) > 0])
        counts = np.diff(np.r_[starts, len(self.label)])
        rows = [
            start + np.unique(np.floor((np.arange(min(each, n)) + 0.5) * n / min(each, n)).astype(int))
            for start, n in zip(starts, counts)
        ]
        return np.concatenate(rows)

    def noise_scale(self):
        """How much noisier than others each fixation is as an observation of gaze: [k], variance ratio >= 1.

        Where all channels are flat, a small disturbance of the features (pupil, lids) is a large one of gaze.
        The features' slope comes from a plane through each target and its neighbours; NOISE_SHARE of a
        frame's noise stands for the disturbance of a mean, BIAS_DEG for the eye's own part. Noise that is
        told apart lets the likelihood choose longer or shorter length scales for the sake of the fixations
        that count.
        """
        disturbance2 = float(np.mean((NOISE_SHARE * self.noise) ** 2))
        if disturbance2 == 0.0:
            return np.ones(len(self.target))
        scale = np.empty(len(self.target))
        for i, place in enumerate(self.target):
            distance = ((self.target - place) ** 2).sum(axis=1)
            near = np.argsort(distance, kind="stable")[:NEIGHBOURS]
            plane = np.column_stack([np.ones(len(near)), self.target[near] - place])
            slope = np.linalg.lstsq(plane, self.mean[near], rcond=None)[0][1:]
            gaze2 = np.trace(np.linalg.inv(slope @ slope.T + 1e-3 * np.eye(2))) / 2
            scale[i] = min(1.0 + disturbance2 * gaze2 / BIAS_DEG**2, SCALE_MAX)
        return scale


def fixations(recording):
    """Sort the valid frames of a Recording into Fixations; the order of its rows does not matter.

    Raises RecordingError when fewer than TARGETS_NEEDED different targets are left.
    """
    rows = np.flatnonzero(recording.valid)
    x, target, t = recording.features[rows].astype(float), recording.target_deg[rows], recording.t_us[rows]
    order = np.lexsort(np.column_stack([x[:, ::-1], target[:, ::-1], t]).T)
    x, target, t = x[order], target[order], t[order]
    label = _runs(target, t)
    keep = np.ones(len(x), bool)
    for run in np.split(np.arange(len(x)), np.flatnonzero(np.diff(label)) + 1):
        if len(run) >= FEW_FRAMES:
            keep[run] = _steady(x[run])
    x, target, label = x[keep], target[keep], np.unique(label[keep], return_inverse=True)[1]
    places = len(np.unique(np.round(target, 3), axis=0))
    if places < TARGETS_NEEDED:
        raise RecordingError(
            f"{places} targets with valid frames are too few",
            f"record at least {TARGETS_NEEDED}, better 100, spread over the whole field",
        )
    count = np.bincount(label)[:, None]
    mean = np.stack([np.bincount(label, column) for column in x.T], axis=1) / count
    place = np.stack([np.bincount(label, column) for column in target.T], axis=1) / count
    spare = len(x) - len(mean)
    noise = np.sqrt(np.sum((x - mean[label]) ** 2, axis=0) / max(spare, 1)) * (spare >= len(mean))
    return Fixations(x, target, label, mean, place, noise, int(np.sum(~keep)))


def _runs(target, t):
    """Label of the fixation of each frame, frames in order of time."""
    label, start, current = np.zeros(len(t), int), 0, 0
    for i in range(1, len(t)):
        if t[i] - t[i - 1] > GAP_US or np.abs(target[i] - target[start]).max() > MOVE_DEG:
            current, start = current + 1, i
        label[i] = current
    return label


def _steady(x):
    """Frames of one fixation that lie with the others in every channel: bool [n]."""
    centre = np.median(x, axis=0)
    spread = 1.4826 * np.median(np.abs(x - centre), axis=0)
    return (np.abs(x - centre) <= BLINK_SIGMAS * np.maximum(spread, STEADY_FLOOR)).all(axis=1)
