# SPDX-License-Identifier: Apache-2.0
"""EEPROM and self-programming: times, protections, what a power cut leaves, memory images on disk."""

import struct

import pytest

from board import QUIET, Board, firmware

BOOT = 0x7800           # the bench program as a bootloader: there, SPM works


@pytest.fixture
def board():
    with Board(bootloader=firmware("memory", start=BOOT), start=BOOT, constants=QUIET) as running:
        running.run(1000)
        yield running


def do(board, command, *values, us=15000):
    board.send(command.encode() + b"".join(values))
    return board.run(us)


def word(value):
    return struct.pack("<H", value)


def byte(value):
    return bytes([value])


def test_byte_takes_3_4_ms_erase_or_write_alone_1_8(board):
    eighths, = struct.unpack("<H", do(board, "E", word(5), byte(0x3C), byte(0)))
    assert abs(eighths / 2 - 3400) < 4                                  # microseconds
    assert do(board, "R", word(5)) == byte(0x3C)
    eighths, = struct.unpack("<H", do(board, "E", word(5), byte(0xF0), byte(2)))      # write without erase
    assert abs(eighths / 2 - 1800) < 4
    assert do(board, "R", word(5)) == byte(0x30)
    do(board, "E", word(5), byte(0), byte(1))                           # erase only
    assert do(board, "R", word(5)) == byte(0xFF)
    assert board.counters()["eeprom_writes"] == 3


def test_write_without_master_enable_in_time_does_nothing(board):
    assert do(board, "M", word(9), byte(1)) == byte(0)
    assert do(board, "R", word(9)) == byte(0xFF)


def test_ready_interrupt_is_a_level_and_silent_while_busy():
    with Board(app=firmware("memory"), constants=QUIET) as board:
        board.run(1000)
        answer = do(board, "I", word(3), byte(1))
    assert struct.unpack("<HB", answer) == (0, 1)


def test_cut_in_the_middle_of_a_byte_corrupts_it_and_only_it(board):
    do(board, "E", word(6), byte(0x11), byte(0))
    do(board, "E", word(7), byte(0x00), byte(0))
    seen = set()
    for attempt in range(6):
        do(board, "E", word(7), byte(0x00), byte(0))
        board.send(b"B" + word(7) + byte(0x5A))
        board.run(60)                                                   # command received, write begun
        board.command(f"cut {board.cycle + 16 * (1000 + 7 * attempt)}")
        board.run(3000)
        assert board.command("time")[2] == "0"
        image = (board.state / "eeprom.bin").read_bytes()               # saved at the cut
        assert image[6] == 0x11 and image[8] == 0xFF
        seen.add(image[7])
        board.command("power on")
        board.run(1000)
    assert len(seen) > 2                                                # invented, but not always the same


def test_cut_after_the_byte_leaves_it_whole(board):
    board.send(b"B" + word(7) + byte(0x5A))
    board.run(60)
    board.command(f"cut {board.cycle + 16 * 3400}")
    board.run(5000)
    assert (board.state / "eeprom.bin").read_bytes()[7] == 0x5A


def test_page_write_only_clears_bits_and_leaves_unfilled_words(board):
    flags = do(board, "P", word(0x1002), word(0x0FF0))
    assert flags == bytes([0x41, 0x40, 0])          # busy and RWW busy; RWW busy; none after RWWSRE
    around = [do(board, "F", word(at))[0] for at in (0x1000, 0x1002, 0x1003, 0x1004)]
    assert around == [0xFF, 0xF0, 0x0F, 0xFF]
    do(board, "P", word(0x1002), word(0x33CC))      # without erasing
    assert [do(board, "F", word(at))[0] for at in (0x1002, 0x1003)] == [0xC0, 0x03]


def test_erase_takes_4_ms_and_empties_one_page(board):
    do(board, "P", word(0x2000), word(0))
    do(board, "P", word(0x2080), word(0))
    eighths, = struct.unpack("<H", do(board, "X", word(0x207E)))        # any address of the page
    assert abs(eighths / 2 - 4000) < 4
    assert do(board, "F", word(0x2000)) == b"\xff" and do(board, "F", word(0x2080)) == b"\0"


def test_rww_section_is_not_readable_until_enabled_again(board):
    do(board, "P", word(0x3000), word(0x1234))
    assert do(board, "G", word(0x3000)) == bytes([0xFF, 0xFF, 0x34])
    assert do(board, "G", word(BOOT + 2))[0] != 0xFF                    # the boot section always is


def test_boot_section_does_not_overwrite_itself(board):
    before = do(board, "F", word(BOOT))
    do(board, "X", word(BOOT))
    assert do(board, "F", word(BOOT)) == before and board.counters()["spm_denied"] == 1


def test_application_may_not_program():
    with Board(app=firmware("memory"), constants=QUIET) as board:
        board.run(1000)
        do(board, "P", word(0x1000), word(0))
        do(board, "X", word(0x1000))
        assert do(board, "F", word(0x1000)) == b"\xff"
        assert board.counters()["spm_denied"] == 5                      # fill, write, enable; erase, enable


def test_cut_in_the_middle_of_a_page_leaves_other_pages_whole(board):
    do(board, "P", word(0x1080), word(0xBEEF))
    do(board, "P", word(0x1000), word(0x0000))
    board.send(b"X" + word(0x1000))
    board.run(40)
    board.command(f"cut {board.cycle + 16 * 2000}")
    board.run(5000)
    image = (board.state / "flash.bin").read_bytes()
    assert image[0x1080:0x1082] == b"\xef\xbe"
    assert image[0x1000:0x1002] not in (b"\0\0", b"\xff\xff")           # neither old nor erased


def test_memories_survive_the_program(tmp_path):
    with Board(bootloader=firmware("memory", start=BOOT), start=BOOT, state=tmp_path) as board:
        board.run(1000)
        do(board, "P", word(0x1000), word(0x1234))
        do(board, "E", word(1), byte(77), byte(0))
    with Board(bootloader=firmware("memory", start=BOOT), start=BOOT, state=tmp_path) as board:
        board.run(1000)
        assert do(board, "F", word(0x1000)) == b"\x34"
        assert do(board, "R", word(1)) == byte(77)


def test_image_of_a_wrong_size_is_refused(tmp_path):
    (tmp_path / "flash.bin").write_bytes(b"short")
    with pytest.raises(RuntimeError, match="not an image of 32768 bytes"):
        with Board(app=firmware("memory"), state=tmp_path):
            pass
