# SPDX-License-Identifier: Apache-2.0
"""Networks on a simulated ATmega328P: the same bits as on the host, and what they cost."""
import re
import zlib

import numpy as np
import pytest

import core_avr_harness as avr
import mlp_avr_harness as harness
from mlp_models import expected_bytes, golden_case, inputs_near, random_model
from test_mlp import GOLDEN_CRC, corner_models

TWINS = {"assembly": (), "portable": ("SG_MLP_PORTABLE",)}

# Net cycles of a prediction from flash with 6 inputs and 2 outputs. A change of either sign is worth a look:
# then change the number.
SHAPES = {"6-16-2": ((16,), (2, 2)), "6-24-2": ((24,), (2, 2)), "6-16-16-2": ((16, 16), (2, 2, 2)),
          "6-16-16-2 with 1-byte weights inside": ((16, 16), (2, 1, 2)),
          "6-64x4-2 with 1-byte weights inside": ((64,) * 4, (2, 1, 1, 1, 2))}
CYCLES = {("6-16-2", "assembly"): 6303, ("6-16-2", "portable"): 19273,
          ("6-24-2", "assembly"): 8827, ("6-24-2", "portable"): 27657,
          ("6-16-16-2", "assembly"): 14281, ("6-16-16-2", "portable"): 45410,
          ("6-16-16-2 with 1-byte weights inside", "assembly"): 12448,
          ("6-16-16-2 with 1-byte weights inside", "portable"): 40274,
          ("6-64x4-2 with 1-byte weights inside", "assembly"): 229386,
          ("6-64x4-2 with 1-byte weights inside", "portable"): 786772}
TOLERANCE = 0.03
# What the notes of this project measured for a network of 16-bit integers in plain C.
PLAIN_C = {"6-16-2": 15628, "6-24-2": 23010, "6-16-16-2": 40331}
STACK_BYTES = {"assembly": 110, "portable": 170}


@pytest.fixture(scope="session")
def bench_dir(tmp_path_factory):
    """Where the simulator's runner is built once."""
    directory = tmp_path_factory.mktemp("mlp_avr")
    avr.runner(directory)
    return directory


def check(bench_dir, model, features, twin):
    """Run on the simulated chip and compare every byte; returns the Result."""
    result = harness.run(bench_dir, model, features, TWINS[twin])
    expected = expected_bytes(model, features)
    assert result.verdict == 0 and result.flash == expected
    if len(model.image) <= harness.MEMORY_BYTES:
        assert result.memory == expected
    return result


@pytest.mark.parametrize("twin", TWINS)
def test_golden_network_is_bit_identical(bench_dir, twin):
    result = check(bench_dir, *golden_case(), twin)
    crc = zlib.crc32(result.flash)
    print(f"golden CRC-32 over 64 predictions of a network, ATmega328P, {twin}: {crc:08x}")
    assert crc == GOLDEN_CRC


@pytest.mark.parametrize("twin", TWINS)
@pytest.mark.parametrize("shape", [
    (1, (), 1, (1,)), (8, (), 8, (2,)), (3, (5, 7, 1, 9), 3, (1, 2, 1, 2, 1)), (8, (64,), 7, (2, 1)),
    (6, (33, 2), 2, (1, 1, 1)), (6, (16, 16), 2, (2, 2, 2))], ids=str)
def test_random_networks_from_flash_and_memory_are_bit_identical(bench_dir, twin, shape):
    rng = np.random.default_rng(len(shape[1]) + 10 * shape[0])
    model = random_model(rng, *shape)
    wild = rng.integers(0, 65536, (15, model.inputs)).astype(np.uint16)
    check(bench_dir, model, np.concatenate([inputs_near(rng, model, 25), wild]), twin)


@pytest.mark.parametrize("twin", TWINS)
@pytest.mark.parametrize("name", corner_models())
def test_weights_at_their_limits_at_every_corner_are_bit_identical(bench_dir, twin, name):
    model, features = corner_models()[name]
    check(bench_dir, model, features[::5], twin)


@pytest.mark.parametrize("twin", TWINS)
@pytest.mark.parametrize("shape", SHAPES)
def test_cycles_stack_and_constant_time(bench_dir, shape, twin):
    rng = np.random.default_rng(3)
    model = random_model(rng, 6, SHAPES[shape][0], 2, SHAPES[shape][1])
    corners = np.array([[0] * 6, [65535] * 6], np.uint16)
    result = check(bench_dir, model, np.concatenate([inputs_near(rng, model, 20), corners]), twin)
    count, low, high = result.cycles["flash"]
    memory = result.cycles.get("memory", ("", "", "-"))[2]
    print(f"{shape}, {twin}: {low}..{high} cycles from flash, {memory} from memory; plain C of the notes "
          f"{PLAIN_C.get(shape, '-')}; open {result.cycles['open'][2]}, stack {result.stack}, "
          f"image {len(model.image)}, code and table {result.text} bytes")
    assert result.cycles["empty"] == (1, 0, 0) and count == 22
    assert high == pytest.approx(CYCLES[shape, twin], rel=TOLERANCE)
    assert low == high                                          # one time for every input
    assert 0 < result.stack <= STACK_BYTES[twin]
    if twin == "assembly":
        assert 2.3 * high <= PLAIN_C.get(shape, np.inf)
        assert 3.0 * high <= CYCLES[shape, "portable"]


def test_no_float_no_division_no_heap_is_linked(bench_dir):
    model, features = golden_case()
    harness.run(bench_dir, model, features, TWINS["portable"])
    symbols = avr.run([avr.avr_tool("avr-nm"), bench_dir / "mlp_bench.elf"])
    names = {line.split()[-1] for line in symbols.splitlines()}
    bad = {n for n in names if re.search(r"div|mod[qhs]i|(sf|df)[0-9]?$|malloc|free|printf|memcpy$", n)}
    assert "sg_mlp_predict" in names and not bad
    ours = [line.split() for line in symbols.splitlines() if line.split()[-1].startswith("sg_")]
    assert not any(kind in "bBdD" for *_, kind, _ in ours)      # no variable of static duration
