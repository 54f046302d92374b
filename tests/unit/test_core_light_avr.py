# SPDX-License-Identifier: Apache-2.0
"""sg_light on a simulated ATmega328P: both twins and the host give the same bits, ordinary case or not."""
import numpy as np
import pytest

import core_avr_cases
from light_reference import CAPS
from sparsegaze._core import ffi, lib

TWINS = {"assembly": (), "portable": ("SG_LIGHT_PORTABLE",)}
CHANNEL_BYTES = 20
STATE_BYTES = 6 * CHANNEL_BYTES + 8
BODY = ("out[12] = 0; sg_light_add(&light, (const struct sg_reading *)in);"
        "if (in[50] & 1) sg_light_gap(&light);"
        "if (in[50] & 2) out[12] = sg_light_features(&light, (uint16_t *)out);"
        "memcpy(out + 13, &light, sizeof light);")
SETUP = ("static struct sg_light light; static const int8_t curve[6] = { 0, 20, -20, 127, -128, 5 };"
         "sg_light_start(&light, %d, 20000); sg_light_curve(&light, curve, -%d);")
CURVE = [0, 20, -20, 127, -128, 5]


def readings(rng, n, hard):
    """Rows of 52 bytes: struct sg_reading, a byte of what to do (1 gap, 2 features), a byte of padding.

    hard: share of cycles with something unusual in them."""
    rows = []
    exposure = np.array([CAPS[1], CAPS[0], CAPS[0], CAPS[1], CAPS[1], CAPS[0]])
    ambient, flicker, signal = 0.0, 0.0, rng.uniform(5, 400, 6)
    for k in range(n):
        act = 2 if rng.random() < 0.8 else 0
        if rng.random() < 0.02:
            ambient, flicker = rng.choice([0, 3, 40, 200, 500]), rng.choice([0, 0, 1.5, 20, 150])
        if rng.random() < 0.05:
            signal = rng.uniform(5, 400, 6)
        wave = flicker * np.sin(0.69 * k + rng.normal(0, 0.01, 2))
        lit = ambient + wave[0] + signal + rng.normal(0, 0.8, 6)
        unlit = ambient + wave[1] + rng.normal(0, 0.8, 6)
        late, held = np.zeros((2, 6), int), 0
        if rng.random() < hard:
            kind, i = rng.integers(0, 9), rng.integers(0, 6)
            if kind == 0:
                exposure[i] = rng.integers(0, 5300)
            elif kind == 1:
                late[rng.integers(0, 2), i] = rng.integers(1, 256)
            elif kind == 2:
                lit[i] = rng.integers(990, 1024)
            elif kind == 3:
                unlit[i] = rng.integers(990, 1024)
            elif kind == 4:
                held = rng.integers(0, 1024)
            elif kind == 5:
                act |= 1
            elif kind == 6:
                lit, unlit = rng.integers(0, 1024, (2, 6))
            elif kind == 7:
                lit[i] = 0
            else:
                late = rng.integers(0, 60, (2, 6))
        words = np.concatenate([np.clip(np.floor([*lit, *unlit]), 0, 1023), exposure]).astype(np.uint16)
        rows.append(words.tobytes() + late.astype(np.uint8).tobytes() + np.uint16(held).tobytes()
                    + bytes([act, 0]))
    return np.frombuffer(b"".join(rows), np.uint8).reshape(n, 52)


def on_host(rows, wiring, zero_q2):
    """What the firmware should write for the same rows."""
    light, feature, out = ffi.new("struct sg_light *"), ffi.new("uint16_t[6]"), []
    lib.sg_light_start(light, wiring, 20000)
    lib.sg_light_curve(light, CURVE, -zero_q2)
    for row in rows:
        reading = ffi.new("struct sg_reading *")
        ffi.memmove(reading, row.tobytes(), 50)
        lib.sg_light_add(light, reading)
        flags, seen = 0, bytes(12)
        if row[50] & 1:
            lib.sg_light_gap(light)
        if row[50] & 2:
            ffi.memmove(feature, bytes(12), 12)
            flags = lib.sg_light_features(light, feature)
            seen = bytes(ffi.buffer(feature))
        out.append(seen + bytes([flags]) + bytes(ffi.buffer(light))[:STATE_BYTES])
    return np.frombuffer(b"".join(out), np.uint8).reshape(len(rows), 13 + STATE_BYTES)


@pytest.mark.parametrize("twin", TWINS)
@pytest.mark.parametrize("wiring", [lib.SG_WIRING_LEDS, lib.SG_WIRING_PHOTODIODES])
@pytest.mark.parametrize("hard", [0.0, 0.1, 0.7])
def test_both_twins_are_bit_identical_to_the_host(twin, wiring, hard, tmp_path):
    zero_q2 = int(10 * hard)
    rows = readings(np.random.default_rng(int(10 * hard) + wiring), 330, hard)
    result = core_avr_cases.run_cases(tmp_path, BODY, rows, 13 + STATE_BYTES, includes=["sg_light.h"],
                                      setup=SETUP % (wiring, zero_q2), defines=TWINS[twin])
    expected = on_host(rows, wiring, zero_q2)
    wrong = np.flatnonzero((result.output != expected).any(axis=1))
    assert wrong.size == 0, (wrong[:5], np.flatnonzero(result.output[wrong[0]] != expected[wrong[0]]))
