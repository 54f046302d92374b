#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Who may include whom, and what the core may not contain. Prints every breach as file:line: reason.

    python3 tests/check_includes.py [ROOT]      exit 1 if there is a breach
"""
import re
import sys
from dataclasses import dataclass
from pathlib import Path

FREESTANDING = {"stddef.h", "stdint.h", "stdbool.h", "limits.h", "stdalign.h"}

# Module of the core -> modules whose header it may include besides its own. Siblings never include each
# other.
CORE = {
    "sg_q": set(), "sg_rom": set(), "sg_err": set(),
    "sg_wire": {"sg_err", "sg_rom", "sg_wire_avr"}, "sg_wire_avr": set(),
    "sg_model": {"sg_err", "sg_q", "sg_rom", "sg_crc32_table"}, "sg_crc32_table": {"sg_rom"},
    "sg_reading": set(),
    "sg_light": {"sg_rom", "sg_reading", "sg_light_loop", "sg_light_table", "sg_light_avr"},
    "sg_light_loop": {"sg_rom", "sg_light", "sg_light_table"}, "sg_light_table": {"sg_light_loop", "sg_rom"},
    "sg_light_avr": {"sg_light_table"},
    "sg_expose": {"sg_reading"}, "sg_health": set(),
    "sg_link": {"sg_err", "sg_wire"},
    "sg_gp": {"sg_err", "sg_q", "sg_rom", "sg_model", "sg_gp_loop"},
    "sg_gp_loop": {"sg_q", "sg_rom", "sg_gp", "sg_gp_avr"}, "sg_gp_avr": set(),
    "sg_gp_table": {"sg_gp_loop", "sg_rom"},
    "sg_mlp": {"sg_err", "sg_rom", "sg_model", "sg_mlp_loop"},
    "sg_mlp_loop": {"sg_rom"}, "sg_mlp_table": {"sg_mlp_loop", "sg_rom"}, "sg_mlp_avr": set(),
    "sg_track": {"sg_err", "sg_q", "sg_wire", "sg_model", "sg_gp", "sg_rom", "sg_light",
                 "sg_expose", "sg_health"},
}
ARCHITECTURE = re.compile(r"__AVR|__arm__|__ARM|__x86_64|__i386|_M_X64|__riscv|__thumb|_WIN32|__linux__|"
                          r"__APPLE__")
ARCHITECTURE_FILES = {"sg_rom.h", "sg_gp_avr.S", "sg_mlp_avr.S", "sg_light_avr.S", "sg_wire_avr.S"}
# Besides include guards.
CONDITIONS = {"sg_gp_loop.c": {"SG_GP_ASSEMBLY"}, "sg_gp_loop.h": {"SG_GP_ASSEMBLY"},
              "sg_mlp_loop.c": {"SG_MLP_ASSEMBLY"}, "sg_light_loop.c": {"SG_LIGHT_ASSEMBLY"},
              "sg_light.h": {"SG_LIGHT_ASSEMBLY"},
              "sg_wire.c": {"SG_WIRE_ASSEMBLY"}, "sg_wire.h": {"SG_WIRE_ASSEMBLY"}}
FORBIDDEN = {
    r"\b(float|double|long double)\b": "floating point",
    r"\b\d+\.\d*[fF]?\b|\b\d+[eE][-+]?\d+\b": "a floating-point constant",
    r"\b(malloc|calloc|realloc|free|alloca)\s*\(": "heap",
    r"\b\w*(printf|puts|putchar|scanf)\s*\(": "stdio",
    r"\b(setjmp|longjmp|goto)\b": "a jump",
    r"/(?![/*])|%": "division",
    r"\b(exit|abort|assert)\s*\(": "an exit",
}


@dataclass(frozen=True)
class Breach:
    """One broken rule."""
    path: Path
    line: int
    reason: str

    def __str__(self):
        return f"{self.path}:{self.line}: {self.reason}"


def without_comments(text):
    """The text with comments and string contents blanked, line numbers kept."""
    def blank(match):
        found = match.group(0)
        return '""' if found[0] == '"' else re.sub(r"[^\n]", " ", found)
    return re.sub(r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"', blank, text, flags=re.DOTALL)


def includes(text):
    """[(line, name, system)] of every #include."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        match = re.match(r'\s*#\s*include\s*([<"])([^>"]+)[>"]', line)
        if match:
            found.append((number, match.group(2), match.group(1) == "<"))
    return found


def check_core_includes(path, text):
    """Includes of one file of the core."""
    module = path.stem
    if module not in CORE:
        yield Breach(path, 1, f"{module} is not a module of the core (the table in this script)")
        return
    for line, name, system in includes(text):
        if system:
            if name not in FREESTANDING and not (path.name in ARCHITECTURE_FILES and name.startswith("avr/")):
                yield Breach(path, line, f"<{name}> is not a freestanding header")
        elif Path(name).suffix != ".h" or Path(name).stem not in CORE[module] | {module}:
            yield Breach(path, line, f'{module} may not include "{name}"')


def check_core_content(path, text):
    """Words and operators that the core does without."""
    code = without_comments(text)
    guard = path.stem.upper() + "_H"
    allowed = CONDITIONS.get(path.name, set()) | {guard}
    for number, line in enumerate(code.splitlines(), 1):
        if ARCHITECTURE.search(line) and path.name not in ARCHITECTURE_FILES:
            yield Breach(path, number, "asks for the architecture; only sg_rom.h may")
        condition = re.match(r"\s*#\s*(?:if|ifdef|ifndef|elif)\b(.*)", line)
        if condition and path.name not in ARCHITECTURE_FILES and condition.group(1).strip() not in allowed:
            yield Breach(path, number, f"conditional compilation on {condition.group(1).strip()}")
        if line.lstrip().startswith("#") or path.suffix == ".S":
            continue
        for pattern, what in FORBIDDEN.items():
            if re.search(pattern, line):
                yield Breach(path, number, f"{what} in the core")
        if re.match(r"(static\s+)?(?!const\b|extern\b|typedef\b|static\s+(inline|const)\b)"
                    r"(struct \w+|u?int\d+_t)\s+\w+"
                    r"(\[[^]]*\])*\s*(=|;)", line):
            yield Breach(path, number, "a global variable")
        if re.match(r"\s+static\s+(?!const\b)", line):
            yield Breach(path, number, "a static variable")


def calls(text):
    """{function: names it calls} of one C file."""
    code = without_comments(text)
    graph = {}
    for match in re.finditer(r"^(?!#|\}|else)\w[^;{}=#]*?\b(\w+)\s*\([^;{}]*\)\s*\{(.*?)^\}", code,
                             re.MULTILINE | re.DOTALL):
        graph[match.group(1)] = set(re.findall(r"\b(\w+)\s*\(", match.group(2)))
    return graph


def check_recursion(files):
    """No function of the core may reach itself."""
    graph = {}
    for _, text in files:
        for name, called in calls(text).items():
            graph.setdefault(name, set()).update(called)
    for name in graph:
        reached, waiting = set(), list(graph[name])
        while waiting:
            at = waiting.pop()
            if at not in reached:
                reached.add(at)
                waiting.extend(graph.get(at, ()))
        if name in reached:
            place = next(path for path, text in files if name in calls(text))
            yield Breach(place, 1, f"{name} is recursive")


def check_layer(files, allowed_quoted, allowed_system, what):
    """Includes of a directory against patterns of full names."""
    for path, text in files:
        for line, name, system in includes(text):
            if not re.fullmatch(allowed_system if system else allowed_quoted, name):
                yield Breach(path, line, f"{what} may not include {name}")


def read(root, folder, *suffixes):
    """[(path, text)] of the files below a folder."""
    paths = sorted(p for p in (root / folder).rglob("*") if p.suffix in suffixes)
    return [(path, path.read_text(encoding="utf-8")) for path in paths]


def check(root):
    """All breaches below a work tree."""
    found = []
    core = read(root, "firmware/core", ".c", ".h", ".S")
    for path, text in core:
        found += check_core_includes(path, text)
        found += check_core_content(path, text)
    found += check_recursion([(p, t) for p, t in core if p.suffix != ".S"])
    standard = "|".join(re.escape(h) for h in sorted(FREESTANDING | {"string.h"}))
    found += check_layer(read(root, "firmware/app", ".c", ".h"), r"sg_\w+\.h|hal\.h|hal_port\.h|app\w*\.h",
                         standard, "the application")
    found += check_layer(read(root, "firmware/ports", ".c", ".h"), r"hal\.h|hal_port\.h|port\w*\.h",
                         standard + r"|(avr|util)/\w+\.h", "a port")
    found += check_layer(read(root, "sim_c", ".c", ".h"), r"sim_\w+\.h", r"(?!simavr|avr/|Python).*",
                         "the simulator")
    found += check_layer(read(root, "tools/vheadset", ".c", ".h"),
                         r"(?!.*\bsg_)(?!\.\./(?!\.\./sim_c/sim_map\.h)).*",
                         r".*", "the virtual Nano")
    for path, text in read(root, "host_sdk", ".py"):
        for number, line in enumerate(text.splitlines(), 1):
            if re.match(r"\s*(import|from)\s+ctypes\b", line):
                found.append(Breach(path, number, "C is reached through the cffi builders only"))
            if re.match(r"\s*(import|from)\s+cffi\b", line) and not path.name.endswith("_build.py"):
                found.append(Breach(path, number, "only the builders know cffi"))
    return found


def main(argv):
    """Print the breaches; returns the exit code."""
    root = Path(argv[0]) if argv else Path(__file__).resolve().parents[1]
    found = check(root)
    for breach in found:
        print(breach)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
