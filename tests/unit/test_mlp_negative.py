# SPDX-License-Identifier: Apache-2.0
"""Negative controls: a copy of the core with a deliberate fault in sg_mlp must change the golden checksum."""
import importlib.util
import shutil
import zlib

import numpy as np
import pytest

import core_avr_harness as avr
import mlp_avr_harness as harness
from mlp_models import expected_bytes, golden_case
from sparsegaze import _core_build
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
    path = _core_build.build(str(directory), str(core))
    spec = importlib.util.spec_from_file_location("sparsegaze._core", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
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


@pytest.fixture
def core_copy(tmp_path):
    """The core's sources, to be altered."""
    shutil.copytree(avr.CORE, tmp_path / "core")
    (tmp_path / "out").mkdir()
    return tmp_path / "core"


def test_an_unaltered_copy_is_green(core_copy):
    assert golden_crc(core_copy, core_copy.parent / "out") == GOLDEN_CRC


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_core_turns_the_golden_network_red(fault, core_copy):
    name, right, wrong = FAULTS[fault]
    text = (core_copy / name).read_text(encoding="utf-8")
    assert text.count(right) == 1
    (core_copy / name).write_text(text.replace(right, wrong), encoding="utf-8")
    assert golden_crc(core_copy, core_copy.parent / "out") != GOLDEN_CRC


ASSEMBLY_FAULTS = {
    "a carry into the third byte": (
        "    mul wl, ah\n    add \\z0, r0\n    adc \\z1, r1\n    adc \\z2, zero\n",
        "    mul wl, ah\n    add \\z0, r0\n    adc \\z1, r1\n"),
    "the sign's mask": ("    lsl sign\n    sbc sign, sign\n", "    lsl sign\n    clr sign\n"),
    "the clamp of the argument": ("    or r26, r30\n    or r27, r30\n", "    or r26, r30\n"),
}


@pytest.mark.parametrize("fault", ASSEMBLY_FAULTS)
def test_a_broken_twin_differs_from_the_host(fault, tmp_path, monkeypatch):
    right, wrong = ASSEMBLY_FAULTS[fault]
    core = tmp_path / "core"
    shutil.copytree(avr.CORE, core)
    text = (core / "sg_mlp_avr.S").read_text(encoding="utf-8")
    assert text.count(right) == 1
    (core / "sg_mlp_avr.S").write_text(text.replace(right, wrong), encoding="utf-8")
    monkeypatch.setattr(avr, "CORE", core)
    flags = [flag for flag in avr.AVR_FLAGS if not flag.startswith("-I")]
    monkeypatch.setattr(avr, "AVR_FLAGS", [*flags, f"-I{core}"])
    model, features = golden_case()
    wild = np.random.default_rng(0).integers(0, 65536, (40, 6)).astype(np.uint16)
    rows = np.concatenate([features, wild])
    assert harness.run(tmp_path, model, rows).flash != expected_bytes(model, rows)
