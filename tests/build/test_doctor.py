# SPDX-License-Identifier: Apache-2.0
"""The doctor finds what is missing, says how to get it, and never falls over."""

import json
import re
import socket
import subprocess
import sys

import pytest

from sparsegaze import doctor, virtual


def test_everything_that_setup_installs_is_found():
    failing = [
        check
        for check in doctor.examine()
        if not check.ok and check.name not in ("ports", "serial permission")
    ]
    assert failing == []


def test_every_check_that_fails_has_a_remedy_and_none_raises_on_an_empty_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "PACKAGE", tmp_path)
    monkeypatch.setattr(doctor, "SOURCE_TREE", tmp_path)
    monkeypatch.setattr(virtual, "BOOTLOADER_FOLDERS", (str(tmp_path),))
    for variable in ("SPARSEGAZE_OPTIBOOT", "SPARSEGAZE_ATMEGABOOT", "SPARSEGAZE_VHEADSET"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(doctor, "PYTHON_MIN", (99, 0))
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "_version", lambda name: None)
    for module in ("sparsegaze._core", "sparsegaze._sim", "sparsegaze.registry"):
        monkeypatch.setitem(sys.modules, module, None)  # its import raises ImportError
    checks = doctor.examine()
    assert [check.name for check in checks if check.ok and check.name != "serial permission"] == []
    assert [check.name for check in checks if check.ok is False] == [
        "Python",
        "Python packages",
        "C core",
        "firmware",
        "ports",
    ]
    for check in checks:
        assert check.found and "\n" not in check.found + check.remedy
        assert bool(check.remedy) == (check.ok is not True), check


def test_a_port_that_this_user_may_not_open_is_reported(monkeypatch):
    monkeypatch.setattr(doctor.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    monkeypatch.setattr(doctor, "_serial_ports", lambda: ["/dev/ttyUSB0"])
    check = doctor.serial_permission()
    assert check.ok is False and "/dev/ttyUSB0" in check.found and "dialout" in check.remedy


def test_a_virtual_nano_whose_library_has_gone_is_not_called_there(monkeypatch, tmp_path):
    program = tmp_path / "tools" / "vheadset" / "vheadset"
    program.parent.mkdir(parents=True)
    program.write_text(
        "#!/bin/sh\necho 'error while loading shared libraries: libsimavr.so.2' >&2\nexit 127\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(doctor, "SOURCE_TREE", tmp_path)
    check = doctor.virtual_nano()
    assert check.ok is None and "libsimavr" in check.found


def test_the_network_is_out_of_reach_of_tests():
    with pytest.raises(AssertionError, match="network"):
        socket.create_connection(("192.0.2.1", 80), timeout=1)


def run(*args):
    """Exit code and what a command prints on stdout and stderr."""
    done = subprocess.run(
        [sys.executable, "-c", "from sparsegaze.cli import main; main()", *map(str, args)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def shipped(repo_root):
    return sorted((repo_root / "headsets").glob("*.toml"))


def test_the_doctor_says_that_the_shipped_headsets_are_safe_and_what_they_draw(repo_root):
    for path in shipped(repo_root):
        code, out, err = run("doctor", path)
        assert (code, err) == (0, ""), out
        assert "safe: the least margin is" in out and "OVER" not in out
        for said in ("normal", "any command", "any fault", "cornea, average", "retina, one pulse", "W/m2"):
            assert said in out
        for said in ("default", "low power", "paper, LEDs", "800", "16, no computer"):
            assert said in out
        assert max(map(len, out.splitlines())) < 200


def test_the_doctors_figures_as_one_object(repo_root):
    code, out, _ = run("doctor", repo_root / "headsets" / "led2gaze.toml", "--json")
    data = json.loads(out)
    assert code == 0 and data["ok"] is True and data["eye_safety"]["ok"] is True
    for case, least, most in (("normal", 5, 40), ("any command", 40, 95), ("any fault", 40, 99)):
        assert least < data["eye_safety"]["irradiance_w_m2"][case] < most
    rows = data["eye_safety"]["rows"]
    assert all(row["value"] * row["margin"] == pytest.approx(row["limit"]) for row in rows)
    assert [one["setting"] for one in data["power"]][:2] == ["default", "250 Hz, 4 cycles"]
    assert data["paper_mw"] == {"leds": 800, "photodiodes": 16}


def test_the_doctor_fails_over_the_limit_and_says_what_would_do(repo_root, tmp_path):
    path = tmp_path / "bright.toml"
    text = (repo_root / "headsets" / "led2gaze.toml").read_text()
    path.write_text(text.replace("intensity_mw_sr = 15.0", "intensity_mw_sr = 60.0"))
    code, out, _ = run("doctor", path)
    assert code == 1 and "OVER  any fault" in out
    assert "NOT SAFE: 3.78 x the limit (any fault, cornea, average, supply) -> emitters of at most" in out
    remedy = re.search(r"emitters of at most ([0-9.]+) mW/sr", out)
    path.write_text(text.replace("intensity_mw_sr = 15.0", "intensity_mw_sr = %s" % remedy.group(1)))
    assert run("doctor", path)[0] == 0, "the remedy is one"
    over = "intensity_mw_sr = %g" % (1.03 * float(remedy.group(1)))
    path.write_text(text.replace("intensity_mw_sr = 15.0", over))
    code, out, _ = run("doctor", path, "--json")
    assert code == 1 and json.loads(out)["ok"] is False


@pytest.mark.parametrize(
    "change, says",
    [
        (("intensity_mw_sr = 15.0\n", ""), "led0 has no intensity_mw_sr"),
        (("wavelength_nm = 940.0\n", ""), "led0 has no wavelength_nm"),
        (('pin = "A1"', 'pin = "A0"'), "led0 and led1 are both on pin A0"),
        (("[board]", "[bord]"), "no key bord"),
    ],
)
def test_the_doctor_of_a_wrong_headset_is_one_line_with_a_remedy(repo_root, tmp_path, change, says):
    path = tmp_path / "wrong.toml"
    path.write_text((repo_root / "headsets" / "led2gaze.toml").read_text().replace(*change))
    code, out, err = run("doctor", path)
    assert code == 1 and out == "" and err.count("\n") == 1
    assert says in err and " — " in err


def test_the_doctor_of_a_headset_that_is_not_there_is_one_line(tmp_path):
    code, out, err = run("doctor", tmp_path / "none.toml")
    assert code == 1 and out == "" and "none.toml" in err and err.count("\n") == 1
