# SPDX-License-Identifier: Apache-2.0
"""Model images and programs that the fault tests flash and upload."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from sparsegaze.model import DeviceModel  # noqa: E402


def make_image(seed, vectors=64, generation=0):
    """Bytes of a valid model with arbitrary numbers drawn from `seed`."""
    rng = np.random.default_rng(seed)
    model = DeviceModel.from_parts(
        offset=rng.integers(0, 30000, 6), gain_q12=rng.integers(200, 4000, 6),
        bias=rng.integers(-(1 << 24), 1 << 24, 2),
        trend=rng.integers(-2000, 2000, (2, 6)), centres=rng.integers(0, 256, (vectors, 6)),
        weights=rng.integers(-3000, 3000, (vectors, 2)), weight_frac_bits=8,
        guards=[(-(1 << 20), 1 << 20, rng.integers(-100, 100, 6)) for _ in range(3)], generation=generation)
    return model.image


def make_hex(path, data, start=0):
    """Write an Intel HEX file of `data` at `start`; returns its path."""
    from intelhex import IntelHex

    image = IntelHex()
    image.frombytes(data, offset=start)
    image.write_hex_file(str(path))
    return path


@pytest.fixture
def program(tmp_path):
    """(path of a hex file, its bytes): 1000 arbitrary bytes, not a whole number of pages."""
    data = np.random.default_rng(7).integers(0, 256, 1000, dtype=np.uint8).tobytes()
    return make_hex(tmp_path / "program.hex", data), data
