# SPDX-License-Identifier: Apache-2.0
"""From a float64 Gaussian process to the few integer vectors that an 8-bit device can carry.

The device's mean is  bias + trend . s + sum_i w_i k(s, c_i)  (firmware/core/sg_model.h). Everything in it is
fitted to the process's mean over a cloud of likely inputs: gains and centres in real numbers (expansion.py),
then rounded in stages; then trend, weights and bias, one after the other, on the integer kernel values of the
device itself, so that the rounding of each is made good by those still free (rounding.py). The process may
have any kernel; the device's is always the RBF. DESIGN.md section 5; notes on what each step buys stand
beside it.
"""

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from . import choose, trustfit
from .errors import CalibrationError
from .expansion import Problem, pruned, spread_start
from .model import CHANNELS, DeviceModel, emulate, quantise
from .rounding import (
    BOX,
    CENTRE_TOP,
    GAIN_MAX,
    LENGTH_STEPS,
    assemble,
    error_bound_deg,
    integer_box,
    integer_centres,
)

BOX_MARGIN = 0.12  # of a channel's calibrated range, on each side
BOX_SIGMAS = 6.0  # and at least this many frame-noise deviations
TAIL = 5e-4  # quantile taken for the end of the calibrated range
RIDGES = [1e-8 * 10**i for i in range(7)]  # of a squared kernel value; the first that fits is taken
POINTS = 4500  # that are fitted to; a third as many are held out
POOL = 2000  # of them, where centres may begin
NEIGHBOURS, MIXED, BEYOND = 8, 0.7, 0.5
GAIN_START, GAIN_LEAST = 0.75, 0.1  # of the gain that fills the range of the kernel's inputs
SURPLUS, LARGEST = 1.5, 160  # centres to begin with, of those wanted; at most
SEARCH_FROM = 96  # centres at the beginning of the search for the fewest; more when these do not do
FIRST_STEPS, LATER_STEPS, POLISH_STEPS = 15, 6, 40


@dataclass(frozen=True)
class DistilReport:
    """How far the device model is from the process it was made from, and what it uses.

    rms_deg, max_deg   distance over held-out likely inputs, by the device's integer arithmetic
    out_of_range       share of those inputs that its guards refuse
    n_vectors, weight_frac_bits, weight_range_deg (least, largest), reach_deg (proven bound of |gaze| before
    wrapping, and what the accumulator holds), error_bound_deg (rounding.py), points (used to fit)
    """

    rms_deg: float
    max_deg: float
    out_of_range: float
    n_vectors: int
    weight_frac_bits: int
    weight_range_deg: tuple
    reach_deg: tuple
    error_bound_deg: float
    points: int


def distil(
    gp,
    features,
    gaze_deg,
    n_vectors=64,
    seed=0,
    noise=None,
    points=None,
    aim_deg=None,
    sigma_deg=None,
    label=None,
    say=None,
):
    """Make a DeviceModel from a fitted GaussianProcess.

    features    [n, d] frames of the calibration, blinks excluded: their cloud is the range of the model
    gaze_deg    [n, 2] where those frames were looking (used to find neighbours, not as labels)
    n_vectors   how many; with aim_deg at most so many, and the fewest whose rms distance is within aim_deg
    noise       [d] rms of one frame, feature units; default 0;  points: number of inputs to fit to
    sigma_deg   [n] standard deviation of each angle at those frames; default what the process says
    label       int [n] their fixations; default each its own
    say(part)   is called with the share of the work that is done
    Returns (DeviceModel, DistilReport); a pure function of its arguments. Raises CalibrationError or
    ModelError.
    """
    features, gaze = np.asarray(features, float), np.asarray(gaze_deg, float)
    choose.most_vectors(None, n_vectors)
    if len(features) < 2 or features.shape[1] > CHANNELS:
        few = f"{len(features)} samples of {features.shape[1:]} channels do not do"
        raise CalibrationError(few, f"give at least 2 samples of at most {CHANNELS} channels")
    order = np.lexsort(np.column_stack([features, gaze]).T)  # the order of the samples must not matter
    noise = np.zeros(features.shape[1]) if noise is None else np.asarray(noise, float)
    sigma_deg = _sigma_deg(gp, features, noise) if sigma_deg is None else np.asarray(sigma_deg, float)
    label = np.arange(len(features)) if label is None else np.asarray(label)
    known = features[order], gaze[order], noise, sigma_deg[order], label[order]
    task = _Task(gp, *known, points or POINTS, seed)
    with threadpool_limits(limits=1, user_api="blas"):  # small matrices; and the sums' order is the answer's
        return task.run(min(n_vectors, max(1, len(task.train) // 4)), aim_deg, say or (lambda part: None))


class _Task:
    """The cloud, in the box; and what is done with it."""

    def __init__(self, gp, features, gaze, noise, sigma_deg, label, points, seed):
        self.gp, self.features, self.noise, self.sigma_deg, self.label = gp, features, noise, sigma_deg, label
        self.live = np.flatnonzero(np.isfinite(gp.hyper.length))
        low, high = box(features, noise)
        self.middle, self.width = (0.5 * (low + high))[self.live], (high - low)[self.live]
        rng = np.random.default_rng([0x647374, seed])
        cloud = likely_inputs(rng, features, gaze, noise, points + points // 3)
        inside = ((cloud >= low) & (cloud <= high))[:, self.live].all(axis=1)
        cloud = np.clip(np.rint(cloud[inside]), 0, 65535)
        held = np.arange(len(cloud)) % 4 == 3
        self.train, self.held = cloud[~held], cloud[held]

    def run(self, n_vectors, aim_deg, say):
        problem = self._problem(RIDGES[0])
        if aim_deg is None:
            found = list(self._path(problem, n_vectors, n_vectors, say))[-1:]
        else:
            found = self._search(problem, n_vectors, aim_deg, say)
        for i, expansion in enumerate(reversed(found)):
            say(0.8 + 0.2 * i / len(found))
            model, reach_deg = self._integers(expansion.improved(POLISH_STEPS))
            miss, refused = self._judge(model)
            if aim_deg is None or np.sqrt(np.mean(miss**2)) <= aim_deg:
                break
        weights = model.weights / 2.0**model.weight_frac_bits
        return model, DistilReport(
            float(np.sqrt(np.mean(miss**2))),
            float(miss.max()),
            float(np.mean(refused)),
            model.vectors,
            model.weight_frac_bits,
            (float(weights.min()), float(weights.max())),
            reach_deg,
            error_bound_deg(model),
            len(self.train),
        )

    def _problem(self, ridge):
        z = (self.train[:, self.live] - self.middle) / self.width
        most = np.minimum(BOX, GAIN_MAX * self.width / LENGTH_STEPS / 4096.0)
        return Problem(
            z,
            self.gp.predict(self.train),
            ridge,
            np.stack([GAIN_LEAST * most, most]),
            -self.middle / self.width,
            CENTRE_TOP,
        )

    def _path(self, problem, most, least, say):
        """Expansions of at most `most` centres, fewer and fewer."""
        count = min(max(most, LARGEST), int(np.ceil(SURPLUS * most)), max(most, len(self.train) // 4))
        first = spread_start(problem, count, GAIN_START * problem.gain_range[1], problem.z[:POOL])
        for expansion in pruned(first.improved(FIRST_STEPS), most, LATER_STEPS):
            say(0.8 * (1.0 - (len(expansion.centres) - least) / max(count - least, 1)))
        yield expansion
        for expansion in pruned(expansion, least, LATER_STEPS):
            say(0.8 * (1.0 - (len(expansion.centres) - least) / max(count - least, 1)))
            yield expansion

    def _search(self, problem, most, aim_deg, say):
        """Expansions to try, the last one first: fewer and fewer centres while the aim is met."""
        found = []
        for size in sorted({min(most, int(SEARCH_FROM / SURPLUS)), most}):
            for expansion in self._path(problem, size, 1, say):
                if expansion.rms > aim_deg:
                    expansion = expansion.improved(POLISH_STEPS)
                if expansion.rms > aim_deg:
                    break
                found.append(expansion)
            if found:
                return found
        return [expansion]

    def _integers(self, expansion):
        for ridge in RIDGES:
            if ridge != expansion.problem.ridge:
                problem = self._problem(ridge)
                expansion = type(expansion)(problem, expansion.gains, expansion.centres).improved(
                    POLISH_STEPS
                )
            offset, gain_q12, centres = self._placed(expansion)
            s, target = self._steps(self.train, offset, gain_q12)
            made = assemble(
                s, target, centres, offset, gain_q12, ridge, self._trust(offset, gain_q12, len(centres))
            )
            if made:
                return made
        none = "no number format holds the weights of this model"
        raise CalibrationError(none, "calibrate again with more targets")

    def _trust(self, offset, gain_q12, vectors):
        gaze = self.gp.predict(self.features)
        return trustfit.learn(
            self.features,
            gaze,
            self.sigma_deg,
            offset,
            gain_q12,
            self.noise,
            self.label,
            choose.cells(vectors),
        )

    def _placed(self, expansion):
        """offset, gain_q12 [d], centres [n, d] of all channels; zeros where the process dropped one."""
        d = self.features.shape[1]
        offset, gain_q12 = np.zeros(d, np.int64), np.zeros(d, np.int64)
        offset[self.live], gain_q12[self.live] = integer_box(expansion.gains, self.middle, self.width)
        s, target = self._steps(self.train, offset, gain_q12)
        centres = np.zeros((len(expansion.centres), d), np.int64)
        centres[:, self.live] = integer_centres(
            expansion,
            s[:, self.live],
            target,
            offset[self.live],
            gain_q12[self.live],
            self.middle,
            self.width,
        )
        return offset, gain_q12, centres

    def _steps(self, cloud, offset, gain_q12):
        """(s, what the process says there): at the very inputs that the device sees, quantised."""
        s, _ = quantise(cloud, offset, gain_q12)
        return s, self.gp.predict(unquantise(s, offset, gain_q12, cloud))

    def _judge(self, model):
        """(distance in degrees, refused) of the held-out inputs, by the device's integer arithmetic."""
        az, el, flags = emulate(model, self.held.astype(np.uint16))
        target = self.gp.predict(self.held)
        return np.hypot(az / 128.0 - target[:, 0], el / 128.0 - target[:, 1]), flags & 4 != 0


def _sigma_deg(gp, features, noise):
    """Standard deviation of each angle of single frames, [n], as the process has it."""
    _, own = gp.predict(features, return_std=True)
    through = (gp.gradient(features) * noise) ** 2
    return np.sqrt(own**2 + gp.hyper.noise_deg**2 + through.sum(axis=(1, 2)) / 2)


def box(features, noise):
    """Least and largest feature of every channel that the model is made for, float [d] each.

    The calibrated range and a margin, so that ordinary gaze never clips.
    """
    low, high = np.quantile(features, [TAIL, 1 - TAIL], axis=0)
    margin = np.maximum(BOX_MARGIN * (high - low), BOX_SIGMAS * noise) + 2
    return np.maximum(low - margin, 0.0), np.minimum(high + margin, 65535.0)


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
