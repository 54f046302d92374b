# SPDX-License-Identifier: Apache-2.0
"""The core on a Cortex-M4: the same bits as on the host, function by function, and a counter that counts."""
import zlib

import numpy as np
import pytest

import core_m4_harness as m4
from core_models import random_parts
from sparsegaze import qemu
from sparsegaze._core import ffi, lib
from sparsegaze.device import Device
from sparsegaze.errors import NoDeviceError
from test_core_avr import READINGS, exposure_bytes, gaze_bytes
from test_core_gp import GOLDEN_CRC, golden_case
from test_core_negative import FAULTS

INFER = "sg_track_infer(&view, (const uint16_t *)in, 0, &recentre, (struct sg_gaze *)out);"
OPEN = ("struct sg_model_view view; const struct sg_affine recentre = { 0 };"
        "if (sg_model_open(&view, image, sizeof image, 0) != SG_OK) return 1;")


def infer(directory, parts, feature, **more):
    """sg_track_infer over the features on the Cortex-M4."""
    return m4.run_cases(directory, INFER, feature, ffi.sizeof("struct sg_gaze"), ["sg_track.h", "sg_err.h"],
                        OPEN, {"image": parts.image()}, **more)


def test_golden_vectors_are_bit_identical(tmp_path):
    parts, feature = golden_case()
    output = infer(tmp_path, parts, feature).output.tobytes()
    crc = zlib.crc32(output)
    print(f"golden CRC-32 over 64 predictions, Cortex-M4: {crc:08x}")
    assert output == gaze_bytes(parts, feature) and crc == GOLDEN_CRC


@pytest.mark.parametrize("d,n", [(1, 1), (3, 48), (6, 200)])
def test_random_models_are_bit_identical(tmp_path, d, n):
    rng = np.random.default_rng(10 * d + n)
    parts = random_parts(rng, n, d, guards=n % 9)
    feature = rng.integers(0, 65536, (200, 6)).astype(np.uint16)
    assert infer(tmp_path, parts, feature).output.tobytes() == gaze_bytes(parts, feature)


def test_features_and_exposures_of_readings_are_bit_identical(tmp_path):
    rows = np.array([lit + [code >> 2 for code in lit] + exposure for lit, exposure in READINGS], np.uint16)
    result = m4.run_cases(
        tmp_path, "struct sg_reading reading = { .held_code = 0 }; uint16_t feature[6];"
        "memcpy(&reading, in, 36); sg_light_add(&light, &reading);"
        "out[0] = sg_light_features(&light, feature); memcpy(out + 1, feature, 12);"
        "sg_expose_cycle(&expose, &reading, 0);"
        "for (int i = 0; i < 6; i++) memcpy(out + 13 + 2 * i, &expose.led[i].exposure_cycles, 2);",
        rows, 25, ["sg_expose.h", "sg_light.h"],
        setup="static struct sg_light light; static struct sg_expose expose; "
              "const uint16_t most[6] = { 2544, 1656, 1656, 2544, 2544, 1656 };"
              "sg_light_start(&light, 0, 15984); sg_expose_start(&expose, most, most);")
    assert result.output.tobytes() == exposure_bytes()


def test_the_counter_counts_every_instruction(tmp_path):
    # A loop of three instructions, n times; what stands round it costs the same for every n > 0.
    loop = ('uint32_t k = *(const uint32_t *)in;'
            '__asm__ volatile("1: nop\\n subs %0, #1\\n bne 1b" : "+r"(k));')
    n = np.array([[1], [2], [3], [1000], [100000]], np.uint32)
    counted = m4.run_cases(tmp_path, loop, n, 1).instructions
    assert ((counted - counted[0]) == 3 * (n[:, 0].astype(np.int64) - 1)).all()
    assert 3 <= counted[0] <= 10


def test_a_wrapped_function_is_counted_without_its_caller(tmp_path):
    n = np.array([[0], [1], [2], [10]], np.uint32)
    data = bytes(range(16))
    result = m4.run_cases(tmp_path, "*(uint16_t *)out = sg_wire_crc16(0xFFFF, bytes, *(const uint32_t *)in);",
                          n, 2, ["sg_wire.h"], data={"bytes": data}, wrap="sg_wire_crc16")
    expected = [lib.sg_wire_crc16(0xFFFF, data[:k], k) for k in n[:, 0].tolist()]
    assert result.output.view(np.uint16)[:, 0].tolist() == expected
    assert 1 <= result.function[0] < 16 and (np.diff(result.function) > 0).all()


@pytest.mark.parametrize("fault", ["the sign of a weight", "one table entry", "one guard left out"])
def test_a_broken_core_turns_the_golden_vectors_red(fault, tmp_path):
    name, right, wrong = FAULTS[fault]
    (tmp_path / "altered").mkdir()
    text = (m4.CORE / name).read_text(encoding="utf-8")
    assert text.count(right) == 1
    (tmp_path / "altered" / name).write_text(text.replace(right, wrong), encoding="utf-8")
    parts, feature = golden_case()
    broken = infer(tmp_path, parts, feature, altered=tmp_path / "altered" / name)
    assert zlib.crc32(broken.output.tobytes()) != GOLDEN_CRC


def test_a_program_that_floods_the_line_is_no_device(tmp_path):
    flood = m4.build(tmp_path, "for (uint32_t k = 0; ; k++) UART_DATA(UART_LINE) = (uint8_t)(k * 7);",
                     np.zeros((1, 1), np.uint8), 1)
    with qemu.QemuBoard(program=flood) as board:
        with pytest.raises(NoDeviceError, match="not in sparsegaze's protocol"):
            Device(board, timeout_s=1.0)


def test_a_program_that_faults_is_an_error_and_no_hang(tmp_path):
    with pytest.raises(AssertionError, match="wrote 0 bytes"):
        m4.run_cases(tmp_path, '__asm__ volatile("udf #0");', np.zeros((3, 1), np.uint8), 1)
