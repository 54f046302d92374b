# SPDX-License-Identifier: Apache-2.0
"""Writer of response map files (`.sgmap`): sim_c/sim_map.h states the format, sim_map_file.c reads it."""

import os
import struct
import zlib
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

MAGIC = b"SGMAP\r\n\x02"
AXES = ("slip_x_mm", "slip_y_mm", "slip_z_mm", "pupil_mm", "lid_opening", "elevation_deg", "azimuth_deg")
SMOOTH, GLINT = 0, 1
UNMEASURED = (-1.0,) * 4


@dataclass(frozen=True)
class Table:
    """One table: B-spline coefficients over its seven axes.

    kind           SMOOTH or GLINT
    axes           nodes of AXES, in order, strictly increasing; one node: does not depend on it
    coefficients   [slip x, slip y, slip z, pupil, lid, elevation, azimuth, sensor, emitter], float32, or
                   uint16 with offset and scale [sensor, emitter]
    """

    kind: int
    axes: tuple
    coefficients: np.ndarray
    offset: np.ndarray = None
    scale: np.ndarray = None

    def header(self):
        width = self.coefficients.dtype.itemsize
        return struct.pack("<10I", self.kind, width, *(len(axis) for axis in self.axes), 0)

    def blocks(self):
        """Its bytes in the file, in pieces."""
        yield b"".join(axis.tobytes() for axis in self.axes)
        if self.offset is not None:
            yield self.offset.astype("<f8").tobytes() + self.scale.astype("<f8").tobytes()
        yield self.coefficients.tobytes()
        yield bytes(-self.coefficients.nbytes % 8)


def fit_table(kind, axes, values, bytes_per_value=4):
    """The Table whose splines go through values at its nodes, [seven axes, sensor, emitter].

    bytes_per_value   4, or 2: rounded to 1/65535 of each pair's range of coefficients
    Raises ValueError when shapes and axes do not fit or a value is not finite.
    """
    axes = tuple(np.atleast_1d(np.asarray(axis, dtype="<f8")) for axis in axes)
    values = np.asarray(values)
    if len(axes) != 7 or values.ndim != 9 or values.shape[:7] != tuple(len(axis) for axis in axes):
        raise ValueError("values have shape %s, which does not fit their axes" % (values.shape,))
    if not (np.isfinite(values).all() and all(np.isfinite(axis).all() for axis in axes)):
        raise ValueError("a response or axis value is not finite")
    for number, nodes in enumerate(axes):
        if len(nodes) > 1:
            # A matrix from values to coefficients: its product is far faster than a solver for every pair.
            fit = make_interp_spline(nodes, np.eye(len(nodes)), min(3, len(nodes) - 1)).c
            before, after = int(np.prod(values.shape[:number])), int(np.prod(values.shape[number + 1 :]))
            values = np.matmul(fit, values.reshape(before, len(nodes), after)).reshape(values.shape)
    if bytes_per_value == 4:
        return Table(kind, axes, np.ascontiguousarray(values, dtype="<f4"))
    flat = values.reshape((-1,) + values.shape[7:])
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = (high - low) / 65535.0
    steps = np.rint((values - low) / np.where(scale > 0, scale, 1.0))
    return Table(kind, axes, np.ascontiguousarray(steps, dtype="<u2"), low, scale)


def write_tables(path, tables, mean, error=UNMEASURED):
    """Write one map, atomically (a temporary file renamed into place).

    mean    what sim_map_mean() returns          error   the four numbers of struct sim_map_error
    """
    sensors, emitters = tables[0].coefficients.shape[7:]
    blocks = [struct.pack("<3I d 4d", sensors, emitters, len(tables), mean, *error)]
    blocks += [table.header() for table in tables]
    for table in tables:
        blocks += table.blocks()
    check = 0
    for block in blocks:
        check = zlib.crc32(block, check)
    head = MAGIC + struct.pack("<QI", 20 + sum(len(block) for block in blocks), check)
    temporary = "%s.%d.tmp" % (path, os.getpid())
    try:
        with open(temporary, "wb") as file:
            file.write(head)
            file.writelines(blocks)
        os.replace(temporary, path)
    except BaseException:
        if os.path.exists(temporary):
            os.unlink(temporary)
        raise


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
    """Write a map of two tables from values at their nodes.

    Axes are 1-d arrays, strictly increasing; `slip_mm` is three of them (x, y, z).
    smooth   [slip x, slip y, slip z, pupil, lid, elevation, azimuth, sensor, emitter], relative irradiance
    glint    [slip x, slip y, slip z, lid, elevation, azimuth, sensor, emitter]
    mean     what sim_map_mean() returns; None = from the nodes nearest to pupil 3.5 mm, lids open, no slip.
    Raises ValueError when shapes and axes do not fit or a value is not finite.
    """
    smooth, glint = np.asarray(smooth), np.asarray(glint)
    if glint.ndim != 8 or smooth.ndim != 9 or glint.shape[6:] != smooth.shape[7:]:
        raise ValueError("glint has shape %s, smooth %s" % (glint.shape, smooth.shape))
    tables = [
        fit_table(SMOOTH, (*slip_mm, pupil_mm, lid_opening, elevation_deg, azimuth_deg), smooth),
        fit_table(
            GLINT,
            (*slip_mm, [PUPIL_ANY_MM], glint_lid_opening, glint_elevation_deg, glint_azimuth_deg),
            glint[:, :, :, None],
        ),
    ]
    if mean is None:
        mean = _mean_response(tables, smooth, glint[:, :, :, None])
    write_tables(path, tables, mean)


PUPIL_ANY_MM = 3.5  # the one node of an axis on which a table does not depend


def _mean_response(tables, smooth, glint):
    other = 1.0 - np.eye(*smooth.shape[7:]) if min(smooth.shape[7:]) > 1 else np.ones(smooth.shape[7:])
    total = 0.0
    for table, values in zip(tables, (smooth, glint)):
        slip = tuple(int(np.argmin(abs(axis))) for axis in table.axes[:3])
        inside = values[slip][np.argmin(abs(table.axes[3] - 3.5)), -1]
        near = [abs(axis) <= 20.0 + 1e-9 for axis in table.axes[5:]]
        if near[0].any() and near[1].any():
            inside = inside[near[0]][:, near[1]]
        total += float((np.asarray(inside, dtype=float).mean(axis=(0, 1)) * other).sum() / len(other))
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
