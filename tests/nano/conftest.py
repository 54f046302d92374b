# SPDX-License-Identifier: Apache-2.0
"""The bench programs need the virtual Nano: build it before the first test."""

import subprocess

import pytest

from board import FOLDER, PROGRAM, uniform_map


@pytest.fixture(scope="session", autouse=True)
def vheadset():
    """Path of the built program."""
    subprocess.run(["make", "-s", "-C", FOLDER], check=True, timeout=300)
    return PROGRAM


@pytest.fixture(scope="session")
def flat_map(tmp_path_factory):
    """A map on which every emitter gives every sensor the same, whatever the eye does."""
    return uniform_map(tmp_path_factory.mktemp("map") / "flat.sgmap")


@pytest.fixture(scope="session")
def photodiode_map(tmp_path_factory):
    """The same of six sensors and three emitters: one emitter gives what five give in flat_map."""
    return uniform_map(tmp_path_factory.mktemp("map") / "photodiodes.sgmap", emitters=3)
