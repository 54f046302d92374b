# SPDX-License-Identifier: Apache-2.0
"""metrics.py against ETDQualitizer and against closed forms."""

import ETDQualitizer
import numpy as np
import pytest

from sparsegaze import metrics


@pytest.fixture
def fixation():
    rng = np.random.default_rng(4)
    return 12.0 + rng.normal(size=200), -8.0 + 0.5 * rng.normal(size=200)


@pytest.mark.parametrize("target", [(12.0, -8.0), (0.0, 0.0), (-20.0, 20.0), (170.0, 60.0)])
def test_accuracy_is_etdqualitizers(fixation, target):
    assert metrics.accuracy_deg(*fixation, *target) == pytest.approx(
        ETDQualitizer.accuracy(*fixation, *target), abs=1e-9
    )


def test_precision_is_etdqualitizers(fixation):
    assert metrics.rms_s2s_deg(*fixation) == pytest.approx(ETDQualitizer.rms_s2s(*fixation)[0], rel=1e-12)
    assert metrics.std_deg(*fixation) == pytest.approx(ETDQualitizer.std(*fixation)[0], rel=1e-12)
    assert metrics.bcea_deg2(*fixation) == pytest.approx(ETDQualitizer.bcea(*fixation)[0], rel=1e-9)


def test_missing_samples_stay_in_place_as_in_etdqualitizer(fixation):
    az, el = (v.copy() for v in fixation)
    az[[3, 50, 51]] = el[[3, 50, 51]] = np.nan
    assert metrics.rms_s2s_deg(az, el) == pytest.approx(ETDQualitizer.rms_s2s(az, el)[0], rel=1e-12)
    assert metrics.std_deg(az, el) == pytest.approx(ETDQualitizer.std(az, el)[0], rel=1e-12)
    assert metrics.accuracy_deg(az, el, 11, -8) == pytest.approx(
        ETDQualitizer.accuracy(az, el, 11, -8), abs=1e-9
    )
    assert metrics.bcea_deg2(az, el) == pytest.approx(ETDQualitizer.bcea(az, el)[0], rel=1e-9)
    assert metrics.data_loss_percent(az, el) == ETDQualitizer.data_loss_from_invalid(az, el) == 1.5


def test_data_loss_counts_either_coordinate():
    assert metrics.data_loss_percent([1, np.nan, 3, 4], [1, 2, np.nan, 4]) == 50.0


def test_no_samples_at_all_is_nan_not_an_error():
    none = np.full(5, np.nan)
    assert np.isnan(metrics.accuracy_deg(none, none, 0, 0)).all()
    assert np.isnan(
        [metrics.rms_s2s_deg(none, none), metrics.std_deg(none, none), metrics.bcea_deg2(none, none)]
    ).all()
    assert metrics.data_loss_percent(none, none) == 100.0
    assert metrics.frame_error(none, none, 0, 0).frames == 0


def test_frame_error_is_the_angle_on_the_sphere_not_the_plane():
    # At elevation 60 deg, 10 deg of azimuth is an arc of acos(sin^2 60 + cos^2 60 cos 10) only.
    expected = np.rad2deg(np.arccos(0.75 + 0.25 * np.cos(np.deg2rad(10.0))))
    assert metrics.frame_errors_deg([10.0], [60.0], [0.0], [60.0])[0] == pytest.approx(expected, abs=1e-12)


def test_mean_of_frame_errors_exceeds_error_of_the_mean(fixation):
    frames = metrics.frame_error(*fixation, 12.0, -8.0)
    assert frames.mean_deg > 5 * metrics.accuracy_deg(*fixation, 12.0, -8.0)[0]
    error = metrics.frame_errors_deg(*fixation, 12.0, -8.0)
    assert (frames.median_deg, frames.p95_deg) == (np.median(error), np.percentile(error, 95))


def test_angle_is_exact_near_0_and_180():
    small = metrics.fick_vector(1e-7, 0.0)
    assert metrics.angle_between_deg(small, metrics.fick_vector(0.0, 0.0)) == pytest.approx(1e-7, rel=1e-6)
    assert metrics.angle_between_deg(metrics.fick_vector(180.0, 0.0), metrics.fick_vector(0.0, 0.0)) == 180.0
