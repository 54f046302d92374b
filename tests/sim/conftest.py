# SPDX-License-Identifier: Apache-2.0
"""Fixtures that the simulator's tests share."""

import pytest


@pytest.fixture(scope="session")
def headset_path(repo_root):
    """The default headset's file."""
    return str(repo_root / "headsets" / "led2gaze.toml")


@pytest.fixture(scope="session")
def led2gaze(headset_path):
    """The default headset."""
    from sparsegaze.headset import load_headset

    return load_headset(headset_path)
