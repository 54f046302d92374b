# SPDX-License-Identifier: Apache-2.0
"""The fake device beside these tests."""

import contextlib
import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fake_device import FakeDevice, fit_linear  # noqa: E402

from sparsegaze import cli  # noqa: E402


@pytest.fixture
def command(capsys):
    """command("info", PORT) runs a command line; returns (exit code, stdout, stderr)."""

    def run(*args):
        capsys.readouterr()
        code = cli.run([str(arg) for arg in args])
        out = capsys.readouterr()
        assert "Traceback" not in out.err + out.out
        return code, out.out, out.err

    return run


@pytest.fixture
def command_json(command):
    """The same with --json: returns (exit code, the one object on stdout, stderr)."""

    def run(*args):
        code, out, err = command(*args, "--json")
        assert out.count("\n") == 1 and out.endswith("\n"), out
        return code, json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON")), err

    return run


@pytest.fixture
def fake(monkeypatch):
    """fake(**options of FakeDevice): every port has this device behind it. Returns the device."""

    def put(model=None, **options):
        device = FakeDevice(model, **options)
        monkeypatch.setattr("sparsegaze.device.Device", lambda port, *_: device)
        monkeypatch.setattr("sparsegaze.screen.screen_for", lambda *_, **__: device.screen)
        monkeypatch.setattr("sparsegaze.fit.fit_recording", fit_linear)
        monkeypatch.setattr(
            "sparsegaze.transport.open_link", lambda port, *_: contextlib.nullcontext(device.link)
        )
        return device

    return put
