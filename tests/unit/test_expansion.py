# SPDX-License-Identifier: Apache-2.0
"""expansion.py, rounding.py, reach.py: the steps of a distillation, each on numbers made for it."""

import numpy as np
import pytest

from sparsegaze import rounding
from sparsegaze.expansion import Expansion, Problem
from sparsegaze.model import half_squares, kernel_q16, weighed
from sparsegaze.reach import KERNEL_ERROR, reach
from sparsegaze.trust import Trust


def slabs(least, most, rows=63 * np.eye(6, dtype=int)):
    none = np.zeros(len(rows), int)
    return Trust(rows, none, none + least, none + most, np.zeros((2, 2, len(rows)), int))


def test_no_kernel_value_is_further_from_the_exponential_than_the_proof_believes():
    s, centres = np.arange(4096)[:, None], np.arange(256)[:, None]
    exact = s * s / 32.0 + 256 * half_squares(centres) - s * centres.T
    error = kernel_q16(s, centres) - 65536 * np.exp(-exact / 65536)
    print("kernel: %.2f to %.2f steps of 2^-16" % (error.min(), error.max()))
    assert 0.5 * KERNEL_ERROR < np.abs(error).max() <= KERNEL_ERROR


def test_reach_is_tight_for_one_kernel_cancelling_kernels_and_a_trend():
    # One kernel in a small parallelepiped round its centre: the bound is its weight, attained at the centre.
    box = slabs(63 * 28, 63 * 32)
    none = np.zeros((2, 6), int), np.zeros(2, int)
    bound = reach(np.array([[256, -256]]), *none, np.full((1, 6), 30), box)
    assert 255 * 256 <= bound <= 1.05 * 256 * 256
    # Two kernels of opposite weight in nearly the same place cancel: far below the sum of the weights.
    pair = reach(np.array([[2560, 0], [-2560, 0]]), *none, np.array([[30] * 6, [31] * 6]), box)
    assert pair < 0.1 * 10 * bound
    # A trend alone is bounded by its value at the far corner.
    trend = np.array([[700, -300, 0, 0, 0, 200], [0] * 6])
    least, most = 16 * 28, 16 * 32 + 15
    corner = (900 * most - 300 * least) / 16
    found = reach(np.zeros((1, 2), int), trend, np.zeros(2, int), np.zeros((1, 6), int), box)
    assert corner <= found <= 1.001 * corner


@pytest.mark.parametrize("guards", [0, 1, 2, 4])
def test_reach_holds_with_few_guards_and_with_guards_that_say_the_same_twice(guards):
    rng = np.random.default_rng(guards)
    rows = rng.integers(-10, 11, (guards, 6))
    if guards > 1:
        rows[1] = rows[0]
    trust = slabs(-200, 300, rows)
    weights, centres = rng.integers(-3000, 3000, (12, 2)), rng.integers(0, 256, (12, 6))
    trend, bias = rng.integers(-300, 300, (2, 6)), rng.integers(-(10**6), 10**6, 2)
    s = rng.integers(0, 4096, (200_000, 6))
    s[:100_000] = np.where(s[:100_000] < 2048, 0, 4095)
    projection = (s >> 4) @ rows.T
    s = s[((projection >= -200) & (projection <= 300)).all(axis=1)]
    total = (bias + s @ trend.T >> 4) + weighed(kernel_q16(s, centres), weights)
    assert len(s) > 100 and np.abs(total).max() <= reach(weights, trend, bias, centres, trust)


def test_rounding_in_turn_beats_rounding_at_once():
    rng = np.random.default_rng(0)
    design = rng.standard_normal((300, 5)) @ rng.standard_normal((5, 30)) + 0.05 * rng.standard_normal(
        (300, 30)
    )
    y = rng.standard_normal((300, 2))
    normal, moment = design.T @ design + 1e-3 * np.eye(30), design.T @ y
    unit = np.full(30, 0.02)
    turn = rounding._round_in_turn(normal, moment, unit, np.arange(30)) * 0.02
    once = np.rint(np.linalg.solve(normal, moment) / 0.02) * 0.02
    cost = [np.sum((design @ w - y) ** 2) for w in (np.linalg.solve(normal, moment), turn, once)]
    assert cost[0] <= cost[1] < cost[0] + 0.5 * (cost[2] - cost[0])


def problem(rng, m=200, d=4, ridge=1e-7):
    z = rng.uniform(-0.5, 0.5, (m, d))
    wide = np.full(d, 4.0)
    return Problem(
        z, np.sin(3 * z @ rng.standard_normal((d, 2))), ridge, np.stack([0.1 * wide, wide]), -9 * wide, 4.0
    )


def test_variable_projection_gradient_equals_finite_differences():
    rng = np.random.default_rng(0)
    task = problem(rng)
    gains, centres = rng.uniform(1, 3, 4), rng.uniform(-1.5, 1.5, (10, 4))
    by_centre, by_gain = Expansion(task, gains, centres).gradient()
    for i, j in [(0, 0), (4, 2), (9, 3)]:
        step = np.zeros_like(centres)
        step[i, j] = 1e-5
        up, down = (Expansion(task, gains, centres + s).cost for s in (step, -step))
        assert 2 / 200 * by_centre[i, j] == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-9)
    for j in range(4):
        grown = [np.exp(s * (np.arange(4) == j)) for s in (1e-5, -1e-5)]
        up, down = (Expansion(task, gains * g, centres * g).cost for g in grown)
        assert 2 / 200 * by_gain[j] == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-9)


def test_steps_never_leave_the_bounds_never_make_it_worse_and_leave_frozen_centres_alone():
    rng = np.random.default_rng(1)
    task = problem(rng)
    start = Expansion(task, np.full(4, 3.5), rng.uniform(-2, 2, (12, 4)))
    better = start.improved(30)
    assert better.cost < 0.5 * start.cost
    assert (np.abs(better.centres) <= 2.0).all() and (better.gains <= 4.0).all()
    frozen = rng.random((12, 4)) < 0.5
    part = start.improved(30, frozen)
    assert part.cost < start.cost and (part.gains == start.gains).all()
    assert (part.centres[frozen] == start.centres[frozen]).all() and (part.centres != start.centres).any()


def test_the_centre_that_is_removed_is_the_one_that_costs_least():
    rng = np.random.default_rng(2)
    start = Expansion(problem(rng), np.full(4, 2.0), rng.uniform(-1, 1, (9, 4)))
    costs = [
        Expansion(start.problem, start.gains, np.delete(start.centres, i, axis=0)).cost for i in range(9)
    ]
    assert start.without(1).cost == pytest.approx(min(costs), rel=1e-9)
    assert len(start.without(4).centres) == 5
