# SPDX-License-Identifier: Apache-2.0
"""The bench programs need the virtual Nano: build it before the first test."""

import subprocess

import pytest

from board import FOLDER, PROGRAM


@pytest.fixture(scope="session", autouse=True)
def vheadset():
    """Path of the built program."""
    subprocess.run(["make", "-s", "-C", FOLDER], check=True, timeout=300)
    return PROGRAM
