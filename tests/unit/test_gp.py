# SPDX-License-Identifier: Apache-2.0
"""gp.py against scikit-learn, brute force and finite differences, and in the cases where such code breaks."""

import json
import warnings

import numpy as np
import pytest
from gp_reference import CASES, KERNELS, LENGTH, hyper_for, quietly, recording, written_out
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from sparsegaze import gp as module
from sparsegaze.errors import CalibrationError
from sparsegaze.gp import GaussianProcess, Hyper


every_kernel = pytest.mark.parametrize("name, p", KERNELS)


def data(n=60, d=6, seed=0, noise=0.2):
    """Six smooth channels over +-20 deg, in feature units."""
    rng = np.random.default_rng(seed)
    gaze = rng.uniform(-20, 20, (n, 2))
    angle = np.arange(d) * 2 * np.pi / d
    place = 25 * np.stack([np.cos(angle), np.sin(angle)], 1)
    bump = np.exp(-((gaze[:, None] - place) ** 2).sum(-1) / (2 * 18.0**2))
    features = 45000 + 4096 * np.log2(1 - 0.5 * bump) + 5 * rng.standard_normal((n, d))
    return features, gaze + noise * rng.standard_normal((n, 2))


HYPER = Hyper(np.array([900.0, 1200, 700, 1500, 1000, 800]), 12.0, 0.4)


def sklearn_twin(hyper):
    kernel = ConstantKernel(hyper.signal_deg**2) * RBF(hyper.length) + WhiteKernel(hyper.noise_deg**2)
    return GaussianProcessRegressor(kernel, optimizer=None, alpha=0.0)


def covariance(gp):
    x = gp.x / gp.hyper.length
    k = gp.hyper.signal_deg**2 * np.exp(-0.5 * ((x[:, None] - x) ** 2).sum(-1))
    return (
        k
        + gp.hyper.noise_deg**2 * np.diag(gp.noise_scale)
        + gp.hyper.group_deg**2 * (gp.groups[:, None] == gp.groups)
    )


def test_mean_std_and_likelihood_equal_scikit_learns_at_equal_parameters():
    features, gaze = data()
    gp = GaussianProcess.fit(features, gaze, mean="zero", hyper=HYPER)
    twin = sklearn_twin(HYPER).fit(features, gaze)
    query = data(40, seed=5)[0]
    mean, std = gp.predict(query, return_std=True)
    theirs, spread = twin.predict(query, return_std=True)
    np.testing.assert_allclose(mean, theirs, atol=1e-7)
    np.testing.assert_allclose(std, np.sqrt(spread[:, 0] ** 2 - HYPER.noise_deg**2), atol=1e-6)
    assert gp.lml == pytest.approx(twin.log_marginal_likelihood(twin.kernel_.theta), rel=1e-9)


def test_optimised_likelihood_is_not_below_scikit_learns():
    features, gaze = data(80)
    gp = GaussianProcess.fit(features, gaze, mean="zero")
    kernel = ConstantKernel(100.0, (1e-2, 1e8)) * RBF(np.full(6, 1000.0), (10, 1e6)) + WhiteKernel(
        0.1, (1e-6, 1e2)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        twin = GaussianProcessRegressor(kernel, alpha=0.0, n_restarts_optimizer=2, random_state=0).fit(
            features, gaze
        )
    assert gp.lml > twin.log_marginal_likelihood_value_ - 0.5


@pytest.mark.parametrize("mean", ["zero", "constant", "linear"])
def test_leave_one_out_equals_brute_force(mean):
    features, gaze = data(30)
    gp = GaussianProcess.fit(features, gaze, mean=mean, hyper=HYPER)
    predicted, spread = gp.loo()
    for i in range(len(gp.x)):
        rest = np.arange(len(gp.x)) != i
        one, std = GaussianProcess.fit(gp.x[rest], gp.y[rest], mean=mean, hyper=HYPER).predict(
            gp.x[i : i + 1], True
        )
        if mean != "linear":  # a linear mean is scaled by its data
            assert spread[i] == pytest.approx(np.hypot(std[0], HYPER.noise_deg), rel=1e-6)
        np.testing.assert_allclose(predicted[i], one[0], atol=1e-6)


def test_leave_one_group_out_equals_brute_force():
    features, gaze = data(36)
    groups = np.arange(36) // 4
    hyper = Hyper(HYPER.length, 12.0, 0.4, 0.3)
    gp = GaussianProcess.fit(features, gaze, groups=groups, mean="constant", hyper=hyper)
    residual = gp.loo_groups()
    for label in range(9):
        out = gp.groups == label
        rest = GaussianProcess.fit(
            gp.x[~out], gp.y[~out], groups=gp.groups[~out], mean="constant", hyper=hyper
        )
        np.testing.assert_allclose(residual[out], gp.y[out] - rest.predict(gp.x[out]), atol=1e-6)


def test_grouped_and_scaled_noise_enter_the_covariance():
    features, gaze = data(24)
    hyper = Hyper(HYPER.length, 12.0, 0.4, 0.7)
    scale = np.random.default_rng(0).uniform(0.5, 3, 24)
    gp = GaussianProcess.fit(
        features, gaze, noise_scale=scale, groups=np.arange(24) // 3, mean="zero", hyper=hyper
    )
    np.testing.assert_allclose(covariance(gp) @ gp.alpha, gp.y, atol=1e-8)
    assert gp.condition == pytest.approx(np.linalg.cond(covariance(gp)), rel=0.2)
    sign, logdet = np.linalg.slogdet(covariance(gp))
    expected = -0.5 * np.sum(gp.y * np.linalg.solve(covariance(gp), gp.y)) - logdet - 24 * np.log(2 * np.pi)
    assert gp.lml == pytest.approx(expected, rel=1e-9)


def test_order_of_the_samples_is_irrelevant_to_the_bit():
    features, gaze = data(50)
    order = np.random.default_rng(3).permutation(50)
    query = data(20, seed=9)[0]
    np.testing.assert_array_equal(
        GaussianProcess.fit(features, gaze).predict(query),
        GaussianProcess.fit(features[order], gaze[order]).predict(query),
    )


def test_duplicates_and_near_duplicates_without_noise_are_solved_with_reported_jitter():
    features, gaze = data(30)
    twice = np.vstack([features, features, features + 1e-9])
    labels = np.vstack([gaze] * 3)
    gp = GaussianProcess.fit(twice, labels, mean="zero", hyper=Hyper(HYPER.length, 12.0, 0.0))
    assert gp.jitter > 0 and gp.condition > 1e6
    single = GaussianProcess.fit(features, gaze, mean="zero", hyper=Hyper(HYPER.length, 12.0, 0.05))
    assert np.abs(gp.predict(features) - gaze).max() < 0.5
    assert np.isfinite(gp.predict(single.x)).all()


def test_same_input_with_contradicting_labels_becomes_noise():
    features, gaze = data(30, noise=0.0)
    gp = GaussianProcess.fit(
        np.vstack([features, features]), np.vstack([gaze - 1, gaze + 1]), mean="constant"
    )
    assert 0.8 < gp.hyper.noise_deg < 1.3
    assert np.sqrt(np.mean((gp.predict(features) - gaze) ** 2)) < 0.7


def test_a_constant_channel_is_dropped_with_a_warning_and_changes_nothing():
    features, gaze = data(40)
    dead = features.copy()
    dead[:, 2] = 123.0
    with pytest.warns(UserWarning, match="s2"):
        gp = GaussianProcess.fit(dead, gaze)
    assert gp.dropped == (2,) and np.isinf(gp.hyper.length[2])
    without = GaussianProcess.fit(np.delete(dead, 2, 1), gaze)
    query = dead.copy()
    query[:, 2] = 60000.0
    np.testing.assert_allclose(gp.predict(query), without.predict(np.delete(dead, 2, 1)), atol=1e-6)


def test_wildly_different_channel_scales_give_the_same_answer():
    features, gaze = data(50)
    scale = np.array([1.0, 1e-6, 1e6, 1e3, 1e-3, 1.0])
    query = data(20, seed=3)[0]
    np.testing.assert_allclose(
        GaussianProcess.fit(features * scale, gaze).predict(query * scale),
        GaussianProcess.fit(features, gaze).predict(query),
        atol=0.02,
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity_are_refused(bad):
    features, gaze = data(20)
    features[3, 1] = bad
    with pytest.raises(CalibrationError, match="nan or infinity"):
        GaussianProcess.fit(features, gaze)
    with pytest.raises(CalibrationError, match="nan or infinity"):
        GaussianProcess.fit(gaze, features[:, :2])


@pytest.mark.parametrize(
    "n, mean, needed", [(0, "linear", None), (2, "linear", 9), (5, "linear", 9), (2, "constant", 3)]
)
def test_too_few_points_are_refused_with_the_number_needed(n, mean, needed):
    features, gaze = data(20)
    with pytest.raises(CalibrationError) as caught:
        GaussianProcess.fit(features[:n], gaze[:n], mean=mean)
    assert needed is None or str(needed) in caught.value.remedy


def test_five_points_give_a_finite_smooth_answer_with_a_constant_mean():
    features, gaze = data(5)
    gp = GaussianProcess.fit(features, gaze, mean="constant")
    assert np.abs(gp.predict(data(50, seed=2)[0])).max() < 60


def test_no_channel_varies_and_channels_that_copy_each_other_are_refused():
    gaze = data(20)[1]
    with pytest.raises(CalibrationError, match="no channel"):
        GaussianProcess.fit(np.ones((20, 6)), gaze)
    copied = np.repeat(data(20)[0][:, :1], 6, axis=1)
    with pytest.raises(CalibrationError, match="linear"):
        GaussianProcess.fit(copied, gaze, mean="linear")
    assert np.isfinite(GaussianProcess.fit(copied, gaze, mean="constant").lml)


def test_all_targets_on_a_line_and_all_targets_equal():
    features, gaze = data(40)
    gaze[:, 1] = 3.0
    gp = GaussianProcess.fit(features, gaze, mean="constant")
    np.testing.assert_allclose(gp.predict(features)[:, 1], 3.0, atol=0.2)
    gaze[:, 0] = -1.0
    np.testing.assert_allclose(
        GaussianProcess.fit(features, gaze, mean="constant").predict(features), gaze, atol=1e-3
    )


def test_condition_number_near_1e16_still_predicts():
    features, gaze = data(200, noise=0.0)
    with pytest.warns(UserWarning, match="singular to float64"):
        gp = GaussianProcess.fit(features, gaze, mean="zero", hyper=Hyper(HYPER.length * 50, 1e4, 1e-4))
    assert gp.jitter > 0 and gp.condition_raw > 1e15 and "float64" in gp.describe()["condition_note"]
    assert np.isfinite(gp.predict(features)).all()


def test_prediction_in_blocks_is_prediction_at_once(monkeypatch):
    features, gaze = data(30)
    gp = GaussianProcess.fit(features, gaze, hyper=HYPER)
    whole = gp.predict(features, True)
    monkeypatch.setattr(module, "_blocks", lambda n, width: [slice(i, min(i + 7, n)) for i in range(0, n, 7)])
    for a, b in zip(whole, gp.predict(features, True)):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_unknown_mean_is_a_programming_error():
    with pytest.raises(ValueError, match="cubic"):
        GaussianProcess.fit(*data(20), mean="cubic")


@every_kernel
@pytest.mark.parametrize("mean", ["zero", "constant", "linear"])
def test_the_gradient_of_the_mean_equals_high_order_differences(name, p, mean):
    features, gaze = recording(40)
    gp = quietly(features, gaze, mean=mean, kernel=name, p=p, hyper=hyper_for(name, 3.0, 30.0, 0.3))
    query = recording(8, seed=7)[0]
    slope = gp.gradient(query)
    for j in range(6):
        step = np.zeros(6)
        step[j] = 0.5
        at = {k: gp.predict(query + k * step) for k in (-3, -2, -1, 1, 2, 3)}
        expected = ((at[3] - at[-3]) / 60 - 3 * (at[2] - at[-2]) / 20 + 3 * (at[1] - at[-1]) / 4) / 0.5
        # At a sample of the same value in channel j kernels with a cusp have none; they avoid it by > 2.
        apart = np.abs(query[:, None, j] - gp.x[:, j]).min(axis=1) > 2.0
        smooth = name in ("rbf", "matern52", "cosine")
        rows = np.ones(8, bool) if smooth else apart
        np.testing.assert_allclose(slope[rows, :, j], expected[rows], rtol=2e-4, atol=2e-6)


@every_kernel
def test_describe_is_json_and_names_what_a_reader_needs(name, p):
    gp = quietly(*recording(30), mean="constant", kernel=name, p=p, restarts=0)
    told = json.loads(json.dumps(gp.describe(), allow_nan=False))
    assert told["kernel"] == name and told["lml"] == gp.lml and told["rows"] == told["rows_given"] == 30
    keys = {"formula", "length_unit", "condition", "jitter", "loo_rms_deg", "rounding_deg", "repair", "p"}
    assert keys <= set(told)


def test_learning_on_a_part_and_polishing_on_all_reaches_the_likelihood_of_learning_on_all():
    features, gaze = recording(240)
    whole = quietly(features, gaze, mean="constant", restarts=0)
    part = quietly(features, gaze, mean="constant", restarts=0, learn_rows=100)
    assert part.lml > whole.lml - 0.5
    assert 0 <= part.likelihood_gap(restarts=0) < 1.0
    poor = quietly(features, gaze, mean="constant", hyper=Hyper(LENGTH, 30.0, 1.0))
    assert poor.likelihood_gap(restarts=0) == pytest.approx(whole.lml - poor.lml, abs=1.0)


@pytest.mark.parametrize("mean", ["zero", "constant", "linear"])
@pytest.mark.parametrize("case", [case for case in CASES if case not in ("p=3", "p=10", "p=inf")])
def test_mean_and_deviation_equal_the_equations_of_universal_kriging(case, mean):
    """R & W equations 2.41 and 2.42 by dense solves, the kernel written out, for every kernel."""
    features, gaze = recording(30)
    query = recording(12, seed=2)[0]
    name, p, exponent = CASES[case]
    hyper = hyper_for(name, 2.0, 25.0, 0.4)
    scale = np.random.default_rng(1).uniform(0.5, 2, 30)
    gp = quietly(features, gaze, scale, mean=mean, hyper=hyper, kernel=name, p=p, exponent=exponent)
    k = 625.0 * written_out(case, features, features, hyper.length).real + 0.16 * np.diag(scale)
    cross = 625.0 * written_out(case, query, features, hyper.length).real
    h, at = {
        "zero": lambda x: np.empty((len(x), 0)),
        "constant": lambda x: np.ones((len(x), 1)),
        "linear": lambda x: np.hstack([np.ones((len(x), 1)), (x - 45000) / 1000]),
    }[mean], np.linalg.solve(k, cross.T)
    normal = h(features).T @ np.linalg.solve(k, h(features))
    b = np.linalg.solve(normal, h(features).T @ np.linalg.solve(k, gaze))
    r = h(query).T - h(features).T @ at
    expected = h(query) @ b + cross @ np.linalg.solve(k, gaze - h(features) @ b)
    variance = 625.0 - np.sum(cross * at.T, axis=1) + np.sum(r * np.linalg.solve(normal, r), axis=0)
    got, std = gp.predict(query, return_std=True)
    np.testing.assert_allclose(got, expected, atol=1e-6)
    np.testing.assert_allclose(std, np.sqrt(variance), rtol=1e-5)


def test_refining_given_parameters_reaches_the_likelihood_of_learning():
    features, gaze = recording(300)
    learnt = quietly(features, gaze, mean="constant", restarts=0)
    near = Hyper(learnt.hyper.length * 1.3, learnt.hyper.signal_deg * 0.8, learnt.hyper.noise_deg * 1.2)
    given = quietly(features, gaze, mean="constant", hyper=near)
    refined = quietly(features, gaze, mean="constant", hyper=near, refine=True, learn_rows=100)
    assert given.lml < learnt.lml - 5 and refined.lml > learnt.lml - 0.1


@pytest.mark.parametrize(
    "hyper, words",
    [
        (Hyper(LENGTH[:5], 10.0, 0.1), "5 length scales for 6 channels"),
        (Hyper(-LENGTH, 10.0, 0.1), "must be above 0"),
        (Hyper(np.full(6, np.inf), 10.0, 0.1), "finite"),
        (Hyper(LENGTH, 0.0, 0.1), "signal_deg"),
        (Hyper(LENGTH, 10.0, -0.1), "noise_deg"),
        (Hyper(LENGTH, np.nan, 0.1), "signal_deg"),
    ],
)
def test_impossible_parameters_are_refused_in_words(hyper, words):
    with pytest.raises(CalibrationError, match=words):
        GaussianProcess.fit(*recording(20), mean="constant", hyper=hyper)
