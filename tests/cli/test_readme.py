# SPDX-License-Identifier: Apache-2.0
"""What README.md and the other documents tell one to type, or to read, is there and runs."""

import re

import pytest
from click.testing import CliRunner

from sparsegaze.cli import cli
from sparsegaze.mapfile import synthetic_map


@pytest.fixture(scope="module")
def readme(repo_root):
    return (repo_root / "README.md").read_text(encoding="utf-8")


def commands_of(text):
    """Lists of words after `sparsegaze` in indented lines and in inline code."""
    lines = re.findall(r"^    sparsegaze +(.+)$", text, re.M)
    lines += re.findall(r"`sparsegaze +([^`]+)`", text)
    return [re.split(r"\s+#|\s+&", line)[0].split() for line in lines]


def test_every_command_and_option_of_the_readme_exists(readme):
    commands = commands_of(readme)
    named = {words[0] for words in commands}
    assert named >= {"doctor", "virtual", "list", "flash", "calibrate", "stream", "info"}
    for words in commands:
        told = CliRunner().invoke(cli, [words[0], "--help"])
        assert told.exit_code == 0, words
        for option in (word for word in words if word.startswith("-")):
            assert option in told.output, words


HEADSETS = ["headsets/led2gaze.toml", "headsets/nextgaze_nano.toml"]
DOCUMENTS = ["DESIGN.md", "PROTOCOL.md", "CHANGELOG.md", *HEADSETS]


@pytest.mark.parametrize("name", DOCUMENTS)
def test_every_command_of_the_other_documents_exists(name, repo_root):
    for words in commands_of((repo_root / name).read_text(encoding="utf-8")):
        told = CliRunner().invoke(cli, [words[0].rstrip(","), "--help"])
        assert told.exit_code == 0, words
        for option in (word for word in words if word.startswith("--")):
            assert option in told.output, words


@pytest.mark.parametrize("name", ["README.md", "DESIGN.md", "PROTOCOL.md", "CHANGELOG.md"])
def test_every_target_and_file_that_a_document_names_exists(name, repo_root):
    text, makefile = (repo_root / name).read_text(encoding="utf-8"), (repo_root / "Makefile").read_text()
    targets = re.findall(r"(?:^    |`)make ([a-z][\w-]*)", text, re.M)
    assert [target for target in targets if not re.search(rf"^{target}:", makefile, re.M)] == []
    files = re.findall(r"`((?:firmware|host_sdk|tools|tests|headsets|persons|sim_c)/[\w./-]+\.\w+)`", text)
    assert [file for file in files if not (repo_root / file).is_file()] == []


def test_a_command_that_does_not_exist_would_be_seen():
    assert commands_of("    sparsegaze nonsense PORT   # no\n") == [["nonsense", "PORT"]]
    assert CliRunner().invoke(cli, ["nonsense", "--help"]).exit_code != 0


def test_the_folders_of_the_tree_exist(readme, repo_root):
    rows = re.findall(r"^\| ((?:`[\w/]+`(?:, )?)+) \|", readme, re.M)
    folders = [name for row in rows for name in re.findall(r"`([\w/]+)`", row)]
    assert len(folders) >= 8
    assert [name for name in folders if not (repo_root / name).is_dir()] == []


def test_the_python_example_runs_on_a_virtual_nano(readme, virtual_nano, firmware_hex, tmp_path, capsys):
    """Verbatim but for the port and an end: 40 frames. Without a model no gaze is valid, and none printed."""
    example = re.search(r"```python\n(.*?)```", readme, re.S).group(1)
    nano = virtual_nano(map=synthetic_map(str(tmp_path / "m.sgmap")), person=2, unpaced=True,
                        app=firmware_hex)
    example = example.replace("/dev/ttyUSB0", nano.port)
    assert "device.frames()" in example and nano.port in example
    seen = []
    scope = {"only": lambda frames: (seen.append(frame) or frame for frame, _ in zip(frames, range(40)))}
    exec(example.replace("device.frames()", "only(device.frames())"), scope)
    assert len(seen) == 40 and not any(frame.gaze.valid for frame in seen)
    assert capsys.readouterr().out == ""
