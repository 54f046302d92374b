# SPDX-License-Identifier: Apache-2.0
"""The core under hostile bytes, with address and undefined-behaviour sanitizers.

SPARSEGAZE_FUZZ_ROUNDS in the environment lengthens the run (default 20000 rounds per seed)."""
import os
import pathlib
import subprocess

import pytest

from altered_core import CORE, altered

ROUNDS = os.environ.get("SPARSEGAZE_FUZZ_ROUNDS", "20000")
FLAGS = ["-std=c11", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined",
         "-fno-sanitize-recover=all", "-fno-omit-frame-pointer"]


def compiled(directory, name, sources):
    """Compile a fuzz program of this folder with sources of a core; returns its path."""
    target = directory / name
    done = subprocess.run(["gcc", *FLAGS, f"-I{sources[0].parent}", *sources,
                           pathlib.Path(__file__).with_name(f"{name}.c"), "-o", target], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


def build(directory, core=CORE):
    """The program of this file."""
    return compiled(directory, "core_fuzz", sorted(core.glob("*.c")))


def run(program, seed, rounds=ROUNDS):
    """(exit code, stdout, stderr)."""
    done = subprocess.run([program, str(seed), rounds], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The fuzz program."""
    return build(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.parametrize("seed", [1, 2])
def test_random_and_damaged_bytes_break_no_invariant(program, seed):
    code, out, err = run(program, seed)
    print(out)
    assert code == 0, err
    words = out.split()
    counts = {words[i]: int(words[i + 1]) for i in range(0, len(words), 2)}
    assert set(counts) == {"decoded", "opened", "short", "magic", "version", "bounds", "crc"}
    assert all(counts.values()), counts         # every way out was taken


FAULTS = {
    "a decoder that trusts the code byte": (
        "sg_wire.c",
        "        if ((size_t)(code - 1U) > (size_t)(end - at))\n            return SG_E_SHORT;\n", ""),
    "a decoder that trusts the length": ("sg_wire.c", "byte == 0 || to == full", "byte == 0"),
    "a model opened without its length": ("sg_model.c",
                                          "    if (length > room)\n        return SG_E_SHORT;\n", ""),
    "a receiver that never forgets": ("sg_link.c", "    rx->fill = 0;\n",
                                      "    rx->fill = fill > 71 ? 72 : 0;\n"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_fuzzer_finds_a_planted_fault(fault, tmp_path):
    code, _, err = run(build(tmp_path, altered(tmp_path, FAULTS[fault])), 1, "3000")
    assert code != 0 and ("ERROR: AddressSanitizer" in err or "broken invariant" in err
                          or "runtime error" in err)
