# SPDX-License-Identifier: Apache-2.0
"""The core on a simulated ATmega328P: the same bits as on the host, and what they cost."""
import re
import zlib

import numpy as np
import pytest

import core_avr_harness as avr
from core_models import Parts, View, features_near, random_parts, twin as model_twin
from sparsegaze._core import ffi, lib
from test_core_gp import GOLDEN_CRC, golden_case

TWINS = {"assembly": (), "portable": ("SG_GP_PORTABLE",)}

# Net cycles at 64 vectors, 6 channels, 4 guards, all kernels in range. A change of either sign is worth a
# look: then change the number.
CYCLES = {("assembly", "infer_flash"): 13187, ("portable", "infer_flash"): 31699,
          ("assembly", "features"): 4381}
TOLERANCE = 0.03

MOST = [2544, 1656, 1656, 2544, 2544, 1656]
READINGS = [([300 + 11 * i, 999, 4, 700 - 20 * i, 500, 120 + i], MOST) for i in range(30)] + \
    [([1023, 1000, 999, 4, 0, 600], MOST), ([300, 900, 50, 1000, 1, 700], [64, 65, 500, 5216, 2544, 0])]


def reading_of(lit, exposure):
    """struct sg_reading as bench.c makes it."""
    return ffi.new("struct sg_reading *", {"lit_code": lit, "unlit_code": [code >> 2 for code in lit],
                                           "exposure_cycles": exposure})


@pytest.fixture(scope="session")
def bench_dir(tmp_path_factory):
    """Where the simulator's runner is built once."""
    directory = tmp_path_factory.mktemp("core_avr")
    avr.runner(directory)
    return directory


def gaze_bytes(parts, feature):
    """What the host's core makes of the features: n structs of 12 bytes."""
    view, out = View(parts.image()), ffi.new("struct sg_gaze[]", len(feature))
    assert view.verdict == lib.SG_OK
    lib.sg_batch_infer(view.view, ffi.from_buffer("uint16_t[]", np.ascontiguousarray(feature)), ffi.NULL,
                       ffi.new("struct sg_affine *"), out, len(feature))
    return bytes(ffi.buffer(out))


def exposure_bytes():
    """Flags, features and exposures over READINGS on the host, as bench.c writes them."""
    light, expose = ffi.new("struct sg_light *"), ffi.new("struct sg_expose *")
    lib.sg_light_start(light, lib.SG_WIRING_LEDS, 15984)
    lib.sg_expose_start(expose, MOST, MOST)
    out, feature = b"", ffi.new("uint16_t[6]")
    for lit, exposure in READINGS:
        reading = reading_of(lit, exposure)
        lib.sg_light_add(light, reading)
        out += bytes([lib.sg_light_features(light, feature)]) + bytes(ffi.buffer(feature))
        lib.sg_expose_cycle(expose, reading, lib.SG_WIRING_LEDS)
        out += b"".join(led.exposure_cycles.to_bytes(2, "little") for led in expose.led)
    return out


def run(bench_dir, parts, feature, twin):
    codes, exposures = zip(*READINGS)
    return avr.run_bench(bench_dir, parts.image(), feature, codes, exposures, TWINS[twin])


def check_bytes(result, parts, feature):
    """Compare every byte the bench wrote; returns the gaze bytes."""
    gaze, out = gaze_bytes(parts, feature), result.output
    trial = len(parts.image()) <= 880
    expected = b"\0" + gaze + (b"\0" + gaze if trial else b"") + exposure_bytes()
    assert out[:len(expected)] == expected
    frame, decoded = out[len(expected):-2], out[-2:]
    head, made = ffi.new("struct sg_head *", [0x0100, lib.SG_MSG_GAZE, 0]), ffi.new("uint8_t[72]")
    n = lib.sg_wire_encode(head, gaze[-12:], 12, made)
    assert frame == bytes(ffi.buffer(made, n)) and int.from_bytes(decoded, "little") == 12
    return out[1:1 + len(gaze)]


@pytest.mark.parametrize("twin", TWINS)
def test_golden_vectors_are_bit_identical(bench_dir, twin):
    parts, feature = golden_case()
    crc = zlib.crc32(check_bytes(run(bench_dir, parts, feature, twin), parts, feature))
    print(f"golden CRC-32 over 64 predictions, ATmega328P, {twin}: {crc:08x}")
    assert crc == GOLDEN_CRC


@pytest.mark.parametrize("twin", TWINS)
@pytest.mark.parametrize("d,n", [(1, 1), (3, 48), (5, 7), (6, 48), (6, 200)])
def test_random_models_from_flash_and_memory_are_bit_identical(bench_dir, twin, d, n):
    rng = np.random.default_rng(10 * d + n)
    parts = random_parts(rng, n, d, guards=n % 5)
    wild = rng.integers(0, 65536, (20, 6)).astype(np.uint16)
    feature = np.concatenate([features_near(rng, parts, 30), wild])
    check_bytes(run(bench_dir, parts, feature, twin), parts, feature)


@pytest.mark.parametrize("twin", TWINS)
def test_extremes_of_the_distance_and_of_every_operand_are_bit_identical(bench_dir, twin):
    # T at both ends of 24 bits, at 0, around 2^20 and around every carry; weights and trends at their limits.
    rows, weights = [], []
    for i in range(12):
        for c in (0, 1, 128, 255):
            rows.append([c] * 6 if i % 3 else [c, 255 - c] * 3)
            weights.append([(-32768, 32767, -1, 1, 255, -256)[(i + c) % 6], (32767, -32768, 0, 256)[i % 4]])
    parts = Parts(offset=np.zeros(6, int), gain_q12=np.full(6, 4096), bias=np.array([2 ** 30, -2 ** 30]),
                  trend=np.array([[32767, -32768, -1, 1, 255, -256]] * 2), centre=np.array(rows),
                  weight=np.array(weights), weight_frac_bits=5,
                  guard=[(-14336, -2 ** 15, 2 ** 15 - 1, np.array([-12, 17, -1, 1, 0, -32])),
                         (14336, -12 * 10 ** 3, 4 * 10 ** 3, np.array([-63, 0, 0, 0, 0, 0])),
                         (0, -2 ** 15, 2 ** 15 - 1, np.zeros(6, int)),
                         (3, -4, 5, np.array([0, 0, 63, 0, 0, 0]))],
                  expected=np.arange(20 * 20 * 4).reshape(20, 20, 4) % 256,
                  sigma=1 + np.arange(20 * 20).reshape(20, 20) % 255, origin=(-16384, 16384), scale=(255, 1),
                  limit=64515, sigma_gain=255)
    s = (0, 1, 15, 16, 255, 256, 4094, 4095)
    feature = np.array([[v] * 6 for v in s] + [[a, b] * 3 for a in s for b in s if a != b], np.uint16)
    check_bytes(run(bench_dir, parts, feature, twin), parts, feature)


@pytest.mark.parametrize("twin", TWINS)
def test_cycles_at_64_vectors(bench_dir, twin):
    rng = np.random.default_rng(2)
    parts = Parts(offset=np.full(6, 20000), gain_q12=np.full(6, 1500),
                  bias=rng.integers(-2 ** 27, 2 ** 27, 2),
                  trend=rng.integers(-9000, 9000, (2, 6)), centre=rng.integers(98, 103, (64, 6)),
                  weight=rng.integers(-32768, 32768, (64, 2)),
                  guard=[(0, -2 ** 15, 2 ** 15 - 1, rng.integers(-10, 11, 6)) for _ in range(4)],
                  expected=rng.integers(0, 256, (9, 9, 4)), sigma=rng.integers(1, 200, (9, 9)))
    feature = (20000 + 1600 * 4096 // 1500 + rng.integers(0, 40, (20, 6))).astype(np.uint16)
    cycles = run(bench_dir, parts, feature, twin).cycles
    print(twin, cycles)
    assert cycles["empty"] == (1, 0, 0)
    for (which, section), expected in CYCLES.items():
        if which == twin:
            assert cycles[section][2] == pytest.approx(expected, rel=TOLERANCE), section
    assert cycles["infer_flash"][2] <= {"assembly": 13500, "portable": 40000}[twin]


def test_inference_takes_the_same_time_whatever_the_features(bench_dir):
    # Far from every vector, on top of one, clamped, saturated, refused by a guard, off the grid.
    rng = np.random.default_rng(3)
    parts = random_parts(rng, 40, guards=4, limit=9000)
    parts.guard = [(128 * (i == 0), -50, 240, np.eye(6, dtype=int)[i] * (i < 2)) for i in range(4)]
    parts.guard[1] = (0, -10, 200, parts.guard[1][3] * 0)
    parts.expected[:] = 0
    wild = rng.integers(0, 65536, (40, 6))
    corners = np.array([[65535 * (i >> j & 1) for j in range(6)] for i in range(64)])
    feature = np.concatenate([features_near(rng, parts, 60), wild, corners]).astype(np.uint16)
    deg, outside, doubt, _ = model_twin(parts, feature)
    assert outside.any() and not outside.all() and (doubt > 9000).any() and np.ptp(deg) > 5000
    for section in ("infer_flash", "infer_memory"):
        count, least, most = run(bench_dir, parts, feature, "assembly").cycles[section]
        print(section, count, least, most)
        assert count == len(feature) and most - least <= 8      # flags set or not


def test_no_float_no_division_no_heap_is_linked(bench_dir):
    parts, feature = golden_case()
    run(bench_dir, parts, feature, "portable")
    symbols = avr.run([avr.avr_tool("avr-nm"), bench_dir / "bench.elf"])
    names = {line.split()[-1] for line in symbols.splitlines()}
    bad = {n for n in names if re.search(r"div|mod[qhs]i|(sf|df)[0-9]?$|malloc|free|printf|memcpy$", n)}
    assert "sg_gp_predict" in names and not bad
    ours = [line.split() for line in symbols.splitlines() if line.split()[-1].startswith("sg_")]
    assert not any(kind in "bBdD" for *_, kind, _ in ours)      # no variable of static duration
