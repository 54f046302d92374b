# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the fault tests."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from material import make_hex  # noqa: E402


@pytest.fixture
def program(tmp_path):
    """(path of a hex file, its bytes): 1000 arbitrary bytes, not a whole number of pages."""
    data = np.random.default_rng(7).integers(0, 256, 1000, dtype=np.uint8).tobytes()
    return make_hex(tmp_path / "program.hex", data), data
