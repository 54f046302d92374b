# SPDX-License-Identifier: Apache-2.0
"""Negative controls: a copy of the core with one deliberate fault must turn its test red."""
import importlib.util

import numpy as np
import pytest

from altered_core import altered
from core_models import View, features_near, random_parts, twin
from sparsegaze import _core_build
from test_core_gp import GOLDEN_CRC, golden_crc

FAULTS = {
    "the shift of the interpolated drop": ("sg_gp_loop.c", "fraction_q8) >> 6)", "fraction_q8) >> 7)"),
    "the sign of a weight": ("sg_gp_loop.c", "sum->acc[1] = acc_elevation >> 8;",
                             "sum->acc[1] = (0U - acc_elevation) >> 8;"),
    "the kernel's end": ("sg_gp_loop.c", "index = SG_GP_EXP_BYTES - 1U", "index = SG_GP_EXP_BYTES - 9U"),
    "where the kernel's bytes begin": ("sg_gp_loop.c", "index - SG_GP_EXP_WORDS",
                                       "index - SG_GP_EXP_WORDS + 1"),
    "the scale of S2": ("sg_gp_loop.c", "squares >> 5", "squares >> 4"),
    "the product of the low bytes": ("sg_gp_loop.c", "* k_q16 - low", "* k_q16"),
    "the rounding": ("sg_gp_loop.c", "((acc >> 8) + 2) >> 2", "acc >> 10"),
    "one guard left out": ("sg_gp_loop.c", "i < SG_MODEL_GUARDS", "i + 2 < SG_MODEL_GUARDS"),
    "a corner of the grid": ("sg_gp_loop.c", "place->share[1] = (uint8_t)(fraction_q7[0] - both)",
                             "place->share[1] = (uint8_t)(fraction_q7[1] - both)"),
    "one table entry": ("sg_gp_table.c", "65535, ", "65000, "),
}


def build(core, directory):
    """Compile a core directory into an extension of its own, outside the package, and import it."""
    directory.mkdir(exist_ok=True)
    path = _core_build.build(str(directory), str(core))
    spec = importlib.util.spec_from_file_location("sparsegaze._core", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_an_unaltered_copy_is_green(tmp_path):
    module = build(altered(tmp_path), tmp_path / "out")
    assert golden_crc(module.ffi, module.lib) == GOLDEN_CRC


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_core_turns_the_golden_vectors_red(fault, tmp_path):
    module = build(altered(tmp_path, FAULTS[fault]), tmp_path / "out")
    assert golden_crc(module.ffi, module.lib) != GOLDEN_CRC


def test_a_wrong_twin_would_be_noticed():
    rng = np.random.default_rng(0)
    parts = random_parts(rng, 64)
    feature = features_near(rng, parts, 50)
    view = View(parts.image())
    parts.centre = parts.centre.copy()
    parts.centre[0, 0] ^= 1
    expected = twin(parts, feature)[0]
    assert (view.predict(feature)[0] != np.clip(expected, -32768, 32767)).any()
