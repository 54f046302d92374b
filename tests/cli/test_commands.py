# SPDX-License-Identifier: Apache-2.0
"""The command line: help, one JSON object, one error line with its remedy, exit codes, complete files."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from fake_device import linear_model

from sparsegaze import cli
from sparsegaze.errors import FlashError, ModelError
from sparsegaze.recording import Recording


def program(*args, **options):
    """The program in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "sparsegaze.cli", *map(str, args)],
        capture_output=True,
        text=True,
        timeout=60,
        **options,
    )


def test_help_loads_neither_numerics_nor_serial_nor_terminal_code():
    done = program("--help", env={**os.environ, "PYTHONPROFILEIMPORTTIME": "1"})
    assert done.returncode == 0 and "calibrate" in done.stdout
    loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if "import time" in line}
    assert "click" in loaded
    assert not loaded & {"numpy", "scipy", "serial", "rich", "matplotlib", "cffi", "sparsegaze._core"}


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_help_teaches_with_an_example_and_explains_json(command, name):
    code, out, err = command(name, "--help")
    assert code == 0 and err == ""
    assert "Example:" in out and f"sparsegaze {name}" in out and "--json" in out
    assert max(map(len, out.splitlines())) <= 100


def test_every_command_has_a_line_in_the_list(command):
    out = command("--help")[1]
    for name, (_, text) in cli.COMMANDS.items():
        assert name in out and text.split()[0] in out


def test_version(command):
    from sparsegaze import __version__

    assert __version__ in command("--version")[1]


CASES = [
    (["info", "/dev/no-such-port"], 1, "no such port", "sparsegaze list"),
    (["stream", "/dev/no-such-port"], 1, "no such port", "sparsegaze list"),
    (["calibrate", "/dev/no-such-port", "--save", "{tmp}/kept"], 1, "no such port", "sparsegaze list"),
    (["record", "/dev/no-such-port", "-o", "{tmp}/eye.csv"], 1, "no such port", "sparsegaze list"),
    (["validate", "/dev/no-such-port"], 1, "no such port", "sparsegaze list"),
    (["recentre", "/dev/no-such-port"], 1, "no such port", "sparsegaze list"),
    (["flash", "/dev/no-such-port"], 1, "no such port", "sparsegaze list"),
    (["flash", "/dev/no-such-port", "--hex", "{tmp}/none.hex"], 1, "none.hex", "check"),
    (["upload", "/dev/no-such-port", "{tmp}/none.sgm"], 1, "none.sgm", "sparsegaze fit"),
    (["upload", "/dev/no-such-port", "{tmp}/junk"], 1, "not a sparsegaze model", "sparsegaze fit"),
    (["fit", "{tmp}/none.csv"], 1, "none.csv", "sparsegaze record"),
    (["fit", "{tmp}/junk"], 1, "junk", ""),
    (["replay", "{tmp}/none.csv", "--model", "{tmp}/eye.sgm"], 1, "none.csv", "sparsegaze record"),
    (["replay", "{tmp}/junk", "--model", "{tmp}/eye.sgm"], 1, "junk", ""),
    (["replay", "{tmp}/short.csv", "--model", "{tmp}/eye.sgm"], 1, "short.csv", "record again"),
    (["replay", "{tmp}/words.csv", "--model", "{tmp}/eye.sgm"], 1, "line 3, column s2", "repair"),
    (["replay", "{tmp}/ragged.csv", "--model", "{tmp}/eye.sgm"], 1, "line 2", "record again"),
    (["replay", "{tmp}/three.csv", "--model", "{tmp}/eye.sgm"], 1, "3", "this headset"),
    (["virtual", "--headset", "{tmp}/none.toml"], 1, "none.toml", ""),
    (["nonsense"], 2, "no command 'nonsense'", "sparsegaze --help"),
    (["strem"], 2, "did you mean stream", "sparsegaze --help"),
    (["stream"], 2, "Missing argument 'PORT'", "sparsegaze stream --help"),
    (["record", "PORT"], 2, "--output", "sparsegaze record --help"),
    (["stream", "PORT", "--seconds", "-1"], 2, "--seconds", "sparsegaze stream --help"),
    (["fit", "x.csv", "--vectors", "500"], 2, "--vectors", "sparsegaze fit --help"),
    (["calibrate", "PORT", "--targets", "3"], 2, "--targets", "sparsegaze calibrate --help"),
]


@pytest.fixture
def broken_files(tmp_path):
    header = "t_us,s0,s1,s2,s3,s4,s5,target_az_deg,target_el_deg,valid\n"
    (tmp_path / "junk").write_bytes(bytes(range(256)) * 40)
    (tmp_path / "short.csv").write_text(header)
    (tmp_path / "words.csv").write_text(header + "1,2,3,4,5,6,7,0,0,1\n1,2,3,four,5,6,7,0,0,1\n")
    (tmp_path / "ragged.csv").write_text(header + "1,2,3,4\n")
    (tmp_path / "three.csv").write_text("t_us,s0,s1,s2\n1,2,3,4\n")
    linear_model().save(tmp_path / "eye.sgm")
    return tmp_path


@pytest.mark.parametrize(
    "args, expected, what, remedy",
    CASES,
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_input_is_one_line_with_a_remedy(command, broken_files, args, expected, what, remedy):
    args = [arg.format(tmp=broken_files) for arg in args]
    code, out, err = command(*args)
    assert code == expected and out == ""
    said = [line for line in err.splitlines() if line.startswith("sparsegaze: ")]
    assert len(said) == 1 and said[0] == err.splitlines()[-1]
    assert what in said[0] and remedy in said[0].partition(" — ")[2]


@pytest.mark.parametrize(
    "args, expected, what, remedy",
    CASES,
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_bad_input_with_json_is_also_one_object(command_json, broken_files, args, expected, what, remedy):
    code, data, err = command_json(*[arg.format(tmp=broken_files) for arg in args])
    assert code == expected and set(data) == {"error", "remedy"}
    assert what in data["error"] and remedy in data["remedy"]
    assert f"sparsegaze: {data['error']}" in err


def test_no_port_leaves_no_recording_behind(command, broken_files):
    command("record", "/dev/no-such-port", "-o", broken_files / "eye.csv")
    assert not (broken_files / "eye.csv").exists()


def test_no_port_leaves_no_folder_behind(command, tmp_path):
    command("calibrate", "/dev/no-such-port", "--save", tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


def test_a_bug_is_one_line_too_and_shows_itself_on_request(command, fake, monkeypatch):
    device = fake(linear_model())
    monkeypatch.setattr(device, "set_stream", lambda **_: 1 / 0)
    code, _, err = command("stream", "PORT", "--seconds", "1")
    assert code == 1 and "internal error (ZeroDivisionError" in err and "SPARSEGAZE_DEBUG=1" in err
    monkeypatch.setenv("SPARSEGAZE_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        cli.run(["stream", "PORT", "--seconds", "1"])


def test_a_missing_part_points_to_doctor(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "sparsegaze.virtual", None)
    code, _, err = command("virtual")
    assert code == 1 and "sparsegaze doctor" in err


def test_record_fit_and_replay_from_one_recording(command_json, fake, tmp_path):
    fake()
    eye, model = tmp_path / "eye.csv", tmp_path / "eye.sgm"
    code, data, err = command_json("record", "PORT", "-o", eye, "--targets", "40")
    assert code == 0 and data["used_targets"] == 40 and data["frames"]["used"] > 4000 and data["lost"] == 0
    assert "targets" in err
    code, data, _ = command_json("fit", eye, "-o", model, "--vectors", "16")
    assert code == 0 and data["n_vectors"] == 16 and data["report"]["loo_rms_deg"] < 0.5
    code, data, _ = command_json("replay", eye, "--model", model)
    assert code == 0 and data["identical"] is None and data["frames"] == len(data["azimuth_deg"])
    recording = Recording.read(eye)
    gaze = np.array([data["azimuth_deg"], data["elevation_deg"]], float).T
    assert np.nanmedian(np.hypot(*(gaze - recording.target_deg)[recording.valid].T)) < 0.5


def test_stream_csv_replays_bit_identical_and_a_changed_gaze_does_not(command_json, command, fake, tmp_path):
    device = fake(linear_model(), raw_flags=lambda t: 8 if t % 700_000 < 30_000 else 0)
    device.recentre((0.5, -1.25))
    gaze, model = tmp_path / "gaze.csv", tmp_path / "eye.sgm"
    device.model.save(model)
    code, data, _ = command_json("stream", "PORT", "--seconds", "3", "--csv", gaze)
    assert (
        code == 0
        and data["seconds"] == pytest.approx(3.0, abs=0.01)
        and data["frames"] == 782
        and data["lost"] == 0
    )
    code, data, _ = command_json("replay", gaze, "--model", model)
    assert code == 0 and data["identical"] is True and data["compared"] == 782 and data["valid"] < 782
    lines = gaze.read_text().splitlines()
    row = lines[100].split(",")
    row[3] = f"{float(row[3]) + 1 / 128:.7f}"
    gaze.write_text("\n".join(lines[:100] + [",".join(row)] + lines[101:]) + "\n")
    code, data, _ = command_json("replay", gaze, "--model", model)
    assert code == 1 and data["identical"] is False and data["differing"] == 1
    code, out, _ = command("replay", gaze, "--model", model, "-o", tmp_path / "again.csv")
    assert "1 of 782 DIFFER" in out
    assert len((tmp_path / "again.csv").read_text().splitlines()) == 783


def test_stream_to_stdout_is_pure_csv(command, fake):
    fake(linear_model())
    code, out, err = command("stream", "PORT", "--seconds", "1", "--csv", "-")
    lines = [line for line in out.splitlines() if not line.startswith("#")]
    assert code == 0 and lines[0].startswith(
        "t_us,host_time_s,seq,azimuth_deg,elevation_deg,flags,s0,s1,s2,s3,s4,s5"
    )
    assert all(line.count(",") == lines[0].count(",") for line in lines) and len(lines) == 262
    assert "261 frames" in err


def test_stream_without_a_model_says_that_nothing_is_valid(command_json, fake):
    fake()
    code, data, _ = command_json("stream", "PORT", "--seconds", "1")
    assert code == 0 and data["valid"] == 0 and data["frames"] > 200


def test_validate_reports_and_draws(command_json, command, fake, tmp_path):
    fake(linear_model())
    code, data, err = command_json(
        "validate", "PORT", "--targets", "4", "--png", tmp_path / "v.png", "--csv", tmp_path / "v.csv"
    )
    assert code == 0 and data["stream"]["bit_identical"] is True and len(data["per_target"]) == 4
    assert (tmp_path / "v.png").read_bytes()[:4] == b"\x89PNG" and (tmp_path / "v.csv").exists()
    code, out, _ = command("validate", "PORT", "--targets", "2")
    assert code == 0 and "bit-identical" in out and "data loss" in out


def test_validate_of_a_device_that_computes_something_else_fails(command_json, fake):
    fake(
        linear_model(),
        spoil=lambda seq, gaze: gaze._replace(elevation_deg_q7=gaze.elevation_deg_q7 + (seq == 1500)),
    )
    code, data, _ = command_json("validate", "PORT", "--targets", "4")
    assert code == 1 and data["stream"]["differing"] == 1


def test_recentre_and_clear(command_json, fake):
    device = fake(linear_model(), shift_deg=(2.0, -3.0))
    code, data, _ = command_json("recentre", "PORT")
    assert code == 0 and np.allclose(data["after_deg"], (-2.0, 3.0), atol=0.1)
    assert device.screen.closed
    code, data, _ = command_json("recentre", "PORT", "--clear")
    assert code == 0 and data["after_deg"] == [0.0, 0.0]


def test_recentre_with_points_sets_a_gain_that_stream_and_replay_carry(command, command_json, fake, tmp_path):
    device = fake(linear_model(), shift_deg=(2.0, -3.0), warp=((1.12, 0.05), (-0.06, 0.9)))
    code, data, _ = command_json("recentre", "PORT", "--points", "5")
    assert code == 0 and data["applied"] == "affine" and len(data["points"]) == 5
    assert data["predicted_error_deg"] < data["offset_error_deg"] < data["error_deg"]
    assert data["after_gain"] == [list(row) for row in device.recentre().affine.gain] != data["before_gain"]
    gaze, model = tmp_path / "gaze.csv", tmp_path / "eye.sgm"
    device.model.save(model)
    assert command_json("stream", "PORT", "--seconds", "1", "--csv", gaze)[0] == 0
    assert command_json("replay", gaze, "--model", model)[1]["identical"] is True
    lines = gaze.read_text().splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("t_us"))
    column = lines[head].split(",").index("recentre_el_el")
    row = lines[head + 20].split(",")
    row[column] = "0.0"
    gaze.write_text("\n".join(lines[: head + 20] + [",".join(row)] + lines[head + 21 :]) + "\n")
    assert command_json("replay", gaze, "--model", model)[1]["differing"] == 1
    code, out, _ = command("recentre", "PORT", "--points", "5")
    assert code == 0 and "all stays as it was" in out and "gain, percent" in out
    code, data, _ = command_json("recentre", "PORT", "--clear")
    assert code == 0 and data["after_gain"] == [[0.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("points, word", [("2", "cannot tell a gain"), ("0", "1<=x<=9"), ("10", "1<=x<=9")])
def test_recentre_with_a_number_of_points_that_makes_no_sense(command, fake, points, word):
    fake(linear_model())
    code, out, err = command("recentre", "PORT", "--points", points)
    assert code != 0 and word in out + err and "Traceback" not in out + err


def test_a_stream_from_before_gains_and_sigma_still_replays(command_json, fake, tmp_path):
    device = fake(linear_model())
    device.recentre((0.5, -1.25))
    gaze, model = tmp_path / "gaze.csv", tmp_path / "eye.sgm"
    device.model.save(model)
    assert command_json("stream", "PORT", "--seconds", "1", "--csv", gaze)[0] == 0
    lines = gaze.read_text().splitlines()
    old = [line if line.startswith("#") else ",".join(line.split(",")[:14]) for line in lines]
    gaze.write_text("\n".join(old) + "\n")
    code, data, _ = command_json("replay", gaze, "--model", model)
    assert code == 0 and data["identical"] is True and data["compared"] > 250


def fake_upload(monkeypatch, device, error=None):
    def upload(link, model, progress=None):
        if error:
            raise error
        device.model = model.with_generation(7)
        return SimpleNamespace(
            _asdict=lambda: {"slot": 1, "generation": 7, "crc": device.model.crc},
            slot=1,
            generation=7,
            crc=device.model.crc,
        )

    monkeypatch.setattr("sparsegaze.store.upload", upload)


def test_calibrate_does_everything_and_keeps_recording_model_and_report(
    command_json, fake, monkeypatch, tmp_path
):
    device = fake()
    fake_upload(monkeypatch, device)
    code, data, _ = command_json(
        "calibrate",
        "PORT",
        "--targets",
        "40",
        "--vectors",
        "24",
        "--validation",
        "9",
        "--save",
        tmp_path / "kept",
    )
    assert code == 0
    assert data["used_targets"] == 40 and data["n_vectors"] == 24 and data["validation_targets"] == 9
    assert data["crc_host"] == data["crc_device"] == device.model.crc
    assert data["accuracy"]["mean_deg"] < 0.5 and data["stream"]["bit_identical"] is True
    assert sorted(os.listdir(tmp_path / "kept")) == ["model.sgm", "recording.csv", "report.json"]
    assert json.loads((tmp_path / "kept" / "report.json").read_text())["crc_host"] == data["crc_host"]
    assert (tmp_path / "kept" / "model.sgm").read_bytes() == device.model.image


@pytest.mark.parametrize(
    "error",
    [FlashError("the bootloader did not answer", "press reset"), ModelError("too large", "fewer vectors")],
)
def test_a_failed_upload_keeps_recording_and_model_and_says_where(
    command_json, fake, monkeypatch, tmp_path, error
):
    device = fake()
    fake_upload(monkeypatch, device, error)
    code, data, _ = command_json(
        "calibrate", "PORT", "--targets", "24", "--vectors", "16", "--save", tmp_path / "kept"
    )
    assert (
        code == 1
        and data["error"] == error.message
        and str(tmp_path / "kept" / "recording.csv") in data["remedy"]
    )
    assert len(Recording.read(tmp_path / "kept" / "recording.csv")) > 5000
    assert (tmp_path / "kept" / "model.sgm").exists()
