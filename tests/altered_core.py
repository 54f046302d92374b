# SPDX-License-Identifier: Apache-2.0
"""Copies of the core with one deliberate fault: negative controls of the tests that must notice it."""
import pathlib
import shutil

CORE = pathlib.Path(__file__).resolve().parents[1] / "firmware" / "core"


def altered(folder, fault=None):
    """The core's sources in folder/core, one of them changed. Returns that folder.

    fault   (file, text that it has exactly once, text in its place); None: nothing is changed
    """
    core = folder / "core"
    shutil.copytree(CORE, core)
    if fault:
        name, right, wrong = fault
        text = (core / name).read_text(encoding="utf-8")
        assert text.count(right) == 1
        (core / name).write_text(text.replace(right, wrong), encoding="utf-8")
    return core
