# SPDX-License-Identifier: Apache-2.0
"""What a function of a linked program takes: flash by its symbol's size, stack by the deepest chain of calls.

A chain adds what the compiler states for each function (-fstack-usage) and, for assembly, its pushes. Where
the return address lies on the stack (AVR) it is part of a function's own.
"""
import pathlib
import re
import subprocess
from dataclasses import dataclass

CALL = re.compile(r"\s(?:bl|b\.w|b\.n|b|call|rcall|jmp|rjmp)\s+.*<([\w.]+)>\s*$")


@dataclass
class Footprint:
    """Functions of one program. flash, own: {name: bytes}; calls: {name: names}."""

    flash: dict
    own: dict
    calls: dict

    def stack(self, name):
        """Bytes from the entry of a function to the deepest point that it can reach."""
        return self.own[name] + max((self.stack(other) for other in self.calls[name]), default=0)


def footprint(elf, stack_files, prefix, return_bytes):
    """Footprint of a program.

    stack_files    the .su files of its objects
    prefix         path of the binutils up to their names ("/usr/bin/avr-")
    return_bytes   that a call puts on the stack
    """
    sizes = {}
    for line in _run(f"{prefix}nm", "-S", elf).splitlines():
        cells = line.split()
        if len(cells) == 4 and cells[2] in "tT":
            sizes[cells[3]] = int(cells[1], 16)
    stated = {}
    for path in stack_files:
        for line in pathlib.Path(path).read_text(encoding="utf-8").splitlines():
            place, size, kind = line.split("\t")
            assert kind == "static", f"{place} has a stack that depends on its data"
            stated[place.split(":")[-1]] = int(size)
    bodies = {}
    for line in _run(f"{prefix}objdump", "-d", elf).splitlines():
        begins = re.match(r"[0-9a-f]+ <([\w.]+)>:", line)
        if begins:
            body = bodies.setdefault(begins[1], [])
        elif bodies and line.startswith(" "):
            body.append(line)
    own, calls = {}, {}
    for name, body in bodies.items():
        # A copy made for constant arguments is called name.constprop.0 here and name.constprop there.
        known = next((stated[n] for n in (name, name.rsplit(".", 1)[0]) if n in stated), None)
        own[name] = return_bytes + sum(map(_pushed, body)) if known is None else known
        called = {match[1] for match in map(CALL.search, body) if match}
        calls[name] = called & set(bodies) - {name}
    return Footprint(sizes, own, calls)


def _pushed(line):
    """Bytes that an instruction of an assembly function puts on the stack."""
    match = re.search(r"\spush(?:\.w)?\s+(\{.*\}|r\d+)", line)
    if not match:
        return 0
    if match[1][0] != "{":
        return 1
    total = 0
    for part in match[1].strip("{}").split(","):
        low, _, high = part.strip().partition("-")
        total += 4 * (int(high.strip()[1:]) - int(low[1:]) + 1 if high else 1)
    return total


def _run(*command):
    return subprocess.run([str(c) for c in command], check=True, capture_output=True, text=True).stdout
