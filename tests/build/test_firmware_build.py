# SPDX-License-Identifier: Apache-2.0
"""The firmware that users flash is the one that these sources give, anywhere, with or without a network."""

import importlib.util
import os
import pathlib
import shutil
import subprocess
import sys

import pytest

REPO = pathlib.Path(__file__).resolve().parents[2]
AVR_GCC = REPO / ".pio-offline" / "packages" / "toolchain-atmelavr" / "bin" / "avr-gcc"
# Nothing listens there: a build that asks the network for anything fails instead of being lucky.
DEAD_PROXY = {
    name: "http://127.0.0.1:9"
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "http_proxy", "https_proxy")
}


def load_tool(name):
    spec = importlib.util.spec_from_file_location(name, REPO / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


check_link = load_tool("check_link")
pio_offline = load_tool("pio_offline")


def git(*arguments):
    return subprocess.run(["git", *arguments], cwd=REPO, check=True, capture_output=True).stdout


def pio(tree, *arguments):
    """Starts pio through the tree's own copy of the script, with no network."""
    return subprocess.Popen(
        [sys.executable, "tools/pio_offline.py", *arguments],
        cwd=tree,
        env={**os.environ, **DEAD_PROXY},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.fixture
def other_tree(tmp_path):
    """A copy of what the firmware is made from, somewhere else."""
    tree = tmp_path / "elsewhere"
    (tree / "tools").mkdir(parents=True)
    shutil.copy(REPO / "tools" / "pio_offline.py", tree / "tools")
    shutil.copy(REPO / "platformio.ini", tree)
    shutil.copytree(REPO / "firmware", tree / "firmware")
    return tree


def test_the_committed_hex_is_the_built_one(firmware_hex):
    built = (REPO / "build" / "firmware" / "firmware.hex").read_bytes()
    assert firmware_hex.read_bytes() == built
    if git("status", "--porcelain", "--", "firmware", "platformio.ini").strip():
        return  # sources under work: the hex is committed with them
    path = firmware_hex.relative_to(REPO).as_posix()
    assert git("show", f"HEAD:{path}") == built, f"commit {path}: make firmware has built it anew"


def test_two_builds_at_once_in_another_folder_give_the_same_bytes_without_a_network(other_tree, firmware_hex):
    # Without the lock the second finds a package folder, or a build folder, half made.
    runs = [pio(other_tree, "run", "-s", "-e", "nano") for _ in range(2)]
    outputs = [run.communicate()[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], outputs
    assert (other_tree / ".pio/build/nano/firmware.hex").read_bytes() == firmware_hex.read_bytes()


def test_a_compile_error_fails_the_build_and_leaves_no_hex(other_tree):
    (other_tree / "firmware" / "app" / "main.c").write_text("int main(void) { return }\n")
    run = pio(other_tree, "run", "-s", "-e", "nano")
    output = run.communicate()[0]
    assert run.returncode == 1 and "error" in output
    assert not (other_tree / ".pio/build/nano/firmware.hex").exists()


def test_an_interpreter_without_platformio_is_told_to_run_setup(other_tree):
    done = subprocess.run(
        [sys.executable, "-S", "-E", "tools/pio_offline.py", "--seed-only"],
        cwd=other_tree,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "make setup" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "version, major, coded",
    [
        ("7.3.0", 1, "1.70300.0"),
        ("4.11.1", 4, "4.41101.0"),
        ("5.4.0", 1, "1.50400.0"),
        ("14.2", 1, "1.140200.0"),
    ],
)
def test_versions_are_coded_as_the_registry_does(version, major, coded):
    assert pio_offline.coded_version(version, major) == coded


def test_no_float_division_heap_or_stdio_is_linked(firmware_elf):
    assert check_link.forbidden(check_link.symbols(firmware_elf)) == []


# Negative controls: one innocent-looking operator each.
@pytest.mark.parametrize(
    "operation, meaning",
    [
        ("b = b * a;", "floating point"),
        ("b = i;", "floating point"),
        ("c = c / i;", "division"),
        ("c = c % i;", "division"),
        ("i = i / s;", "division"),
        ("s = s % (unsigned char)i;", "division"),
        ("c = (long)malloc(i);", "the heap"),
    ],
)
def test_link_check_sees(operation, meaning, tmp_path):
    source = tmp_path / "main.c"
    source.write_text(
        "#include <stdlib.h>\n"
        "volatile float a, b; volatile int i; volatile long c; volatile unsigned char s;\n"
        f"int main(void) {{ for (;;) {{ {operation} }} }}\n"
    )
    elf = tmp_path / "program.elf"
    # Without optimisation: even division by a constant stays one.
    subprocess.run([AVR_GCC, "-mmcu=atmega328p", "-O0", source, "-o", elf], check=True)
    assert meaning in {found for _, found in check_link.forbidden(check_link.symbols(elf))}
    assert check_link.main([str(elf)]) == 1


@pytest.mark.parametrize("content", [b"", b"not an ELF file at all"])
def test_link_check_refuses_what_it_cannot_judge(content, tmp_path, capsys):
    path = tmp_path / "firmware.elf"
    path.write_bytes(content)
    assert check_link.main([str(path)]) == 1
    assert check_link.main([str(tmp_path / "missing.elf")]) == 1
    assert check_link.main([]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 2
