# SPDX-License-Identifier: Apache-2.0
"""STK500v1, as the stock Arduino bootloaders speak it (Optiboot 4.4 at 115200 baud, ATmegaBOOT at 57600)."""

from .errors import FlashError

BOOTLOADERS = ((115200, "Optiboot"), (57600, "ATmegaBOOT"))
SIGNATURE = b"\x1e\x95\x0f"     # ATmega328P
PAGE_BYTES = 128

RESET_SETTLE_S = 0.05           # until the bootloader's receiver is on: half a command would confuse it
SYNC_WAIT_S = 0.6               # Optiboot blinks for 0.4 s first; see Bootloader.sync
ANSWER_WAIT_S = 3.0             # a bootloader that is there answers at once; a busy computer may not
RESETS_PER_SPEED = 2
PRESS_WAIT_S = 10.0             # how long a board without auto-reset gets to have its button pressed

_OK, _INSYNC, _EOP = 0x10, 0x14, 0x20
_GET_SYNC, _ENTER, _LEAVE, _ADDRESS, _WRITE, _READ, _SIGNATURE = 0x30, 0x50, 0x51, 0x55, 0x64, 0x74, 0x75


class Bootloader:
    """A conversation with the bootloader behind `link`. enter() first, leave() last.

    name, baud   of the bootloader found
    """

    def __init__(self, link):
        self.link = link
        self.name = None
        self.baud = None

    def enter(self, progress=None):
        """Reset the board into its bootloader, find its speed, check the chip.

        progress   called as progress("press reset", done_s, total_s) while a board without auto-reset waits
                   for its button
        Raises FlashError when no bootloader answers or the chip is another one.
        """
        for _ in range(RESETS_PER_SPEED):
            for baud, name in BOOTLOADERS:
                # At the wrong speed a bootloader hears garbage and may start the application: reset per try.
                self.link.set_baud(baud)
                if not self.link.reset():
                    continue
                self.link.sleep(RESET_SETTLE_S)
                if self._sync(SYNC_WAIT_S, 2):
                    return self._found(baud, name)
        self._wait_for_button(progress)

    def read_page(self, address, n=PAGE_BYTES):
        """`n` (at most 128) flash bytes from `address`."""
        self._load_address(address)
        return self._command(bytes((_READ, n >> 8, n & 255, ord("F"))), n)

    def write_page(self, address, data):
        """Erase and program one page of 128 bytes at `address`, a multiple of 128."""
        if address % PAGE_BYTES or len(data) != PAGE_BYTES:
            raise ValueError("a flash write is one whole page")
        self._load_address(address)
        self._command(bytes((_WRITE, len(data) >> 8, len(data) & 255, ord("F"))) + bytes(data))

    def leave(self):
        """Start the application."""
        self._command(bytes((_LEAVE,)))

    def _wait_for_button(self, progress):
        # One speed for half of the time, then the other: garbage at the wrong one would end the other's wait.
        start = self.link.now()
        for half, (baud, name) in enumerate(BOOTLOADERS, 1):
            self.link.set_baud(baud)
            while self.link.now() - start < half * PRESS_WAIT_S / len(BOOTLOADERS):
                if progress is not None:
                    progress("press reset", self.link.now() - start, PRESS_WAIT_S)
                self.link.sleep(RESET_SETTLE_S)     # the button may have been pressed just now
                if self._sync(SYNC_WAIT_S, 1):
                    return self._found(baud, name)
        raise FlashError(f"no bootloader answers on {self.link.port} at 115200 or 57600 baud",
                         "press the board's reset button when asked to; a chip without the stock Arduino "
                         "bootloader needs an ISP programmer")

    def _sync(self, wait_s, tries):
        # One sync, then patience: the receiver holds two bytes while the bootloader blinks, and a third would
        # split a command in two.
        for _ in range(tries):
            self.link.flush_input()
            self.link.write(bytes((_GET_SYNC, _EOP)))
            heard = self._collect(2, wait_s)
            if heard[-2:] == bytes((_INSYNC, _OK)):
                self.link.sleep(0.02)
                self.link.flush_input()
                return True
        return False

    def _found(self, baud, name):
        self.baud, self.name = baud, name
        signature = self._command(bytes((_SIGNATURE,)), 3)
        if signature != SIGNATURE:
            raise FlashError(f"the chip on {self.link.port} has signature {signature.hex(' ')}, "
                             f"this firmware is for an ATmega328P ({SIGNATURE.hex(' ')})",
                             "connect an Arduino Nano with an ATmega328P")
        self._command(bytes((_ENTER,)))

    def _load_address(self, address):
        word = address >> 1
        self._command(bytes((_ADDRESS, word & 255, word >> 8)))

    def _command(self, message, n=0):
        self.link.write(message + bytes((_EOP,)))
        answer = self._collect(n + 2, ANSWER_WAIT_S)
        if len(answer) != n + 2 or answer[0] != _INSYNC or answer[-1] != _OK:
            heard = answer[:4].hex(" ") or "nothing"
            raise FlashError(f"the bootloader on {self.link.port} stopped answering (heard {heard})",
                             "check the cable and the supply, then flash again")
        return answer[1:-1]

    def _collect(self, n, wait_s):
        data = b""
        deadline = self.link.now() + wait_s
        while len(data) < n and self.link.now() < deadline:
            data += self.link.read(n - len(data), deadline - self.link.now())
        return data


def write_pages(bootloader, pages, step=None):
    """Write `pages`, [(address, 128 bytes)], in the order given. step: called after each page."""
    for address, data in pages:
        bootloader.write_page(address, data)
        if step is not None:
            step()


def verify_pages(bootloader, pages, step=None):
    """Read `pages` back. Raises FlashError naming the first difference."""
    for address, data in pages:
        found = bootloader.read_page(address)
        if found != data:
            at = next(i for i in range(PAGE_BYTES) if found[i] != data[i])
            raise FlashError(f"flash reads back 0x{found[at]:02X} instead of 0x{data[at]:02X} "
                             f"at 0x{address + at:04X}",
                             "try again; if it repeats, the chip's flash is worn out")
        if step is not None:
            step()
