# SPDX-License-Identifier: Apache-2.0
"""The dependency rules hold, and the script that says so sees each kind of breach."""
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "tests" / "check_includes.py"


def run(root):
    """(exit code, output lines) of the script."""
    done = subprocess.run([sys.executable, SCRIPT, root], capture_output=True, text=True, check=False)
    assert not done.stderr, done.stderr
    return done.returncode, done.stdout.splitlines()


def test_this_work_tree_keeps_the_rules():
    code, lines = run(ROOT)
    assert (code, lines) == (0, [])


@pytest.fixture
def copy(tmp_path):
    """A copy of the firmware to break."""
    shutil.copytree(ROOT / "firmware", tmp_path / "firmware")
    assert run(tmp_path) == (0, [])
    return tmp_path


BREACHES = {
    "a sibling's header": ("core/sg_expose.c", '#include "sg_wire.h"', "may not include"),
    "a header from above": ("core/sg_wire.c", '#include "sg_link.h"', "may not include"),
    "the port": ("core/sg_track.c", '#include "hal.h"', "may not include"),
    "stdio": ("core/sg_gp.c", "#include <stdio.h>", "freestanding"),
    "AVR headers": ("core/sg_gp.c", "#include <avr/io.h>", "freestanding"),
    "an architecture": ("core/sg_gp.c", "#ifdef __AVR__\n#endif", "architecture"),
    "a test switch": ("core/sg_gp.c", "#ifdef TEST\n#endif", "conditional"),
    "float": ("core/sg_gp.c", "static inline float half(void) { return 1; }", "floating point"),
    "a float constant": ("core/sg_gp.c", "static inline int x(void) { return (int)0.5; }", "constant"),
    "heap": ("core/sg_link.c", "static inline void *x(void) { return malloc(3); }", "heap"),
    "a division": ("core/sg_gp.c", "static inline int x(int a, int b) { return a / b; }", "division"),
    "a remainder": ("core/sg_gp.c", "static inline int x(int a, int b) { return a % b; }", "division"),
    "a global": ("core/sg_link.c", "uint16_t frames = 0;", "global"),
    "a file static": ("core/sg_link.c", "static struct sg_link_rx rx;", "global"),
    "a function static": ("core/sg_link.c",
                          "static inline void x(void)\n{\n    static uint8_t n;\n    n++;\n}",
                          "static variable"),
    "direct recursion": ("core/sg_gp.c", "static int down(int n)\n{\n    return n ? down(n - 1) : 0;\n}",
                         "recursive"),
    "mutual recursion": ("core/sg_gp.c",
                         "static int a1(int n);\nstatic int b1(int n)\n{\n    return a1(n);\n}\n"
                         "static int a1(int n)\n{\n    return b1(n);\n}", "recursive"),
    "an unknown module": ("core/sg_utils.c", "", "not a module"),
    "hardware in the application": ("app/main.c", "#include <avr/io.h>", "the application may not"),
    "the application in a port": ("ports/avr328p/poll.c", '#include "app.h"', "a port may not"),
}


@pytest.mark.parametrize("kind", BREACHES)
def test_the_script_sees(kind, copy):
    name, text, reason = BREACHES[kind]
    path = copy / "firmware" / name
    path.write_text((path.read_text(encoding="utf-8") if path.exists() else "") + "\n" + text + "\n",
                    encoding="utf-8")
    code, lines = run(copy)
    assert code == 1 and any(reason in line and path.name in line for line in lines), lines


def test_comments_and_strings_may_say_anything(copy):
    path = copy / "firmware" / "core" / "sg_gp.c"
    path.write_text(path.read_text(encoding="utf-8") +
                    '\n// float malloc( a / b 0.5 % __AVR__\n/* printf( goto */\n'
                    '_Static_assert(1, "a / b, 0.5, float");\n', encoding="utf-8")
    assert run(copy) == (0, [])
