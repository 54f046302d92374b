# SPDX-License-Identifier: Apache-2.0
"""The few-point correction: shrinkage, leave-one-out against leaving out, rounding, when to do nothing."""
import numpy as np
import pytest

from sparsegaze import correction

TRUE_GAIN = np.array([[0.10, -0.04], [0.03, -0.08]])
TRUE_OFFSET = np.array([1.5, -2.5])


def seen(targets, gain=TRUE_GAIN, offset=TRUE_OFFSET, noise=0.0, seed=0):
    """The model's outputs whose exact correction is gain and offset, with errors of `noise` deg."""
    targets = np.asarray(targets, float)
    errors = np.random.default_rng(seed).normal(0, noise, targets.shape) if noise else 0.0
    return np.linalg.solve(np.eye(2) + gain, (targets + errors - offset).T).T


@pytest.mark.parametrize("n", range(4, 10))
def test_exact_points_give_the_gain_shrunken_and_the_offset(n):
    targets = correction.points(n)
    found = correction.fit(seen(targets), targets)
    assert found.kind == "affine" and found.affine_error_deg < found.offset_error_deg
    ratio = np.array(found.gain) / TRUE_GAIN
    assert (0.3 < ratio).all() and (ratio < 1.05).all()
    assert np.allclose(found.offset_deg, TRUE_OFFSET, atol=0.35)
    after = seen(targets) @ (np.eye(2) + np.array(found.gain)).T + found.offset_deg
    assert np.hypot(*(after - targets).T).mean() < 0.6 * found.offset_error_deg


def test_three_points_cannot_vouch_for_a_gain_of_a_tenth():
    found = correction.fit(seen(correction.points(3)), correction.points(3))
    assert found.kind == "offset" and found.affine_error_deg > found.offset_error_deg


def test_more_points_shrink_less():
    targets = [correction.points(n) for n in (4, 6, 9)]
    shrunken = [correction.fit(seen(at), at).gain[0][0] for at in targets]
    assert 0 < shrunken[0] < shrunken[1] < shrunken[2] < 0.105


def test_points_close_together_give_an_offset_almost_alone():
    targets = correction.points(5) * 0.1
    found = correction.fit(seen(targets), targets)
    assert np.abs(found.gain).max() < 0.01
    assert np.allclose(np.array(found.offset_deg), (targets - seen(targets)).mean(axis=0), atol=0.05)


def test_noise_without_a_gain_is_an_offset_almost_alone():
    targets, kinds, gains = correction.points(5), [], []
    for seed in range(200):
        found = correction.fit(seen(targets, np.zeros((2, 2)), noise=0.7, seed=seed), targets)
        kinds.append(found.kind)
        gains.append(np.abs(found.gain).max())
        assert np.hypot(*(found.offset_deg - TRUE_OFFSET)) < 2.0
    assert kinds.count("offset") > 100 and np.mean(gains) < 0.02


@pytest.mark.parametrize("n", [3, 5, 9])
def test_the_leave_one_out_errors_are_those_of_leaving_one_out(n):
    targets = correction.points(n)
    g = seen(targets, noise=0.8)
    found = correction.fit(g, targets)
    shift, whole = [], []
    penalty = np.diag([0, 1, 1]) * (correction.POINT_SIGMA_DEG / correction.GAIN_SIGMA) ** 2
    for i in range(n):
        rest = np.arange(n) != i
        shift.append(np.hypot(*(targets[i] - g[i] - (targets - g)[rest].mean(axis=0))))
        x = np.column_stack([np.ones(n), g])
        b = np.linalg.solve(x[rest].T @ x[rest] + penalty, x[rest].T @ (targets - g)[rest])
        whole.append(np.hypot(*(targets[i] - g[i] - x[i] @ b)))
    assert found.offset_error_deg == pytest.approx(np.mean(shift), rel=1e-9)
    assert found.affine_error_deg == pytest.approx(np.mean(whole), rel=1e-9)


def test_what_is_in_force_stays_when_it_is_as_good():
    targets = correction.points(5)
    g = seen(targets, noise=0.5, seed=3)
    first = correction.fit(g, targets)
    again = correction.fit(g, targets, first.offset_deg, first.gain)
    assert again.kind == "none" and again.offset_deg == first.offset_deg and again.gain == first.gain
    assert again.before_deg < again.affine_error_deg and again.predicted_deg == again.before_deg


def test_a_headset_that_did_not_slip_is_mostly_left_alone():
    targets, flat = correction.points(5), np.zeros((2, 2))
    found = [correction.fit(seen(targets, flat, np.zeros(2), 0.7, seed), targets) for seed in range(200)]
    left = [fit for fit in found if fit.kind == "none"]
    assert len(left) > 120
    assert all(fit.offset_deg == (0.0, 0.0) and fit.gain == ((0, 0), (0, 0)) for fit in left)


def test_gains_are_steps_of_the_device_and_the_offset_makes_up_for_their_rounding():
    targets = correction.points(9)
    g = seen(targets)
    found = correction.fit(g, targets)
    steps = np.array(found.gain) * 512
    assert (steps == np.round(steps)).all() and np.abs(steps).max() <= 127
    left = targets - g - g @ np.array(found.gain).T - found.offset_deg
    assert np.allclose(left.mean(axis=0), 0, atol=1e-12)


def test_a_gain_beyond_what_the_device_holds_stops_at_its_limit():
    targets = correction.points(9)
    found = correction.fit(seen(targets, np.diag([0.9, -0.6])), targets)
    assert correction.GAIN_LIMIT == 127 / 512
    assert (found.gain[0][0], found.gain[1][1]) == (correction.GAIN_LIMIT, -correction.GAIN_LIMIT)


def test_undo_is_the_inverse_of_the_correction_also_at_the_limits():
    g = np.random.default_rng(1).uniform(-25, 25, (50, 2))
    for signs in ((1, 1, 1, 1), (-1, 1, 1, -1), (-1, -1, -1, -1)):
        gain = correction.GAIN_LIMIT * np.reshape(signs, (2, 2))
        assert np.allclose(correction.undo(g + TRUE_OFFSET + g @ gain.T, TRUE_OFFSET, gain), g)


def test_the_order_of_the_points_does_not_matter():
    targets = correction.points(7)
    g = seen(targets, noise=0.6)
    order = np.random.default_rng(0).permutation(7)
    one, other = correction.fit(g, targets), correction.fit(g[order], targets[order])
    assert one.gain == other.gain and np.allclose(one.offset_deg, other.offset_deg, atol=1e-12)


def test_points_stay_on_the_screen_and_cover_all_directions():
    assert correction.points(1).tolist() == [[0, 0]]
    for n in range(3, 10):
        at = correction.points(n, reach_deg=(12.0, 6.0))
        assert at.shape == (n, 2) and (np.abs(at) <= [12.0 + 1e-9, 6.0 + 1e-9]).all()
        wide = correction.points(n)
        assert np.allclose(wide.mean(axis=0), 0, atol=1e-9) and np.abs(wide).max() <= 15 + 1e-9
        assert np.linalg.eigvalsh(wide.T @ wide / n).min() > 80     # deg^2: no axis is left out
    for n in (0, 2, 10):
        with pytest.raises(ValueError, match="3 to 9"):
            correction.points(n)


@pytest.mark.parametrize("g, targets", [
    ([[0, 0], [1, 1]], [[0, 0], [1, 1]]), ([[0, 0, 0]] * 3, [[0, 0, 0]] * 3), ([[0, 0]] * 3, [[0, 0]] * 4),
    ([[0, np.nan]] * 3, [[0, 0]] * 3), ([[0, 0]] * 3, [[0, np.inf]] * 3)])
def test_too_few_points_and_numbers_that_are_none_are_refused(g, targets):
    with pytest.raises(ValueError):
        correction.fit(g, targets)


def test_points_all_in_one_place_give_the_offset_alone():
    found = correction.fit([[1.0, 2.0]] * 4, [[3.0, 1.0]] * 4)
    assert found.gain == ((0.0, 0.0), (0.0, 0.0)) and np.allclose(found.offset_deg, (2.0, -1.0))
