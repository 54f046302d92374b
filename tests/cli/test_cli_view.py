# SPDX-License-Identifier: Apache-2.0
"""`sparsegaze view` as its user meets it: pictures, files, words, refusals."""

import builtins

import numpy as np
import pytest

QUICK = ["--pixels", "48", "--samples", "1"]


@pytest.fixture(scope="module")
def headset(repo_root):
    return str(repo_root / "headsets" / "led2gaze.toml")


@pytest.fixture
def refused(command_json, headset, tmp_path):
    """refused(*options): the command must fail in a line and write nothing. Returns (code, error, remedy)."""

    def run(*options):
        before = sorted(tmp_path.iterdir())
        code, data, err = command_json("view", *options)
        assert code in (1, 2) and set(data) == {"error", "remedy"} and data["error"] and data["remedy"]
        assert err.count("\n") == 1
        assert sorted(tmp_path.iterdir()) == before
        return code, data["error"], data["remedy"]

    return run


@pytest.mark.parametrize("kind, start", [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_a_picture_is_drawn_and_told_in_words(command, headset, tmp_path, kind, start):
    path = tmp_path / f"view.{kind}"
    code, out, err = command("view", headset, "--sensor", 3, "--gaze", "27,-20", "-o", path, *QUICK)
    assert code == 0, err
    assert path.read_bytes().startswith(start) and sorted(tmp_path.iterdir()) == [path]
    for word in ("signal", "face", "sclera", "iris", "glint", "48 x 48", str(path)):
        assert word in out


def test_the_file_holds_what_the_signal_is_made_of(command_json, headset, tmp_path):
    files = tmp_path / "view.png", tmp_path / "view.npz"
    options = ["--gaze", "5,-3", "--emitter", 4, "--emitter", 2, "--person", 7, "--lids", 0.8, "--pupil", 5]
    code, data, err = command_json(
        "view", headset, "--sensor", 3, "-o", files[0], "--npz", files[1], *options, *QUICK
    )
    assert code == 0, err
    assert data["emitters"] == [4, 2] and data["pupil_mm"] == 5 and data["azimuth_deg"] == 5
    with np.load(files[1], allow_pickle=False) as held:
        radiance = held["radiance"]
        assert radiance.shape == (2, 48, 48) and radiance.dtype == float and held["edges_tan"].shape == (49,)
        assert np.allclose(radiance, sum(held["part_" + p] for p in ("face", "sclera", "iris", "glint")))
        total = (radiance * held["window"] * held["solid_angle"]).sum()
        assert held["emitters"].tolist() == [4, 2] and "1/mm^2" in str(held["units"])
    assert total == pytest.approx(data["signal_per_mm2"]["total"], rel=1e-12)
    assert data["brightest_per_mm2"] == pytest.approx(radiance.sum(0).max())


def test_both_renderers_tell_the_same(command_json, headset, tmp_path):
    told = []
    for renderer in ("embree", "osmesa"):
        code, data, err = command_json(
            "view", headset, "--sensor", 5, "-o", tmp_path / "view.png", "--renderer", renderer, *QUICK
        )
        assert code == 0, err
        told.append(list(data["signal_per_mm2"].values()))
    assert np.allclose(*told, rtol=2e-3) and told[0] != told[1]


def test_closed_lids_and_black_skin_leave_a_dark_picture(command, headset, tmp_path):
    person = tmp_path / "black.toml"
    person.write_text("[person]\nalbedo_skin = 0.0\n")
    options = ["--person", person, "--lids", 0, "-o", tmp_path / "dark.png"]
    code, out, err = command("view", headset, "--sensor", 0, *options, *QUICK)
    assert code == 0 and "dark" in out and "Warning" not in err, err


@pytest.mark.parametrize(
    "options, words, remedy",
    [
        (["--sensor", 6], "no sensor 6", "0 to 5"),
        (["--sensor", 3, "--emitter", 8], "no emitter 8", "0 to 5"),
        (["--sensor", 3, "--gaze", "75,0"], "gaze 75, 0", "within 60 degrees"),
        (["--sensor", 3, "--gaze", "nan,0"], "gaze nan, 0", "within 60 degrees"),
        (["--sensor", 3, "--pupil", "13"], "pupil 13", "smaller than the iris"),
        (["--sensor", 3, "--lids", "1.5"], "lids 1.5", "0 (closed) to 1 (open)"),
        (["--sensor", 3, "--pixels", 2048, "--samples", 4], "2048 pixels", "4096"),
        (["--sensor", 3, "--person", "nobody.toml"], "nobody.toml", "TOML"),
    ],
)
def test_what_cannot_be_seen_is_refused(refused, headset, tmp_path, options, words, remedy):
    code, error, said = refused(headset, "-o", tmp_path / "view.png", *QUICK, *options)
    assert code == 1 and words in error and remedy in said


@pytest.mark.parametrize("gaze", ["5", "5,6,7", "left,up", ""])
def test_a_gaze_that_is_not_two_numbers_is_wrong_usage(refused, headset, tmp_path, gaze):
    code, error, remedy = refused(headset, "--sensor", 3, "--gaze", gaze, "-o", tmp_path / "view.png")
    assert code == 2 and "27,-20" in error and "view --help" in remedy


def test_a_bad_headset_file_is_refused_with_its_name(refused, tmp_path):
    code, error, _ = refused(tmp_path / "none.toml", "--sensor", 0, "-o", tmp_path / "view.png")
    assert code == 1 and "none.toml" in error


@pytest.mark.parametrize("option", ["-o", "--npz"])
def test_an_output_without_a_folder_is_refused_before_the_work(refused, headset, tmp_path, option):
    place = {"-o": tmp_path / "view.png", "--npz": tmp_path / "view.npz"}
    place[option] = tmp_path / "none" / "view.png"
    code, error, _ = refused(headset, "--sensor", 0, *[word for pair in place.items() for word in pair])
    assert code == 1 and "no folder" in error


def test_a_picture_of_no_known_kind_is_refused(refused, headset, tmp_path):
    code, error, remedy = refused(headset, "--sensor", 0, "-o", tmp_path / "view.gaze")
    assert code == 1 and ".gaze" in error and ".png" in remedy


def test_a_missing_matplotlib_is_said_with_its_extra(refused, headset, tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] == "matplotlib":
            raise ImportError("No module named 'matplotlib'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    code, error, remedy = refused(headset, "--sensor", 0, "-o", tmp_path / "view.png")
    assert code == 1 and "matplotlib" in error and "sparsegaze[pictures]" in remedy


def test_the_help_teaches(command):
    code, out, _ = command("view", "--help")
    assert code == 0
    for word in ("--sensor", "--gaze", "27,-20", "glint", "solid_angle", "libosmesa6"):
        assert word in out
