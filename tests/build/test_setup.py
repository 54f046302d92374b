# SPDX-License-Identifier: Apache-2.0
"""tools/setup.sh does nothing when there is nothing to do, and says one line when it may not do it."""

import os
import shutil
import subprocess

import pytest


def fake(folder, name, script):
    """Puts a shell script of this name into the folder."""
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


@pytest.fixture
def traps(tmp_path):
    """A folder for the front of PATH whose apt-get and sudo leave a trace and fail: (folder, trace)."""
    folder = tmp_path / "bin"
    folder.mkdir()
    trace = tmp_path / "trace"
    for name in ("apt-get", "sudo"):
        fake(folder, name, f'echo "{name} $*" >>"{trace}"; exit 99')
    return folder, trace


def run_setup(tree, folder, **variables):
    """Runs tree/tools/setup.sh with the folder in front of PATH and no package index within pip's reach."""
    environment = dict(
        os.environ, PATH=f"{folder}{os.pathsep}{os.environ['PATH']}", PIP_NO_INDEX="1", **variables
    )
    environment.pop("PYTHON", None)
    return subprocess.run(
        ["sh", "tools/setup.sh"], cwd=tree, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture
def bare_tree(tmp_path, repo_root):
    """What setup.sh reads, without an environment."""
    tree = tmp_path / "tree"
    (tree / "tools").mkdir(parents=True)
    for name in ("requirements.txt", "pyproject.toml", "setup.py", "tools/setup.sh"):
        shutil.copy(repo_root / name, tree / name)
    return tree


def test_second_run_installs_nothing(repo_root, traps):
    folder, trace = traps
    stamp = repo_root / ".venv" / "setup-stamp"
    assert stamp.is_file(), "run make setup first"
    before = stamp.stat().st_mtime_ns
    done = run_setup(repo_root, folder)
    assert (done.returncode, done.stdout, done.stderr) == (0, "setup: nothing to do\n", "")
    assert stamp.stat().st_mtime_ns == before
    assert not trace.exists(), trace.read_text()


def test_changed_requirements_are_noticed(repo_root, traps, bare_tree):
    # The stamp is the environment's own, so the copy gets one that was right before the change.
    folder, _ = traps
    subprocess.run(["python3", "-m", "venv", "--without-pip", ".venv"], cwd=bare_tree, check=True)
    pip = bare_tree / ".venv" / "bin" / "pip"
    pip.write_text(f"#!{bare_tree}/.venv/bin/python\n")
    (bare_tree / ".venv" / "setup-stamp").write_text("of other requirements\n")
    done = run_setup(bare_tree, folder)
    assert done.returncode == 1
    assert "installing the packages of requirements.txt" in done.stdout
    assert "pip could not install" in done.stderr


def test_an_environment_behind_a_link_is_never_cleared(tmp_path, traps, bare_tree):
    folder, _ = traps
    theirs = tmp_path / "another-tree" / ".venv"
    (theirs / "bin").mkdir(parents=True)
    (theirs / "bin" / "python").write_text("theirs")
    (bare_tree / ".venv").symlink_to(theirs)
    done = run_setup(bare_tree, folder)
    assert done.returncode == 1
    assert f"setup: .venv is a link to {theirs}" in done.stderr and len(done.stderr.splitlines()) == 1
    assert (theirs / "bin" / "python").read_text() == "theirs"


def test_without_root_the_line_to_run_is_printed_and_nothing_is_installed(traps, bare_tree):
    folder, trace = traps
    fake(folder, "id", "echo 1000")
    fake(folder, "cc", "exit 1")  # no header is found
    done = run_setup(bare_tree, folder)
    assert done.returncode == 1
    line = done.stderr.strip()
    assert (
        line.startswith("setup: run first: sudo apt-get update && sudo apt-get install ") and "\n" not in line
    )
    assert {"libsimavr-dev", "libelf-dev", "libembree-dev", "libc6-dev"} <= set(line.split())
    assert trace.read_text().split() == ["sudo", "-n", "true"]
    assert not (bare_tree / ".venv").exists()


def test_the_cortex_m4s_compiler_and_machine_are_asked_for_by_what_they_provide(tmp_path, traps, bare_tree):
    folder, _ = traps
    fake(folder, "id", "echo 1000")
    # Everything that is on this machine's PATH but the two.
    there = {"arm-none-eabi-gcc", "qemu-system-arm", *os.listdir(folder)}
    for place in filter(os.path.isdir, os.environ["PATH"].split(os.pathsep)):
        for name in set(os.listdir(place)) - there:
            (folder / name).symlink_to(os.path.join(place, name))
            there.add(name)
    done = subprocess.run(["sh", "tools/setup.sh"], cwd=bare_tree, env=dict(os.environ, PATH=str(folder)),
                          capture_output=True, text=True, check=False)
    assert done.returncode == 1
    wanted = done.stderr.split("sudo apt-get install ")[-1].split()
    assert {"gcc-arm-none-eabi", "qemu-system-arm"} <= set(wanted)


def test_a_failing_apt_get_is_one_line_with_its_log(traps, bare_tree):
    folder, trace = traps
    fake(folder, "id", "echo 0")
    fake(folder, "cc", "exit 1")
    done = run_setup(bare_tree, folder)
    assert done.returncode == 1
    assert "apt-get failed" in done.stderr and "apt.log" in done.stderr
    assert trace.read_text().count("apt-get") == 2  # update, install: no retries


def test_help_lists_every_target(repo_root):
    text = (repo_root / "Makefile").read_text()
    phony = next(line for line in text.splitlines() if line.startswith(".PHONY:")).split()[1:]
    shown = subprocess.run(
        ["make", "--no-print-directory"], cwd=repo_root, check=True, capture_output=True, text=True
    ).stdout
    assert [line.split()[1] for line in shown.splitlines()] == phony
