# SPDX-License-Identifier: Apache-2.0
"""An expansion's numbers as the device's integers: gains, centres, then trend, weights and bias."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .expansion import Expansion, Problem
from .model import (
    BIAS_MAX,
    S_FRAC,
    S_MAX,
    U_STEPS,
    WEIGHT_FRAC_BITS,
    DeviceModel,
    kernel_q16,
    weighed,
)
from .reach import reach

LENGTH_STEPS = U_STEPS * S_FRAC  # input steps per length scale
CENTRE_TOP = 255.0 / U_STEPS  # length scales from a channel's offset to the farthest centre
BOX = S_MAX / LENGTH_STEPS  # and to the end of its inputs
GAIN_MAX = 65535
STAGES, STAGE_STEPS = (0.5, 0.75, 0.9), 4
ACCUMULATOR = 2**23
OUTPUT_ERROR_DEG = 2.0**-8


def integer_box(gains, middle, width):
    """Offsets and gain_q12, int64 [d], of inputs z = (feature - middle) / width at gains a.

    The range of the kernel's inputs lies evenly about `middle`, or begins at feature 0 where it would begin
    below.
    """
    gain_q12 = np.clip(np.floor(gains * LENGTH_STEPS * 4096.0 / width), 1, GAIN_MAX).astype(np.int64)
    half = 0.5 * S_MAX * 4096.0 / gain_q12
    return np.clip(np.floor(middle - half), 0, 65535).astype(np.int64), gain_q12


def integer_centres(expansion, s, target, offset, gain_q12, middle, width):
    """Centres [n, d] 0..255 of an expansion whose gains have become offset and gain_q12.

    s [m, d] inputs of the kernel, target [m, 2]. In stages the coordinates nearest to integers are frozen
    there
    and the rest moves on: with few vectors, rounding all at once costs a tenth of the error.
    """
    unit = 4096.0 * LENGTH_STEPS / gain_q12  # features per length scale
    centres = np.clip(
        expansion.centres * width / unit / expansion.gains + (middle - offset) / unit, 0.0, CENTRE_TOP
    )
    one, none = np.ones(len(unit)), np.zeros(len(unit))
    problem = Problem(
        s / LENGTH_STEPS, target, expansion.problem.ridge, np.stack([one, one]), none, CENTRE_TOP, none
    )
    frozen = np.zeros(centres.shape, bool)
    for stage in STAGES:
        steps = centres * U_STEPS
        gap = np.where(frozen, -1.0, np.abs(steps - np.rint(steps)))
        frozen = frozen | (gap <= np.quantile(gap, stage))
        centres = np.where(frozen, np.clip(np.rint(steps), 0, 255) / U_STEPS, centres)
        centres = Expansion(problem, one, centres).improved(STAGE_STEPS, frozen).centres
    return np.clip(np.rint(centres * U_STEPS), 0, 255).astype(np.int64)


def assemble(s, target, centres, offset, gain_q12, ridge, trust):
    """Trend, weights and bias in the device's integers, on the device's own kernel values.

    Takes the finest weight format whose weights fit 16 bits and whose sum provably fits 24.
    s [m, d] inputs of the kernel, target [m, 2] deg; ridge of a squared weight per sample, deg^-2
    trust  trust.Trust for inputs of that offset and gain_q12
    Returns (DeviceModel, (proven bound of |gaze| in degrees, what the accumulator holds)), or None when none
    fits.
    """
    k = kernel_q16(s, centres)
    design = np.hstack([k / 65536.0, s / 4096.0, np.ones((len(s), 1))])
    n, d = len(centres), s.shape[1]
    damped = design.T @ design + np.diag(np.r_[np.full(n, ridge), np.full(d, 1e-9), 0.0]) * len(s)
    moment = design.T @ target
    for bits in reversed(WEIGHT_FRAC_BITS):
        fine, trend_unit = 2.0 ** -(bits + 8), 2.0 ** -(bits + 12)
        unit = np.r_[np.full(n, 2.0**-bits), np.full(d, 4096.0 * trend_unit), trend_unit]
        whole = _round_in_turn(damped, moment, unit, np.r_[np.arange(n, n + d), np.arange(n), n + d])
        weights, trend = whole[:n], whole[n : n + d].T
        if np.abs(weights).max() > 32767 or np.abs(trend).max() > 32767:
            continue
        # The bias last, on the device's own sums: it takes the mean of all that they leave out.
        rest = target / fine - weighed(k, weights) - (s @ trend.T >> 4)
        bias = np.rint(16.0 * rest.mean(axis=0)).astype(np.int64)
        if np.abs(bias).max() > BIAS_MAX:
            continue
        parts = offset, gain_q12, bias, trend, centres, weights, bits
        bound = reach(weights, trend, bias, centres, trust, 0.99 * ACCUMULATOR)
        if bound < ACCUMULATOR:
            return DeviceModel.from_parts(*parts, trust), (float(bound * fine), float(ACCUMULATOR * fine))
    return None


def error_bound_deg(model):
    """Bound of the device's arithmetic, degrees: its angle against the same expansion in real numbers.

    The expansion is that of the stored centres, half squares, weights, trend and bias at the same inputs s,
    plus a
    constant: half of the most that the left-out products of low bytes can come to. Errors: kernels 10 steps
    of 2^-16 (sg_gp.h); the left-out products, then within half of their range; floors of one accumulator
    step; rounding of the result to 1/128 deg.
    """
    from .reach import KERNEL_ERROR

    step = 2.0 ** -(model.weight_frac_bits + 8)
    kernels = KERNEL_ERROR / 256.0 * np.abs(model.weights).sum(axis=0)
    products = 0.5 * 255.0 / 256.0 * (model.weights & 255).sum(axis=0)
    return float(np.max(kernels + products + 1.0) * step + OUTPUT_ERROR_DEG)


def _round_in_turn(normal, moment, unit, order):
    """Least-squares solution whose entries are whole multiples of `unit`: int64, same shape as moment.

    Entries are rounded in the given order; after each, those still free are solved anew given all the rounded
    ones.
    """
    scale = 1.0 / np.sqrt(np.diag(normal))
    normal = normal * scale[:, None] * scale
    normal[np.diag_indices(len(normal))] += 1e-14
    inverse = cho_solve(cho_factor(normal), np.eye(len(normal)))
    value = inverse @ (moment * scale[:, None])
    step = unit / scale
    whole = np.zeros(moment.shape, np.int64)
    for i in order:
        whole[i] = np.rint(value[i] / step[i]).astype(np.int64)
        error = (value[i] - whole[i] * step[i]) / inverse[i, i]
        value = value - np.outer(inverse[:, i], error)
        inverse = inverse - np.outer(inverse[:, i], inverse[i]) / inverse[i, i]
    return whole
