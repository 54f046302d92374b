# SPDX-License-Identifier: Apache-2.0
"""What the command line may find behind a port: the stand-ins of the fault tests."""

import importlib.util
import sys
from pathlib import Path

_FAULT = Path(__file__).resolve().parent.parent / "fault"


def _load(name):
    """A module of tests/fault, under its own name and without its folder on the path (its conftest)."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, _FAULT / f"{name}.py")
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


_fake_board = _load("fake_board")
FakeBoard, Printer, PtyPeer = _fake_board.FakeBoard, _fake_board.Printer, _fake_board.PtyPeer
