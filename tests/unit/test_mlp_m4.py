# SPDX-License-Identifier: Apache-2.0
"""Networks on a Cortex-M4 in QEMU: the same bits as on the host, and what they cost in instructions."""
import zlib

import numpy as np
import pytest

import core_m4_harness as m4
from mlp_models import expected_bytes, golden_case, inputs_near, random_model
from test_mlp import GOLDEN_CRC, corner_models
from test_mlp_avr import SHAPES

OPEN = ("struct sg_mlp_view view; static uint16_t scratch[SG_MLP_SCRATCH_MAX];"
        "if (sg_mlp_open(&view, image, sizeof image, 0) != SG_OK) return 1;")
PREDICT = ("uint8_t *end = out + 2 * view.outputs;"
           "end[1] = (uint8_t)sg_mlp_predict(&view, (const uint16_t *)in, scratch, (int16_t *)out, end);")
# Instructions of a prediction, the call included.
INSTRUCTIONS = {"6-16-2": 2234, "6-24-2": 3134, "6-16-16-2": 5003,
                "6-16-16-2 with 1-byte weights inside": 4139, "6-64x4-2 with 1-byte weights inside": 66737}
TOLERANCE = 0.03


def run(directory, model, features):
    """sg_mlp_predict over the features on the Cortex-M4; compares every byte; returns the Result."""
    result = m4.run_cases(directory, PREDICT, features, 2 * model.outputs + 2, ["sg_mlp.h", "sg_err.h"], OPEN,
                          {"image": model.image})
    assert result.output.tobytes() == expected_bytes(model, features)
    return result


def test_golden_network_is_bit_identical(tmp_path):
    crc = zlib.crc32(run(tmp_path, *golden_case()).output.tobytes())
    print(f"golden CRC-32 over 64 predictions of a network, Cortex-M4: {crc:08x}")
    assert crc == GOLDEN_CRC


@pytest.mark.parametrize("shape", [(8, (), 8, (2,)), (3, (5, 7, 1, 9), 3, (1, 2, 1, 2, 1)),
                                   (6, (64,) * 4, 2, (2,) * 5)], ids=str)
def test_random_networks_are_bit_identical(tmp_path, shape):
    rng = np.random.default_rng(shape[0])
    model = random_model(rng, *shape)
    wild = rng.integers(0, 65536, (100, model.inputs)).astype(np.uint16)
    run(tmp_path, model, np.concatenate([inputs_near(rng, model, 100), wild]))


@pytest.mark.parametrize("name", [name for name in corner_models() if name.endswith("65535")])
def test_weights_at_their_limits_at_every_corner_are_bit_identical(tmp_path, name):
    run(tmp_path, *corner_models()[name])


@pytest.mark.parametrize("shape", SHAPES)
def test_instructions_are_the_same_for_every_input(tmp_path, shape):
    rng = np.random.default_rng(3)
    model = random_model(rng, 6, SHAPES[shape][0], 2, SHAPES[shape][1])
    corners = np.array([[0] * 6, [65535] * 6], np.uint16)
    result = run(tmp_path, model, np.concatenate([inputs_near(rng, model, 20), corners]))
    low, high = int(result.instructions.min()), int(result.instructions.max())
    print(f"{shape}: {low}..{high} instructions on a Cortex-M4")
    assert low == high == pytest.approx(INSTRUCTIONS[shape], rel=TOLERANCE)
