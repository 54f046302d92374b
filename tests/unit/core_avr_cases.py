# SPDX-License-Identifier: Apache-2.0
"""Any function of the core on a simulated ATmega328P, over given inputs; core_m4_harness's twin.

The same statements run on both: `in`, `out` and the constant arrays of `data` have the same names there, and
CASE_SPACE is the memory space (sg_rom.h) that `data` is in.
"""
import atexit
import functools
import pathlib
import shutil
import tempfile
from dataclasses import dataclass

import numpy as np

import core_avr_harness as avr

SECTION_CASE, SECTION_FUNCTION, SECTION_NOTHING = 0, 1, 2
RETURN_CYCLES = 4

MAIN = """
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include <string.h>
{includes}
#include "case_data.h"

enum {{ CASE_SPACE = 1 }};
void nothing(void);

int main(void)
{{
    static uint8_t in[{in_bytes}], out[{out_bytes}];
    nothing();
    {setup}
    for (uint16_t i = 0; i < {count}; i++) {{
        memcpy_P(in, case_in[i], sizeof in);
        memset(out, 0, sizeof out);
        GPIOR0 = {begin};
        {body}
        GPIOR0 = {end};
        for (uint16_t k = 0; k < sizeof out; k++)
            GPIOR1 = out[k];
    }}
    sleep_enable();
    sleep_cpu();
    for (;;)
        ;
}}
"""

# A function marked round its call; `nothing` tells what that costs.
WRAP = """
#include <avr/io.h>
.macro mark value
    push r16
    ldi r16, \\value
    out _SFR_IO_ADDR(GPIOR0), r16
    pop r16
.endm
    .text
    .global nothing
nothing:
    mark {begin}
    call nothing_real
    mark {end}
nothing_real:
    ret
"""
MARKED = """
    .global __wrap_{name}
__wrap_{name}:
    mark {begin}
    call __real_{name}
    mark {end}
    ret
"""


@dataclass
class Result:
    """One run.

    output     uint8 [n, out_bytes]
    cycles     (least, most) of the case's statements, the call and its arguments included
    function   (least, most) of the calls of the wrapped function, its return included; None without one
    elf        the program
    """

    output: np.ndarray
    cycles: tuple
    function: tuple
    elf: pathlib.Path


def run_cases(directory, body, inputs, out_bytes, includes=(), setup="", data=None, wrap=None, defines=()):
    """As core_m4_harness.run_cases; defines: of the C preprocessor (SG_GP_PORTABLE). The wrapped function may
    have no arguments on the stack."""
    directory = pathlib.Path(directory)
    rows = np.ascontiguousarray(inputs).view(np.uint8).reshape(len(inputs), -1)
    lines = [f"static const uint8_t {name}[{len(value)}] PROGMEM = {{{_bytes(value)}}};"
             for name, value in (data or {}).items()]
    lines.append(f"static const uint8_t case_in[{len(rows)}][{rows.shape[1]}] PROGMEM = {{"
                 + ",\n".join("{" + _bytes(row) + "}" for row in rows) + "};")
    (directory / "case_data.h").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (directory / "case_main.c").write_text(MAIN.format(
        includes="\n".join(f'#include "{name}"' for name in includes), in_bytes=rows.shape[1], setup=setup,
        out_bytes=out_bytes, count=len(rows), body=body, **_marks(SECTION_CASE)), encoding="utf-8")
    wrapped = WRAP.format(**_marks(SECTION_NOTHING))
    if wrap:
        wrapped += MARKED.format(name=wrap, **_marks(SECTION_FUNCTION))
    (directory / "case_wrap.S").write_text(wrapped, encoding="utf-8")
    flags = (f"-I{directory}", *(f"-D{define}" for define in defines))
    own = [compile_one(directory / name, directory, flags) for name in ("case_main.c", "case_wrap.S")]
    objects = core_objects(tuple(defines))
    elf = directory / "case.elf"
    avr.run([avr.avr_tool("avr-gcc"), *avr.AVR_FLAGS, "-Wl,--gc-sections",
             *([f"-Wl,--wrap={wrap}"] if wrap else []), *objects, *own, "-o", elf])
    *lines, output = avr.run([avr.runner(objects[0].parent), elf]).splitlines()
    found = {}
    for line in lines:
        if line.startswith("section "):
            k, _, least, most = map(int, line[8:].replace(":", "").split())
            found[k] = least, most
    output = bytes.fromhex(output)
    assert len(output) == len(rows) * out_bytes, f"the program wrote {len(output)} bytes"
    function = None
    if wrap:
        assert SECTION_FUNCTION in found, f"{wrap} is not called from another file"
        around = found[SECTION_NOTHING][0] - RETURN_CYCLES
        function = tuple(value - around for value in found[SECTION_FUNCTION])
    return Result(np.frombuffer(output, np.uint8).reshape(len(rows), out_bytes), found[SECTION_CASE],
                  function, elf)


def compile_one(source, directory, flags=()):
    """Compile one file, with a .su file beside the object; returns the object."""
    made = pathlib.Path(directory) / (pathlib.Path(source).name + ".o")
    avr.run([avr.avr_tool("avr-gcc"), *avr.AVR_FLAGS, "-fstack-usage", *flags, "-c", source, "-o", made])
    return made


@functools.lru_cache(maxsize=4)
def core_objects(defines=()):
    """Objects of the core, compiled once per run of the tests, .su files beside them."""
    folder = tempfile.mkdtemp(prefix="sgavr-")
    atexit.register(shutil.rmtree, folder, True)
    flags = tuple(f"-D{define}" for define in defines)
    return [compile_one(source, folder, flags)
            for source in [*sorted(avr.CORE.glob("*.c")), *sorted(avr.CORE.glob("*.S"))]]


def _marks(section):
    return {"begin": 2 * section + 1, "end": 2 * section + 2}


def _bytes(values):
    return ",".join(map(str, bytes(values)))
