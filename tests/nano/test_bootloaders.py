# SPDX-License-Identifier: Apache-2.0
"""Stock bootloaders and stock avrdude: written, verified, read back, started."""

import shutil
import subprocess

import pytest
import serial

from board import ATMEGABOOT, BOOTLOADERS, OPTIBOOT, Board, firmware


def avrdude(port, baud, *memory):
    program = shutil.which("avrdude")
    assert program, "avrdude is missing: run make setup"
    words = [word for item in memory for word in ("-U", item)]
    return subprocess.run([program, "-q", "-p", "atmega328p", "-c", "arduino", "-P", port, "-b", str(baud),
                           "-D", *words], capture_output=True, text=True, timeout=120)


def image_of(path):
    """Bytes of an application ELF as it lies in flash."""
    out = path.with_suffix(".bin")
    subprocess.run(["avr-objcopy" if shutil.which("avr-objcopy") else objcopy(), "-O", "binary", path, out],
                   check=True)
    return out.read_bytes()


def objcopy():
    from board import avr_gcc

    return avr_gcc().replace("avr-gcc", "avr-objcopy")


@pytest.mark.parametrize("bootloader,start,baud", [(OPTIBOOT, 0x7E00, 115200), (ATMEGABOOT, 0x7800, 57600)])
def test_stock_avrdude_flashes_verifies_and_reads_back(bootloader, start, baud, tmp_path):
    app = firmware("stream")
    image = image_of(app)
    back = tmp_path / "back.bin"
    with Board(bootloader=bootloader, start=start, auto_reset=1, unpaced=0) as board:
        done = avrdude(board.ready["port"], baud, f"flash:w:{app.with_suffix('.bin')}:r")
        assert done.returncode == 0, done.stderr
        assert "bytes of flash verified" in done.stderr
        done = avrdude(board.ready["port"], baud, f"flash:r:{back}:r")
        assert done.returncode == 0, done.stderr
        assert back.read_bytes()[:len(image)] == image
        with serial.Serial(board.ready["port"], 1000000, timeout=10) as port:
            assert len(port.read(200)) == 200           # it runs: after the bootloader has waited in vain
        counters = board.counters()
        assert counters["page_writes"] >= len(image) // 128 and counters["crashes"] == 0


def test_bootloader_at_the_wrong_speed_is_not_understood():
    with Board(app=firmware("echo"), bootloader=OPTIBOOT, start=0x7E00, auto_reset=1, baud=57600) as board:
        board.run(400000)
        for _ in range(5):
            board.send(b"0 ")
            assert b"\x14\x10" not in board.run(20000)
        assert board.counters()["rx_garbage"] == 10     # the bootloader gives up, the program hears the rest
        board.port.baudrate = 115200
        board.port.close()
        board.open(115200)                              # resets: out of whatever garbage made of it
        board.run(400000)
        board.send(b"0 ")
        assert board.run(20000) == b"\x14\x10"


def test_blank_chip_stays_in_reach_of_the_bootloader():
    with Board(bootloader=OPTIBOOT, start=0x7E00, auto_reset=1, baud=115200) as board:
        board.run(5000000)              # no program: it wanders through the empty flash, again and again
        board.port.close()
        board.open()
        board.run(400000)
        board.send(b"0 ")
        assert board.run(20000) == b"\x14\x10"


def test_debian_build_of_optiboot_leaves_the_watchdog_running():
    """Its last 20 bytes lie behind the flash's end: so tools/vheadset/Makefile builds its source anew."""
    starts = {}
    for path in (OPTIBOOT, BOOTLOADERS / "optiboot" / "optiboot_atmega328.hex"):
        with Board(app=firmware("echo"), bootloader=path, start=0x7E00, auto_reset=1, baud=115200) as board:
            board.run(400000)
            board.send(b"Q ")                           # leave programming mode
            board.run(10000)
            board.port.baudrate = 1000000
            starts[path] = board.run(1000000).count(b"R")
    ours, debian = starts.values()
    assert ours == 1 and debian > 30
