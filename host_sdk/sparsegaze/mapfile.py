# SPDX-License-Identifier: Apache-2.0
"""Writer of response map files (`.sgmap`): sim_c/sim_map.h states the format, sim_map.c reads it."""

import os
import struct
import zlib

import numpy as np

MAGIC = b"SGMAP\r\n\x01"


def _axis(values):
    return np.atleast_1d(np.asarray(values, dtype="<f8"))


def write_map(
    path,
    *,
    pupil_mm,
    lid_opening,
    slip_mm,
    elevation_deg,
    azimuth_deg,
    smooth,
    glint_lid_opening,
    glint_elevation_deg,
    glint_azimuth_deg,
    glint,
    mean=None,
):
    """Write one map, atomically (a temporary file renamed into place).

    Axes are 1-d arrays, strictly increasing; `slip_mm` is three of them (x, y, z). Gaze axes are uniform
    with 1 or >= 4 nodes.
    smooth   [slip x, slip y, slip z, pupil, lid, elevation, azimuth, sensor, emitter], relative irradiance
    glint    [slip x, slip y, slip z, lid, elevation, azimuth, sensor, emitter]
    mean     what sim_map_mean() returns; None = from the nodes nearest to pupil 3.5 mm, lids open, no slip.
    Raises ValueError when shapes and axes do not fit or a value is not finite.
    """
    axes = [
        _axis(pupil_mm),
        _axis(lid_opening),
        *(_axis(s) for s in slip_mm),
        _axis(elevation_deg),
        _axis(azimuth_deg),
        _axis(glint_lid_opening),
        _axis(glint_elevation_deg),
        _axis(glint_azimuth_deg),
    ]
    smooth = np.asarray(smooth, dtype="<f4")
    glint = np.asarray(glint, dtype="<f4")
    n = [len(a) for a in axes]
    if smooth.ndim != 9 or smooth.shape[:7] != (n[2], n[3], n[4], n[0], n[1], n[5], n[6]):
        raise ValueError("smooth has shape %s, which does not fit its axes" % (smooth.shape,))
    if glint.shape != (n[2], n[3], n[4], n[7], n[8], n[9]) + smooth.shape[7:]:
        raise ValueError("glint has shape %s, which does not fit its axes" % (glint.shape,))
    if not (
        np.isfinite(smooth).all() and np.isfinite(glint).all() and all(np.isfinite(a).all() for a in axes)
    ):
        raise ValueError("a response or axis value is not finite")
    sensors, emitters = smooth.shape[7:]
    if mean is None:
        mean = _mean_response(axes, smooth, glint)
    body = struct.pack("<13I d", sensors, emitters, *n, 0, mean)
    body += b"".join(a.tobytes() for a in axes) + smooth.tobytes() + glint.tobytes()
    head = MAGIC + struct.pack("<QI", 20 + len(body), zlib.crc32(body))
    temporary = "%s.%d.tmp" % (path, os.getpid())
    with open(temporary, "wb") as file:
        file.write(head + body)
    os.replace(temporary, path)


def _mean_response(axes, smooth, glint):
    slip = tuple(int(np.argmin(abs(axes[2 + k]))) for k in range(3))
    other = 1.0 - np.eye(*smooth.shape[7:]) if min(smooth.shape[7:]) > 1 else np.ones(smooth.shape[7:])
    total = 0.0
    for table, el, az in (
        (smooth[slip][np.argmin(abs(axes[0] - 3.5)), -1], axes[5], axes[6]),
        (glint[slip][-1], axes[8], axes[9]),
    ):
        inside = table[abs(el) <= 20.0 + 1e-9][:, abs(az) <= 20.0 + 1e-9]
        if inside.size == 0:
            inside = table
        total += float((np.asarray(inside, dtype=float).mean(axis=(0, 1)) * other).sum() / smooth.shape[7])
    return total


def synthetic_map(path, sensors=6, emitters=6, seed=0, half_angle_deg=25.0):
    """A map with no optics behind it, for tests of whatever reads maps: bumps of the state, and a ring.

    Returns `path`. Same seed, same file.
    """
    rng = np.random.default_rng(seed)
    pupil, lid = np.array([2.0, 3.5, 5.0, 6.5, 8.0]), np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    gaze, fine = np.linspace(-half_angle_deg, half_angle_deg, 21), np.linspace(
        -half_angle_deg, half_angle_deg, 101
    )
    angle = 2 * np.pi * np.arange(sensors) / sensors
    slope = np.stack([np.cos(angle), np.sin(angle)], 1) * 0.012 + rng.normal(0, 0.001, (sensors, 2))
    emitter_gain = rng.uniform(0.8, 1.2, emitters)
    el, az = np.meshgrid(gaze, gaze, indexing="ij")
    dim = np.exp(
        slope[:, 0] * az[..., None] + slope[:, 1] * el[..., None] - (az**2 + el**2)[..., None] / 3000
    )
    open_part = (1.0 - 0.04 * (pupil - 3.5))[:, None] * (0.3 + 0.7 * lid**2)[None, :]
    smooth = 1e-6 * open_part[:, :, None, None, None, None] * dim[None, None, ..., None] * emitter_gain
    el, az = np.meshgrid(fine, fine, indexing="ij")
    centre = rng.uniform(-15, 15, (sensors, emitters, 2))
    radius = np.hypot(az[..., None, None] - centre[..., 0], el[..., None, None] - centre[..., 1])
    ring = 2e-7 * np.exp(-0.5 * ((radius - 35) / 1.3) ** 2) + 3e-8
    glint = lid[:, None, None, None, None] * ring[None]
    write_map(
        path,
        pupil_mm=pupil,
        lid_opening=lid,
        slip_mm=([0], [0], [0]),
        elevation_deg=gaze,
        azimuth_deg=gaze,
        smooth=smooth[None, None, None],
        glint_lid_opening=lid,
        glint_elevation_deg=fine,
        glint_azimuth_deg=fine,
        glint=glint[None, None, None],
    )
    return path
