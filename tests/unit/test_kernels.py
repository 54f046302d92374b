# SPDX-License-Identifier: Apache-2.0
"""kernels.py and likelihood.py against formulas written out, complex steps and theorems on definiteness."""

import numpy as np
import pytest
from gp_reference import CASES, written_out

from sparsegaze.errors import CalibrationError
from sparsegaze.kernels import NAMES, kernel
from sparsegaze.likelihood import Likelihood, maximise, refine

DEFINITE = [name for name in CASES if name not in ("p=3", "p=10", "p=inf")]
all_cases = pytest.mark.parametrize("case", CASES)


def points(n=20, d=4, seed=0):
    """Positive, so that every measure is defined."""
    return np.random.default_rng(seed).uniform(0.5, 3.0, (n, d))


def lengths(made, d, seed=0):
    return np.random.default_rng([7, seed]).uniform(0.6, 2.0, d if made.per_channel else 1)


@all_cases
def test_the_kernel_is_its_formula(case):
    made = kernel(*CASES[case])
    a, b = points(), points(15, seed=1)
    length = lengths(made, 4)
    expected = written_out(case, a, b, length).real
    np.testing.assert_allclose(made.value(a, b, length), expected, rtol=1e-12, atol=1e-15)
    own = made.value(a, a, length)
    np.testing.assert_allclose(np.diag(own), 1.0, atol=1e-7 if CASES[case][2] else 1e-12)
    assert own.max() <= 1.0 + 1e-12 and made.formula().startswith(("exp", "("))


@all_cases
def test_the_slope_in_the_features_equals_high_order_differences(case):
    made = kernel(*CASES[case])
    x, query = points(), points(40, seed=1)
    query = query[(np.abs(query[:, None] - x) > 0.02).all((1, 2))][:9]  # a cusp has no slope
    length, alpha = lengths(made, 4), np.random.default_rng(3).standard_normal((20, 2))
    if case == "p=inf":  # nor has this where two channels tie
        ordered = np.sort(np.abs(query[:, None] - x) / length, axis=-1)
        query = query[(ordered[..., -1] - ordered[..., -2] > 1e-3).all(axis=1)]
    assert len(query) > 3
    slope = made.slope(query, x, length, alpha)
    for j in range(4):
        step = np.zeros(4)
        step[j] = 3e-5
        at = {k: made.value(query + k * step, x, length) @ alpha for k in (-3, -2, -1, 1, 2, 3)}
        expected = (at[3] - at[-3]) / 60 - 3 * (at[2] - at[-2]) / 20 + 3 * (at[1] - at[-1]) / 4
        np.testing.assert_allclose(slope[:, :, j], expected / 3e-5, rtol=1e-6, atol=1e-7)


def reference_likelihood(case, theta, x, unit, y, h, noise_scale, groups, noise_free):
    """Log marginal likelihood by dense solves and a determinant, for complex theta."""
    made = kernel(*CASES[case])
    value = np.exp(theta)
    count = len(unit)
    k = value[count] ** 2 * written_out(case, x, x, value[:count] * unit)
    rest = list(value[count + 1 :] ** 2)
    k = k + np.diag(np.full(len(x), 1e-10 * value[count] ** 2) if noise_free else rest.pop(0) * noise_scale)
    if rest:
        k = k + rest[0] * (groups[:, None] == groups)
    assert made.definite(x.shape[1])
    r = y - h @ np.linalg.solve(h.T @ np.linalg.solve(k, h), h.T @ np.linalg.solve(k, y)) if h.shape[1] else y
    sign, size = np.linalg.slogdet(k)
    return -0.5 * np.sum(r * np.linalg.solve(k, r)) - np.log(sign + 0j) - size - len(x) * np.log(2 * np.pi)


def problem(case, mean="linear", noise_free=False, grouped=False, n=25, d=3):
    made = kernel(*CASES[case])
    rng = np.random.default_rng(2)
    x, y = points(n, d), rng.standard_normal((n, 2))
    z, unit, _ = made.natural(x)
    one = np.ones((n, 1))
    h = {"zero": one[:, :0], "constant": one, "linear": np.hstack([one, x])}[mean]
    groups = np.arange(n) // 3
    whole = Likelihood(made, z, unit, y, h, rng.uniform(0.5, 2, n), groups, noise_free, grouped)
    size = len(unit) + 1 + (not noise_free) + grouped
    return whole, np.log(rng.uniform(0.3, 1.2, size))


@pytest.mark.parametrize("stacked", [True, False])
@pytest.mark.parametrize(
    "mean, noise_free, grouped",
    [("zero", False, False), ("constant", False, True), ("linear", False, False), ("zero", True, False)],
)
@pytest.mark.parametrize("case", DEFINITE)
def test_the_likelihood_and_its_gradient_equal_a_complex_step(case, mean, noise_free, grouped, stacked):
    whole, theta = problem(case, mean, noise_free, grouped)
    if not stacked:
        whole._stack = None
    value, slope = whole(theta)
    args = whole.z, whole.unit, whole.y, whole.h, whole.noise_scale, whole.groups, noise_free
    assert value == pytest.approx(reference_likelihood(case, theta + 0j, *args).real, rel=1e-9)
    for i in range(len(theta)):
        step = np.zeros(len(theta), complex)
        step[i] = 1e-25j
        expected = reference_likelihood(case, theta + step, *args).imag / 1e-25
        assert slope[i] == pytest.approx(expected, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("p", [3.0, 10.0, np.inf])
def test_the_gradient_of_the_repaired_likelihood_equals_high_order_differences(p):
    made = kernel("minkowski", p)
    rng = np.random.default_rng(1)
    n = 150
    x = rng.standard_normal((n, 6))
    z, unit, _ = made.natural(x)
    whole = Likelihood(made, z, unit, rng.standard_normal((n, 2)), np.ones((n, 1)), np.ones(n), np.arange(n))
    theta = np.log(np.r_[rng.uniform(20, 40, 6), 2.0, 0.3])
    values = np.linalg.eigvalsh(made.value(z, z, np.exp(theta[:6])))
    assert values[0] < -1e-4  # else nothing is repaired here
    _, slope = whole(theta)
    for i in range(len(theta)):
        step = np.zeros(len(theta))
        step[i] = h = 1e-6 if np.isinf(p) else 3e-5  # p = inf has a kink wherever two channels tie
        at = {k: whole(theta + k * step)[0] for k in (-2, -1, 1, 2)}
        expected = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / 12 / h
        assert slope[i] == pytest.approx(expected, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("case", DEFINITE)
def test_definite_kernels_have_no_negative_eigenvalue_on_hard_point_sets(case):
    made = kernel(*CASES[case])
    rng = np.random.default_rng(5)
    corners = 1.5 + np.array(np.meshgrid(*[[-1.0, 1.0]] * 6)).reshape(6, -1).T
    axes = 5.0 + np.vstack([4 * np.eye(6), -4 * np.eye(6), np.zeros((1, 6))])
    for x in (rng.uniform(0.1, 3, (80, 6)), corners, axes, np.repeat(points(9, 6), 2, axis=0)):
        for scale in (0.3, 3.0, 30.0):
            length = scale * lengths(made, 6)
            assert made.definite(6)
            assert np.linalg.eigvalsh(made.value(x, x, length))[0] > -1e-13 * len(x)


@pytest.mark.parametrize("p", [3.0, 10.0, np.inf])
def test_p_above_2_is_indefinite_in_six_channels_and_definite_in_two(p):
    made = kernel("minkowski", p)
    x = np.random.default_rng(1).standard_normal((200, 6))
    assert not made.definite(6) and np.linalg.eigvalsh(made.value(x, x, np.full(6, 30.0)))[0] < -1e-3
    two = x[:, :2]
    assert made.definite(2) and np.linalg.eigvalsh(made.value(two, two, np.full(2, 30.0)))[0] > -1e-12


@pytest.mark.parametrize(
    "name, p, squared",
    [("laplace", None, 2.0), ("minkowski", 1.5, 2.0), ("canberra", None, 2.0), ("minkowski", 0.5, 1.0)],
)
def test_squares_of_distances_that_must_not_be_squared_are_refused_in_words(name, p, squared):
    with pytest.raises(CalibrationError, match="no covariance for the .* distance.*at most"):
        kernel(name, p, squared)
    x = np.random.default_rng(2).uniform(0.1, 3, (200, 6))
    good = kernel(name, p)
    distance = good.distance(x, x, np.full(6, 30.0)) ** (1 / (p or 1.0))
    assert np.linalg.eigvalsh(np.exp(-(distance**squared)))[0] < -1e-4  # they are refused for a reason


@pytest.mark.parametrize(
    "args, words",
    [
        (("gauss",), "no kernel 'gauss'.*rbf, matern52"),
        (("minkowski",), "needs its order p"),
        (("minkowski", 0.0), "above 0, not 0"),
        (("minkowski", -1.0), "above 0"),
        (("minkowski", np.nan), "above 0"),
        (("rbf", 3.0), "has no order p"),
        (("cosine", None, 2.0), "is fixed"),
    ],
)
def test_what_is_no_kernel_is_refused_in_words(args, words):
    with pytest.raises(CalibrationError, match=words):
        kernel(*args)


def test_measures_are_refused_where_they_are_undefined():
    with pytest.raises(CalibrationError, match="below 0"):
        kernel("canberra").check(np.array([[1.0, -1e-9]]))
    kernel("canberra").check(np.zeros((2, 3)))
    with pytest.raises(CalibrationError, match="all 0"):
        kernel("cosine").check(np.array([[1.0, 0.0], [0.0, 0.0]]))


def test_canberra_is_the_hyperbolic_tangent_of_half_the_difference_of_logarithms():
    x = points(12, 1)
    half = np.abs(np.log(x) - np.log(x).T) / 2
    got = kernel("canberra").value(x, x, [0.4])
    np.testing.assert_allclose(got, np.exp(-np.tanh(half) / 0.4), rtol=1e-12)
    zero = np.array([[0.0], [1.0]])
    np.testing.assert_allclose(kernel("canberra").value(zero, zero, [1.0]), np.exp([[0, -1], [-1, 0]]))


def test_the_cosine_of_nearly_parallel_samples_keeps_its_digits():
    angle = 1e-9
    a, b = np.array([[1.0, 0.0]]), np.array([[np.cos(angle), np.sin(angle)]])
    assert 1 - kernel("cosine").value(a, b, [1e-5])[0, 0] == pytest.approx(angle**2 / 2e-10, rel=1e-6)


@pytest.mark.parametrize("p", [3.0, 10.0, 200.0])
def test_a_large_p_neither_overflows_nor_underflows(p):
    made = kernel("minkowski", p)
    for scale in (1e-120, 1.0, 1e120):
        x = scale * points(6, 3)
        expected = np.exp(-np.sum((np.abs(x[:, None] - x) / scale) ** p, -1) ** (1 / p))
        np.testing.assert_allclose(made.value(x, x, np.full(3, scale)), expected, rtol=1e-10)
    largest = np.exp(-(np.abs(x[:, None] - x) / scale).max(-1))
    got = kernel("minkowski", np.inf).value(x, x, np.full(3, scale))
    np.testing.assert_allclose(got, largest, rtol=1e-10)


@pytest.mark.parametrize("case", ["rbf", "laplace", "canberra", "cosine"])
def test_refining_from_a_part_reaches_the_maximum_of_the_whole(case):
    rng = np.random.default_rng(4)
    made = kernel(*CASES[case])
    gaze = rng.uniform(-1, 1, (240, 2))
    x = 2 + np.stack([np.sin(gaze @ v) for v in ([1, 0], [0, 1], [1, 1], [1, -1.0])], 1)
    z, unit, _ = made.natural(x)
    y = gaze + 0.05 * rng.standard_normal((240, 2))
    whole = Likelihood(made, z, unit, y, np.ones((240, 1)), np.ones(240), np.arange(240))
    part = whole.part(np.arange(0, 240, 3))
    start, _ = maximise(part, [part.start()], 100.0)
    before = whole(start)[0]
    theta, value, used = refine(whole, part, start, 100.0, 14)
    _, best = maximise(whole, [start], 100.0, tight=True)
    assert used <= 14 and before + 0.1 < value <= best + 1e-4 and value > best - 0.01


def test_every_name_is_tested():
    assert {case[0] for case in CASES.values()} == set(NAMES)
