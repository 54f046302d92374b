# SPDX-License-Identifier: Apache-2.0
"""What a user gets who installs the package without this work tree."""

import os
import re
import shutil
import subprocess
import sys
import zipfile

import pytest

BUILD_SDIST = "import sys, setuptools.build_meta as backend; print(backend.build_sdist(sys.argv[1]))"


@pytest.fixture(scope="module")
def sdist(tmp_path_factory, repo_root):
    """The unpacked source distribution."""
    folder = tmp_path_factory.mktemp("sdist")
    # From a clean copy: what lies about in a work tree (modules built by hand) must not decide what goes in.
    tree = folder / "tree"
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=repo_root,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.splitlines()
    for name in listed:
        if (repo_root / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            (tree / name).write_bytes((repo_root / name).read_bytes())
    done = subprocess.run(
        [sys.executable, "-c", BUILD_SDIST, str(folder)], cwd=tree, check=True, capture_output=True, text=True
    )
    shutil.unpack_archive(folder / done.stdout.split()[-1], folder / "unpacked")
    return next((folder / "unpacked").iterdir())


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    """The wheel built from the source distribution alone."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "-q",
            "--no-index",
            "--no-deps",
            "--no-build-isolation",
            "-w",
            str(folder),
            str(sdist),
        ],
        check=True,
    )
    return next(folder.glob("*.whl"))


def test_the_source_distribution_carries_the_core_and_the_hex(sdist):
    names = {path.relative_to(sdist).as_posix() for path in sdist.rglob("*") if path.is_file()}
    assert {
        "LICENSE",
        "firmware/core/sg_wire.h",
        "firmware/core/sg_wire.c",
        "firmware/app/app_rate.c",
        "host_sdk/sparsegaze/_core_build.py",
        "host_sdk/sparsegaze/data/firmware.hex",
    } <= names
    assert not [name for name in names if "vheadset" in name], "GPL files do not belong into the package"


def test_the_wheel_installs_alone_and_its_core_works(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path)
    assert any(re.fullmatch(r"sparsegaze/_core\.[\w.-]*(so|pyd)", name) for name in names)
    assert "sparsegaze/data/firmware.hex" in names
    assert {name.split("/")[0] for name in names} == {
        "sparsegaze",
        wheel.name.split("-")[0] + "-" + wheel.name.split("-")[1] + ".dist-info",
    }
    program = (
        "import sparsegaze, sparsegaze._core as core, sparsegaze.doctor as doctor; "
        "print(sparsegaze.__file__, core.lib.SG_WIRE_VERSION, doctor.firmware().ok)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        check=True,
        capture_output=True,
        text=True,
    )
    place, version, firmware = done.stdout.split()
    assert place.startswith(str(tmp_path)) and int(version) >= 1 and firmware == "True"


def test_importing_the_package_needs_neither_simulator_nor_screen(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    assert not list((tmp_path / "sparsegaze").glob("_sim.*"))
    program = (
        "import sys\n"
        "for name in 'pygame', 'matplotlib', 'sparsegaze._sim':\n"
        "    sys.modules[name] = None\n"
        "from sparsegaze import Device, DeviceModel, Recording, flash_hex, upload, ports\n"
        "import sparsegaze.cli"
    )
    subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        check=True,
    )
