# SPDX-License-Identifier: Apache-2.0
"""The same firmware on a headset of photodiodes and separate LEDs, from the setting to a gaze."""

import numpy as np
import pytest

from sparsegaze import calibrate
from sparsegaze.device import Device
from sparsegaze.simulate import Grid, response_map

pytestmark = pytest.mark.timeout(600)
PERSON = 3
# Coarser than the product's: the eye that is calibrated is the one that is judged.
ROUGH = dict(smooth_nodes=13, glint_nodes=41, pupil_mm=(2.0, 3.5, 5.0, 6.5, 8.0), check_states=4)


@pytest.fixture
def photodiodes(repo_root, firmware_hex, virtual_nano, tmp_path):
    """A virtual Nano with headsets/nextgaze_nano.toml on a simulated person, fresh from the factory."""
    path = repo_root / "headsets" / "nextgaze_nano.toml"
    grid = Grid(**ROUGH, lid_opening=np.linspace(0, 1, 9))
    optics = response_map(path, PERSON, cache=tmp_path, grid=grid)
    return virtual_nano(headset=path, person=PERSON, map=optics, unpaced=True, app=firmware_hex)


def test_photodiodes_are_dark_until_the_firmware_is_told_of_them(photodiodes):
    with Device(photodiodes.port) as device:
        device.link.sleep(0.5)
        photodiodes.control.counters_clear()
        device.link.sleep(0.1)
        assert photodiodes.control.counters()["lit_cycles_0"] == 0
        assert device.settings(wiring="photodiodes").wiring_text == "photodiodes"
        device.link.sleep(0.1)
        counted = photodiodes.control.counters()
        assert counted["most_lit"] == 1 and min(counted[f"lit_cycles_{i}"] for i in range(3)) > 0


def test_photodiodes_tell_gaze_from_setting_to_validation(photodiodes):
    with Device(photodiodes.port) as device:
        device.settings(wiring="photodiodes")
        device.link.sleep(3.0)  # until it is stored
    made = calibrate.run(photodiodes.port, n_targets=64, vectors=30, n_validation=16, seed=PERSON)
    report = made.report()
    print("photodiodes, simulated person %d:" % PERSON, report["accuracy"], report["stream"])
    assert report["crc_host"] == report["crc_device"] and report["stream"]["bit_identical"] is True
    assert report["accuracy"]["mean_deg"] < 1.0
    with Device(photodiodes.port) as device:
        assert device.settings().wiring_text == "photodiodes", "it outlives the upload's resets"
