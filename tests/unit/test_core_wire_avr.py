# SPDX-License-Identifier: Apache-2.0
"""sg_wire_encode_ring on a simulated ATmega328P: both twins and the host give the same bytes anywhere."""
import numpy as np
import pytest

import core_avr_cases
from sparsegaze._core import ffi, lib

TWINS = {"assembly": (), "portable": ("SG_WIRE_PORTABLE",)}
RING, GUARD, UNTOUCHED = 100, 4, 0xAA
# in: head, body, its length, where to begin. out: where it ended, ring with what lies round it.
BODY = ("memset(out + 2, %d, %d);"
        "uint16_t end = sg_wire_encode_ring((const struct sg_head *)in, in[68] ? in + 4 : 0, in[68],"
        "out + 2 + %d, %d, in[69]); memcpy(out, &end, 2);" % (UNTOUCHED, RING + 2 * GUARD, GUARD, RING))
OUT_BYTES = 2 + RING + 2 * GUARD


def on_host(row):
    """What the firmware should write for 70 bytes of input."""
    n, at = int(row[68]), int(row[69])
    head = ffi.new("struct sg_head *")
    ffi.memmove(head, row[:4].tobytes(), 4)
    ring = ffi.new("uint8_t[]", [UNTOUCHED] * (RING + 2 * GUARD))
    end = lib.sg_wire_encode_ring(head, row[4:68].tobytes(), n, ring + GUARD, RING, at)
    assert end == (at + n + 8) % RING
    return end.to_bytes(2, "little") + bytes(ffi.buffer(ring))


def packets():
    """Every length with zeros, without, of nothing else, at random places; every place of a ring."""
    rng = np.random.default_rng(7)
    rows = []
    for share in (0.0, 0.1, 0.6, 1.0):
        for n in range(lib.SG_WIRE_BODY_MAX + 1):
            content = rng.integers(1, 256, 68) * (rng.random(68) >= share)
            rows.append([*content, n, rng.integers(0, RING)])
    for at in range(RING):
        rows.append([*(rng.integers(0, 256, 68) * (rng.random(68) < 0.8)), (0, 12, 32, 64)[at % 4], at])
    return np.array(rows, np.uint8)


@pytest.mark.parametrize("twin", TWINS)
def test_both_twins_write_the_bytes_of_the_host(twin, tmp_path):
    rows = packets()
    result = core_avr_cases.run_cases(tmp_path, BODY, rows, OUT_BYTES, includes=["sg_wire.h"],
                                      defines=TWINS[twin])
    wrong = [k for k, row in enumerate(rows) if result.output[k].tobytes() != on_host(row)]
    assert not wrong, (wrong[:5], rows[wrong[0]])


def test_the_assembly_is_what_runs(tmp_path):
    """The twins are two: the firmware's takes less time."""
    most = {twin: core_avr_cases.run_cases(tmp_path, BODY, packets()[-8:], OUT_BYTES, includes=["sg_wire.h"],
                                           defines=defines).cycles[1] for twin, defines in TWINS.items()}
    print(most)
    assert most["assembly"] < most["portable"]
