# SPDX-License-Identifier: Apache-2.0
"""Data quality of gaze by ETDQualitizer's definitions, and the per-frame error of the LED2Gaze paper.

Angles are Fick azimuth and elevation in degrees, missing samples are nan and stay in place. Definitions:
Niehorster et al., "The fundamentals of eye tracking part 7", and the package ETDQualitizer 1.2, against which
a test holds these. The accuracy of the mean gaze is smaller than the mean of the per-frame errors: both are
here, and named.
"""

from dataclasses import dataclass

import numpy as np

BCEA_P = 0.68


@dataclass(frozen=True)
class FrameError:
    """Angle between gaze and target per frame, over the frames that have a gaze: degrees, and how many."""

    mean_deg: float
    median_deg: float
    p95_deg: float
    frames: int


def fick_vector(azimuth_deg, elevation_deg):
    """Unit vectors [..., 3] of Fick angles, (cos el sin az, sin el, cos el cos az): right, up, ahead."""
    az, el = np.deg2rad(np.asarray(azimuth_deg, float)), np.deg2rad(np.asarray(elevation_deg, float))
    return np.stack([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)], axis=-1)


def angle_between_deg(first, second):
    """Angle in degrees between vectors [..., 3] of any length; atan2(|a x b|, a . b), exact at 0 and 180."""
    first, second = np.broadcast_arrays(first, second)
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.rad2deg(np.arctan2(sine, np.sum(first * second, axis=-1)))


def frame_errors_deg(azimuth_deg, elevation_deg, target_az_deg, target_el_deg):
    """Angle [n] between the unit vectors of gaze and target, per frame; nan where the gaze is missing."""
    return angle_between_deg(
        fick_vector(azimuth_deg, elevation_deg), fick_vector(target_az_deg, target_el_deg)
    )


def frame_error(azimuth_deg, elevation_deg, target_az_deg, target_el_deg):
    """Mean, median (LED2Gaze section 6) and 95th percentile of frame_errors_deg."""
    error = frame_errors_deg(azimuth_deg, elevation_deg, target_az_deg, target_el_deg)
    error = error[np.isfinite(error)]
    if not len(error):
        return FrameError(np.nan, np.nan, np.nan, 0)
    return FrameError(
        float(error.mean()), float(np.median(error)), float(np.percentile(error, 95)), len(error)
    )


def accuracy_deg(azimuth_deg, elevation_deg, target_az_deg, target_el_deg):
    """Accuracy of one fixation: angle between the mean 3-D gaze vector and the target, and its parts.

    Returns (offset, azimuth offset, elevation offset) in degrees; the parts are the Fick angles of the mean
    vector in a frame turned so that the target lies straight ahead. nan without a single sample.
    """
    vectors = fick_vector(azimuth_deg, elevation_deg)
    vectors = vectors[np.isfinite(vectors).all(axis=-1)]
    if not len(vectors):
        return np.nan, np.nan, np.nan
    mean = vectors.mean(axis=0)
    ahead = fick_vector(target_az_deg, target_el_deg)
    right = fick_vector(target_az_deg + 90.0, 0.0)
    x, y, z = mean @ right, mean @ np.cross(ahead, right), mean @ ahead
    offset = np.arctan2(np.hypot(x, y), z)
    return tuple(float(v) for v in np.rad2deg([offset, np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))]))


def rms_s2s_deg(azimuth_deg, elevation_deg):
    """RMS of sample-to-sample distances, sqrt(mean(d_az^2 + d_el^2)) over pairs that are both there."""
    step = np.diff(np.asarray(azimuth_deg, float)) ** 2 + np.diff(np.asarray(elevation_deg, float)) ** 2
    step = step[np.isfinite(step)]
    return float(np.sqrt(step.mean())) if len(step) else np.nan


def std_deg(azimuth_deg, elevation_deg):
    """Spread hypot(std az, std el), population form."""
    pair = _pair(azimuth_deg, elevation_deg)
    return float(np.hypot(*pair.std(axis=1))) if pair.size else np.nan


def bcea_deg2(azimuth_deg, elevation_deg, p=BCEA_P):
    """Bivariate contour ellipse area, 2 pi k s_az s_el sqrt(1 - rho^2), k = ln(1 / (1 - p)); deg^2."""
    pair = _pair(azimuth_deg, elevation_deg)
    if pair.shape[1] < 2:
        return np.nan
    return float(2 * np.pi * np.log(1 / (1 - p)) * np.sqrt(max(np.linalg.det(np.cov(pair)), 0.0)))


def data_loss_percent(azimuth_deg, elevation_deg):
    """Share of samples without a gaze, in percent."""
    missing = ~(np.isfinite(np.asarray(azimuth_deg, float)) & np.isfinite(np.asarray(elevation_deg, float)))
    return float(100 * missing.mean()) if len(missing) else np.nan


def _pair(azimuth_deg, elevation_deg):
    pair = np.stack([np.asarray(azimuth_deg, float), np.asarray(elevation_deg, float)])
    return pair[:, np.isfinite(pair).all(axis=0)]
