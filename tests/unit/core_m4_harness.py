# SPDX-License-Identifier: Apache-2.0
"""Any function of the core on a Cortex-M4 in QEMU, over given inputs: its bytes and its instructions.

    result = run_cases(tmp_path, "*(uint16_t *)out = sg_expose_from_us_q4(*(const uint16_t *)in);",
                       inputs=rows, out_bytes=2, includes=["sg_expose.h"])

The program is the core, the start-up of firmware/ports/mps2an386 and a main made here. QEMU counts
instructions, not cycles.
"""
import atexit
import functools
import pathlib
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass

import numpy as np

from sparsegaze import qemu

ROOT = pathlib.Path(__file__).resolve().parents[2]
CORE = ROOT / "firmware" / "core"
PORT = ROOT / "firmware" / "ports" / "mps2an386"
PREFIX = "arm-none-eabi-"
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
FLAGS = re.search(r"^M4_FLAGS := (.*)$", MAKEFILE, re.MULTILINE)[1].split()
SECTION_CASE, SECTION_FUNCTION, SECTION_NOTHING = 0, 1, 2

MAIN = """
#include "port.h"
{includes}
#include <string.h>
#include "case_data.h"

enum {{ CASE_SPACE = 0 }};
void nothing(void);

static void put(const uint8_t *byte, uint32_t n)
{{
    while (n--)
        UART_DATA(UART_LINE) = *byte++;
}}

int main(void)
{{
    static uint8_t out[{out_bytes}] __attribute__((aligned(8)));
    UART_DIVIDER(UART_LINE) = 16;
    UART_CTRL(UART_LINE) = UART_CTRL_TX;
    scope_start();
    nothing();
    {setup}
    for (uint32_t i = 0; i < {count}; i++) {{
        const uint8_t *in = case_in[i];
        (void)in;
        memset(out, 0, sizeof out);
        HAL_BEGIN({section});
        {body}
        HAL_END({section});
        put(out, sizeof out);
    }}
    return 0;
}}
"""

# A function marked round its call; `nothing` tells what that costs. The return address waits in a variable,
# so that arguments on the stack stay where the function looks for them: it must not be recursive.
WRAP = """
    .syntax unified
    .thumb
    .bss
    .align 2
back: .space 4
    .text
    .global nothing
{marked}
    .thumb_func
nothing_real:
    bx lr
"""
MARKED = """
    .global {wrapper}
    .thumb_func
{wrapper}:
    push {{r0-r4, lr}}
    movs r0, #{section}
    bl scope_begin
    pop {{r0-r4, lr}}
    ldr r12, =back
    str lr, [r12]
    bl {real}
    push {{r0, r1}}
    movs r0, #{section}
    bl scope_end
    pop {{r0, r1}}
    ldr r12, =back
    ldr pc, [r12]
    .ltorg
"""


@dataclass
class Result:
    """One run.

    output        uint8 [n, out_bytes]
    instructions  int64 [n]: of the case's statements, the call and its arguments included
    function      int64 [k]: of every call of the wrapped function, its return included; None without one
    elf           the program
    """

    output: np.ndarray
    instructions: np.ndarray
    function: np.ndarray
    elf: pathlib.Path


def tool(name):
    """Path of a program of the ARM toolchain."""
    found = shutil.which(PREFIX + name)
    assert found, "apt-get install gcc-arm-none-eabi (make setup does it)"
    return found


def run(command, cwd=None):
    """Run a command; AssertionError with its messages if it fails. Returns stdout."""
    done = subprocess.run([str(c) for c in command], cwd=cwd, capture_output=True, text=True, check=False,
                          timeout=300)
    assert done.returncode == 0, f"{command[0]} failed:\n{done.stderr[-4000:]}"
    return done.stdout


def compile_one(source, directory, folders=()):
    """Compile one file as the Makefile does, with a .su file beside the object; returns the object."""
    include = run([tool("gcc"), "-print-file-name=include"]).strip()
    made = pathlib.Path(directory) / (pathlib.Path(source).stem + ".o")
    folders = [PORT / "include", CORE, ROOT / "firmware" / "app", PORT, *folders]
    run([tool("gcc"), *FLAGS, "-nostdinc", "-isystem", include, "-fstack-usage",
         *[f"-I{folder}" for folder in folders], "-c", source, "-o", made])
    return made


@functools.lru_cache(maxsize=1)
def core_objects():
    """Objects of the core and the start-up, compiled once per run of the tests, .su files beside them."""
    folder = tempfile.mkdtemp(prefix="sgm4-")
    atexit.register(shutil.rmtree, folder, True)
    sources = [*sorted(CORE.glob("*.c")), *[PORT / f"{name}.c" for name in ("boot", "scope", "memory")]]
    return [compile_one(source, folder) for source in sources]


def run_cases(directory, body, inputs, out_bytes, includes=(), setup="", data=None, wrap=None, altered=None):
    """Compile and run `body` once per row of inputs.

    body      C statements; `in` points to the row's bytes (8-aligned), `out` to out_bytes zeroed bytes
    inputs    array [n, ..] of fixed-width integers: the bytes of a row are what `in` points to
    setup     C statements before the first case: declare what the body needs
    data      {name: bytes}, constant arrays of that name that setup and body may read (8-aligned)
    wrap      name of a function of the core that is called from another file
    altered   path of a C file to take instead of the core's file of that name
    """
    elf = build(directory, body, inputs, out_bytes, includes, setup, data, wrap, altered)
    output, counts = run_elf(elf)
    assert len(output) == len(inputs) * out_bytes, f"the program wrote {len(output)} bytes"
    function = None
    if wrap:
        assert SECTION_FUNCTION in counts, f"{wrap} is not called from another file"
        # The empty function is one instruction: its return.
        function = counts[SECTION_FUNCTION] - counts[SECTION_NOTHING][0] + 1
    return Result(np.frombuffer(output, np.uint8).reshape(len(inputs), out_bytes), counts[SECTION_CASE],
                  function, elf)


def build(directory, body, inputs, out_bytes, includes=(), setup="", data=None, wrap=None, altered=None):
    """The program of run_cases, not run; returns its path."""
    directory = pathlib.Path(directory)
    inputs = np.ascontiguousarray(inputs)
    rows = inputs.view(np.uint8).reshape(len(inputs), -1)
    width = -(-rows.shape[1] // 8) * 8
    padded = np.zeros((len(rows), width), np.uint8)
    padded[:, :rows.shape[1]] = rows
    lines = [f"static const uint8_t {name}[{len(value)}] __attribute__((aligned(8))) = {{{_bytes(value)}}};"
             for name, value in (data or {}).items()]
    lines.append(f"static const uint8_t case_in[{len(padded)}][{width}] __attribute__((aligned(8))) = {{\n"
                 + ",\n".join("{" + _bytes(row) + "}" for row in padded) + "};")
    (directory / "case_data.h").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (directory / "case_main.c").write_text(MAIN.format(
        includes="\n".join(f'#include "{name}"' for name in includes), out_bytes=out_bytes, setup=setup,
        count=len(padded), body=body, section=SECTION_CASE), encoding="utf-8")
    marked = [MARKED.format(wrapper="nothing", real="nothing_real", section=SECTION_NOTHING)]
    flags = ["-nostdlib", "-T", PORT / "port.ld", "-Wl,--gc-sections"]
    if wrap:
        marked.append(MARKED.format(wrapper=f"__wrap_{wrap}", real=f"__real_{wrap}",
                                    section=SECTION_FUNCTION))
        flags.append(f"-Wl,--wrap={wrap}")
    (directory / "case_wrap.s").write_text(WRAP.format(marked="".join(marked)), encoding="utf-8")
    own = [compile_one(directory / name, directory, [directory]) for name in ("case_main.c", "case_wrap.s")]
    core = {made.name: made for made in core_objects()}
    if altered:
        made = compile_one(altered, directory)
        assert made.name in core, f"the core has no file of the name of {altered}"
        core[made.name] = made
    elf = directory / "case.elf"
    run([tool("gcc"), *FLAGS, *flags, *core.values(), *own, "-o", elf])
    return elf


def run_elf(elf):
    """Run a program to its end: (the bytes of its serial line, {section: instructions of every run})."""
    program = shutil.which(qemu.PROGRAM)
    assert program, "apt-get install qemu-system-arm (make setup does it)"
    run([*qemu.machine(program, elf.name), "-serial", "file:line", "-serial", "file:scope"], cwd=elf.parent)
    return (elf.parent / "line").read_bytes(), qemu.section_counts((elf.parent / "scope").read_bytes())


def _bytes(values):
    return ",".join(map(str, bytes(values)))
