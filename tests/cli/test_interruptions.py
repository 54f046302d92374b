# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM, a pulled cable, a reader that goes away: files complete, one line, no traceback."""

import json
import os
import signal
import subprocess
import sys

import pytest
from fake_device import linear_model

from sparsegaze.recording import Recording


def test_ctrl_c_in_a_recording_exits_130_and_leaves_a_complete_file(command_json, fake, tmp_path):
    device = fake(interrupt_us=9_000_000)
    code, data, err = command_json("record", "PORT", "-o", tmp_path / "eye.csv")
    assert code == 130 and data["error"] == "interrupted" and "sparsegaze: interrupted" in err
    assert Recording.read(tmp_path / "eye.csv").valid.sum() > 500
    assert device.screen.closed and device.stream[-1] == "closed"


def test_ctrl_c_in_a_calibration_says_where_the_recording_is(command, fake, tmp_path):
    fake(interrupt_us=9_000_000)
    code, out, err = command("calibrate", "PORT", "--save", tmp_path / "kept")
    assert code == 130 and out == "" and str(tmp_path / "kept" / "recording.csv") in err
    assert Recording.read(tmp_path / "kept" / "recording.csv").valid.sum() > 500


def test_a_recording_without_a_frame_is_not_offered(command, fake, tmp_path):
    fake().settings(lights=False)
    code, out, err = command("calibrate", "PORT", "--save", tmp_path / "kept")
    assert code == 1 and out == "" and "off by command" in err and "recording is kept" not in err


def test_a_rate_out_of_reach_is_refused_before_anybody_looks_at_a_target(command, monkeypatch, tmp_path):
    monkeypatch.setattr("sparsegaze.transport.open_link", lambda *_: pytest.fail("the port was opened"))
    code, out, err = command("calibrate", "PORT", "--rate", "1500", "--save", tmp_path / "kept")
    assert code == 1 and out == "" and "1500 Hz is too fast: the device does 1001 Hz at most" in err
    assert not (tmp_path / "kept").exists()


def test_ctrl_c_ends_a_stream_with_its_summary_and_exits_130(command_json, fake, tmp_path):
    fake(linear_model(), interrupt_us=4_000_000)
    code, data, _ = command_json("stream", "PORT", "--csv", tmp_path / "gaze.csv")
    assert code == 130 and data["interrupted"] is True and data["frames"] > 500
    rows = (tmp_path / "gaze.csv").read_text()
    assert (
        rows.endswith("\n")
        and sum(not line.startswith("#") for line in rows.splitlines()) == data["frames"] + 1
    )


def test_a_pulled_cable_during_a_stream_is_one_line_and_the_csv_complete(command_json, fake, tmp_path):
    fake(linear_model(), unplug_us=4_000_000)
    code, data, _ = command_json("stream", "PORT", "--csv", tmp_path / "gaze.csv")
    assert code == 1 and "gone" in data["error"] and data["remedy"]
    assert (tmp_path / "gaze.csv").read_text().endswith("\n")


def test_a_signal_during_a_real_process_ends_it_in_order(tmp_path):
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from fake_device import FakeDevice, fit_linear, linear_model\n"
        "import sparsegaze.device, sparsegaze.cli\n"
        "sparsegaze.device.Device = lambda port: FakeDevice(linear_model())\n"
        "sparsegaze.cli.main(sys.argv[2:])\n"
    )
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        path = tmp_path / f"{code}.csv"
        process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                script,
                os.path.dirname(__file__),
                "stream",
                "PORT",
                "--csv",
                str(path),
                "--json",
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            while not path.exists() or path.stat().st_size < 2000:
                assert process.poll() is None, process.stderr.read()
            process.send_signal(number)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
        assert process.returncode == code and "Traceback" not in err
        assert json.loads(out)["interrupted"] is True
        assert path.read_text().endswith("\n")


def test_a_second_sigterm_does_not_interrupt_the_cleaning_up(tmp_path):
    """`timeout` sends one to the process and one to its group."""
    script = (
        "import sys, time, click, sparsegaze.cli\n"
        "@click.command()\n"
        "def slow():\n"
        "    try:\n"
        "        print('begun', flush=True)\n"
        "        time.sleep(60)\n"
        "    finally:\n"
        "        print('ending', flush=True)\n"
        "        time.sleep(0.5)\n"
        "        print('ended', flush=True)\n"
        "sparsegaze.cli.cli.resolve_command = lambda context, args: ('slow', slow, [])\n"
        "sparsegaze.cli.main(['slow'])\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "begun\n"
        process.terminate()
        assert process.stdout.readline() == "ending\n"
        process.terminate()
        out, _ = process.communicate(timeout=30)
    finally:
        process.kill()
    assert out == "ended\n" and process.returncode in (130, 143)


def test_a_reader_that_goes_away_is_no_traceback(tmp_path):
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from fake_device import FakeDevice, fit_linear, linear_model\n"
        "import sparsegaze.device, sparsegaze.cli\n"
        "sparsegaze.device.Device = lambda port: FakeDevice(linear_model())\n"
        "sparsegaze.cli.main(sys.argv[2:])\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, os.path.dirname(__file__), "stream", "PORT", "--csv", "-"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline()
    process.stdout.close()
    err = process.stderr.read()
    assert process.wait(timeout=60) == 1
    assert "Traceback" not in err and "BrokenPipe" not in err
