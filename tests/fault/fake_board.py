# SPDX-License-Identifier: Apache-2.0
"""Things to find behind a port: small stand-ins on a pty thread, for what the virtual Nano never does."""

import os
import select
import termios
import threading
import tty

from sparsegaze import wire
from sparsegaze.wire import ffi, lib

SLOTS, SLOT_BYTES = (0x6C00, 0x7200), 1536     # the Nano's model slots
SPEED_BOOTLOADER = {termios.B115200: 115200, termios.B57600: 57600}


class PtyPeer:
    """A pty with `self.heard(data, speed)` called on a thread for whatever the client writes.

    Opened at both ends by us, so that a client may come and go. close() is the pulled cable.
    """

    def __init__(self):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self._wake_r, self._wake_w = os.pipe()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    def heard(self, data, speed):
        """Override: react to `data` received at termios speed `speed`."""

    def idle(self):
        """Override: called every 10 ms."""

    def say(self, data):
        os.write(self.master, data)

    def close(self):
        if self.master is None:
            return
        os.write(self._wake_w, b"x")
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self):
        while True:
            ready, _, _ = select.select([self.master, self._wake_r], [], [], 0.01)
            if self._wake_r in ready:
                break
            try:
                if self.master in ready:
                    self.heard(os.read(self.master, 4096), termios.tcgetattr(self.master)[5])
                self.idle()
            except Unplugged:
                break
            except OSError:
                break
        os.close(self.slave)
        os.close(self.master)
        self.master = None


class Unplugged(Exception):
    """Raised by a peer's hook to pull its own cable."""


class Printer(PtyPeer):
    """Foreign firmware: prints a line over and over."""

    def __init__(self, text=b"Hello from a blink sketch\r\n"):
        self.text = text
        self.ticks = 0
        super().__init__()

    def idle(self):
        self.ticks += 1
        if self.ticks % 20 == 0:
            self.say(self.text)


class FakeBoard(PtyPeer):
    """A board whose bootloader answers at `boot_speed` and whose application answers at 1 Mbaud.

    hello     fields of sg_hello that differ from the nominal ones
    cut_after  number of STK500 page writes after which the cable is pulled (None: never)
    signature  of the chip
    """

    def __init__(self, boot_speed=termios.B115200, hello=None, cut_after=None, signature=b"\x1e\x95\x0f",
                 deaf_first=0,
                 disturb=None):
        self.flash = bytearray(b"\xff" * 0x8000)
        self.boot_speed = boot_speed
        self.signature = signature
        self.cut_after = cut_after
        self.deaf_first = deaf_first        # requests that get no answer
        self.disturb = disturb              # disturb(answer bytes, number of the answer) -> bytes really sent
        self.writes = []
        self.requests = []
        self.answers = 0
        self.hello = dict(firmware=0x000100, slot_bytes=SLOT_BYTES, slot_base=list(SLOTS),
                          cpu_hz=16000000,
                          wire_version=lib.SG_WIRE_VERSION, model_version=lib.SG_MODEL_VERSION,
                          frame_period_us=999,
                          exposure_min_us=4, exposure_max_us=330, page_bytes=128, trial_bytes=0,
                          board=lib.SG_BOARD_NANO328P, channels=6)
        self.hello.update(hello or {})
        self._decoder = wire.Decoder()
        self._stk = bytearray()
        self._address = 0
        super().__init__()

    def heard(self, data, speed):
        if speed == self.boot_speed:
            self._stk += data
            while self._stk and self._bootloader():
                pass
        elif speed == termios.B1000000:
            for packet in self._decoder.feed(data):
                self._application(packet)

    # bootloader ---------------------------------------------------------------------------------------------

    def _bootloader(self):
        command = self._stk[0]
        lengths = {0x55: 4, 0x74: 5}
        n = lengths.get(command, 2)
        if command == 0x64:
            n = 5 + (self._stk[1] << 8 | self._stk[2]) if len(self._stk) > 2 else 1 << 30
        if len(self._stk) < n:
            return False
        message, self._stk = bytes(self._stk[:n]), self._stk[n:]
        body = b""
        if command == 0x55:
            self._address = 2 * (message[1] | message[2] << 8)
        elif command == 0x64:
            page = message[4:-1]
            if self.cut_after is not None and len(self.writes) >= self.cut_after:
                self.flash[self._address:self._address + len(page)] = b"\x00" * len(page)
                raise Unplugged
            self.flash[self._address:self._address + len(page)] = page
            self.writes.append(self._address)
        elif command == 0x74:
            body = bytes(self.flash[self._address:self._address + (message[1] << 8 | message[2])])
        elif command == 0x75:
            body = self.signature
        self.say(b"\x14" + body + b"\x10")
        return True

    # application --------------------------------------------------------------------------------------------

    def _application(self, packet):
        self.requests.append(packet)
        if len(self.requests) <= self.deaf_first:
            return
        if packet.type == lib.SG_MSG_HELLO:
            self._answer(packet, wire.body("struct sg_hello", **self.hello))
        elif packet.type == lib.SG_MSG_MODEL_INFO:
            self._answer(packet, self._model_info())
        elif packet.type == lib.SG_MSG_PING:
            self._answer(packet, packet.body + b"\0" * 8)
        elif packet.type == lib.SG_MSG_MODE:
            self._answer(packet, packet.body[:1])
        else:
            self.say(wire.encode(lib.SG_MSG_ERROR, packet.seq,
                                 wire.body("struct sg_error", error=lib.SG_E_UNKNOWN, type=packet.type)))

    def _answer(self, packet, body):
        data = wire.encode(packet.type | lib.SG_REPLY, packet.seq, body)
        self.answers += 1
        self.say(self.disturb(data, self.answers) if self.disturb else data)

    def _model_info(self):
        info = {"crc": [0] * 3, "generation": [0] * 3, "vectors": [0] * 3, "channels": [0] * 3,
                "verdict": [lib.SG_E_MAGIC] * 3, "active": lib.SG_SLOT_NONE}
        for slot, base in enumerate(self.hello["slot_base"]):
            image = bytes(self.flash[base:base + SLOT_BYTES])
            head = ffi.from_buffer("struct sg_model_head *", image)
            info["verdict"][slot] = lib.sg_model_open(ffi.new("struct sg_model_view *"),
                                                      ffi.from_buffer(image), len(image), 0)
            if info["verdict"][slot] == lib.SG_OK:
                info["crc"][slot], info["generation"][slot] = head.crc, head.generation
                info["vectors"][slot], info["channels"][slot] = head.vectors, head.channels
                if info["active"] == lib.SG_SLOT_NONE or head.generation > info["generation"][info["active"]]:
                    info["active"] = slot
        return wire.body("struct sg_model_info", **info)
