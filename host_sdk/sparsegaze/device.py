# SPDX-License-Identifier: Apache-2.0
"""A board running the sparsegaze firmware: requests, the gaze stream, the clock.

    with Device(port) as device:
        device.set_stream(raw=True, gaze=True)
        for frame in device.frames():
            ...
"""

from typing import NamedTuple, Optional

import numpy as np

from . import wire
from .clock import Clock
from .errors import DeviceError, NoDeviceError, ProtocolError, one_of
from .exchange import Exchange, refusal
from .sensing import Sensing
from .stream import Assembler
from .transport import open_link
from .wire import Counts, Gaze, Hello, Mode, ModelInfo, Pong, Raw, Recentre, Status, Verdict, lib

SLOTS = (lib.SG_SLOT_A, lib.SG_SLOT_B, lib.SG_SLOT_RAM)
SPEEDS = (1_000_000, 500_000)
BOOT_WAIT_S = 1.7               # the bootloader listens this long; what we said to it would only confuse it
HELLO_EVERY_S = 0.25
CONNECT_S = 6.0
PING_EVERY_S = 1.0
QUEUE_FRAMES = 16384            # finished frames kept when nobody takes them: 16 s at 1 kHz


class Frame(NamedTuple):
    """What the device sent of one sensing frame."""

    seq: int                    # unwrapped
    t_us: int                   # device time, unwrapped
    host_time: float            # link.now() when its last part had arrived, s
    raw: Optional[Raw]
    gaze: Optional[Gaze]
    counts: Optional[Counts]


class Inference(NamedTuple):
    """Gazes computed by the device from given features."""

    azimuth_deg: np.ndarray     # [n] float64, exact multiples of 1/128
    elevation_deg: np.ndarray
    flags: np.ndarray           # [n] uint8, bits of enum sg_flag
    sigma_deg: np.ndarray       # [n] float64, standard deviation by the model's own account, NaN: unknown


class Device(Sensing):
    """Connects on construction; a context manager that turns the stream off on leaving.

    port     port name, or an open Link (then not closed by this object)
    timeout_s  how long to wait for the firmware, s of the link's clock
    Raises PortError, NoDeviceError (nothing or something foreign answers), ProtocolError (other version).
    """

    def __init__(self, port, timeout_s=CONNECT_S):
        self._owned = isinstance(port, str)
        self.link = open_link(port, SPEEDS[0]) if self._owned else port
        self.port = self.link.port
        self.clock = Clock()
        self.hello = None
        self._stream_bits = 0
        self._token = 0
        self._exchange = Exchange(self.link)
        self._assembler = Assembler(Frame, QUEUE_FRAMES, self.clock.unwrap)
        try:
            self.connect(timeout_s)
        except BaseException:
            if self._owned:
                self.link.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    def close(self):
        """Turn the stream off (if the device still listens) and close the port."""
        if self.link is None:
            return
        try:
            if self._stream_bits and self.hello is not None:
                self._exchange.send(lib.SG_MSG_MODE, wire.body("struct sg_mode", mode=0))
                self.link.sleep(0.002)
        except Exception:           # the device is gone: there is nothing left to turn off
            pass
        finally:
            if self._owned:
                self.link.close()
            self.link = None

    def connect(self, timeout_s=CONNECT_S, boot_wait_s=None):
        """Wait for the firmware to start and say HELLO. Called by the constructor; again after a reset.

        boot_wait_s  silence before the first request (default: until the bootloader has given up waiting)
        """
        link, start = self.link, self.link.now()
        if boot_wait_s is None:
            boot_wait_s = max(0.0, link.reset_s + BOOT_WAIT_S - start)
        self.hello = None
        self._stream_bits = 0
        self._exchange.restart()
        decoder = self._exchange.decoder
        self._assembler.clear()
        self.clock.reset()
        link.set_baud(SPEEDS[0])
        # A board that was not reset by the opening and streams already needs no waiting.
        while link.now() - start < boot_wait_s and not decoder.good:
            decoder.feed(link.read(4096, boot_wait_s - (link.now() - start)))
        while link.now() - start < max(timeout_s, boot_wait_s + 2 * HELLO_EVERY_S):
            # Only a board that was not reset can be at the slower speed: it gets the last third of the time.
            speed = SPEEDS[link.now() - start > boot_wait_s + (timeout_s - boot_wait_s) * 0.66]
            if speed != link.baud:
                link.set_baud(speed)
                decoder.clear()
            self._exchange.send(lib.SG_MSG_HELLO)
            end = link.now() + HELLO_EVERY_S
            while link.now() < end:
                for packet in decoder.feed(link.read(4096, end - link.now())):
                    if packet.type == lib.SG_MSG_HELLO | lib.SG_REPLY:
                        return self._greet(packet)
        raise self._nobody(decoder)

    # requests -----------------------------------------------------------------------------------------------

    def status(self):
        """Status: device time, counters, exposures, reset cause."""
        return self._exchange.request(lib.SG_MSG_STATUS, answer=Status)

    def ping(self):
        """One round trip, taken into `clock`. Returns its Pong."""
        self._token = token = (self._token + 1) & 0xFFFFFFFF
        sent = []
        pong = self._exchange.request(lib.SG_MSG_PING, wire.body("struct sg_ping", token=token), Pong, sent)
        heard = self.link.now()
        if pong.token != token:
            raise ProtocolError("the device answered another ping than the one sent", "connect again")
        if len(sent) == 1:          # after a retry it is unknown which sending was answered
            self.clock.add(sent[0], heard, pong.rx_us, pong.tx_us)
        return pong

    def sync_clock(self, n=8):
        """Ping n times; returns `clock`."""
        for _ in range(n):
            self.ping()
        return self.clock

    def set_stream(self, raw=False, gaze=False, counts=False):
        """Choose what the device streams; all False turns the stream off."""
        bits = (lib.SG_STREAM_RAW * bool(raw) | lib.SG_STREAM_GAZE * bool(gaze)
                | lib.SG_STREAM_COUNTS * bool(counts))
        was, self._stream_bits = self._stream_bits, bits
        if not was:
            self._exchange.forget_stream(until=lib.SG_MSG_MODE | lib.SG_REPLY)
        self._exchange.request(lib.SG_MSG_MODE, wire.body("struct sg_mode", mode=bits), Mode)
        if not was:
            self._assembler.clear()
        self._assembler.expect(bits)

    def infer(self, features):
        """Inference that the device makes of `features`, [n, 6] or [6], unsigned 16 bit."""
        rows = np.atleast_2d(np.asarray(features))
        if rows.shape[1:] != (lib.SG_WIRE_CHANNELS,):
            raise ValueError(f"features are [n, {lib.SG_WIRE_CHANNELS}], not {rows.shape}")
        if rows.size and (rows.min() < 0 or rows.max() > 65535):
            raise ValueError("features are unsigned 16-bit integers")
        result = np.zeros((len(rows), 3))
        flags = np.zeros(len(rows), np.uint8)

        def take(i, answer):
            gaze = wire.parse(Gaze, answer)
            result[i] = gaze.azimuth_deg, gaze.elevation_deg, gaze.sigma_deg
            flags[i] = gaze.flags

        bodies = [wire.body("struct sg_infer", feature=row) for row in rows.tolist()]
        self._exchange.request_many(lib.SG_MSG_INFER, bodies, take)
        return Inference(result[:, 0], result[:, 1], flags, result[:, 2])

    def model_info(self):
        """ModelInfo of both slots and the RAM trial."""
        return self._exchange.request(lib.SG_MSG_MODEL_INFO, answer=ModelInfo)

    def read_model(self, slot=None):
        """The image bytes stored in `slot` (0 A, 1 B, 2 RAM trial; None: the active one).

        Raises DeviceError(SG_E_MAGIC) when there is no valid model in it.
        """
        info = self.model_info()
        slot = info.active if slot is None else one_of(SLOTS, slot, "a slot")
        if slot > lib.SG_SLOT_RAM or info.verdict[slot] != lib.SG_OK:
            raise refusal(lib.SG_E_MAGIC, lib.SG_MSG_MODEL_READ)
        head = self.read_slot(slot, lib.SG_MODEL_PAGE)
        length = wire.ffi.from_buffer("struct sg_model_head *", head).length
        if not len(head) < length <= self.hello.slot_bytes:
            raise ProtocolError(f"the device calls a model of {length} bytes valid", "try again")
        return head + self.read_slot(slot, length - len(head), len(head))

    def read_slot(self, slot, size, start=0):
        """`size` bytes from `start` on as they stand in `slot`, model or not."""
        image = bytearray()
        one_of(SLOTS, slot, "a slot")
        while len(image) < size:
            step = min(lib.SG_WIRE_DATA_MAX, size - len(image))
            body = wire.body("struct sg_model_at", offset=start + len(image), slot=slot, length=step)
            _, offset, data = wire.parse_data(self._exchange.request(lib.SG_MSG_MODEL_READ, body))
            if offset != start + len(image) or len(data) != step:
                raise ProtocolError("the device answered with another part of the model than asked for",
                                    "try again")
            image += data
        return bytes(image)

    def verify(self, slot):
        """Verdict on `slot` with the CRC-32 computed afresh by the device."""
        body = wire.body("struct sg_model_at", slot=one_of(SLOTS, slot, "a slot"))
        return self._exchange.request(lib.SG_MSG_MODEL_VERIFY, body, Verdict)

    def trial(self, image):
        """Use a model from RAM until the next reset; None goes back to the stored one.

        image   bytes or DeviceModel, at most hello.trial_bytes
        Returns the Verdict. Raises DeviceError when the model does not fit or is not valid.
        """
        if image is None:
            return self._exchange.request(lib.SG_MSG_TRIAL_USE, wire.body("struct sg_mode", mode=0), Verdict)
        data = bytes(getattr(image, "image", image))
        if not self.hello.trial_bytes:
            raise DeviceError(lib.SG_E_BOUNDS, "this board has no room for a trial model", "upload it")
        if len(data) > self.hello.trial_bytes:
            raise DeviceError(lib.SG_E_BOUNDS,
                              f"a trial model of {len(data)} bytes does not fit into the device's "
                              f"{self.hello.trial_bytes}",
                              "use fewer calibration vectors, or upload it")
        for offset in range(0, len(data), lib.SG_WIRE_DATA_MAX):
            part = data[offset:offset + lib.SG_WIRE_DATA_MAX]
            self._exchange.request(lib.SG_MSG_TRIAL_WRITE, wire.data_body(lib.SG_SLOT_RAM, offset, part))
        verdict = self._exchange.request(lib.SG_MSG_TRIAL_USE, wire.body("struct sg_mode", mode=1), Verdict)
        if verdict.verdict != lib.SG_OK:
            raise refusal(verdict.verdict, lib.SG_MSG_TRIAL_USE)
        return verdict

    def recentre(self, offset_deg=None, gain=None, clear=False):
        """Recentre: the correction in force, gaze = g + offset + G g of the model's output g.

        offset_deg   (azimuth, elevation) from now on, rounded to 1/128 deg
        gain         G from now on, 2 x 2 degrees per degree, rounded to 1/512; None with an offset: zero
        clear        True: no correction
        Raises ValueError when a number does not fit.
        """
        fields = {"op": lib.SG_RECENTRE_CLEAR if clear else lib.SG_RECENTRE_GET}
        if offset_deg is not None:
            fields = {"op": lib.SG_RECENTRE_SET, "affine": wire.affine(offset_deg, gain)._asdict()}
        elif gain is not None:
            raise ValueError("a recentre gain goes with an offset")
        return self._exchange.request(lib.SG_MSG_RECENTRE, wire.body("struct sg_recentre", **fields),
                                      Recentre)

    def reboot(self):
        """Restart the firmware by its watchdog and connect again."""
        self._exchange.request(lib.SG_MSG_REBOOT, wire.body("struct sg_mode", mode=0xA5), Mode)
        # The watchdog start skips Optiboot's waiting, and nothing of the old run may pass for the new one.
        self.link.sleep(0.2)
        self.link.flush_input()
        self.connect(boot_wait_s=0.1)

    def set_baud(self, baud):
        """Change the speed of the line until the next reset: 1000000 or 500000."""
        if baud not in SPEEDS:
            raise ValueError(f"the firmware speaks {SPEEDS[0]} or {SPEEDS[1]} baud, not {baud}")
        if baud == self.link.baud:
            return
        try:
            self._exchange.request(lib.SG_MSG_BAUD, wire.body("struct sg_mode", mode=SPEEDS.index(baud)),
                                   Mode)
        except NoDeviceError:       # if only the answer was lost, the device is at the new speed by now
            pass
        self.link.sleep(0.005)
        self.link.set_baud(baud)
        self._exchange.decoder.clear()
        self._exchange.request(lib.SG_MSG_HELLO, answer=Hello)

    # the stream ---------------------------------------------------------------------------------------------

    def frames(self, timeout_s=2.0):
        """Iterator over Frames as they arrive, for ever. Pings about once a second to keep `clock` fitted.

        Raises NoDeviceError when none arrives for `timeout_s`, DisconnectedError when the port goes away.
        """
        link, frames = self.link, self._assembler
        heard = link.now()
        pinged, sent = heard, {}
        while True:
            for packet, host_time in self._exchange.stream():
                frames.take(packet, host_time)
            for frame in frames.drain():
                yield frame
                heard = link.now()      # the time that the caller took is not the device's silence
            now = link.now()
            if now - heard > timeout_s:
                raise NoDeviceError(f"no frame has arrived from {self.port} for {timeout_s:g} s",
                                    "the device may have restarted: connect again")
            if now - pinged >= PING_EVERY_S:
                seq = self._exchange.send(lib.SG_MSG_PING, wire.body("struct sg_ping", token=0))
                pinged, sent = now, {seq: now}
            for packet in self._exchange.receive(now + min(0.1, timeout_s)):
                if packet.type == lib.SG_MSG_PING | lib.SG_REPLY and packet.seq in sent:
                    pong = wire.parse(Pong, packet.body)
                    self.clock.add(sent.pop(packet.seq), link.now(), pong.rx_us, pong.tx_us)
                else:
                    self._exchange.stale += 1

    @property
    def lost(self):
        """Frames missing between the received ones, by their numbers; also those nobody took in time."""
        return self._assembler.lost

    @property
    def incomplete(self):
        """Frames received without one of the streamed parts."""
        return self._assembler.incomplete

    @property
    def restarts(self):
        """Times the device's clock went back during the stream."""
        return self._assembler.restarts

    @property
    def bad(self):
        """Received frames dropped for their coding, length or CRC."""
        return self._exchange.decoder.bad

    @property
    def stale(self):
        """Answers received that nothing waited for any more."""
        return self._exchange.stale

    # --------------------------------------------------------------------------------------------------------

    def _greet(self, packet):
        theirs = wire.parse_hello_prefix(packet.body)
        if theirs.wire_version != lib.SG_WIRE_VERSION:
            remedy = f"run `sparsegaze flash {self.port}`"
            if theirs.wire_version > lib.SG_WIRE_VERSION:
                remedy = f"update this SDK, or {remedy} to put its own firmware on the device"
            raise ProtocolError(f"device speaks protocol {theirs.wire_version} (firmware "
                                f"{theirs.firmware_text}), this SDK speaks {lib.SG_WIRE_VERSION}", remedy)
        self.hello = wire.parse(Hello, packet.body)
        self.link.flush_input()
        self._exchange.decoder.clear()

    def _nobody(self, decoder):
        if decoder.good:
            return NoDeviceError(f"frames arrive from {self.port}, but it answers no request",
                                 "check the wire from the host's transmitter to the board's receiver (D0)")
        flash = f"`sparsegaze flash {self.port}`"
        if decoder.heard:
            return NoDeviceError(f"{self.port} sends something, but not in sparsegaze's protocol "
                                 f"(first bytes: {decoder.heard[:16]!r})",
                                 f"this is another device or firmware; if it is your board, run {flash}")
        return NoDeviceError(f"nothing answers on {self.port}",
                             f"check the cable and `sparsegaze list`; a new board needs {flash} first")
