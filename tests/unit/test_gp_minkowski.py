# SPDX-License-Identifier: Apache-2.0
"""Minkowski's p = 0.5, 1, 1.5, 2, 3, 10 and infinity: what each must do, and what a repair must hold."""

import numpy as np
import pytest
from gp_reference import LENGTH, quietly, recording

from sparsegaze import gp as module
from sparsegaze.errors import CalibrationError
from sparsegaze.gp import GaussianProcess, Hyper
from sparsegaze.repair import Repair


@pytest.mark.parametrize("p", [0.5, 1.0, 1.5, 2.0])
def test_p_up_to_2_is_positive_definite_and_needs_no_repair(p):
    features, gaze = recording(60)
    gp = quietly(features, gaze, mean="constant", kernel="minkowski", p=p, restarts=0)
    told = gp.describe()
    assert gp.repair is None and told["positive_definite"] and told["p"] == p and gp.jitter == 0
    error = np.linalg.norm(gp.y - gp.loo()[0], axis=1)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(told["loo_rms_deg"]) and told["loo_rms_deg"] < 5


def test_p_1_is_laplace_and_p_2_is_rbf_of_another_length():
    features, gaze = recording(30)
    query, hyper = recording(10, seed=1)[0], Hyper(LENGTH, 20.0, 0.3)
    for p, name, factor in ((1.0, "laplace", 1.0), (2.0, "rbf", np.sqrt(0.5))):
        a = GaussianProcess.fit(features, gaze, hyper=hyper, kernel="minkowski", p=p)
        b = GaussianProcess.fit(features, gaze, hyper=Hyper(LENGTH * factor, 20.0, 0.3), kernel=name)
        np.testing.assert_allclose(a.predict(query), b.predict(query), atol=1e-8)


def indefinite(n=200):
    """Samples that fill six dimensions, on which p > 2 shows: (features [n, 6], gaze [n, 2], Hyper)."""
    rng = np.random.default_rng(1)
    z = rng.standard_normal((n, 6))
    noise = np.random.default_rng(2).standard_normal((n, 2))
    gaze = 8 * np.stack([np.sin(z[:, 0]) + z[:, 1], z[:, 2]], 1) + 0.3 * noise
    return 40000 + 1000 * z, gaze, Hyper(np.full(6, 3e4), 20.0, 2.0)


@pytest.mark.parametrize("p", [3.0, 10.0, np.inf])
def test_p_above_2_is_repaired_in_words_and_predicts_consistently(p):
    features, gaze, hyper = indefinite()
    with pytest.warns(UserWarning, match="gives no covariance in 3 or more channels.*values.*were removed"):
        gp = GaussianProcess.fit(features, gaze, mean="constant", kernel="minkowski", p=p, hyper=hyper)
    assert gp.repair["smallest_eigenvalue"] < -1e-3 and 0 < gp.repair["removed_share"] < 0.5
    assert gp.repair["negative"] > 0 and gp.repair["rank"] + gp.repair["negative"] <= 200
    assert not gp.describe()["positive_definite"] and "removed" in gp.describe()["repair"]["words"]
    # The matrix that is solved is a covariance: no eigenvalue is below the noise.
    solved = gp._factor[0] @ gp._factor[0].T
    noise2 = gp.hyper.noise_deg**2 + gp.repair["noise_deg"] ** 2
    assert np.linalg.eigvalsh(solved)[0] > 0.99 * noise2
    # It is the kernel's own matrix less its negative part ...
    own = gp._kernel(gp.x) + noise2 * np.eye(200)
    least = np.linalg.eigvalsh(own - noise2 * np.eye(200))[0]
    assert np.linalg.norm(solved - own, 2) == pytest.approx(-least, rel=1e-6)
    assert gp.repair["noise_deg"] ** 2 == pytest.approx(-least, rel=1e-6)
    # ... and predictions at the data are that matrix's: S y with S = K+ (K+ + noise)^-1 and a constant.
    one = np.ones((200, 1))
    inside = solved - noise2 * np.eye(200)
    b = np.linalg.solve(one.T @ np.linalg.solve(solved, one), one.T @ np.linalg.solve(solved, gp.y))
    expected = inside @ np.linalg.solve(solved, gp.y - one @ b) + one @ b
    np.testing.assert_allclose(gp.predict(gp.x), expected, atol=1e-6)
    mean, std = gp.predict(gp.x + 300.0, return_std=True)
    assert np.isfinite(mean).all() and std.min() > 0
    assert gp.repair["held_out_deg"] < gp.repair["claimed_deg"]


def test_a_repair_under_forced_parameters_claims_no_more_than_it_holds():
    """A long length scale and hardly any noise: the repair brings the noise that it needs."""
    features, gaze, _ = indefinite()
    hyper = Hyper(np.full(6, 3e4), 60.0, 0.03)
    for p in (3.0, 10.0, np.inf):
        gp = quietly(features, gaze, mean="constant", kernel="minkowski", p=p, hyper=hyper)
        assert gp.repair["noise_deg"] > 1 and gp.repair["held_out_deg"] < gp.repair["claimed_deg"]


def test_a_repair_that_misses_by_more_than_it_claims_is_refused(monkeypatch):
    """Negative control: removal without the noise misses by tens of degrees, and does not pass for a fit."""

    class Silent(Repair):
        noise = property(lambda self: 0.0, lambda self, value: None)

    monkeypatch.setattr(module, "Repair", Silent)
    features, gaze, _ = indefinite()
    hyper = Hyper(np.full(6, 3e4), 60.0, 0.03)
    with pytest.raises(CalibrationError, match="p = 10 cannot be repaired.*use p of at most 2"):
        quietly(features, gaze, mean="constant", kernel="minkowski", p=10.0, hyper=hyper)


def test_p_above_2_learns_where_it_has_to_be_repaired():
    features, gaze, _ = indefinite(300)
    gp = quietly(features[:200], gaze[:200], mean="constant", kernel="minkowski", p=10.0)
    assert np.sqrt(np.mean((gp.predict(features[200:]) - gaze[200:]) ** 2)) < 2.5


@pytest.mark.parametrize("p", [3.0, 10.0])
def test_p_above_2_learns_and_says_when_nothing_had_to_be_removed(p):
    features, gaze = recording(70)
    gp = quietly(features, gaze, mean="constant", kernel="minkowski", p=p, restarts=0)
    assert gp.repair["negative"] == 0 and "nothing had to be removed" in gp.repair["words"]
    error = gp.predict(recording(100, 6)[0]) - recording(100, 6)[1]
    assert np.sqrt(np.mean(error**2)) < 3


def test_leave_one_out_of_a_repaired_process_is_that_of_its_matrix():
    features, gaze, hyper = indefinite()
    gp = quietly(features, gaze, mean="zero", kernel="minkowski", p=10.0, hyper=hyper)
    solved = gp._factor[0] @ gp._factor[0].T
    assert gp.repair["negative"] > 0
    predicted, _ = gp.loo()
    for i in (0, 13, 39):
        rest = np.arange(200) != i
        expected = solved[i, rest] @ np.linalg.solve(solved[np.ix_(rest, rest)], gp.y[rest])
        np.testing.assert_allclose(predicted[i], expected, atol=1e-6)


@pytest.mark.parametrize("p", [3.0, 10.0])
def test_p_above_2_in_two_channels_is_a_covariance_and_left_alone(p):
    features, gaze = recording(40)
    gp = quietly(features[:, :2], gaze, mean="constant", kernel="minkowski", p=p, restarts=0)
    assert gp.repair is None and gp.describe()["positive_definite"]
