#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Fails when the firmware that was linked holds what the core must not need.

    .venv/bin/python tools/check_link.py build/firmware/firmware.elf

Floating point, division and the heap are hundreds of cycles or unbounded time behind an innocent-looking
operator; the compiler never says that it called them, but the linker had to take them from its libraries, so
their names show.
Exit: 0 clean, 1 with one line per forbidden symbol or when the file cannot be judged.
"""

import re
import sys

from elftools.common.exceptions import ELFError
from elftools.elf.elffile import ELFFile

FORBIDDEN = (
    (r"__(?:add|sub|mul|div|neg|cmp|eq|ne|lt|le|gt|ge|unord)[sd]f[23](?:x|_pse)?", "floating point"),
    (r"__(?:fix|fixuns|float|floatun|extend|trunc)[a-z]*[sd]f[a-z]*2?|__fp_\w+", "floating point"),
    (r"__u?(?:div|mod|divmod)(?:q|h|ps|s|d)i[34]?(?:_\w+)?|__(?:u?div|u?mod)[sd]?i3", "division"),
    (r"malloc|calloc|realloc|free|__brkval|__flp", "the heap"),
    (r"v?f?s?n?printf(?:_P)?|v?f?s?scanf(?:_P)?", "stdio"),
)


def symbols(path):
    """Names of the symbols in the file's symbol table. Raises ValueError when there is none to judge by."""
    with open(path, "rb") as file:
        table = ELFFile(file).get_section_by_name(".symtab")
        names = [symbol.name for symbol in table.iter_symbols()] if table else []
    if "main" not in names:
        raise ValueError("no symbol table with a main: stripped, or not a program")
    return names


def forbidden(names):
    """Pairs (name, what it means) of the names that must not be linked."""
    return [
        (name, meaning)
        for name in sorted(set(names))
        for pattern, meaning in FORBIDDEN
        if re.fullmatch(pattern, name)
    ]


def main(arguments):
    """Checks the files. Returns the exit code."""
    bad = not arguments
    for path in arguments:
        try:
            found = forbidden(symbols(path))
        except (OSError, ELFError, ValueError) as error:
            print(f"{path}: {error}", file=sys.stderr)
            bad = True
            continue
        for name, meaning in found:
            print(f"{path}: {name} is linked: {meaning}", file=sys.stderr)
            bad = True
    return int(bad)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
