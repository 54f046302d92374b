# SPDX-License-Identifier: Apache-2.0
"""Stored networks with every byte changed and the CRC repaired, under address and undefined-behaviour
sanitizers.

SPARSEGAZE_FUZZ_ROUNDS in the environment, divided by 100, lengthens the run (default 200 rounds a seed)."""
import os

import pytest

from altered_core import CORE, altered
from test_core_fuzz import compiled, run

ROUNDS = str(int(os.environ.get("SPARSEGAZE_FUZZ_ROUNDS", "20000")) // 100)
SOURCES = ("sg_mlp.c", "sg_mlp_loop.c", "sg_mlp_table.c", "sg_model.c")


def build(directory, core=CORE):
    """The program of this file."""
    return compiled(directory, "mlp_fuzz", [core / name for name in SOURCES])


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The fuzz program."""
    return build(tmp_path_factory.mktemp("mlp_fuzz"))


@pytest.mark.parametrize("seed", [1, 2])
def test_changed_networks_are_refused_or_stay_in_bounds(program, seed):
    code, out, err = run(program, seed, ROUNDS)
    print(out)
    assert code == 0, err
    words = out.split()
    counts = {words[i]: int(words[i + 1]) for i in range(0, len(words), 2)}
    assert set(counts) == {"opened", "short", "magic", "version", "bounds", "crc"}
    assert all(counts.values()), counts         # every way out was taken


FAULTS = {
    "a length that is trusted": ("sg_mlp.c", "    if (length > room)\n        return SG_E_SHORT;\n", ""),
    "a width that is trusted": ("sg_mlp.c", "width < 1 || width > SG_MLP_WIDTH_MAX", "width < 1"),
    "more outputs than there may be": ("sg_mlp.c", " || outputs > SG_MLP_OUTPUTS_MAX", ""),
    "scratch of the last layer alone": ("sg_mlp.c", "if (layer.rows > widest)", "if (k == hidden)"),
    "an index beyond the table": ("sg_mlp_loop.c", "tanh_table[u >> 8]", "tanh_table[u >> 7]"),
    "saturation that is not said": ("sg_mlp_loop.c", "    run->saturated |= (uint8_t)above;\n",
                                    "    run->saturated = 255;\n"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_fuzzer_finds_a_planted_fault(fault, tmp_path):
    code, _, err = run(build(tmp_path, altered(tmp_path, FAULTS[fault])), 1, "40")
    assert code != 0 and ("ERROR: AddressSanitizer" in err or "broken invariant" in err
                          or "runtime error" in err)
