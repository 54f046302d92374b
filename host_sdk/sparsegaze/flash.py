# SPDX-License-Identifier: Apache-2.0
"""Flashing the firmware through the stock bootloader, verified by reading back. Stored models survive it."""

import os
from pathlib import Path
from typing import NamedTuple

from .errors import DisconnectedError, FlashError
from .stk500 import BOOTLOADERS, PAGE_BYTES, Bootloader, verify_pages, write_pages
from .transport import open_link

APPLICATION_BYTES = 0x6C00      # above it: the two model slots, then the bootloaders
PARKED = b"\xff\xcf" * (PAGE_BYTES // 2)    # rjmp to itself, all over the first page
FIRMWARE_HEX = Path(__file__).parent / "data" / "firmware.hex"


class FlashReport(NamedTuple):
    bytes: int                  # of program, without padding to pages
    pages: int
    verified: bool              # always True: anything else raises
    seconds: float              # on the link's clock
    bootloader: str
    baud: int


def load_hex(path=None):
    """The pages of an Intel HEX file (default: the firmware that came with this package).

    Returns (pages, n_bytes): pages [(address, 128 bytes)] in order of address, padded with 0xFF.
    Raises FlashError when the file is missing, damaged, empty, or does not fit into the application area.
    """
    from intelhex import IntelHex, IntelHexError

    path = FIRMWARE_HEX if path is None else Path(path)
    try:
        text = path.read_text(encoding="ascii")
    except OSError as error:
        remedy = "build it with `make firmware`" if path == FIRMWARE_HEX else "check the file's name"
        raise FlashError(f"cannot read {path} ({error.strerror})", remedy) from None
    except UnicodeDecodeError:
        raise FlashError(f"{path} is not an Intel HEX file",
                         "give the .hex file, not the .elf or .bin") from None
    image = IntelHex()
    try:
        _check_lines(path, text)
        image.loadfile(os.fspath(path), format="hex")
    except IntelHexError as error:
        raise FlashError(f"{path} is corrupt ({error})", "build or download it again") from None
    if not image.addresses():
        raise FlashError(f"{path} holds no program", "build or download it again")
    if image.maxaddr() >= APPLICATION_BYTES:
        raise FlashError(f"{path} reaches to 0x{image.maxaddr():04X}, "
                         f"the application area ends at 0x{APPLICATION_BYTES - 1:04X}",
                         "this hex is too large or made for another chip")
    if image.minaddr() != 0:
        raise FlashError(f"{path} begins at 0x{image.minaddr():04X}, not at the reset vector",
                         "this hex is not an application (a bootloader?)")
    image.padding = 0xFF
    used = sorted({address - address % PAGE_BYTES for address in image.addresses()})
    pages = [(address, bytes(image.tobinarray(start=address, size=PAGE_BYTES))) for address in used]
    return pages, len(image.addresses())


def flash_hex(link, path=None, progress=None):
    """Flash an Intel HEX file (default: the firmware that came with this package) and start it.

    link      an open Link, or a port's name
    progress  called as progress(stage, done, total): "write" and "verify" in pages, "press reset" in seconds

    Returns a FlashReport. Raises FlashError, PortError, DisconnectedError. Only pages of the hex are written,
    so stored models and the EEPROM stay as they are.
    """
    pages, n_bytes = load_hex(path)     # before anything is touched
    if isinstance(link, (str, os.PathLike)):
        with open_link(os.fspath(link), BOOTLOADERS[0][0]) as opened:
            return _flash(opened, pages, n_bytes, progress)
    return _flash(link, pages, n_bytes, progress)


def _flash(link, pages, n_bytes, progress):
    start = link.now()
    bootloader = Bootloader(link)
    bootloader.enter(progress)
    count = _Count(progress)
    first, rest = pages[0], pages[1:]
    try:
        # Page 0 is parked first and written last: half a program never runs, and so never drives an LED.
        count.stage("write", len(pages))
        write_pages(bootloader, [(first[0], PARKED)] + rest, count.step)
        count.stage("verify", len(pages) + 1)
        verify_pages(bootloader, [(first[0], PARKED)] + rest, count.step)
        write_pages(bootloader, [first])
        verify_pages(bootloader, [first], count.step)
        bootloader.leave()
    except (DisconnectedError, FlashError) as error:
        raise type(error)(f"flashing was not finished: {error.message}",
                          f"{error.remedy}; stored models are untouched, "
                          f"and `sparsegaze flash {link.port}` starts afresh") from None
    return FlashReport(n_bytes, len(pages), True, link.now() - start, bootloader.name, bootloader.baud)


def _check_lines(path, text):
    # IntelHex takes a file that ends early for a shorter program.
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        raise FlashError(f"{path} is empty", "build or download it again")
    if lines[-1].upper() != ":00000001FF":
        raise FlashError(f"{path} is cut off: its end record is missing", "build or download it again")


class _Count:
    def __init__(self, progress):
        self._progress = progress

    def stage(self, name, total):
        self._name, self._done, self._total = name, 0, total

    def step(self):
        self._done += 1
        if self._progress is not None:
            self._progress(self._name, self._done, self._total)
