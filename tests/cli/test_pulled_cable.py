# SPDX-License-Identifier: Apache-2.0
"""The virtual Nano dies in the middle of a command: one line, exit code 1, what was kept stays."""

import contextlib
import threading
import time

import pytest
from fake_device import linear_model

from sparsegaze import store
from sparsegaze.device import Device
from sparsegaze.mapfile import synthetic_map
from sparsegaze.recording import Recording


@pytest.fixture
def pulled_at(monkeypatch):
    """pulled_at(nano, stage, done): the power goes and the port closes at this step of the next command."""

    def arm(nano, stage, done):
        def step(now_stage, now_done, total):
            if (now_stage, now_done) == (stage, done):
                nano.control.power(False)       # what is in flash goes to its file
                nano.kill()

        @contextlib.contextmanager
        def progress(console):
            yield step

        monkeypatch.setattr("sparsegaze.console.Console.progress", progress)

    return arm


@pytest.fixture
def killed_when_longer(request):
    """killed_when_longer(nano, path, n_bytes): a thread kills the virtual Nano once the file is that long."""

    def arm(nano, path, n_bytes):
        def watch():
            while not stop.is_set():
                if path.exists() and path.stat().st_size > n_bytes:
                    nano.kill()
                    return
                time.sleep(0.01)

        stop = threading.Event()
        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        request.addfinalizer(lambda: (stop.set(), thread.join()))

    return arm


@pytest.fixture
def optics(tmp_path):
    return synthetic_map(str(tmp_path / "synthetic.sgmap"))


def test_cable_pulled_during_flash_says_to_flash_again_and_the_stored_model_survives(
    command_json, virtual_nano, firmware_hex, tmp_path, pulled_at, monkeypatch
):
    state = tmp_path / "state"
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex, state_dir=state)
    stored = store.upload(nano.port, linear_model())
    pulled_at(nano, "write", 50)
    code, data, _ = command_json("flash", nano.port)
    assert code == 1 and set(data) == {"error", "remedy"}
    assert "not finished" in data["error"] and "flash" in data["remedy"]
    nano.stop()
    monkeypatch.undo()
    nano = virtual_nano(map=False, unpaced=True, state_dir=state)
    assert command_json("flash", nano.port)[0] == 0
    with Device(nano.port) as device:
        assert device.model_info().crc[0] == stored.crc


@pytest.mark.parametrize("stage, done", [("write", 2), ("verify", 5)])
def test_cable_pulled_during_upload_leaves_the_old_model_to_the_bit(
    command_json, virtual_nano, firmware_hex, tmp_path, pulled_at, stage, done
):
    state = tmp_path / "state"
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex, state_dir=state)
    store.upload(nano.port, linear_model())
    old = store.stamp(linear_model().image, 1)
    linear_model(n_vectors=70).save(tmp_path / "eye.sgm")
    pulled_at(nano, stage, done)
    code, data, _ = command_json("upload", nano.port, tmp_path / "eye.sgm")
    assert code == 1 and "the upload was not finished" in data["error"]
    assert "the old model is still in place" in data["remedy"]
    nano.stop()
    again = virtual_nano(map=False, unpaced=True, state_dir=state)
    with Device(again.port) as device:
        assert device.read_model() == old


def test_cable_pulled_during_stream_leaves_whole_rows_in_the_csv(
    command_json, virtual_nano, firmware_hex, tmp_path, optics, killed_when_longer
):
    nano = virtual_nano(map=optics, app=firmware_hex)
    gaze = tmp_path / "gaze.csv"
    killed_when_longer(nano, gaze, 20_000)
    code, data, err = command_json("stream", nano.port, "--csv", gaze)
    assert code == 1 and set(data) == {"error", "remedy"} and data["remedy"]
    assert err.count("sparsegaze: ") == 1
    rows = [line for line in gaze.read_text().splitlines() if not line.startswith("#")]
    assert gaze.read_text().endswith("\n") and len(rows) > 100 and len({row.count(",") for row in rows}) == 1
    linear_model().save(tmp_path / "eye.sgm")
    assert command_json("replay", gaze, "--model", tmp_path / "eye.sgm")[1]["compared"] > 100


def test_cable_pulled_during_record_leaves_the_targets_so_far(
    command_json, virtual_nano, firmware_hex, tmp_path, optics, killed_when_longer
):
    nano = virtual_nano(map=optics, unpaced=True, app=firmware_hex)
    eye = tmp_path / "eye.csv"
    killed_when_longer(nano, eye, 40_000)
    code, data, _ = command_json("record", nano.port, "-o", eye, "--targets", "200")
    assert code == 1 and set(data) == {"error", "remedy"} and data["remedy"]
    assert Recording.read(eye).valid.sum() > 100


@pytest.mark.parametrize(
    "args",
    [("stream", "{port}", "--csv", "{file}"), ("record", "{port}", "-o", "{file}")],
    ids=["stream", "record"],
)
def test_a_port_that_is_gone_does_not_cost_the_file_of_yesterday(command_json, tmp_path, args):
    kept = tmp_path / "kept.csv"
    kept.write_text("yesterday\n")
    code, data, _ = command_json(*[arg.format(port="/dev/no-such-port", file=kept) for arg in args])
    assert code == 1 and "no such port" in data["error"]
    assert kept.read_text() == "yesterday\n"
