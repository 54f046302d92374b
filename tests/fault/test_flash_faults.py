# SPDX-License-Identifier: Apache-2.0
"""Hex files not to be flashed, bootloaders that do not answer as hoped, cables pulled while flashing."""

import termios

import numpy as np
import pytest
from material import make_hex
from fake_board import FakeBoard, PtyPeer

from sparsegaze import stk500
from sparsegaze.errors import DisconnectedError, FlashError
from sparsegaze.flash import APPLICATION_BYTES, PARKED, flash_hex, load_hex


def refused(path):
    """The message of the refusal; no port is opened before the file is found good."""
    with pytest.raises(FlashError) as caught:
        flash_hex("/dev/does-not-exist", path)
    assert "\n" not in str(caught.value) and caught.value.remedy
    return caught.value.message


def test_missing_empty_and_binary_files_are_refused(tmp_path):
    assert "cannot read" in refused(tmp_path / "none.hex")
    empty, binary = tmp_path / "empty.hex", tmp_path / "firmware.elf"
    empty.write_text("\n\n")
    binary.write_bytes(b"\x7fELF\x01\x01\x01" + bytes(range(128, 256)))
    assert "is empty" in refused(empty)
    assert "not an Intel HEX file" in refused(binary)


def test_every_kind_of_damage_to_a_hex_line_is_found(program, tmp_path):
    lines = program[0].read_text().splitlines()
    rng = np.random.default_rng(3)
    path = tmp_path / "bad.hex"
    for _ in range(200):
        row, column = rng.integers(len(lines) - 1), rng.integers(1, 40)
        line = lines[row]
        column = min(column, len(line) - 1)
        other = rng.choice([c for c in "0123456789ABCDEF" if c != line[column]])
        changed = line[:column] + other + line[column + 1:]
        path.write_text("\n".join(lines[:row] + [changed] + lines[row + 1:]) + "\n")
        assert "is corrupt" in refused(path)


def test_a_hex_without_its_end_record_is_cut_off(program, tmp_path):
    path = tmp_path / "cut.hex"
    path.write_text("\n".join(program[0].read_text().splitlines()[:-1]) + "\n")
    assert "cut off" in refused(path)
    path.write_text(":00000001FF\n")
    assert "holds no program" in refused(path)


def test_the_last_byte_of_the_application_area_fits_and_the_next_does_not(tmp_path):
    data = bytes(APPLICATION_BYTES)
    pages, n = load_hex(make_hex(tmp_path / "full.hex", data))
    assert n == len(data) and len(pages) == APPLICATION_BYTES // 128
    message = refused(make_hex(tmp_path / "over.hex", data + b"\0"))
    assert "0x6C00" in message and "0x6BFF" in message


def test_a_bootloader_hex_is_not_an_application(tmp_path):
    assert "0x7E3F" in refused(make_hex(tmp_path / "boot.hex", bytes(64), 0x7E00))
    assert "not at the reset vector" in refused(make_hex(tmp_path / "late.hex", bytes(64), 0x100))


def test_pages_between_the_parts_of_a_program_are_left_alone(tmp_path):
    from intelhex import IntelHex

    image = IntelHex()
    image.puts(0, b"\x01" * 4)
    image.puts(0x400, b"\x02" * 130)
    image.write_hex_file(str(tmp_path / "gaps.hex"))
    pages, n = load_hex(tmp_path / "gaps.hex")
    assert n == 134 and [address for address, _ in pages] == [0, 0x400, 0x480]
    assert pages[0][1] == b"\x01" * 4 + b"\xff" * 124


@pytest.mark.parametrize("speed, name", [(termios.B115200, "Optiboot"), (termios.B57600, "ATmegaBOOT")])
def test_the_bootloader_speed_is_found_by_trying(program, speed, name):
    with FakeBoard(boot_speed=speed) as board:
        board.flash[0x6C00:0x7800] = marks = bytes(range(256)) * 12
        report = flash_hex(board.port, program[0])
        assert (report.bootloader, report.verified, report.bytes) == (name, True, 1000)
        assert board.flash[:1000] == program[1] and board.flash[1000:1024] == b"\xff" * 24
        assert board.flash[0x6C00:0x7800] == marks
        assert board.writes == [0, 128, 256, 384, 512, 640, 768, 896, 0]


def test_progress_counts_every_page_once_and_ends_full(program):
    seen = []
    with FakeBoard() as board:
        flash_hex(board.port, program[0], lambda *what: seen.append(what))
    assert [what for what in seen if what[0] == "write"] == [("write", i, 8) for i in range(1, 9)]
    assert [what for what in seen if what[0] == "verify"] == [("verify", i, 9) for i in range(1, 10)]


def test_another_chip_is_refused_before_anything_is_written(program):
    with FakeBoard(signature=b"\x1e\x94\x06") as board:
        with pytest.raises(FlashError, match="signature 1e 94 06.*ATmega328P"):
            flash_hex(board.port, program[0])
        assert board.writes == []


def test_flash_that_reads_back_wrong_is_reported_with_its_address(program):
    class Worn(FakeBoard):
        def _bootloader(self):
            more = super()._bootloader()
            self.flash[300] &= 0x0F
            return more

    with Worn() as board:
        with pytest.raises(FlashError, match=r"reads back 0x.. instead of 0x.. at 0x012C"):
            flash_hex(board.port, program[0])
        assert board.flash[:128] == PARKED


@pytest.mark.parametrize("after", range(0, 9, 2))
def test_cable_pulled_after_any_page_leaves_no_half_program_that_runs(program, after):
    board = FakeBoard(cut_after=after)
    with pytest.raises(DisconnectedError) as caught:
        flash_hex(board.port, program[0])
    assert "not finished" in caught.value.message and "stored models are untouched" in caught.value.remedy
    # Of page 0 there is a torn page or the parking loop, never an old start of a new program.
    assert board.flash[:128] in (b"\0" * 128, PARKED)
    assert set(board.flash[1024:]) == {255}


def test_a_bootloader_that_stops_answering_half_way_is_not_a_traceback(program):
    class Stops(FakeBoard):
        def _bootloader(self):
            if len(self.writes) >= 3:
                self._stk.clear()
                return False
            return super()._bootloader()

    with Stops() as board:
        with pytest.raises(FlashError) as caught:
            flash_hex(board.port, program[0])
        assert "stopped answering" in caught.value.message and "flash" in caught.value.remedy


def test_a_board_without_auto_reset_is_waited_for_and_the_button_asked_for(program, monkeypatch):
    monkeypatch.setattr(stk500, "SYNC_WAIT_S", 0.1)

    class Manual(FakeBoard):
        """Answers only once its button has been pressed."""
        pressed = False

        def heard(self, data, speed):
            if self.pressed:
                super().heard(data, speed)

    asked = []
    with Manual() as board:
        def progress(stage, done, total):
            asked.append(stage)
            board.pressed = True
        report = flash_hex(board.port, program[0], progress)
        assert asked[0] == "press reset" and report.verified


def test_silence_at_both_speeds_ends_with_the_button_in_the_remedy(program, monkeypatch):
    monkeypatch.setattr(stk500, "SYNC_WAIT_S", 0.05)
    monkeypatch.setattr(stk500, "PRESS_WAIT_S", 0.5)

    class Listener(PtyPeer):
        speeds = ()

        def heard(self, data, speed):
            self.speeds += (speed,)
            assert data == b"\x30\x20" * (len(data) // 2)

    with Listener() as peer:
        with pytest.raises(FlashError) as caught:
            flash_hex(peer.port, program[0])
        assert set(peer.speeds) == {termios.B115200, termios.B57600}
    assert "115200 or 57600" in caught.value.message and "reset button" in caught.value.remedy
