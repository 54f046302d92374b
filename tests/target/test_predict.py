# SPDX-License-Identifier: Apache-2.0
"""predict: every target's own binary gives the same bytes, and what the command says of them."""

import itertools
import json
import math
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from conftest import costly_model, random_features, random_model

from sparsegaze import predict as module
from sparsegaze import qemu
from sparsegaze.cli import run
from sparsegaze.device import Device
from sparsegaze.errors import DisconnectedError, ModelError, ProtocolError, RecordingError, VirtualError
from sparsegaze.model import CHANNELS, FLAG_OUT_OF_RANGE, FLAG_VALID
from sparsegaze.predict import CYCLES_EXACT, INSTRUCTIONS, REQUEST_SECTION, predict
from sparsegaze.recording import Recording

MODELS = {"64 vectors": (64, 6), "one vector, one channel": (1, 1), "three channels": (20, 3),
          "100 vectors": (100, 6)}


def hard_features(n=500, seed=0):
    """[n, 6]: every corner of what features can be and of the box that random_model spans, random ones."""
    corners = [list(itertools.product(ends, repeat=CHANNELS)) for ends in ((0, 65535), (31000, 40000))]
    features = np.concatenate([*corners, random_features(n - 2 * 2 ** CHANNELS, seed)])
    assert (features == 0).all(1).any() and (features == 65535).all(1).any()
    assert len(features) == n
    return features.astype(np.uint16)


@pytest.mark.parametrize("name", MODELS)
def test_every_target_gives_the_same_bytes(name):
    vectors, channels = MODELS[name]
    model = random_model(vectors, seed=vectors, channels=channels)
    features = hard_features(seed=vectors)
    done = {target: predict(model, features, target) for target in module.TARGETS}
    crc = {one.crc for one in done.values()}
    print(f"output CRC-32 over {len(features)} predictions, {name}: "
          + ", ".join(f"{target} {one.crc:08x}" for target, one in done.items()))
    first = done["host"].gaze.tobytes()
    assert len(first) == 12 * len(features)
    for target, one in done.items():
        assert one.gaze.tobytes() == first, target
    assert len(crc) == 1
    assert 0 < done["host"].valid.sum() < len(features), "the features do not try both sides of the range"


def test_the_host_is_what_the_model_predicts():
    model, features = random_model(64), random_features(200)
    done = predict(model, features)
    azimuth, elevation, flags = model.predict(features)[:3]
    assert np.array_equal(done.azimuth_deg, azimuth) and np.array_equal(done.elevation_deg, elevation)
    assert np.array_equal(done.flags, flags)
    assert done.cycle_kind is None and done.cycles_min is None


def test_a_wrong_bit_changes_the_crc():
    done = predict(random_model(8), random_features(50))
    gaze = done.gaze.copy()
    gaze["elevation_deg_q7"][49] ^= 1
    assert module.Prediction("host", gaze, 0).crc != done.crc


def test_the_nano_counts_the_cycles_of_the_requests_alone(board, tmp_path):
    model = random_model(64)
    features = random_features(300)
    inside = features[(features > 31000).all(1) & (features < 40000).all(1)]
    done = predict(model, inside, "nano")
    assert done.cycle_kind == CYCLES_EXACT and 0 < done.cycles_min <= done.cycles_max
    # The same section of the same features over the device's own line, live frames beside it.
    nano, device = board(models={0: model.image})
    device.set_stream(raw=True, gaze=True)
    nano.control.markers_clear()
    device.infer(inside)
    section = nano.control.markers()["6n"]
    assert (section.least, section.most) == (done.cycles_min, done.cycles_max)


def test_the_cortex_m4_counts_instructions_the_same_every_time():
    model, features = random_model(64), random_features(300)
    first, again = predict(model, features, "cortex-m4"), predict(model, features, "cortex-m4")
    assert first.cycle_kind == INSTRUCTIONS
    assert 64 * 20 < first.cycles_min <= first.cycles_max < 64 * 400
    assert (first.cycles_min, first.cycles_max) == (again.cycles_min, again.cycles_max)


def test_more_vectors_take_more_instructions_by_the_same_number_each():
    middle = np.full((1, CHANNELS), 30000)
    counts = [predict(costly_model(middle[0], n), middle, "cortex-m4").cycles_max for n in (1, 2, 33, 64)]
    each = counts[1] - counts[0]
    # One pass of the inner loop, give or take a branch or two where a distance is below 0.
    assert each > 20
    assert counts[3] - counts[2] == pytest.approx(31 * each, abs=3 * 31)


def test_the_cortex_m4_says_in_words_that_it_counts_instructions(files, capsys):
    model, path, _ = files
    assert run(["predict", model, path, "--on", "cortex-m4"]) == 0
    text = capsys.readouterr().out
    assert "instructions" in text and "cycles" not in text and "at most" in text
    assert run(["predict", model, path, "--on", "cortex-m4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cycle_kind"] == "instructions"


def test_qemu_missing_is_one_line_with_its_remedy(files, capsys, monkeypatch):
    model, path, _ = files
    monkeypatch.setattr(qemu, "PROGRAM", "qemu-system-of-no-machine")
    assert run(["predict", model, path, "--on", "cortex-m4"]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "not installed" in said and "apt-get install qemu-system-arm; make firmware" in said


def test_the_image_missing_is_one_line_with_its_remedy(tmp_path):
    with pytest.raises(VirtualError, match="not built") as caught:
        qemu.QemuBoard(program=tmp_path / "no.elf")
    assert "make firmware" in caught.value.remedy


def test_an_image_that_is_no_program_is_told_by_qemus_own_words(tmp_path):
    (tmp_path / "bad.elf").write_bytes(b"no program")
    with qemu.QemuBoard(program=tmp_path / "bad.elf") as board:
        with pytest.raises(DisconnectedError, match="the Cortex-M4 in QEMU is gone"):
            Device(board)


def test_a_damaged_model_is_refused_by_the_cortex_m4_itself():
    image = bytearray(random_model(20).image)
    image[-1] ^= 1
    with qemu.QemuBoard(bytes(image)) as board, Device(board) as device:
        with pytest.raises(ModelError, match="a checksum does not match"):
            module.check_model(device, random_model(20))


def test_a_board_without_a_model_flags_every_answer():
    with qemu.QemuBoard() as board, Device(board) as device:
        assert (device.infer(random_features(5)).flags == 2).all()


def test_noise_on_the_line_of_the_cortex_m4_harms_nothing():
    noise = np.random.default_rng(0).integers(0, 256, 5000, np.uint8).tobytes()
    model, features = random_model(20), random_features(20)
    with qemu.QemuBoard(model.image) as board, Device(board) as device:
        board.write(noise)
        board.write(b"\0")
        assert device.status().rx_bad > 0
        assert device.infer(features).azimuth_deg.tolist() == predict(model, features).azimuth_deg.tolist()
        assert device.status().stack_free > 4000


def test_a_program_that_stops_answering_is_given_up(monkeypatch):
    class Stopped(qemu.QemuBoard):
        def __init__(self, image):
            super().__init__(image)
            os.kill(self.pid, signal.SIGSTOP)

        def close(self):
            os.kill(self.pid, signal.SIGCONT)
            super().close()

    monkeypatch.setattr(module, "QemuBoard", Stopped)
    with pytest.raises(VirtualError, match="does not answer") as caught:
        predict(random_model(4), random_features(2), "cortex-m4")
    assert "make firmware" in caught.value.remedy


def test_a_reboot_ends_qemu_and_is_noticed():
    with qemu.QemuBoard() as board, Device(board) as device:
        with pytest.raises(DisconnectedError, match="the program in it ended"):
            device.reboot()


def test_ctrl_c_ends_qemu_and_leaves_nothing_behind(tmp_path):
    random_model(64).save(tmp_path / "m.sgm")
    Recording(np.arange(50000), random_features(50000), np.zeros((50000, 2)), np.ones(50000)).write(
        tmp_path / "r.csv")
    left = tmp_path / "t"
    left.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "sparsegaze.cli", "predict", str(tmp_path / "m.sgm"), str(tmp_path / "r.csv"),
         "--on", "cortex-m4", "--json"], env={**os.environ, "TMPDIR": str(left)}, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True)
    assert "predicting" in process.stderr.readline()
    assert list(left.iterdir())
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130 and json.loads(out)["error"] == "interrupted"
    assert list(left.iterdir()) == []


def test_a_record_with_a_part_missing_is_refused(tmp_path):
    with qemu.QemuBoard(random_model(4).image) as board, Device(board) as device:
        device.infer(random_features(3))
        assert len(board.sections()[REQUEST_SECTION]) >= 3
        whole = board._scope.read_bytes()
        assert [len(k) for k in qemu.section_counts(whole[:-3]).values()] == [len(whole) // 8 - 2, 1]
        board._scope.write_bytes(whole[:8] + whole[16:])
        with pytest.raises(ProtocolError, match="damaged"):
            board.sections()


@pytest.mark.parametrize("target,kind", [("host", None), ("nano", "cycles (exact)"),
                                         ("cortex-m4", "instructions")])
def test_the_command_says_the_same_of_every_target(files, target, kind, capsys):
    model, path, recording = files
    assert run(["predict", model, path, "--on", target, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    here = predict(random_model(16), recording.features[recording.valid]).report()
    assert (said["target"], said["cycle_kind"]) == (target, kind)
    same = ("n", "model_crc", "output_crc", "azimuth_deg", "elevation_deg", "flags", "sigma_deg")
    assert [said[key] for key in same] == [here[key] for key in same]
    assert (said["cycles_min"] is None) == (target == "host") == (said["cycles_max"] is None)


@pytest.fixture
def files(tmp_path):
    """A model and a recording of 40 rows, 30 of them valid: (model path, recording path, Recording)."""
    model, features = random_model(16), random_features(40)
    azimuth, elevation, _ = model.predict(features)[:3]
    valid = np.arange(40) % 4 != 0
    # A target of 1 deg to the right of every prediction that is an angle at all.
    target = np.clip(np.stack([azimuth + 1.0, elevation], 1), -80, 80)
    recording = Recording(np.arange(40), features, target, valid)
    model.save(tmp_path / "m.sgm")
    recording.write(tmp_path / "r.csv")
    return str(tmp_path / "m.sgm"), str(tmp_path / "r.csv"), recording


def test_json_holds_one_gaze_per_valid_row_in_order(files, capsys):
    model, path, recording = files
    assert run(["predict", model, path, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    done = predict(random_model(16), recording.features[recording.valid])
    assert said["n"] == 30 == len(said["azimuth_deg"]) == len(said["elevation_deg"]) == len(said["flags"])
    assert said["azimuth_deg"] == done.azimuth_deg.tolist() and said["flags"] == done.flags.tolist()
    assert len(said["sigma_deg"]) == 30
    assert all(value is None or value > 0 for value in said["sigma_deg"])
    assert all(math.isfinite(value) for value in said["azimuth_deg"] + said["elevation_deg"])
    assert said["output_crc"] == done.crc and said["model_crc"] == random_model(16).crc
    assert said["cycles_min"] is said["cycles_max"] is said["cycle_kind"] is None and said["target"] == "host"


def test_rows_out_of_range_keep_their_numbers_and_are_flagged(tmp_path, capsys):
    model = random_model(16)
    model.save(tmp_path / "m.sgm")
    rows = [",".join([value] * CHANNELS) for value in ("0", "65535")]
    (tmp_path / "f.csv").write_text("\n".join(["s0,s1,s2,s3,s4,s5", *rows]) + "\n")
    assert run(["predict", str(tmp_path / "m.sgm"), str(tmp_path / "f.csv"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert all(flags & FLAG_OUT_OF_RANGE and not flags & FLAG_VALID for flags in said["flags"])
    assert all(isinstance(value, float) for value in said["azimuth_deg"] + said["elevation_deg"])
    assert "error" not in said      # the file has no targets


def test_targets_without_a_single_gaze_leave_the_error_null(tmp_path, capsys):
    random_model(4).save(tmp_path / "m.sgm")
    Recording(np.arange(3), np.zeros((3, CHANNELS)), np.zeros((3, 2)), np.ones(3)).write(tmp_path / "r.csv")
    assert run(["predict", str(tmp_path / "m.sgm"), str(tmp_path / "r.csv"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["error"] == {"mean_deg": None, "median_deg": None, "p95_deg": None, "rows": 0}
    assert run(["predict", str(tmp_path / "m.sgm"), str(tmp_path / "r.csv")]) == 0
    assert "100.0 % flagged" in capsys.readouterr().out


def test_sigma_is_null_only_where_the_model_has_none(files, capsys):
    model, path, _ = files
    assert run(["predict", model, path, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    good = [sigma for sigma, flags in zip(said["sigma_deg"], said["flags"]) if flags & FLAG_VALID]
    flagged = [sigma for sigma, flags in zip(said["sigma_deg"], said["flags"]) if not flags & FLAG_VALID]
    assert good and flagged and all(0 < sigma < 230 for sigma in good) and min(flagged) > 230


def test_error_to_the_targets_is_told_over_the_rows_that_are_a_gaze(files, capsys):
    model, path, recording = files
    assert run(["predict", model, path, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    rows = recording.select(recording.valid)
    done = predict(random_model(16), rows.features)
    assert said["error"]["rows"] == done.valid.sum() > 0
    expected = module.target_error(done, rows)
    assert said["error"]["mean_deg"] == pytest.approx(expected.mean_deg, rel=1e-4)   # %.6g in the file


def test_the_output_file_holds_what_json_says(files, tmp_path, capsys):
    model, path, _ = files
    out = tmp_path / "gaze.csv"
    assert run(["predict", model, path, "--json", "-o", str(out)]) == 0
    said = json.loads(capsys.readouterr().out)
    lines = [line for line in out.read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == "row,azimuth_deg,elevation_deg,flags,sigma_deg" and len(lines) == 31
    azimuth = [float(line.split(",")[1]) for line in lines[1:]]
    assert azimuth == said["azimuth_deg"]


def test_text_and_help_fit_a_hundred_columns(files, capsys):
    model, path, _ = files
    assert run(["predict", model, path]) == 0
    assert run(["predict", "--help"]) == 0
    text = capsys.readouterr().out
    assert "error to target" in text and "flagged" in text and "Example:" in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_model_too_large_for_a_slot_is_one_line():
    class Large:
        channels, image, crc = 6, bytes(4000), 0

    with pytest.raises(ModelError, match="4000 bytes does not fit the target's slot of 1536") as caught:
        predict(Large(), random_features(3), "nano")
    assert "\n" not in str(caught.value) and "vectors" in caught.value.remedy


def test_a_file_of_fewer_channels_than_the_model_is_refused():
    with pytest.raises(ModelError, match="the model has 6 channels, the features 5"):
        predict(random_model(4), random_features(5)[:, :5])


def test_a_recording_without_a_valid_row_is_refused(tmp_path):
    Recording(np.arange(3), random_features(3), np.zeros((3, 2)), np.zeros(3)).write(tmp_path / "r.csv")
    with pytest.raises(RecordingError, match="no valid row"):
        module.read_rows(tmp_path / "r.csv")


def test_nan_in_the_features_names_its_line(tmp_path):
    (tmp_path / "f.csv").write_text("s0,s1\n1,2\n3,nan\n")
    with pytest.raises(RecordingError, match="line 3, column s1"):
        module.read_rows(tmp_path / "f.csv")
