# SPDX-License-Identifier: Apache-2.0
"""From a float64 Gaussian process to the few integer vectors that an 8-bit device can carry.

The device's mean is  bias + trend . s + sum_i w_i k(s, c_i)  (firmware/core/sg_model.h). Everything in it is
fitted to the process's mean over a cloud of likely inputs: the centres by variable projection and L-BFGS,
rounded in stages; then trend, weights and bias, one after the other, on the integer kernel values of the
device itself, so that the rounding of each is made good by those still free. DESIGN.md section 5; notes on
what each step buys stand beside it.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from .errors import CalibrationError, ModelError
from .fixations import TARGETS_NEEDED, fixations
from .gp import GaussianProcess
from .model import CHANNELS, S_FRAC, S_MAX, U_STEPS, VECTORS_MAX, DeviceModel, emulate, quantise
from .rounding import assemble
from .trust import GUARDS, Trust

BOX_MARGIN = 0.12  # of a channel's calibrated range, on each side
BOX_SIGMAS = 6.0  # and at least this many frame-noise deviations
GUARD_MARGIN = 0.06
GUARD_SIGMAS = 5.0
TAIL = 5e-4  # quantile taken for the end of the calibrated range
RIDGES = [1e-8 * 3**i for i in range(12)]  # of a squared kernel value; the first that fits is taken
POINTS = 6000
NEIGHBOURS, MIXED, BEYOND = 8, 0.7, 0.5
ROUNDING = (0.5, 0.75, 0.9, 1.0)
MEAN = "constant"
FRAMES_EACH = 16  # frames of each fixation that the process is given, noise and all
LENGTH_MAX = 3.0  # standard deviations of a channel: longer ones only ask for huge weights
ROWS_MAX, LEARN_MAX = 2000, 400  # rows of the final process, and of the one whose likelihood is maximised
CLOUD_EACH = 50
OUTLIER_SIGMAS, OUTLIER_ROUNDS = 6.0, 3
FIRST_STEPS, LATER_STEPS = 1500, 60
LOO_DOUBTFUL_DEG = 3.0  # twice what people reach with such a headset; gaze at random has about 18


@dataclass(frozen=True)
class DistilReport:
    """How far the device model is from the process it was made from, and what it uses.

    rms_deg, max_deg   distance over held-out likely inputs, by the device's integer arithmetic
    out_of_range       share of those inputs that its guards refuse
    n_vectors, weight_frac_bits, weight_range_deg (least, largest), reach_deg (proven bound of |gaze| before
    wrapping, and what the accumulator holds), points (used to fit)
    """

    rms_deg: float
    max_deg: float
    out_of_range: float
    n_vectors: int
    weight_frac_bits: int
    weight_range_deg: tuple
    reach_deg: tuple
    points: int


def distil(gp, features, gaze_deg, n_vectors=64, seed=0, noise=None, points=None):
    """Make a DeviceModel from a fitted GaussianProcess.

    features    [n, d] frames of the calibration, blinks excluded: their cloud is the range of the model
    gaze_deg    [n, 2] where those frames were looking (used to find neighbours, not as labels)
    noise       [d] rms of one frame, feature units; default 0;  points: number of inputs to fit to
    Returns (DeviceModel, DistilReport); a pure function of its arguments. Raises CalibrationError or
    ModelError.
    """
    features, gaze = np.asarray(features, float), np.asarray(gaze_deg, float)
    points = points or POINTS
    if not 1 <= n_vectors <= VECTORS_MAX:
        raise ModelError(f"{n_vectors} vectors do not fit the device", f"ask for 1 to {VECTORS_MAX}")
    if len(features) < 2 or features.shape[1] > CHANNELS:
        few = f"{len(features)} samples of {features.shape[1:]} channels do not do"
        raise CalibrationError(few, f"give at least 2 samples of at most {CHANNELS} channels")
    rng = np.random.default_rng([0x647374, seed])
    order = np.lexsort(np.column_stack([features, gaze]).T)  # the order of the samples must not matter
    features, gaze = features[order], gaze[order]
    noise = np.zeros(features.shape[1]) if noise is None else np.asarray(noise, float)
    offset, gain = box(gp, features, noise)
    cloud = likely_inputs(rng, features, gaze, noise, points + points // 3)
    s, clamped = quantise(np.clip(np.rint(cloud), 0, 65535), offset, gain)
    s, cloud = s[~clamped], cloud[~clamped]
    # The process is asked at the very inputs that the device sees, quantised.
    target = gp.predict(unquantise(s, offset, gain, cloud))
    held = np.arange(len(s)) % 4 == 3
    n_vectors = min(n_vectors, max(1, int((~held).sum()) // 4))
    rails = guards(features, offset, gain, noise)
    centres = None
    for ridge in RIDGES:
        centres = optimise_centres(rng, s[~held], target[~held], n_vectors, gain > 0, ridge, centres)
        made = assemble(s[~held], target[~held], centres, offset, gain, rails, ridge)
        if made:
            break
    else:
        none = "no number format holds the weights of this model"
        raise CalibrationError(none, "calibrate again with more targets")
    model, bound_deg = made
    fitted = np.clip(np.rint(cloud[held]), 0, 65535).astype(np.uint16)
    az, el, flags = emulate(model, fitted)
    miss = np.hypot(az / 128.0 - target[held, 0], el / 128.0 - target[held, 1])
    weights = model.weights / 2.0**model.weight_frac_bits
    rms_deg, max_deg = float(np.sqrt(np.mean(miss**2))), float(miss.max())
    refused = float(np.mean(flags & 4 != 0))
    span = float(weights.min()), float(weights.max())
    fitted_to = int((~held).sum())
    return model, DistilReport(
        rms_deg, max_deg, refused, model.vectors, model.weight_frac_bits, span, bound_deg, fitted_to
    )


def box(gp, features, noise):
    """Offset and gain of every channel: (offset int64 [d], gain_q12 int64 [d]).

    The box holds the calibrated range and a margin, so that ordinary gaze never clips, and no more than that:
    the device's length scale is a fixed part of the box, and the shorter it is, the smaller are the weights
    that a steep direction needs. Gains by the process's length scales gave weights 4 times larger at equal
    error on simulated eyes, whose channels are alike and differ where it matters. Channels that the process
    dropped have gain 0.
    """
    low, high = np.quantile(features, [TAIL, 1 - TAIL], axis=0)
    margin = np.maximum(BOX_MARGIN * (high - low), BOX_SIGMAS * noise) + 2
    low, high = np.maximum(low - margin, 0), np.minimum(high + margin, 65535)
    gain_q12 = np.minimum(np.floor(4096 * S_MAX / (high - low)), 65535).astype(np.int64)
    gain_q12[~np.isfinite(gp.hyper.length)] = 0
    return np.where(gain_q12 > 0, np.floor(low), 0).astype(np.int64), gain_q12


def unquantise(s, offset, gain_q12, like):
    """Features in the middle of the steps s; channels without gain keep their values from `like`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        middle = offset + (s + 0.5) * 4096.0 / gain_q12
    return np.where(gain_q12 > 0, middle, like)


def likely_inputs(rng, features, gaze, noise, count):
    """`count` inputs such as the device will meet: frames and mixtures of neighbours in gaze.

    Neighbours differ by pupil and time as well as by gaze: mixtures reach beyond them, because both will
    drift on. A mixture has another noise than a frame; what it lacks is added.
    """
    n = len(features)
    anchor = rng.integers(0, n, count)
    reach = min(n, NEIGHBOURS * max(1, n // 150))
    pool = rng.choice(n, min(n, 4000), replace=False)
    mixed = np.empty((count, features.shape[1]))
    for rows in np.array_split(np.arange(count), max(1, count // 500)):
        distance = ((gaze[anchor[rows], None] - gaze[pool]) ** 2).sum(-1)
        near = pool[np.argpartition(distance, min(reach, len(pool) - 1), axis=1)[:, :reach]]
        partner = near[np.arange(len(rows)), rng.integers(0, near.shape[1], len(rows))]
        share = rng.uniform(-BEYOND, 1.0, (len(rows), 1)) * (rng.random((len(rows), 1)) < MIXED)
        lost = np.sqrt(np.maximum(1 - (1 - share) ** 2 - share**2, 0.0))
        mixed[rows] = (
            (1 - share) * features[anchor[rows]]
            + share * features[partner]
            + lost * noise * rng.standard_normal((len(rows), features.shape[1]))
        )
    return mixed


def optimise_centres(rng, s, target, n_vectors, free, ridge, start=None):
    """Centres [n_vectors, d] in 0..255 for the least squares to target [m, 2] at inputs s [m, d] (u8.4).

    Variable projection: for given centres the weights and the trend are a linear least-squares problem, and
    at its solution the derivative in the centres needs no derivative of the weights (Golub & Pereyra 1973).
    Bounds keep the centres in the box; in stages the coordinates nearest to integers are frozen there and the
    rest moves on: rounding all at once at the end costs three times the error. `start` are centres to begin
    with.
    """
    x = s / S_FRAC / U_STEPS
    linear = np.hstack([np.ones((len(x), 1)), x[:, free] - x[:, free].mean(axis=0)])
    level = np.sqrt(np.mean((target - target.mean(axis=0)) ** 2))
    y = (target - target.mean(axis=0)) / max(level, 1e-9)
    centres = maximin(rng, x, n_vectors) if start is None else start / U_STEPS
    first = FIRST_STEPS if start is None else LATER_STEPS
    top = 255.0 / U_STEPS
    frozen = np.zeros(centres.shape, bool)
    frozen[:, ~free] = True
    centres[:, ~free] = 0.0
    for stage in (0.0,) + ROUNDING:
        if stage:
            steps = centres * U_STEPS
            gap = np.where(frozen, -1.0, np.abs(steps - np.rint(steps)))
            gap[:, ~free] = -1.0
            chosen = gap <= np.quantile(gap[:, free], stage)
            centres = np.where(chosen, np.clip(np.rint(steps), 0, 255) / U_STEPS, centres)
            frozen = frozen | chosen
        if frozen.all():
            break
        moving = ~frozen

        def objective(values):
            trial = centres.copy()
            trial[moving] = values
            value, slope = _projected(trial, x, linear, y, ridge)
            return np.log(value), slope[moving] / value  # the scale that L-BFGS's tolerances expect

        found = minimize(
            objective,
            centres[moving],
            jac=True,
            method="L-BFGS-B",
            bounds=[(0.0, top)] * int(moving.sum()),
            options={"maxiter": LATER_STEPS if stage else first, "maxcor": 20, "ftol": 1e-6, "gtol": 1e-6},
        )
        centres[moving] = found.x
    return np.clip(np.rint(centres * U_STEPS), 0, 255).astype(np.int64)


def _projected(centres, x, linear, y, ridge):
    """Mean squared residual with the best weights, and its derivative in the centres."""
    d2 = np.sum(x * x, 1)[:, None] + np.sum(centres * centres, 1) - 2.0 * (x @ centres.T)
    k = np.exp(-0.5 * np.maximum(d2, 0.0))
    design = np.hstack([k, linear])
    m = len(x)
    normal = design.T @ design
    normal[np.diag_indices(len(normal))] += ridge * m
    w = cho_solve(cho_factor(normal, check_finite=False), design.T @ y, check_finite=False)
    residual = design @ w - y
    value = np.sum(residual**2) / m + ridge * np.sum(w**2)
    pull = (residual @ w[: len(centres)].T) * k
    slope = 2.0 / m * (pull.T @ x - pull.sum(axis=0)[:, None] * centres)
    return value, slope


def maximin(rng, x, count):
    """`count` rows of x, each as far as possible from those before it."""
    pool = x[rng.choice(len(x), min(len(x), 2000), replace=False)]
    chosen = [int(np.argmin(((pool - pool.mean(axis=0)) ** 2).sum(1)))]
    nearest = np.full(len(pool), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, ((pool - pool[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(np.argmax(nearest)))
    return pool[chosen].copy()


def guards(features, offset, gain, noise):
    """Bounds along the least principal directions of the calibrated cloud: Trust.

    Blinks and slip leave the cloud in directions in which gaze does not move it, long before a single channel
    leaves its own range.
    """
    s, _ = quantise(np.clip(np.rint(features), 0, 65535), offset, gain)
    live = np.flatnonzero(gain > 0)
    step_noise = (noise * gain / 4096.0)[live]
    _, directions = np.linalg.eigh(np.cov(s[:, live].T).reshape(len(live), len(live)))
    rows, low, high = [], [], []
    for direction in directions.T[:GUARDS]:  # least variance first: gaze does not move these
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
        row = np.zeros(s.shape[1], np.int64)
        row[live] = np.trunc(63.0 * direction / np.abs(direction).sum())
        projection = (s >> 4) @ row
        least, most = np.quantile(projection, [TAIL, 1 - TAIL])
        spread = float(np.sqrt(row[live] ** 2 @ step_noise**2)) / 16
        margin = max(GUARD_MARGIN * (most - least), GUARD_SIGMAS * spread)
        rows.append(row)
        low.append(int(np.floor(least - margin)))
        high.append(int(np.ceil(most + margin)))
    none = np.zeros(len(rows), np.int64)
    return Trust(np.array(rows), none, np.array(low), np.array(high), np.zeros((2, 2, len(rows)), np.int64), limit=65535)


@dataclass(frozen=True)
class FitResult:
    """What fit_recording made: gp GaussianProcess, model DeviceModel, report FitReport."""

    gp: GaussianProcess
    model: DeviceModel
    report: "FitReport"


@dataclass(frozen=True)
class FitReport:
    """How a recording became a model.

    fixations, frames used; rejected_frames (blinks) and outliers (targets [m, 2] that contradict all others)
    loo_rms_deg  leave-one-fixation-out error of the fixations' means; lml, condition, jitter of the process
    length [d] feature units, signal_deg, noise_deg; dropped_channels; distil: DistilReport
    """

    fixations: int
    frames: int
    rejected_frames: int
    outliers: list
    loo_rms_deg: float
    lml: float
    condition: float
    jitter: float
    length: list
    signal_deg: float
    noise_deg: float
    dropped_channels: tuple
    distil: DistilReport


@threadpool_limits.wrap(limits=1, user_api="blas")  # the matrices are small: threads cost 20 times their gain
def fit_recording(recording, n_vectors=64, seed=0):
    """Recording -> FitResult. Raises RecordingError or CalibrationError; warns of channels it drops and of
    a recording that hardly depends on its targets.

    Length scales and noise are learnt from the fixations' means, of which each is one observation. The final
    process is then given single frames, with that noise each: the device judges single frames, and a process
    that has only seen means trusts directions that their noise fills. On simulated persons this takes 5 % off
    the error of frames; likelihood on frames, or noise shared within fixations, makes it worse (frames of a
    fixation agree for free).
    """
    fixed = fixations(recording)
    learnt = _learn(fixed, seed)
    lost = []
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
            learnt = _learn(fixed, seed)
    loo_rms_deg = float(np.sqrt(np.mean(np.sum((learnt.y - learnt.loo()[0]) ** 2, axis=1))))
    if loo_rms_deg > LOO_DOUBTFUL_DEG:
        warnings.warn(
            f"targets that are left out are missed by {loo_rms_deg:.1f} deg: this recording says little "
            "about where the eye looked; check the headset's seat and record again, with more targets"
        )
    rows = _thin(fixed.frames(max(1, min(FRAMES_EACH, ROWS_MAX // len(fixed.mean)))), ROWS_MAX)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gp = GaussianProcess.fit(
            *spread_out(fixed, rows, seed),
            hyper=learnt.hyper,
            mean=MEAN,
            noise_scale=fixed.noise_scale()[fixed.label[rows]],
        )
    cloud = fixed.frames(CLOUD_EACH)
    model, report = distil(gp, fixed.features[cloud], fixed.target_deg[cloud], n_vectors, seed, fixed.noise)
    return FitResult(
        gp,
        model,
        FitReport(
            len(fixed.mean),
            len(fixed.features),
            fixed.rejected,
            lost,
            loo_rms_deg,
            learnt.lml,
            learnt.condition,
            learnt.jitter,
            [float(v) for v in learnt.hyper.length],
            learnt.hyper.signal_deg,
            learnt.hyper.noise_deg,
            learnt.dropped,
            report,
        ),
    )


def spread_out(fixed, rows, seed):
    """Frames `rows` of the Fixations, each moved to a place near its target: (features [n, d], gaze [n, 2]).

    Targets stand some degrees apart, and the features bend between them (the ring of the limbus is 2 degrees
    wide). The map from gaze to features is smooth and two-dimensional, so that far fewer points tell it than
    its inverse: frames are moved along it by up to half the distance between targets, noise and pupil
    included.
    """
    target, place = fixed.target_deg[rows], fixed.target
    few = _thin(np.arange(len(place)), LEARN_MAX)
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


def _learn(fixed, seed):
    rows = _thin(np.arange(len(fixed.mean)), LEARN_MAX)
    known = fixed.mean[rows], fixed.target[rows], fixed.noise_scale()[rows]
    return GaussianProcess.fit(*known, mean=MEAN, seed=seed, length_max=LENGTH_MAX)


def _thin(rows, most):
    """At most `most` of the rows, evenly spread."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(int)]
