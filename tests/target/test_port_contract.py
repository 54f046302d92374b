# SPDX-License-Identifier: Apache-2.0
"""What a port is: the template builds with the host's compiler, and nothing but a port knows the chip."""

import re
import subprocess


def test_template_port_builds_without_a_warning_and_ends_at_once(repo_root, tmp_path):
    firmware = repo_root / "firmware"
    program = tmp_path / "template"
    subprocess.run(
        ["cc", "-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror",
         *[f"-I{firmware / part}" for part in ("core", "app", "ports/template")],
         *sorted((firmware / "core").glob("*.c")), *sorted((firmware / "app").glob("*.c")),
         *sorted((firmware / "ports" / "template").glob("*.c")), "-o", program], check=True)
    assert subprocess.run([program], timeout=10).returncode == 0


def test_the_application_names_no_chip(repo_root):
    chip = re.compile(r"<avr/|<util/|__AVR|ATmega|\bPORT[B-D]\b|\bDDR[B-D]\b|\bTCNT1\b")
    found = [f"{path.name}:{n}" for path in sorted((repo_root / "firmware" / "app").glob("*.[ch]"))
             for n, line in enumerate(path.read_text().splitlines(), 1) if chip.search(line)]
    assert found == []


def test_every_port_implements_exactly_the_contract(repo_root):
    firmware = repo_root / "firmware"
    contract = firmware / "app" / "hal.h"
    down = contract.read_text().split("// Down-calls", 1)[1].split("// Up-calls", 1)[0]
    wanted = set(re.findall(r"^[a-z].*?\b(hal_\w+)\(", down, re.M))
    assert 8 <= len(wanted) <= 16
    for port in ("template", "avr328p", "mps2an386"):
        text = "\n".join(path.read_text() for path in sorted((firmware / "ports" / port).glob("*.c")))
        found = re.findall(r"^(?!static)(?:[A-Z]+ )?[a-z][^;\n=]*?\b(hal_\w+)\([^;{]*\)\s*\{", text, re.M)
        assert set(found) == wanted, port
