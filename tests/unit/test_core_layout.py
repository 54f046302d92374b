# SPDX-License-Identifier: Apache-2.0
"""One layout everywhere: hashes per version, sizes on host and AVR, tables as their script makes them."""
import hashlib
import re
import subprocess
import sys

import pytest

import core_avr_harness as avr
from sparsegaze import _core_build
from sparsegaze._core import ffi, lib

# A changed hash under an old version number means that two programs of the same version would not understand
# each other: raise SG_WIRE_VERSION or SG_MODEL_VERSION in the header and add the line.
WIRE_LAYOUT = {1: "55aa88f91cd2ff83", 2: "0b880ed727b526c8", 3: "b74f6aafbe6ef6a9"}
MODEL_LAYOUT = {1: "8170e606b7f66b46", 2: "0d58657c5f8ead6c"}

STRUCTS = ("sg_head", "sg_hello", "sg_status", "sg_ping", "sg_pong", "sg_mode", "sg_infer", "sg_affine",
           "sg_gaze", "sg_raw", "sg_counts", "sg_model_info", "sg_model_at", "sg_model_data",
           "sg_model_verdict", "sg_exposure", "sg_recentre", "sg_error", "sg_model_head", "sg_model_guard",
           "sg_model_trust", "sg_link_rx", "sg_expose_led", "sg_expose", "sg_light", "sg_light_channel",
           "sg_reading", "sg_health", "sg_health_sight", "sg_settings", "sg_curve", "sg_probe")


def layout_hash(header):
    """Hash of the first marked region: its enums and structs, comments and spacing aside."""
    region = _core_build.cdef_regions(avr.CORE / header)[0]
    region = re.sub(r"//[^\n]*|/\*.*?\*/", "", region, flags=re.DOTALL)
    blocks = re.findall(r"(?:enum|struct)\s+\w+\s*\{.*?\}\s*;", region, flags=re.DOTALL)
    assert len(blocks) >= 3
    text = "\n".join("".join(block.split()) for block in blocks)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def test_wire_layout_hash_belongs_to_its_version():
    assert WIRE_LAYOUT[lib.SG_WIRE_VERSION] == layout_hash("sg_wire.h")


def test_model_layout_hash_belongs_to_its_version():
    assert MODEL_LAYOUT[lib.SG_MODEL_VERSION] == layout_hash("sg_model.h")


def test_layout_hash_sees_a_moved_field_but_not_a_comment(tmp_path, monkeypatch):
    text = (avr.CORE / "sg_wire.h").read_text(encoding="utf-8")
    monkeypatch.setattr(avr, "CORE", tmp_path)
    (tmp_path / "sg_wire.h").write_text(text.replace("// device time now", "// now"), encoding="utf-8")
    assert layout_hash("sg_wire.h") == WIRE_LAYOUT[lib.SG_WIRE_VERSION]
    swapped = text.replace("    uint8_t board;", "    uint8_t bord;")
    assert swapped != text
    (tmp_path / "sg_wire.h").write_text(swapped, encoding="utf-8")
    assert layout_hash("sg_wire.h") != WIRE_LAYOUT[lib.SG_WIRE_VERSION]


def test_no_struct_of_the_wire_has_padding():
    for name in STRUCTS:
        kind = ffi.typeof(f"struct {name}")
        assert sum(ffi.sizeof(field.type) for _, field in kind.fields) == ffi.sizeof(kind), name


def test_sizes_and_offsets_are_equal_on_avr(tmp_path):
    assert avr.avr_tool("avr-gcc"), "no avr-gcc: run make setup"
    lines, expected = [], []
    for name in STRUCTS:
        kind = ffi.typeof(f"struct {name}")
        lines.append(f"sizeof(struct {name})")
        expected.append(ffi.sizeof(kind))
        for field, where in kind.fields:
            lines.append(f"offsetof(struct {name}, {field})")
            expected.append(where.offset)
    for name in ("SG_MODEL_MAGIC", "SG_E_BUSY", "SG_REPLY", "SG_EXPOSE_MAX_CYCLES", "SG_MODEL_VECTORS_MAX"):
        lines.append(f"(uint32_t)(int32_t){name}")
        expected.append(getattr(lib, name) & 0xFFFFFFFF)
    source = tmp_path / "sizes.c"
    source.write_text("".join(f'#include "{h}"\n' for h in _core_build.HEADERS) +
                      'const uint32_t sizes[] __attribute__((section(".sizes"))) = {\n' + ",\n".join(lines) +
                      "};\n", encoding="utf-8")
    avr.run([avr.avr_tool("avr-gcc"), *avr.AVR_FLAGS, "-c", source, "-o", tmp_path / "sizes.o"])
    avr.run([avr.avr_tool("avr-objcopy"), "-O", "binary", "-j", ".sizes", tmp_path / "sizes.o",
             tmp_path / "sizes"])
    raw = (tmp_path / "sizes").read_bytes()
    got = [int.from_bytes(raw[i:i + 4], "little") for i in range(0, len(raw), 4)]
    assert got == expected


def test_tables_are_what_their_script_makes():
    done = subprocess.run([sys.executable, avr.CORE / "make_tables.py", "--check"], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_cdef_regions_hold_no_preprocessor_and_no_floating_point():
    for header in _core_build.HEADERS:
        for region in _core_build.cdef_regions(avr.CORE / header):
            code = re.sub(r"//[^\n]*", "", region)
            assert "#" not in code and not re.search(r"\b(float|double|bool)\b", code), header


def test_a_file_without_marked_region_is_refused(tmp_path):
    (tmp_path / "x.h").write_text("int x;\n", encoding="utf-8")
    with pytest.raises(ValueError, match="no region"):
        _core_build.cdef_regions(tmp_path / "x.h")
