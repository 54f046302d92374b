# SPDX-License-Identifier: Apache-2.0
"""Build and run core_avr/mlp_bench.c on a simulated ATmega328P."""
import pathlib
from dataclasses import dataclass

import core_avr_harness as avr

SECTIONS = ("flash", "memory", "open", "empty")
MEMORY_BYTES = 1200     # an image up to here also runs from memory


@dataclass
class Result:
    """Net cycles {section: (count, min, max)}; bytes of each section's results; stack of a prediction from
    flash, evaluate() of the bench included; flash bytes of the functions and tables of sg_mlp."""
    cycles: dict
    flash: bytes
    memory: bytes
    verdict: int
    stack: int
    text: int


def run(directory, model, features, defines=()):
    """Compile the bench with one network and inputs [n, inputs], run it; returns a Result."""
    directory = pathlib.Path(directory)
    image, in_memory = model.image, len(model.image) <= MEMORY_BYTES
    rows = ",\n".join("{" + ", ".join(str(int(v)) for v in row) + "}" for row in features)
    (directory / "case_data.h").write_text(
        "#include <stdint.h>\n#include <string.h>\n#include <avr/pgmspace.h>\n"
        f"#define CASE_IN_MEMORY {int(in_memory)}\nenum {{ CASE_POINTS = {len(features)} }};\n"
        f"static const uint8_t case_image[{len(image)}] PROGMEM = {{{', '.join(map(str, image))}}};\n"
        f"static const uint16_t case_input[][8] PROGMEM = {{{rows}}};\n", encoding="utf-8")
    elf = directory / "mlp_bench.elf"
    sources = sorted(avr.CORE.glob("*.c")) + sorted(avr.CORE.glob("*.S")) + [avr.HERE / "mlp_bench.c"]
    avr.run([avr.avr_tool("avr-gcc"), *avr.AVR_FLAGS, f"-I{directory}", *[f"-D{d}" for d in defines],
             "-Wl,--gc-sections", *sources, "-o", elf])
    *lines, output = avr.run([avr.runner(directory), elf]).splitlines()
    cycles = {}
    for line in lines:
        if line.startswith("section "):
            _, k, count, low, high = line.replace(":", "").split()
            cycles[SECTIONS[int(k)]] = (int(count), int(low), int(high))
    raw = bytes.fromhex(output)
    each = len(features) * (2 * model.outputs + 2)
    verdict, raw = int.from_bytes(raw[:1], "little", signed=True), raw[1:]
    stack = int.from_bytes(raw[each:each + 2], "little")
    return Result(cycles, raw[:each], raw[each + 3:], verdict, stack, text_bytes(elf))


def text_bytes(elf):
    """Flash of sg_mlp's functions and table, as linked."""
    listing = avr.run([avr.avr_tool("avr-nm"), "-S", "--size-sort", elf]).splitlines()
    sizes = {}
    for line in listing:
        at, size, _, name = line.split()
        if name.startswith("sg_mlp"):
            sizes[at] = int(size, 16)
    return sum(sizes.values())
