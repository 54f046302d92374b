# SPDX-License-Identifier: Apache-2.0
"""Negative controls: a copy of the core with a deliberate fault in sg_mlp must change the golden checksum."""
import zlib

import numpy as np
import pytest

import core_avr_harness as avr
import mlp_avr_harness as harness
from altered_core import altered
from mlp_models import expected_bytes, golden_case
from test_core_negative import build
from test_mlp import GOLDEN_CRC

FAULTS = {
    "the carry of two low bytes": ("sg_mlp_loop.c", "(sum << 7) - (low >> 1)", "(sum << 7)"),
    "the half of the sum": ("sg_mlp_loop.c", "    sum >>= 1;\n", ""),
    "the rounding of q": ("sg_mlp_loop.c", "* scale + 128U;", "* scale;"),
    "the clamp of the argument": ("sg_mlp_loop.c", "(uint16_t)(q | ones_if(q >> 16))", "(uint16_t)q"),
    "the half of the interpolation": ("sg_mlp_loop.c", "(u & 255U) + 128U)", "(u & 255U))"),
    "the fourth row": ("sg_mlp_loop.c", "product(at + 3 * bytes", "product(at + 2 * bytes"),
    "the input's clamp": ("sg_mlp_loop.c", "(uint16_t)(a | above)", "(uint16_t)a"),
    "one table entry": ("sg_mlp_table.c", "0, 710, ", "0, 711, "),
    "the flag": ("sg_mlp.c", "(clamped | run.saturated)", "(run.saturated)"),
}


def golden_crc(core, directory):
    """Checksum of the golden case by an extension built from a copy of the core."""
    module = build(core, directory)
    ffi, lib = module.ffi, module.lib
    model, features = golden_case()
    view, image = ffi.new("struct sg_mlp_view *"), ffi.from_buffer("uint8_t[]", model.image)
    assert lib.sg_mlp_open(view, image, len(model.image), 0) == lib.SG_OK
    scratch, output, flags = ffi.new("uint16_t[128]"), ffi.new("int16_t[8]"), ffi.new("uint8_t *")
    out = b""
    for row in features:
        verdict = lib.sg_mlp_predict(view, [int(v) for v in row], scratch, output, flags)
        out += bytes(ffi.buffer(output, 4)) + bytes([flags[0], verdict & 255])
    return zlib.crc32(out)


def test_an_unaltered_copy_is_green(tmp_path):
    assert golden_crc(altered(tmp_path), tmp_path / "out") == GOLDEN_CRC


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_core_turns_the_golden_network_red(fault, tmp_path):
    assert golden_crc(altered(tmp_path, FAULTS[fault]), tmp_path / "out") != GOLDEN_CRC


ASSEMBLY_FAULTS = {
    "a carry into the third byte": (
        "    mul wl, ah\n    add \\z0, r0\n    adc \\z1, r1\n    adc \\z2, zero\n",
        "    mul wl, ah\n    add \\z0, r0\n    adc \\z1, r1\n"),
    "the sign's mask": ("    lsl sign\n    sbc sign, sign\n", "    lsl sign\n    clr sign\n"),
    "the clamp of the argument": ("    or r26, r30\n    or r27, r30\n", "    or r26, r30\n"),
}


@pytest.mark.parametrize("fault", ASSEMBLY_FAULTS)
def test_a_broken_twin_differs_from_the_host(fault, tmp_path, monkeypatch):
    core = altered(tmp_path, ("sg_mlp_avr.S", *ASSEMBLY_FAULTS[fault]))
    monkeypatch.setattr(avr, "CORE", core)
    flags = [flag for flag in avr.AVR_FLAGS if not flag.startswith("-I")]
    monkeypatch.setattr(avr, "AVR_FLAGS", [*flags, f"-I{core}"])
    model, features = golden_case()
    wild = np.random.default_rng(0).integers(0, 65536, (40, 6)).astype(np.uint16)
    rows = np.concatenate([features, wild])
    assert harness.run(tmp_path, model, rows).flash != expected_bytes(model, rows)
