# SPDX-License-Identifier: Apache-2.0
"""Bad input typed at the command line: one line, its remedy, exit code 1; what was good before stays.

The faults themselves are gone through in tests/fault; here is what the user reads.
"""

import numpy as np
import pytest
from fake_device import MIDDLE, OPTICS, linear_model
from other_ends import FakeBoard, Printer, PtyPeer

from sparsegaze import device as device_module
from sparsegaze import store
from sparsegaze.model import DeviceModel
from sparsegaze.recording import Recording
from sparsegaze.wire import ffi, lib

HEADER = "t_us,s0,s1,s2,s3,s4,s5,target_az_deg,target_el_deg,valid"


@pytest.fixture
def refused(command_json):
    """refused(*command line): it must fail with 1, one line and a remedy. Returns (error, remedy)."""

    def run(*args):
        code, data, err = command_json(*args)
        assert code == 1 and set(data) == {"error", "remedy"} and data["error"] and data["remedy"]
        said = [line for line in err.splitlines() if line.startswith("sparsegaze: ")]
        assert said == [f"sparsegaze: {data['error']} — {data['remedy']}"]
        return data["error"], data["remedy"]

    return run


@pytest.fixture
def quick_fit(monkeypatch):
    """A tenth of the optimiser's steps: what a fit says, not how good it is."""
    for name, value in (("FIRST_STEPS", 60), ("LATER_STEPS", 10), ("POINTS", 1000)):
        monkeypatch.setattr(f"sparsegaze.distil.{name}", value)


@pytest.fixture
def impatient(monkeypatch):
    """Connections wait neither for a bootloader nor as long as usual for an answer."""
    monkeypatch.setattr(device_module, "BOOT_WAIT_S", 0.1)


def looked_at(side=5, frames=6, seed=0):
    """A Recording of side x side targets, bent linear optics."""
    rng = np.random.default_rng(seed)
    grid = np.linspace(-20, 20, side)
    target = np.repeat(np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2), frames, axis=0)
    signal = MIDDLE + target @ OPTICS.T + 0.1 * (target**2) @ OPTICS.T[::-1, :] / 20
    features = np.rint(signal + rng.normal(0, 8, signal.shape)).astype(np.uint16)
    t_us = np.arange(len(target)) * 3840 + np.repeat(np.arange(side * side), frames) * 500_000
    return Recording(t_us, features, target, np.ones(len(target), bool))


def rewrite(path, line, column, text):
    """Put `text` into one cell of a CSV file (line as an editor counts, column by name)."""
    rows = [row.split(",") for row in path.read_text().splitlines()]
    rows[line - 1][HEADER.split(",").index(column)] = text
    path.write_text("\n".join(map(",".join, rows)) + "\n")


# fit --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("column", ["s2", "target_az_deg", "t_us"])
def test_fit_of_nan_in_a_valid_row_names_line_and_column(refused, tmp_path, column):
    looked_at().write(tmp_path / "eye.csv")
    rewrite(tmp_path / "eye.csv", 7, column, "nan")
    error, remedy = refused("fit", tmp_path / "eye.csv")
    assert f"{tmp_path / 'eye.csv'}" in error and "line 7" in error and column in error
    assert "record again" in remedy and not (tmp_path / "eye.sgm").exists()


@pytest.mark.parametrize("column", ["t_us", "s3", "target_el_deg", "valid"])
def test_fit_of_a_recording_without_a_column_names_it(refused, tmp_path, column):
    looked_at().write(tmp_path / "eye.csv")
    at = HEADER.split(",").index(column)
    rows = [row.split(",") for row in (tmp_path / "eye.csv").read_text().splitlines()]
    (tmp_path / "eye.csv").write_text("\n".join(",".join(row[:at] + row[at + 1 :]) for row in rows) + "\n")
    error, remedy = refused("fit", tmp_path / "eye.csv")
    assert column in error and "eye.csv" in error and "t_us, s0.." in remedy


@pytest.mark.parametrize("targets", [0, 1, 8])
def test_fit_of_fewer_targets_than_needed_states_both_numbers(refused, tmp_path, targets):
    recording = looked_at()
    places = np.unique(recording.target_deg, axis=0)[:targets]
    recording.valid = (recording.target_deg[:, None] == places).all(-1).any(-1)
    recording.write(tmp_path / "eye.csv")
    error, remedy = refused("fit", tmp_path / "eye.csv")
    assert f"{targets} targets" in error and "at least 9" in remedy and not (tmp_path / "eye.sgm").exists()


def test_fit_of_a_program_instead_of_a_recording(refused, tmp_path, firmware_elf):
    error, remedy = refused("fit", firmware_elf, "-o", tmp_path / "eye.sgm")
    assert "not text" in error and "sparsegaze record" in remedy and not (tmp_path / "eye.sgm").exists()


def test_a_refused_fit_leaves_the_model_of_yesterday_alone(refused, tmp_path):
    linear_model().save(tmp_path / "eye.sgm")
    before = (tmp_path / "eye.sgm").read_bytes()
    (tmp_path / "eye.csv").write_text(HEADER + "\n1,2,3\n")
    refused("fit", tmp_path / "eye.csv")
    assert (tmp_path / "eye.sgm").read_bytes() == before


def test_fit_of_a_constant_channel_warns_and_fits_the_rest(command_json, tmp_path, quick_fit):
    recording = looked_at()
    recording.features[:, 4] = 777
    recording.write(tmp_path / "eye.csv")
    code, data, err = command_json("fit", tmp_path / "eye.csv", "--vectors", "8")
    assert code == 0 and data["report"]["dropped_channels"] == [4]
    assert len(data["warnings"]) == 1 and "s4" in data["warnings"][0]
    assert f"sparsegaze: warning: {data['warnings'][0]}" in err
    model = DeviceModel.load(tmp_path / "eye.sgm")
    assert model.channels == 6 and model.gain_q12[4] == 0     # the board's six: it can be uploaded


def test_fit_of_looks_that_have_nothing_to_do_with_the_targets_warns(command_json, tmp_path, quick_fit):
    recording = looked_at()
    places, label = np.unique(recording.target_deg, axis=0, return_inverse=True)
    recording.target_deg = np.random.default_rng(3).permutation(places)[label.reshape(-1)]
    recording.write(tmp_path / "eye.csv")
    code, data, err = command_json("fit", tmp_path / "eye.csv", "--vectors", "8")
    assert code == 0 and data["report"]["loo_rms_deg"] > 3.0
    assert any("says little about where the eye looked" in text for text in data["warnings"])
    assert "sparsegaze: warning: " in err and (tmp_path / "eye.sgm").exists()


def test_fit_of_a_good_recording_has_no_warnings(command_json, tmp_path, quick_fit):
    looked_at(side=7).write(tmp_path / "eye.csv")
    code, data, err = command_json("fit", tmp_path / "eye.csv", "--vectors", "8")
    assert code == 0 and data["warnings"] == [] and "warning" not in err
    assert data["report"]["loo_rms_deg"] < 1.0


# upload -----------------------------------------------------------------------------------------------------


def sealed(image, **fields):
    """A model image with header fields changed and the CRC that belongs to them."""
    data = bytearray(image)
    head = ffi.from_buffer("struct sg_model_head *", data)
    for name, value in fields.items():
        setattr(head, name, value)
    return store.stamp(data, head.generation)


SPOILED = {
    "truncated in its header": (lambda image: image[:100], "cut off", "copy the file again"),
    "truncated in its records": (lambda image: image[:-1], "cut off", "copy the file again"),
    "bit flipped in its records": (
        lambda image: image[:700] + bytes([image[700] ^ 1]) + image[701:],
        "checksum",
        "copy the file again",
    ),
    "bit flipped in its checksum": (
        lambda image: image[:4] + bytes([image[4] ^ 0x80]) + image[5:],
        "checksum",
        "copy the file again",
    ),
    "longer than it says": (lambda image: image + b"\0", "1 bytes too many", "copy the file again"),
    "another format version": (lambda image: sealed(image, version=9), "version 9", "this version"),
    "more channels than any board": (lambda image: sealed(image, channels=7), "7 channels", "this board"),
    "no channels": (lambda image: sealed(image, channels=0), "0 channels", "this board"),
    "empty": (lambda image: b"", "not a sparsegaze model", "sparsegaze fit"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_upload_of_a_spoiled_model_never_touches_the_board(refused, tmp_path, impatient, name):
    spoil, what, remedy = SPOILED[name]
    (tmp_path / "eye.sgm").write_bytes(spoil(linear_model().image))
    with FakeBoard() as board:
        error, todo = refused("upload", board.port, tmp_path / "eye.sgm")
        assert board.requests == [] and board.writes == []
    assert what in error and str(tmp_path / "eye.sgm") in error and remedy in todo


@pytest.mark.parametrize("board_channels, model_channels", [(6, 3), (6, 5), (4, 6)])
def test_upload_of_a_model_with_fewer_or_more_channels_than_the_board(
    refused, tmp_path, impatient, board_channels, model_channels
):
    zeros = np.zeros((8, model_channels), int)
    offset, gain = np.full(model_channels, 30000), np.full(model_channels, 2048)
    model = DeviceModel.from_parts(
        offset, gain, np.zeros(2, int), np.zeros((2, model_channels), int), zeros, zeros[:, :2], 8
    )
    model.save(tmp_path / "eye.sgm")
    with FakeBoard(hello={"channels": board_channels}) as board:
        error, remedy = refused("upload", board.port, tmp_path / "eye.sgm")
        assert board.writes == []
    assert f"takes {model_channels} channels, the device has {board_channels}" in error
    assert "recording of this device" in remedy


# flash ------------------------------------------------------------------------------------------------------


def too_large(path):
    """A hex file that reaches into the model slots."""
    from intelhex import IntelHex

    image = IntelHex()
    image.frombytes(bytes(0x6C01))
    image.write_hex_file(str(path))


def corrupt(path):
    """A hex file with one digit changed: a record's checksum no longer holds."""
    path.write_text(":0400000001020304F3\n:00000001FF\n")


HEX = {
    "corrupt": (corrupt, "line 1"),
    "too large": (too_large, "application area ends"),
    "empty": (lambda path: path.write_bytes(b""), "empty"),
    "binary": (lambda path: path.write_bytes(bytes(range(256)) * 8), "hex"),
}


@pytest.mark.parametrize("name", HEX)
def test_flash_of_a_bad_hex_never_touches_the_board(refused, tmp_path, name):
    make, what = HEX[name]
    make(tmp_path / "bad.hex")
    with FakeBoard() as board:
        error, _ = refused("flash", board.port, "--hex", tmp_path / "bad.hex")
        assert board.writes == [] and board.flash == b"\xff" * 0x8000
    assert "bad.hex" in error and what in error


def test_flash_of_a_port_with_nothing_behind_it_says_what_to_press(refused, monkeypatch):
    with PtyPeer() as peer:
        error, remedy = refused("flash", peer.port)
    assert "bootloader" in error and "reset" in remedy


# info -------------------------------------------------------------------------------------------------------


def test_info_of_a_port_with_nothing_behind_it(refused, impatient):
    with PtyPeer() as peer:
        error, remedy = refused("info", peer.port)
        assert error == f"nothing answers on {peer.port}" and f"sparsegaze flash {peer.port}" in remedy


def test_info_of_foreign_firmware_shows_what_it_says(refused, impatient):
    with Printer(b"Hello from a blink sketch\r\n") as peer:
        error, remedy = refused("info", peer.port)
        assert "not in sparsegaze's protocol" in error and "Hello" in error
        assert f"sparsegaze flash {peer.port}" in remedy


def test_info_of_an_older_protocol_names_both_versions(refused, impatient):
    with FakeBoard(hello={"wire_version": 0, "firmware": 0x000401}) as board:
        error, remedy = refused("info", board.port)
        assert f"protocol 0 (firmware 0.4.1), this SDK speaks {lib.SG_WIRE_VERSION}" in error
        assert f"sparsegaze flash {board.port}" in remedy


# virtual ----------------------------------------------------------------------------------------------------


def test_virtual_does_not_replace_a_file_by_its_link(refused, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    error, remedy = refused("virtual", "--link", tmp_path / "thesis.tex")
    assert "thesis.tex" in error and "not a symbolic link" in error and "another path" in remedy
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


# targets ----------------------------------------------------------------------------------------------------


def test_validate_of_a_device_without_a_model_says_to_calibrate(refused, fake):
    fake()
    error, remedy = refused("validate", "PORT")
    assert error == "the device has no model" and remedy == "run `sparsegaze calibrate PORT`"


def test_record_that_keeps_fewer_targets_than_a_fit_needs_says_so(command_json, fake, tmp_path):
    fake(blinks=[(begin, begin + 60_000) for begin in range(3_000_000, 8_000_000, 120_000)])
    code, data, err = command_json("record", "PORT", "-o", tmp_path / "eye.csv", "--targets", "9")
    assert code == 0 and data["used_targets"] < 9
    assert any("needs 9" in text and "--targets" in text for text in data["warnings"])
    assert "sparsegaze: warning: " in err and len(Recording.read(tmp_path / "eye.csv")) > 1000
