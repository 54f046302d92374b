# SPDX-License-Identifier: Apache-2.0
"""Every source file names its licence, and the GPL stays inside the one program that needs it."""

import re
import subprocess

import pytest

SUFFIXES = {".c", ".h", ".S", ".py", ".sh", ".ld"}
GPL_FOLDER = "tools/vheadset/"
TAG = re.compile(r"SPDX-License-Identifier: (\S+)")


def licence(text):
    """The licence named in one of the first three lines, or None."""
    found = TAG.search("\n".join(text.splitlines()[:3]))
    return found[1] if found else None


def expected(path):
    """The licence that a file of this path must name."""
    return "GPL-3.0-or-later" if path.startswith(GPL_FOLDER) else "Apache-2.0"


@pytest.fixture(scope="module")
def sources(repo_root):
    """{path: text} of every source file that is or could be committed."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=repo_root,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.splitlines()
    paths = [
        path for path in listed if (repo_root / path).suffix in SUFFIXES and (repo_root / path).is_file()
    ]
    assert len(paths) > 20
    return {path: (repo_root / path).read_text() for path in paths}


def test_every_source_file_names_its_licence(sources):
    wrong = {path: licence(text) for path, text in sources.items() if licence(text) != expected(path)}
    assert wrong == {}


def test_a_file_without_a_licence_is_seen():
    assert licence("int main(void) { return 0; }\n") is None
    assert licence("\n\n\n// SPDX-License-Identifier: Apache-2.0\n") is None


def test_licence_texts_are_whole(repo_root):
    apache = (repo_root / "LICENSE").read_text()
    assert "Apache License" in apache and "END OF TERMS AND CONDITIONS" in apache
    gpl = (repo_root / GPL_FOLDER / "COPYING").read_text()
    assert "GNU GENERAL PUBLIC LICENSE" in gpl and "END OF TERMS AND CONDITIONS" in gpl


# The virtual Nano is started as a program; code that includes, imports or links it would take its licence.
USES_GPL = re.compile(
    r'#\s*include\s*["<](?:[^">]*vheadset|simavr/|sim_avr\.h|avr_ioport\.h)'
    r"|^\s*(?:from|import)\s+[\w.]*vheadset"
    r"|CDLL\([^)]*(?:vheadset|simavr)|-lsimavr",
    re.MULTILINE,
)
# The only libraries that are opened at run time: Mesa's, under the MIT licence.
OPENED = {"sim_c/sim_osmesa.c": {"libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"}}


def test_nothing_includes_imports_or_links_the_virtual_nano(sources):
    users = [
        path
        for path, text in sources.items()
        if not path.startswith((GPL_FOLDER, "tests/build/")) and USES_GPL.search(text)
    ]
    assert users == []


def test_only_mesa_is_opened_at_run_time(sources):
    openers = {path for path, text in sources.items() if path.endswith((".c", ".h")) and "dlopen(" in text}
    assert openers == set(OPENED)
    for path, libraries in OPENED.items():
        assert set(re.findall(r'"([^"]*\.so[.\d]*)"', sources[path])) == libraries


@pytest.mark.parametrize(
    "line",
    [
        '#include "../tools/vheadset/board.h"',
        "#include <simavr/sim_avr.h>",
        "from tools.vheadset import x",
        "ctypes.CDLL('libsimavr.so')",
        "-lsimavr",
    ],
)
def test_a_use_of_the_virtual_nano_is_seen(line):
    assert USES_GPL.search(line)
