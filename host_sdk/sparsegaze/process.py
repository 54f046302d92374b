# SPDX-License-Identifier: Apache-2.0
"""The full Gaussian process of a recording: which frames it sees, what is learnt from what, which to
doubt."""

import warnings
from dataclasses import dataclass, replace

import numpy as np

from .errors import CalibrationError
from .fixations import TARGETS_NEEDED, Fixations, fixations
from .gp import GaussianProcess

MEAN = "constant"
FRAMES_EACH = 16  # frames of each fixation that the process is given, noise and all
LENGTH_MAX = 3.0  # standard deviations of a channel: longer ones only ask for huge weights
ROWS_MAX, LEARN_MAX = 2000, 400  # rows of the final process, and of the one whose likelihood is maximised
OUTLIER_SIGMAS, OUTLIER_ROUNDS = 6.0, 3
LOO_DOUBTFUL_DEG = 3.0  # twice what people reach with such a headset; gaze at random has about 18
SINGLE_FRAMES = 2.0  # frames a fixation, below which a frame is a fixation
LOCAL = 14  # neighbours of a target, for a quadratic through what they see


@dataclass(frozen=True)
class Process:
    """A recording's process and what it was learnt from.

    gp        the full GaussianProcess;  learnt the one on the fixations' means, whose parameters it has
    fixed     Fixations without the outliers, with the noise of single frames also where a fixation has but
    one
    loo_rms_deg, loo_mean_deg  leave-one-fixation-out error; outliers  targets that contradict all others;
    rows  frames of fixed in gp
    """

    gp: GaussianProcess
    learnt: GaussianProcess
    fixed: Fixations
    loo_rms_deg: float
    loo_mean_deg: float
    outliers: list
    rows: np.ndarray


def fit_process(recording, seed=0, kernel="rbf", p=None):
    """Recording -> Process. Raises RecordingError or CalibrationError; warns of channels it drops and of a
    recording that hardly depends on its targets.

    Length scales and noise are learnt from the fixations' means, of which each is one observation. The final
    process is then given single frames, with that noise each: the device judges single frames, and a process
    that has only seen means trusts directions that their noise fills. On simulated persons this takes 5 % off
    the error of frames; likelihood on frames, or noise shared within fixations, makes it worse (frames of a
    fixation agree for free). Where fixations are single frames there is nothing to spread: the process is a
    plain
    one on all of them.
    """
    fixed = fixations(recording)
    single = len(fixed.features) < SINGLE_FRAMES * len(fixed.mean)

    def learn(mean=MEAN):
        scale = np.ones(len(fixed.mean)) if single else fixed.noise_scale()
        rows = np.arange(len(fixed.mean)) if single else thin(np.arange(len(fixed.mean)), LEARN_MAX)
        return GaussianProcess.fit(
            fixed.mean[rows],
            fixed.target[rows],
            scale[rows],
            mean=mean,
            seed=seed,
            length_max=LENGTH_MAX,
            kernel=kernel,
            p=p,
            rows_max=ROWS_MAX,
        )

    learnt, lost = learn(), []
    for _ in range(OUTLIER_ROUNDS):
        predicted, spread = learnt.loo()
        miss = np.linalg.norm(learnt.y - predicted, axis=1) / spread
        worst = np.flatnonzero(miss > OUTLIER_SIGMAS)
        worst = worst[np.argsort(-miss[worst])][: max(1, len(miss) // 20)]
        if not len(worst) or len(fixed.mean) - len(worst) < TARGETS_NEEDED:
            break
        gone = [
            int(np.argmax((fixed.mean == learnt.x[i]).all(1) & (fixed.target == learnt.y[i]).all(1)))
            for i in worst
        ]
        lost += [[float(v) for v in fixed.target[i]] for i in gone]
        fixed = fixed.without(gone)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            learnt = learn()
    if single:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            learnt = _better(learnt, learn)
    miss = np.linalg.norm(learnt.y - learnt.loo()[0], axis=1)
    loo_rms_deg = float(np.sqrt(np.mean(miss**2)))
    if loo_rms_deg > LOO_DOUBTFUL_DEG:
        warnings.warn(
            f"targets that are left out are missed by {loo_rms_deg:.1f} deg: this recording says little "
            "about where the eye looked; check the headset's seat and record again, with more targets"
        )
    gp, rows = learnt, np.arange(len(fixed.features))
    if single:
        fixed = replace(fixed, noise=local_noise(fixed.mean, fixed.target))
    else:
        rows = thin(fixed.frames(max(1, min(FRAMES_EACH, ROWS_MAX // len(fixed.mean)))), ROWS_MAX)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            gp = GaussianProcess.fit(
                *spread_out(fixed, rows, seed),
                hyper=learnt.hyper,
                mean=MEAN,
                noise_scale=fixed.noise_scale()[fixed.label[rows]],
                kernel=kernel,
                p=p,
            )
    return Process(gp, learnt, fixed, loo_rms_deg, float(miss.mean()), lost, rows)


def _better(constant, learn):
    """The process with a linear mean instead, if its likelihood is worth the parameters (Schwarz 1978).

    On responses with a narrow ring it takes 4 to 14 % off the error, on smooth ones nothing.
    """
    try:
        linear = learn("linear")
    except CalibrationError:
        return constant
    more = linear.beta.size - constant.beta.size
    return linear if linear.lml - constant.lml > 0.5 * more * np.log(len(linear.x)) else constant


def spread_out(fixed, rows, seed):
    """Frames `rows` of the Fixations, each moved to a place near its target: (features [n, d], gaze [n, 2]).

    Targets stand some degrees apart, and the features bend between them (the ring of the limbus is 2 degrees
    wide). The map from gaze to features is smooth and two-dimensional, so that far fewer points tell it than
    its inverse: frames are moved along it by up to half the distance between targets, noise and pupil
    included.
    """
    target, place = fixed.target_deg[rows], fixed.target
    few = thin(np.arange(len(place)), LEARN_MAX)
    low, high = place.min(axis=0), place.max(axis=0)
    reach_deg = 0.5 * np.sqrt(np.prod(np.maximum(high - low, 1e-6)) / len(place))
    rng = np.random.default_rng([0x6D6F76, seed])
    moved = np.clip(target + rng.uniform(-reach_deg, reach_deg, target.shape), low, high)
    features = fixed.features[rows].copy()
    for pair in np.array_split(np.arange(features.shape[1]), (features.shape[1] + 1) // 2):
        forward = GaussianProcess.fit(
            place[few], fixed.mean[few][:, [pair[0], pair[-1]]], mean=MEAN, length_max=LENGTH_MAX, restarts=0
        )
        step = forward.predict(moved) - forward.predict(target)
        features[:, pair] += step[:, : len(pair)]
    return features, moved


def local_noise(mean, target):
    """Rms of one reading of every channel, [d], from single readings: what a quadratic in gaze does not
    explain.

    The quadratic goes through each reading and its neighbours; of the residuals the median counts, so that
    places
    where the features bend faster than that do not.
    """
    near = min(LOCAL, len(target))
    if near < 8:
        return np.zeros(mean.shape[1])
    left = np.empty_like(mean)
    for i, place in enumerate(target):
        others = np.argsort(((target - place) ** 2).sum(axis=1), kind="stable")
        rows = np.r_[i, others[others != i]][:near]
        az, el = (target[rows] - place).T
        design = np.column_stack([np.ones(near), az, el, az * az, az * el, el * el])
        basis = np.linalg.svd(design, full_matrices=False)
        basis = basis[0][:, basis[1] > 1e-9 * basis[1].max()]
        share = np.sqrt(
            max(1.0 - float(np.sum(basis[0] ** 2)), 1e-3)
        )  # of a reading's noise that is left in it
        left[i] = (mean[i] - basis[0] @ (basis.T @ mean[rows])) / share
    return 1.4826 * np.median(np.abs(left), axis=0)


def thin(rows, most):
    """At most `most` of the rows, evenly spread."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(int)]
