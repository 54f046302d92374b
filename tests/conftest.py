# SPDX-License-Identifier: Apache-2.0
"""Fixtures that more than one test folder uses, and a lock on the network."""

import importlib
import ipaddress
import os
import pathlib
import shutil
import socket
import sys
import tempfile
import types

import pytest

REPO = pathlib.Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def repo_root():
    """The work tree, pathlib.Path."""
    return REPO


@pytest.fixture(scope="session")
def shared_dir():
    """The folder shared/ beside the work tree, with the project's constants; skips where there is none."""
    path = REPO.parent / "shared"
    if not path.is_dir():
        pytest.skip("no folder shared/ beside this work tree")
    return path


@pytest.fixture(scope="session")
def firmware_elf():
    """The firmware as `make firmware` built it, with symbols."""
    path = REPO / "build" / "firmware" / "firmware.elf"
    assert path.is_file(), "run make firmware first"
    return path


@pytest.fixture(scope="session")
def firmware_hex():
    """The hex that the Python package carries and `sparsegaze flash` writes."""
    path = REPO / "host_sdk" / "sparsegaze" / "data" / "firmware.hex"
    assert path.is_file(), "run make firmware first"
    return path


@pytest.fixture(scope="session")
def bench_modules():
    """bench_modules(attribute="module of tools/bench", ...) -> these modules under these attributes.

    The folder is on the path only while they are imported.
    """

    def load(**modules):
        path = str(REPO / "tools" / "bench")
        sys.path.insert(0, path)
        try:
            loaded = {name: importlib.import_module(module) for name, module in modules.items()}
        finally:
            sys.path.remove(path)
        return types.SimpleNamespace(**loaded)

    return load


@pytest.fixture
def virtual_nano():
    """Factory of running virtual Nanos: virtual_nano(**options of VirtualNano). Stopped after the test."""
    from sparsegaze.virtual import VirtualNano

    running = []

    def start(**options):
        nano = VirtualNano(**options)
        running.append(nano)
        return nano.__enter__()

    yield start
    for nano in reversed(running):
        nano.__exit__(None, None, None)


@pytest.fixture(scope="session", autouse=True)
def _own_registry():
    """Virtual Nanos of the tests register in a folder of their own, apart from those that somebody uses."""
    # Not pytest's tmp_path: the names of Unix sockets below it must stay under 108 bytes.
    folder = tempfile.mkdtemp(prefix="sgtest-")
    before = os.environ.get("XDG_RUNTIME_DIR")
    os.environ["XDG_RUNTIME_DIR"] = folder
    yield
    if before is None:
        del os.environ["XDG_RUNTIME_DIR"]
    else:
        os.environ["XDG_RUNTIME_DIR"] = before
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session", autouse=True)
def _no_network():
    """A test that reaches beyond this machine fails, whoever's code it runs."""
    connect = socket.socket.connect

    def guarded(self, address):
        if self.family in (socket.AF_INET, socket.AF_INET6):
            try:
                local = ipaddress.ip_address(address[0]).is_loopback
            except ValueError:
                local = address[0] == "localhost"
            if not local:
                raise AssertionError(f"a test tried to reach the network: {address}")
        return connect(self, address)

    patch = pytest.MonkeyPatch()
    patch.setattr(socket.socket, "connect", guarded)
    yield
    patch.undo()
