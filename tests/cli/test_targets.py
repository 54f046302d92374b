# SPDX-License-Identifier: Apache-2.0
"""Target plans: what they cover, that they can be repeated, that validation is held out."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from sparsegaze import targets


def nearest(points, others):
    return np.hypot(*(points[:, None] - others[None]).transpose(2, 0, 1)).min(axis=1)


@settings(max_examples=60, deadline=None)
@given(n=st.integers(9, 300), seed=st.integers(0, 2**31))
def test_calibration_stays_inside_its_range_and_returns_to_the_centre(n, seed):
    plan = targets.calibration_plan(n, seed)
    assert plan.target_deg.shape == (n, 2) and len(plan) == n
    assert np.abs(plan.target_deg).max() <= targets.CALIBRATION_RANGE_DEG
    assert (plan.target_deg == 0).all(axis=1).sum() >= max(1, n // 30)
    assert (plan.target_deg[0] == 0).all()


@settings(max_examples=60, deadline=None)
@given(n=st.integers(1, 100), seed=st.integers(0, 2**31))
def test_validation_stays_inside_20_deg_and_is_held_out(n, seed):
    calibration = targets.calibration_plan(seed=seed).target_deg
    plan = targets.validation_plan(n, seed)
    assert plan.target_deg.shape == (n, 2)
    assert np.abs(plan.target_deg).max() <= targets.VALIDATION_RANGE_DEG
    if n <= 25:
        assert nearest(plan.target_deg, calibration).min() >= targets.HELD_OUT_DEG


def test_every_corner_and_every_part_of_the_field_is_calibrated():
    plan = targets.calibration_plan().target_deg
    r = targets.CALIBRATION_RANGE_DEG
    assert nearest(np.array([[-r, -r], [-r, r], [r, -r], [r, r]]), plan).max() == 0.0
    grid = np.array([(a, e) for a in np.linspace(-20, 20, 41) for e in np.linspace(-20, 20, 41)])
    assert nearest(grid, plan).max() < 5.0  # 120 points on 44 x 44 degrees are about 4 degrees apart


def test_validation_targets_are_spread_over_the_field():
    plan = targets.validation_plan().target_deg
    assert sorted(
        np.floor((plan[:, 0] + 20) / 8).astype(int) + 5 * np.floor((plan[:, 1] + 20) / 8).astype(int)
    ) == list(range(25))


def test_the_same_seed_gives_the_same_plan_and_another_seed_another():
    for make in (targets.calibration_plan, targets.validation_plan):
        assert np.array_equal(make(seed=5).target_deg, make(seed=5).target_deg)
        assert not np.array_equal(make(seed=5).target_deg, make(seed=6).target_deg)


def test_a_small_screen_shrinks_the_plan_and_keeps_its_shape():
    plan = targets.calibration_plan(reach_deg=(22.0, 11.0)).target_deg
    assert np.allclose(plan * [1, 2], targets.calibration_plan().target_deg)
    held_out = targets.validation_plan(reach_deg=(15.0, 9.0)).target_deg
    assert np.abs(held_out[:, 0]).max() <= 15 and np.abs(held_out[:, 1]).max() <= 9


def test_onsets_are_equally_spaced_in_whole_microseconds():
    plan = targets.calibration_plan(10, dwell_s=0.7654321, settle_s=0.3)
    onsets = plan.onsets_us(10**12)
    assert onsets.dtype == np.int64 and onsets[0] == 10**12
    assert np.abs(np.diff(onsets) - 765432.1).max() <= 1
    assert plan.seconds == pytest.approx(7.654321)


@pytest.mark.parametrize("arguments", [dict(n=8), dict(dwell_s=0.5), dict(settle_s=-0.1)])
def test_impossible_plans_are_refused(arguments):
    with pytest.raises(ValueError):
        targets.calibration_plan(**arguments)
