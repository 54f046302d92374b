# SPDX-License-Identifier: Apache-2.0
"""A byte stream to a board.

Real ports, ptys and pyserial URLs run in real time (SerialLink). A registered unpaced virtual Nano runs in
lockstep (LockstepLink): its time passes only inside read() and sleep(), so that a run depends on its seed and
on the calls made, never on how fast this computer is.
"""

import errno
import math
import os
import time

import serial

from . import registry
from .control import VirtualControl
from .errors import DisconnectedError, PortError

# What an operation on a port that went away raises: pyserial's SerialException is an OSError, its select() on
# a closed handle raises TypeError, and termios.error is neither.
try:
    from termios import error as _termios_error
    _GONE = (OSError, TypeError, _termios_error)
except ImportError:
    _GONE = (OSError, TypeError)

WRITE_TIMEOUT_S = 5.0
RESET_PULSE_S = 0.1             # DTR/RTS released: long enough to recharge the Nano's 100 nF
READ_SLICES_S = (0.2, 0.02, 0.002)
LOCKSTEP_SLICE_US = 1000        # while waiting for an answer
LOCKSTEP_LISTEN_US = 32000      # while only listening: 400 bytes of stream
LOCKSTEP_SLEEP_US = 20000       # 2000 bytes at 1 Mbaud: a pty holds 4095
LOCKSTEP_WRITE_BYTES = 1024
LOCKSTEP_PATIENCE_S = 10.0      # real seconds in which sent bytes must show up


def open_link(port, baud=1_000_000):
    """Open `port`: "/dev/ttyUSB0", "COM3", "/dev/cu.usbserial-1", "/dev/pts/5", "socket://host:1234".

    The port is opened exclusively. Returns a Link. Raises PortError with a remedy.
    """
    entry = registry.find(port)
    if entry is None:
        return SerialLink(port, baud)
    control = VirtualControl(entry.control)
    link_type = LockstepLink if entry.unpaced else SerialLink
    try:
        return link_type(port, baud, control, entry.auto_reset)
    except Exception:
        control.close()
        raise


class SerialLink:
    """Real time over pyserial. read() and write() raise DisconnectedError when the port goes away.

    port, baud   as given
    control      VirtualControl of a virtual Nano, or None
    reset_s      now() of the latest opening or reset: from then on the bootloader listens for a while
    """

    def __init__(self, port, baud=1_000_000, control=None, auto_reset=True):
        self.port = port
        self.baud = int(baud)
        self.control = control
        self.auto_reset = auto_reset
        self._serial = self._open()
        self.reset_s = time.monotonic()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    @property
    def lockstep(self):
        return False

    def read(self, n, timeout_s):
        """Up to `n` bytes as soon as there are any; b"" when none came within `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while True:
            data = self._read_slice(n, deadline - time.monotonic())
            if data or time.monotonic() >= deadline:
                return data

    def write(self, data):
        """Send all of `data`. Raises PortError when the other side takes nothing for 5 s."""
        try:
            self._port().write(data)
        except serial.SerialTimeoutException:
            raise PortError(f"{self.port} takes no data",
                            "is anything behind this port? `sparsegaze list`") from None
        except _GONE as error:
            raise self._gone(error) from None

    def set_baud(self, baud):
        """Change the speed. Waits until what was written is on the line."""
        try:
            if int(baud) != self.baud:
                self._port().flush()
                self._port().baudrate = int(baud)
        except (ValueError, *_GONE) as error:
            if isinstance(error, ValueError):
                raise PortError(f"{self.port} cannot do {baud} baud", "use another adapter") from None
            raise self._gone(error) from None
        self.baud = int(baud)

    def reset(self):
        """Reset the board into its bootloader. Returns False when it cannot be reset from here."""
        if not self.auto_reset:
            return False
        if self.control is not None:
            self.control.reset()
        else:
            self._pulse()
        self.flush_input()
        self.reset_s = self.now()
        return True

    def flush_input(self):
        """Forget what has arrived and not been read."""
        try:
            self._port().reset_input_buffer()
        except _GONE as error:
            if _number(error) == errno.ENOTTY:
                return
            raise self._gone(error) from None

    def now(self):
        """Seconds on the clock in which this link's timeouts run."""
        return time.monotonic()

    def sleep(self, seconds):
        time.sleep(seconds)

    def close(self):
        if self._serial is not None:
            try:
                self._serial.close()
            except OSError:
                pass
            self._serial = None
        if self.control is not None:
            self.control.close()

    def _open(self):
        try:
            handle = serial.serial_for_url(self.port, do_not_open=True)
            handle.baudrate = self.baud
            handle.timeout = READ_SLICES_S[0]
            handle.write_timeout = WRITE_TIMEOUT_S
            handle.exclusive = True
            handle.open()
            return handle
        except (ValueError, *_GONE) as error:
            raise _open_error(self.port, self.baud, error) from None

    def _pulse(self):
        try:
            self._port().dtr = False
            self._port().rts = False
            self.sleep(RESET_PULSE_S)
            self._port().dtr = True
            self._port().rts = True
        except _GONE as error:
            if _number(error) not in (errno.ENOTTY, errno.EINVAL):
                raise self._gone(error) from None
            # A pty has no modem lines; what listens behind one takes an opening for the reset.
            self._serial.close()
            self._serial = self._open()

    def _port(self):
        if self._serial is None:
            raise OSError(errno.EBADF, "port is closed")
        return self._serial

    def _read_slice(self, n, remaining_s):
        try:
            handle = self._port()
            # pyserial reconfigures the port on every change of timeout: a few fixed steps keep that rare.
            slice_s = next((s for s in READ_SLICES_S if s <= remaining_s),
                           0 if remaining_s <= 0 else READ_SLICES_S[-1])
            if handle.timeout != slice_s:
                handle.timeout = slice_s
            data = handle.read(1)
            if data and n > 1:
                waiting = min(handle.in_waiting, n - 1)
                if waiting:
                    data += handle.read(waiting)
            return data
        except _GONE as error:
            raise self._gone(error) from None

    def _gone(self, error):
        return DisconnectedError(f"{self.port} is gone ({_reason(error)})",
                                 "check the cable, then `sparsegaze list` shows the ports there are")


class LockstepLink(SerialLink):
    """A registered unpaced virtual Nano; now(), sleep() and timeouts are in its seconds since power-on."""

    def __init__(self, port, baud=1_000_000, control=None, auto_reset=True):
        # The clock must already stand when the opening resets the board: the start would depend on the host.
        control.lockstep(True)      # byte counts start here
        super().__init__(port, baud, control, auto_reset)
        self._sent = 0
        self._received = 0
        self._ready = bytearray()
        self._slice_us = LOCKSTEP_SLICE_US
        control.barrier()
        self._us = control.time().us
        self.reset_s = self.now()

    @property
    def lockstep(self):
        return True

    def read(self, n, timeout_s):
        deadline = self._us + _whole_us(timeout_s)
        while not self._ready and self._us < deadline:
            self._advance(min(self._us + self._slice_us, deadline))
            # Whoever only listens needs no quick answer: longer slices cost fewer round trips.
            self._slice_us = min(2 * self._slice_us, LOCKSTEP_LISTEN_US)
        data = bytes(self._ready[:n])
        del self._ready[:n]
        return data

    def write(self, data):
        for start in range(0, len(data), LOCKSTEP_WRITE_BYTES):
            part = data[start:start + LOCKSTEP_WRITE_BYTES]
            super().write(part)
            self._sent += len(part)
            self._slice_us = LOCKSTEP_SLICE_US
            self._advance(self._us)     # no time passes; empties the pty's buffer

    def set_baud(self, baud):
        if int(baud) != self.baud:
            self._advance(self._us)
            super().set_baud(baud)
            self.control.barrier()

    def flush_input(self):
        self._advance(self._us)
        self._ready.clear()

    def now(self):
        return self._us * 1e-6

    def sleep(self, seconds):
        end = self._us + _whole_us(seconds)
        while self._us < end:
            self._advance(min(self._us + LOCKSTEP_SLEEP_US, end))

    def _advance(self, us):
        self._us, device_bytes = self.control.advance(us, self._sent)
        patience = time.monotonic() + LOCKSTEP_PATIENCE_S
        while self._received < device_bytes:
            data = self._read_slice(device_bytes - self._received, READ_SLICES_S[0])
            self._received += len(data)
            self._ready += data
            if not data and time.monotonic() > patience:
                raise DisconnectedError(f"{self.port} holds back bytes that the virtual Nano has sent",
                                        "is another program reading from this port?")


def _whole_us(seconds):
    # Rounded up: whoever waits for what is left of an interval must see time pass, however little is left.
    return math.ceil(seconds * 1e6) if seconds > 0 else 0


def _number(error):
    number = getattr(error, "errno", None)
    if number is None and error.args and isinstance(error.args[0], int):
        number = error.args[0]      # termios.error
    return number


def _reason(error):
    # SerialException often carries its cause in its text only.
    number = _number(error)
    if number:
        return os.strerror(number)
    return str(error).split("(")[0].strip() or "port is closed"


def _open_error(port, baud, error):
    text = str(error)
    number = _number(error)
    exists = "://" in port or os.path.exists(port) or os.name == "nt"
    if number == errno.ENOENT or "FileNotFoundError" in text or not exists:
        return PortError(f"no such port: {port}", "`sparsegaze list` shows the ports there are")
    if "exclusively lock" in text or "PermissionError" in text or number == errno.EBUSY:
        return PortError(f"{port} is in use by another program", "close that program and try again")
    if number == errno.EACCES:
        return PortError(f"no permission to open {port}",
                         "join the port's group (`sudo usermod -a -G dialout $USER`) and log in again")
    if isinstance(error, ValueError):
        return PortError(f"{port} cannot be opened at {baud} baud ({text})", "check the port's name")
    not_serial = number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR) or "Could not configure" in text
    if not_serial or os.path.isfile(port):
        return PortError(f"{port} is not a serial port", "`sparsegaze list` shows the ports there are")
    return PortError(f"cannot open {port} ({_reason(error)})", "`sparsegaze list` shows the ports there are")
