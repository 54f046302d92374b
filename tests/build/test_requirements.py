# SPDX-License-Identifier: Apache-2.0
"""pyproject.toml, requirements.in and requirements.txt agree, and every byte that pip installs is pinned."""

import re
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


@pytest.fixture(scope="module")
def project(repo_root):
    return tomllib.loads((repo_root / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def wanted(repo_root):
    """Requirements of requirements.in, by canonical name."""
    lines = (line.split("#")[0].strip() for line in (repo_root / "requirements.in").read_text().splitlines())
    return {canonicalize_name(Requirement(line).name): Requirement(line) for line in lines if line}


def locked_versions(text):
    """{name: [(version, number of hashes), ...]} of a locked file. Raises ValueError for any other line."""
    locked = {}
    for line in text.replace("\\\n", " ").splitlines():
        line = line.split("#")[0].strip()
        if not line:
            continue
        found = re.fullmatch(r"([\w.-]+)==([\w.!+]+)(?: ;[^-]*?)?((?: +--hash=sha256:[0-9a-f]{64})*)", line)
        if not found:
            raise ValueError(line)
        locked.setdefault(canonicalize_name(found[1]), []).append((found[2], found[3].count("--hash")))
    return locked


@pytest.fixture(scope="module")
def locked(repo_root):
    return locked_versions((repo_root / "requirements.txt").read_text())


def test_every_dependency_and_extra_is_pinned_within_its_bounds(project, wanted):
    named = list(project["project"]["dependencies"]) + list(project["build-system"]["requires"])
    for extra in project["project"]["optional-dependencies"].values():
        named += extra
    for text in named:
        requirement = Requirement(text)
        pin = wanted[canonicalize_name(requirement.name)]
        version = next(iter(pin.specifier))
        assert version.operator == "==", f"{pin} is not one version"
        assert version.version in requirement.specifier, f"{pin} is outside {requirement} of pyproject.toml"


def test_the_lock_has_what_was_asked_for(wanted, locked):
    for name, pin in wanted.items():
        version = next(iter(pin.specifier)).version
        assert [entry[0] for entry in locked[name]] == [version], f"run make lock: {pin}"


def test_every_locked_package_has_a_hash(locked):
    assert len(locked) > 40
    assert [name for name, entries in locked.items() if any(not hashes for _, hashes in entries)] == []


def test_a_pin_without_a_hash_is_seen():
    assert locked_versions("six==1.16.0\n") == {"six": [("1.16.0", 0)]}


@pytest.mark.parametrize("line", ["six", "six>=1", "--index-url x", "six @ file:///x"])
def test_a_locked_line_that_is_no_pin_is_refused(line):
    with pytest.raises(ValueError):
        locked_versions(line)


def test_no_registry_is_named(repo_root):
    for name in ("requirements.in", "requirements.txt", "pyproject.toml", "tools/setup.sh", "Makefile"):
        text = (repo_root / name).read_text()
        assert not re.search(r"://|index-url|find-links", text), name
