# SPDX-License-Identifier: Apache-2.0
"""maps.compute_map: what it holds, that its bound bounds, and that its files are taken for hostile."""

import numpy as np
import pytest

from sparsegaze.errors import SceneError
from sparsegaze.maps import GazeMap, compute_map
from sparsegaze.person import Person


@pytest.fixture(scope="module")
def small(led2gaze):
    """A coarse map of two states, for what does not depend on how good it is."""
    return compute_map(led2gaze, Person(), grid=5, tol=1e-2, lid_opening=(1.0, 0.4), pupil_mm=(3.0,))


def test_a_map_holds_what_it_says(small, led2gaze):
    assert small.response.shape == (2, 6, 6, 5, 5) and small.response.dtype == np.float64
    assert small.slip_mm.shape == (2, 3) and list(small.lid_opening) == [1.0, 0.4]
    assert np.array_equal(sum(small.parts.values()), small.response)
    assert small.error_estimate.shape == (2, 6, 6) and (small.error_estimate > 0).all()
    assert set(small.estimate_rms) == {"face", "sclera", "iris", "glint", "total"}
    assert small.headset["sensors"][0]["position_mm"] == led2gaze.sensors[0].position_mm
    assert small.person["globe_radius_mm"] == 12.0


def test_a_file_gives_back_the_map(small, tmp_path):
    small.save(tmp_path / "map.npz")
    again = GazeMap.load(tmp_path / "map.npz")
    for name in ("response", "error_estimate", "azimuth_deg", "lid_opening", "slip_mm"):
        assert np.array_equal(getattr(again, name), getattr(small, name))
    assert again.left_out == small.left_out and again.person["cornea_radius_mm"] == 7.8
    small.save(tmp_path / "map.npz", parts=False)
    assert not GazeMap.load(tmp_path / "map.npz").parts


@pytest.mark.parametrize(
    "wrong",
    [
        {"grid": 0},
        {"grid": 182},
        {"half_angle_deg": 46},
        {"half_angle_deg": float("nan")},
        {"tol": 0},
        {"pupil_mm": (12.0,)},
        {"lid_opening": (1.1,)},
        {"slip_mm": ((0, 0),)},
        {"pupil_mm": (3, 4), "lid_opening": (1, 0.5, 0)},
        {"method": "magic"},
    ],
)
def test_an_impossible_argument_is_refused_with_a_remedy(led2gaze, wrong):
    with pytest.raises(SceneError) as caught:
        compute_map(led2gaze, Person(), **wrong)
    assert caught.value.remedy
