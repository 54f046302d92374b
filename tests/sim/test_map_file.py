# SPDX-License-Identifier: Apache-2.0
"""The map file: what its reader refuses, and how it interpolates."""

import struct
import zlib

import numpy as np
import pytest

from sparsegaze.errors import SceneError
from sparsegaze.mapfile import SMOOTH, fit_table, synthetic_map, write_map, write_tables
from sparsegaze.simulate import ResponseMap

CRC_AT, AFTER_CRC, TABLES_AT, MEAN_AT, ERROR_AT = 16, 20, 28, 32, 40


def head_of(table):
    """Offset of a table's head; of the table after the last one: of the first table's axes."""
    return 72 + 40 * table



@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return open(synthetic_map(str(tmp_path_factory.mktemp("map") / "good.sgmap"), seed=3), "rb").read()


def refusal(tmp_path, data):
    path = tmp_path / "bad.sgmap"
    path.write_bytes(data)
    with pytest.raises(SceneError) as caught:
        ResponseMap(str(path))
    return str(caught.value)


def patched(data, at, form, *values, checksum=True):
    """The file with a field replaced and, unless told otherwise, a checksum that fits: only the field is
    wrong.
    """
    changed = bytearray(data)
    struct.pack_into("<" + form, changed, at, *values)
    if checksum:
        struct.pack_into("<I", changed, CRC_AT, zlib.crc32(bytes(changed[AFTER_CRC:])))
    return bytes(changed)


def test_the_undamaged_file_opens(good, tmp_path):
    path = tmp_path / "good.sgmap"
    path.write_bytes(good)
    with ResponseMap(str(path)) as opened:
        assert opened.shape == (6, 6) and opened.mean > 0


@pytest.mark.parametrize("size", [0, 1, 7, 8, 71, 72, 151, 152, 5000])
def test_a_truncated_file_is_refused(good, tmp_path, size):
    refusal(tmp_path, good[:size])


def test_a_file_one_byte_short_or_long_is_refused(good, tmp_path):
    assert "length" in refusal(tmp_path, good[:-1])
    assert "length" in refusal(tmp_path, good + b"\0")


def test_any_flipped_bit_is_refused(good, tmp_path):
    rng = np.random.default_rng(0)
    places = list(range(0, 90)) + sorted(rng.integers(90, len(good), 30).tolist())
    for place in places:
        changed = bytearray(good)
        changed[place] ^= 1 << int(rng.integers(8))
        refusal(tmp_path, bytes(changed))


@pytest.mark.parametrize("field", range(2))
@pytest.mark.parametrize("value", [0, 33, 0x7FFFFFFF, 0xFFFFFFFF])
def test_absurd_sensor_and_emitter_counts_are_refused_before_use(good, tmp_path, field, value):
    refusal(tmp_path, patched(good, 20 + 4 * field, "I", value))


@pytest.mark.parametrize("value", [0, 9, 0x7FFFFFFF, 0xFFFFFFFF])
def test_absurd_table_counts_are_refused_before_use(good, tmp_path, value):
    assert "tables" in refusal(tmp_path, patched(good, TABLES_AT, "I", value))


@pytest.mark.parametrize("table", range(2))
@pytest.mark.parametrize("field,value", [(0, 2), (0, 0xFFFFFFFF), (1, 0), (1, 3), (1, 8), (1, 0xFFFFFFFF)])
def test_unknown_kinds_and_widths_of_tables_are_refused(good, tmp_path, table, field, value):
    assert "table" in refusal(tmp_path, patched(good, head_of(table) + 4 * field, "I", value))


@pytest.mark.parametrize("table", range(2))
@pytest.mark.parametrize("axis", range(7))
@pytest.mark.parametrize("value", [0, 2, 514, 0x10000, 0xFFFFFFFF])
def test_absurd_node_counts_are_refused_before_use(good, tmp_path, table, axis, value):
    refusal(tmp_path, patched(good, head_of(table) + 8 + 4 * axis, "I", value))


@pytest.mark.parametrize(
    "nodes", [(128,) * 5 + (513, 513), (128, 128, 128, 1, 1, 1, 1), (1, 1, 1, 64, 64, 513, 1)]
)
def test_counts_whose_product_would_overflow_are_refused(good, tmp_path, nodes):
    data = patched(patched(good, 20, "2I", 32, 32), head_of(0) + 8, "7I", *nodes)
    assert "large" in refusal(tmp_path, data)


def test_tables_each_small_enough_but_not_together_are_refused(tmp_path, good):
    head = struct.pack("<10I", 0, 2, 1, 1, 1, 8, 32, 32, 32, 0)  # 2^18 nodes of 2^10 pairs: the most
    data = bytearray(good[:72] + 8 * head + bytes(4096))
    struct.pack_into("<Q", data, 8, len(data))
    struct.pack_into("<3I", data, 20, 32, 32, 8)
    assert "large" in refusal(tmp_path, patched(bytes(data), 20, "I", 32))


def test_a_reserved_field_in_use_is_refused(good, tmp_path):
    for table in range(2):
        assert "reserved" in refusal(tmp_path, patched(good, head_of(table) + 36, "I", 1))


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_mean_that_is_not_positive_is_refused(good, tmp_path, value):
    assert "mean" in refusal(tmp_path, patched(good, MEAN_AT, "d", value))


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("value", [-0.5, -2.0, float("nan"), float("inf")])
def test_a_stated_error_that_cannot_be_one_is_refused(good, tmp_path, number, value):
    assert "error" in refusal(tmp_path, patched(good, ERROR_AT + 8 * number, "d", value))


def test_a_stated_error_is_read_and_an_unmeasured_one_is_no_number(good, tmp_path):
    path = tmp_path / "e.sgmap"
    path.write_bytes(patched(good, ERROR_AT, "4d", 1e-9, 2e-9, 0.0, -1.0))
    with ResponseMap(str(path)) as opened:
        got = opened.error_estimate
        assert got.open_rms == pytest.approx(1e-9 * 5 / opened.mean) and got.open_max == 2 * got.open_rms
        assert got.lids_rms == 0 and np.isnan(got.lids_max)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300, -5.0])
def test_axes_that_are_not_finite_or_not_increasing_are_refused(good, tmp_path, value):
    # Three axes of slip, one node each, and the pupil's first: this is its second.
    assert "axis" in refusal(tmp_path, patched(good, head_of(2) + 8 * 4, "d", value))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_ranges_of_rounded_values_that_are_not_finite_are_refused(tmp_path, value):
    path = str(tmp_path / "rounded.sgmap")
    rounded_map(path)
    data, ranges = open(path, "rb").read(), head_of(1) + 8 * (4 + 2 + 1 + 5)
    assert "scale" in refusal(tmp_path, patched(data, ranges, "d", value))
    assert "scale" in refusal(tmp_path, patched(data, ranges + 8 * 7, "d", value))
    assert "scale" in refusal(tmp_path, patched(data, ranges + 8 * 4, "d", -1.0))


def rounded_map(path, half=3.0):
    """One table of 2-byte values, 2 x 2 pairs, lids x azimuth; returns its axes, values and steps."""
    lids, azimuth = np.array([0.0, 1.0]), np.linspace(-half, half, 5)
    rng = np.random.default_rng(4)
    values = rng.uniform(-1.0, 3.0, (1, 1, 1, 1, 2, 1, 5, 2, 2)) * [[1.0, 1e-6], [1e6, 0.0]]
    axes = ([0], [0], [0], [3.5], lids, [0], azimuth)
    table = fit_table(SMOOTH, axes, values, 2)
    write_tables(path, [table], 1.0)
    return lids, azimuth, values[0, 0, 0, 0, :, 0], table.scale


def test_rounded_values_are_right_to_a_step_of_their_range(tmp_path):
    path = str(tmp_path / "rounded.sgmap")
    lids, azimuth, values, step = rounded_map(path)
    states = [(a, 0.0, 3.5, lid) for lid in lids for a in azimuth]
    with ResponseMap(path) as opened:
        got = opened.gradient(states)[0].reshape(values.shape)
    largest = np.abs(values).max(axis=(0, 1))
    assert (step < 2e-4 * largest + 1e-30).all()
    assert (np.abs(got - values) <= step / 2 + 1e-6 * largest).all()


@pytest.mark.parametrize("bits", [0x7FC00000, 0x7F800000, 0xFF800000, 0x7F7FFFFF])
def test_a_response_that_is_not_finite_is_refused(good, tmp_path, bits):
    for back in (4, 400000):
        assert "finite" in refusal(tmp_path, patched(good, len(good) - back, "I", bits))


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    for path in (tmp_path / "none.sgmap", tmp_path):
        with pytest.raises(SceneError):
            ResponseMap(str(path))


def polynomial_map(path, function, gaze_nodes=9):
    gaze = np.linspace(-25, 25, gaze_nodes)
    pupil, lid, slip = np.array([2, 3, 4.5, 6, 8.0]), np.array([0, 0.4, 0.7, 1.0]), np.array([-1, 0, 1.0])
    sx, p, l, el, az = np.meshgrid(slip, pupil, lid, gaze, gaze, indexing="ij")
    smooth = function(az, el, p, l, sx)[:, None, None, ..., None, None]
    write_map(
        path,
        pupil_mm=pupil,
        lid_opening=lid,
        slip_mm=(slip, [0], [0]),
        elevation_deg=gaze,
        azimuth_deg=gaze,
        smooth=smooth,
        glint_lid_opening=[0],
        glint_elevation_deg=[0],
        glint_azimuth_deg=[0],
        glint=np.full((3, 1, 1, 1, 1, 1, 1, 1), 0.25),
        mean=1.0,
    )
    return ResponseMap(path)


def test_cubic_gaze_pupil_and_lid_and_quadratic_slip_are_reproduced(tmp_path):
    def function(az, el, p, l, sx):
        return 30 + (az**3 - el**3 + az * el**2) / 1e4 + p**3 / 50 + l**3 * az / 30 + p * l + sx**2 * el / 50

    rng = np.random.default_rng(0)
    low, high = [-25, -25, 2, 0, -1], [25, 25, 8, 1, 1]
    states = rng.uniform(low, high, (500, 5))
    states[:10, 2] = [2, 3, 4.5, 6, 8] * 2
    states[10:20, 0] = 25
    with polynomial_map(str(tmp_path / "p.sgmap"), function) as opened:
        got = opened.evaluate(states)[:, 0, 0]
    # Values are stored as float32; 0.25 is the constant glint.
    assert np.abs(got - 0.25 - function(*states.T)).max() < 1e-4


def test_axes_need_not_be_uniform(tmp_path):
    nodes = np.array([-25, -20, -11, -3, -1, 2, 9, 17, 25.0])
    values = (nodes**3 / 1e4 - nodes)[None, None, None, None, None, None, :, None, None]
    path = str(tmp_path / "uneven.sgmap")
    write_tables(path, [fit_table(SMOOTH, ([0], [0], [0], [3.5], [1], [0], nodes), values)], 1.0)
    at = np.linspace(-25, 25, 201)
    with ResponseMap(path) as opened:
        got = opened.gradient(np.stack([at, 0 * at], 1))[0][:, 0, 0]
    assert np.abs(got - (at**3 / 1e4 - at)).max() < 1e-5


def test_error_falls_with_the_fourth_power_of_the_step(tmp_path):
    def function(az, el, p, l, sx):
        return 2 + np.sin(az / 6) * np.cos(el / 7) + 0 * p

    states = np.random.default_rng(1).uniform(-20, 20, (800, 2))
    truth = function(*states.T, 3.5, 1, 0)
    error = []
    for nodes in (17, 33, 65):
        with polynomial_map(str(tmp_path / "s.sgmap"), function, nodes) as opened:
            error.append(np.sqrt(np.mean((opened.evaluate(states)[:, 0, 0] - 0.25 - truth) ** 2)))
    assert error[0] / error[1] > 12 and error[1] / error[2] > 12


def test_derivatives_of_a_polynomial_are_exact(tmp_path):
    def function(az, el, p, l, sx):
        return 3 + (az**3 - az * el**2) / 1e4 + p**3 / 50 + l**3 * az / 30 + p * l + sx**2 * el / 50

    def slopes(az, el, p, l, sx):
        return [
            (3 * az**2 - el**2) / 1e4 + l**3 / 30,
            -2 * az * el / 1e4 + sx**2 / 50,
            3 * p**2 / 50 + l,
            l**2 * az / 10 + p,
            2 * sx * el / 50,
        ]

    states = np.random.default_rng(3).uniform([-25, -25, 2, 0, -1], [25, 25, 8, 1, 1], (300, 5))
    states[:5, 3] = 1.0  # at the edge: the slope from within
    with polynomial_map(str(tmp_path / "p.sgmap"), function) as opened:
        value, slope = opened.gradient(states)
        np.testing.assert_allclose(value, opened.evaluate(states), rtol=1e-6)
    assert np.abs(slope[:, :5, 0, 0].T - slopes(*states.T)).max() < 2e-5
    assert (slope[:, 5:] == 0).all()


def test_derivatives_are_those_of_the_interpolated_response(tmp_path):
    with ResponseMap(synthetic_map(str(tmp_path / "s.sgmap"), seed=5)) as opened:
        states = np.random.default_rng(6).uniform([-24, -24, 2.1, 0.05], [24, 24, 7.9, 0.95], (200, 4))
        _, slope = opened.gradient(states)
        for k, step in enumerate((0.05, 0.05, 0.02, 0.005)):
            ahead, behind = states.copy(), states.copy()
            ahead[:, k] += step
            behind[:, k] -= step
            change = (opened.evaluate(ahead) - opened.evaluate(behind)) / (2 * step)
            assert np.abs(slope[:, k] - change).max() < 0.01 * np.abs(change).max()


def test_derivatives_are_zero_where_the_state_is_clamped(tmp_path):
    with ResponseMap(synthetic_map(str(tmp_path / "s.sgmap"))) as opened:
        _, slope = opened.gradient([[90.0, 3.0, 1.0, 1.5]])
        assert (slope[0, [0, 2, 3]] == 0).all() and (slope[0, 1] != 0).any()
        with pytest.raises(SceneError):
            opened.gradient([[0.0, np.nan]])


def test_outside_the_grid_the_state_is_clamped(tmp_path):
    with ResponseMap(synthetic_map(str(tmp_path / "s.sgmap"))) as opened:
        inside = opened.evaluate([[25, -25, 8, 1], [-25, 25, 2, 0]])
        outside = opened.evaluate([[90, -1e9, 50, 3], [-26, 1e300, 0, -1]])
    np.testing.assert_array_equal(inside, outside)


def test_states_that_are_not_finite_are_refused(tmp_path):
    with ResponseMap(synthetic_map(str(tmp_path / "s.sgmap"))) as opened:
        for bad in (np.nan, np.inf):
            with pytest.raises(SceneError):
                opened.evaluate([[bad, 0.0]])
            with pytest.raises(SceneError):
                opened.evaluate([[0.0, 0.0, 3.5, bad]])


def test_interpolation_has_no_staircase_even_across_nodes(tmp_path):
    with ResponseMap(synthetic_map(str(tmp_path / "s.sgmap"), seed=2)) as opened:
        sweep = np.arange(-20, 20, 0.01)
        value = opened.evaluate(np.stack([sweep, 0 * sweep + 3.3], 1)).sum(2)
    first, second = np.diff(value, axis=0), np.diff(value, 2, axis=0)
    # C2: over one step of 0.01 deg the slope changes by no more than 2 % of its largest value.
    assert np.abs(second).max() < 0.02 * np.abs(first).max()


def test_the_writer_refuses_what_does_not_fit(tmp_path):
    gaze, axes = np.linspace(-5, 5, 5), {}
    axes = dict(
        pupil_mm=[3.5],
        lid_opening=[1],
        slip_mm=([0], [0], [0]),
        elevation_deg=gaze,
        azimuth_deg=gaze,
        glint_lid_opening=[1],
        glint_elevation_deg=[0],
        glint_azimuth_deg=[0],
    )
    smooth, glint = np.ones((1, 1, 1, 1, 1, 5, 5, 2, 2)), np.zeros((1, 1, 1, 1, 1, 1, 2, 2))
    path = str(tmp_path / "w.sgmap")
    write_map(path, smooth=smooth, glint=glint, **axes)
    ResponseMap(path).close()
    with pytest.raises(ValueError):
        write_map(path, smooth=smooth[..., :4, :, :], glint=glint, **axes)
    with pytest.raises(ValueError):
        write_map(path, smooth=smooth, glint=np.zeros((1, 1, 1, 1, 1, 1, 2, 3)), **axes)
    smooth[..., 0, 0] = np.nan
    with pytest.raises(ValueError):
        write_map(path, smooth=smooth, glint=glint, **axes)
    ResponseMap(path).close()
