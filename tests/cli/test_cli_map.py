# SPDX-License-Identifier: Apache-2.0
"""`sparsegaze map` as its user meets it: files, words, refusals; and the person files it is given."""

import json
import os
import re
from dataclasses import asdict, fields

import numpy as np
import pytest

from sparsegaze.errors import SceneError
from sparsegaze.maps import GazeMap
from sparsegaze.person import Person, load_person, nominal_person

QUICK = ["--grid", "3", "--tol", "0.01"]


@pytest.fixture(scope="module")
def led2gaze_file(repo_root):
    return str(repo_root / "headsets" / "led2gaze.toml")


@pytest.fixture
def made(command, led2gaze_file, tmp_path):
    """made(*options): runs the command into map.npz; returns (GazeMap, stdout)."""

    def run(*options):
        path = tmp_path / "map.npz"
        code, out, err = command("map", led2gaze_file, *QUICK, "-o", path, *options)
        assert code == 0, err
        return GazeMap.load(path), out

    return run


def test_a_map_is_written_and_told_in_words(made, tmp_path):
    held, out = made()
    assert held.response.shape == (1, 6, 6, 3, 3) and held.azimuth_deg[-1] == 25
    assert not held.parts
    for word in ("mean", "error", "left out", "responses/s", str(tmp_path / "map.npz")):
        assert word in out


def test_numpy_reads_the_file_without_pickle(made, tmp_path):
    made("--parts")
    with np.load(tmp_path / "map.npz", allow_pickle=False) as file:
        names = set(file.files)
        assert {"response", "pupil_mm", "lid_opening", "slip_mm", "azimuth_deg", "elevation_deg"} <= names
        assert {"error_estimate", "units", "headset", "person", "modelled", "left_out", "version"} <= names
        total = sum(file["part_" + term] for term in ("face", "sclera", "iris", "glint"))
        assert np.array_equal(total, file["response"])
        assert "degrees" in str(file["units"])


def test_states_are_walked_in_step(made):
    held, _ = made("--lids", 1, "--lids", 0, "--pupil", 2, "--pupil", 6, "--slip", "0.5,0,-1")
    assert held.lid_opening.tolist() == [1, 0] and held.pupil_mm.tolist() == [2, 6]
    assert held.slip_mm.tolist() == [[0.5, 0, -1]] * 2
    assert np.ptp(held.response[1], axis=-1).max() == 0, "closed lids show the skin only"
    assert np.ptp(held.response[0], axis=-1).max() > 0


def test_json_is_one_object_with_the_estimates(command_json, led2gaze_file, tmp_path):
    code, data, _ = command_json("map", led2gaze_file, *QUICK, "-o", tmp_path / "map.npz")
    assert code == 0 and data["gazes"] == 9 and data["sensors"] == 6
    assert data["error_bound"] > 0 and data["left_out"] and data["rings"][0]["sensor"] == 0


def test_a_sweep_keeps_its_parts(command, led2gaze_file, tmp_path):
    path = tmp_path / "sweep.npz"
    options = ["--sweep", "azimuth", "--elevation", "-5", "--grid", "11", "--tol", "0.01"]
    assert command("map", led2gaze_file, *options, "-o", path)[0] == 0
    held = GazeMap.load(path)
    assert held.response.shape == (1, 6, 6, 1, 11) and held.elevation_deg.tolist() == [-5]
    assert set(held.parts) == {"face", "sclera", "iris", "glint"}


def test_pictures_are_written_beside(command, led2gaze_file, tmp_path):
    pytest.importorskip("matplotlib")
    for options in (["--grid", "5"], ["--sweep", "elevation", "--azimuth", "3", "--grid", "9"]):
        picture = tmp_path / "map.png"
        code, _, err = command(
            "map", led2gaze_file, *options, "--tol", "0.01", "-o", tmp_path / "map.npz", "--png", picture
        )
        assert code == 0, err
        assert picture.read_bytes()[:4] == b"\x89PNG" and picture.stat().st_size > 20000
        picture.unlink()


def test_without_matplotlib_a_picture_is_refused_before_the_work(refused, monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    error, remedy = refused("--png", tmp_path / "map.png")
    assert "matplotlib" in error and "pip install" in remedy


@pytest.fixture
def refused(command_json, led2gaze_file, tmp_path):
    """refused(*options, headset=...): fails with one line and a remedy, and leaves an old map alone."""

    def run(*options, headset=None, output=None):
        old = tmp_path / "map.npz"
        old.write_bytes(b"what was there")
        arguments = ["map", headset or led2gaze_file, "-o", output or old, *QUICK, *options]
        code, data, err = command_json(*arguments)
        assert code in (1, 2) and set(data) == {"error", "remedy"} and data["remedy"]
        assert err.count("sparsegaze: ") == 1
        assert old.read_bytes() == b"what was there"
        assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
        return data["error"], data["remedy"]

    return run


@pytest.mark.parametrize(
    "options, said",
    [
        (["--half-angle", "46"], "half angle"),
        (["--half-angle", "nan"], "half angle"),
        (["--grid", "182"], "grid"),
        (["--grid", "0"], "grid"),
        (["--tol", "0"], "tolerance"),
        (["--tol", "nan"], "tolerance"),
        (["--pupil", "30"], "pupil"),
        (["--pupil", "nan"], "pupil"),
        (["--lids", "1.5"], "lid opening"),
        (["--slip", "1,2"], "three numbers"),
        (["--slip", "nan,0,0"], "slip"),
        (["--slip", "0,0,30"], "face"),
        (
            ["--pupil", "3", "--pupil", "4", "--lids", "1", "--lids", "0.5", "--lids", "0"],
            "do not go together",
        ),
        (["--elevation", "3"], "--sweep azimuth"),
        (["--sweep", "azimuth", "--azimuth", "3"], "--sweep elevation"),
        (["--pixels", "64"], "--method image"),
        (["--person", "no-such.toml"], "no-such.toml"),
        (["--png", "/no/such/folder/map.png"], "folder"),
        (["--png", "map.docx"], "docx"),
    ],
)
def test_a_bad_option_is_one_line_with_its_remedy(refused, options, said, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    error, _ = refused(*options)
    assert said in error


@pytest.mark.parametrize(
    "change, said",
    [
        (("position_mm = [-15.99, 0.56, -28.0]", "position_mm = [nan, 0.56, -28.0]"), "position_mm"),
        (("position_mm = [-15.99, 0.56, -28.0]", "position_mm = [0.0, 0.0, -5.0]"), "inside the eyeball"),
        (("position_mm = [-15.99, 0.56, -28.0]", "position_mm = [-15.99, 0.56, 9.0]"), "behind the face"),
        (("sensitivity_sigma_deg = 8.5", "sensitivity_sigma_deg = 0"), "sensitivity_sigma_deg"),
        (("[[led]]", "[[led"), "headset.toml"),
    ],
)
def test_an_impossible_headset_is_refused_with_its_reason(refused, led2gaze_file, tmp_path, change, said):
    with open(led2gaze_file) as file:
        text = file.read()
    assert change[0] in text
    (tmp_path / "headset.toml").write_text(text.replace(*change, 1))
    error, _ = refused(headset=tmp_path / "headset.toml")
    assert said in error


def test_an_output_that_cannot_be_written_is_refused_before_the_work(refused, tmp_path):
    error, _ = refused(output=tmp_path / "no" / "map.npz")
    assert "folder" in error
    error, _ = refused(output=tmp_path)
    assert "director" in error or "cannot be written" in error


def test_a_full_disk_leaves_the_old_map(refused, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sparsegaze.mapstore.np.savez", full)
    assert "No space left" in refused()[0]


def test_the_image_method_is_told_as_such(made):
    pytest.importorskip("sparsegaze.image")
    held, out = made("--method", "image", "--pixels", "16", "--bits", "8", "--clip", "--grid", "1")
    assert held.method == "image" and np.isnan(held.error_estimate).all()
    assert "16 wide" in out and "clipped" in out


# person files -----------------------------------------------------------------------------------------------


def test_nominal_toml_is_the_nominal_person_and_explains_every_field(repo_root):
    path = repo_root / "persons" / "nominal.toml"
    assert load_person(path) == nominal_person()
    text = path.read_text()
    for field in fields(Person):
        line = re.search(rf"^{field.name} = .*#\s*(.+)$", text, re.M)
        assert line, f"{field.name} is not explained"
        unit = field.name.rpartition("_")[2]
        assert unit not in ("mm", "deg") or line.group(1).startswith(unit + ";"), field.name


def test_every_person_file_is_a_possible_person_and_differs_from_the_nominal(repo_root, led2gaze_file):
    from sparsegaze.headset import load_headset
    from sparsegaze.scene import Scene

    names = sorted(os.listdir(repo_root / "persons"))
    assert {"nominal.toml", "deep-set.toml", "half-closed.toml"} <= set(names)
    people = [load_person(repo_root / "persons" / name) for name in names]
    assert len({tuple(asdict(person).items()) for person in people}) == len(names)
    for person in people:
        values = Scene(load_headset(led2gaze_file), person, quality={"face": 0.2}).response(5, 5)
        assert np.isfinite(values).all() and values.sum() > 0


def test_a_person_file_with_an_unknown_key_is_refused(tmp_path):
    (tmp_path / "p.toml").write_text("[person]\nbrows_mm = 3\n")
    with pytest.raises(SceneError, match="brows_mm"):
        load_person(tmp_path / "p.toml")


def test_a_map_never_replaces_the_headset_or_the_person_it_is_made_from(command, led2gaze_file, tmp_path):
    for name in ("headset.npz", "person.npz"):
        text = open(led2gaze_file).read() if name[0] == "h" else "[person]\n"
        (tmp_path / name).write_text(text)
    headset, person = str(tmp_path / "headset.npz"), str(tmp_path / "person.npz")
    for output in (headset, person):
        code, _, err = command("map", headset, "--person", person, *QUICK, "-o", output)
        assert code != 0 and "is what the command reads" in err
    assert open(headset).read() == open(led2gaze_file).read() and open(person).read() == "[person]\n"


def test_a_map_is_called_npz(command, led2gaze_file, tmp_path):
    code, _, err = command("map", led2gaze_file, *QUICK, "-o", tmp_path / "map.txt")
    assert code != 0 and "does not end in .npz" in err
    assert not os.listdir(tmp_path)


def test_a_scene_without_light_is_said_to_have_none(command, led2gaze_file, tmp_path):
    (tmp_path / "far.toml").write_text("[person]\neye_position_mm = [1000.0, 0.0, 0.0]\n")
    options = ["--person", tmp_path / "far.toml", "-o", tmp_path / "map.npz"]
    code, _, err = command("map", led2gaze_file, *QUICK, *options)
    assert code != 0 and "no sensor receives any light" in err
    assert not os.path.exists(tmp_path / "map.npz")


def test_json_says_whether_the_tolerance_was_met(command, led2gaze_file, tmp_path):
    code, out, _ = command("map", led2gaze_file, *QUICK, "-o", tmp_path / "map.npz", "--json")
    assert code == 0 and json.loads(out)["tolerance_met"] is True
