# SPDX-License-Identifier: Apache-2.0
"""The firmware on a Cortex-M4 in QEMU (machine mps2-an386): started, talked to, counted, ended.

    with QemuBoard(model.image) as board, Device(board) as device:
        ...
        board.sections()

QEMU counts instructions and knows nothing of cycles: what is reported here are instructions.
"""

import os
import select
import shutil
import subprocess
import tempfile
import time
import weakref
from pathlib import Path

import numpy as np

from .errors import DisconnectedError, ProtocolError, VirtualError

SOURCE_TREE = Path(__file__).resolve().parent.parent.parent
IMAGE = SOURCE_TREE / "build" / "firmware" / "cortex-m4.elf"
PROGRAM = "qemu-system-arm"
WRITE_TIMEOUT_S = 5.0
STOP_TIMEOUT_S = 5.0
# What the port (firmware/ports/mps2an386/port.h) and this file agree upon.
SLOT_A = 0x00300000
ICOUNT_SHIFT = 10               # 2^10 ns of QEMU's clock pass with every instruction
TICK_NS = 40
SCOPE = np.dtype([("mark", "u1"), ("section", "u1"), ("number", "<u2"), ("ticks", "<u4")])
SCOPE_MARK = 0xA5
SECTION_EMPTY = 15


class QemuBoard:
    """A running board and, in one, the open link to it (as transport.SerialLink, in real time).

    image     bytes of the model that lies in slot A when it starts; None: no model
    program   path of the firmware's ELF
    The program cannot reach this computer but through its two serial lines: it has no semihosting and no
    network. It ends by itself when nobody has talked to it for two minutes.
    Raises VirtualError when QEMU or the ELF is missing or QEMU does not start.
    """

    port = "the Cortex-M4 in QEMU"
    baud = 1_000_000
    lockstep = False

    def __init__(self, image=None, program=IMAGE):
        qemu = shutil.which(PROGRAM)
        if qemu is None:
            raise VirtualError(f"{PROGRAM} is not installed",
                               "apt-get install qemu-system-arm; make firmware")
        if not os.path.isfile(program):
            raise VirtualError(f"the Cortex-M4 firmware is not built: {program}",
                               "apt-get install gcc-arm-none-eabi; make firmware")
        folder = Path(tempfile.mkdtemp(prefix="sgq-"))
        self._finalizer = weakref.finalize(self, shutil.rmtree, folder, True)
        self._scope, self._errors = folder / "scope", folder / "errors"
        # A copy: QEMU reads commas and other characters of a path in its own way.
        shutil.copyfile(program, folder / "elf")
        command = machine(qemu, "elf") + ["-chardev", "stdio,id=line,signal=off", "-serial", "chardev:line",
                                          "-serial", "file:scope"]
        if image is not None:
            (folder / "model").write_bytes(image)
            command += ["-device", f"loader,file=model,addr={SLOT_A},force-raw=on"]
        with open(self._errors, "wb") as errors:
            try:
                self._process = subprocess.Popen(
                    command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
                    bufsize=0, start_new_session=True)
            except OSError as error:
                raise VirtualError(f"cannot start {qemu} ({error.strerror})",
                                   "apt-get install --reinstall qemu-system-arm") from None
        self._finalizer.detach()
        self._finalizer = weakref.finalize(self, _end, self._process, folder)
        self.pid = self._process.pid
        self.reset_s = -1e9             # no bootloader that one would have to wait for

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    def close(self):
        """End it and remove what it left."""
        self._finalizer()

    def sections(self):
        """section_counts() of all that was marked so far."""
        return section_counts(self._scope.read_bytes())

    # the link -----------------------------------------------------------------------------------------------

    def read(self, n, timeout_s):
        """Up to n bytes as soon as there are any; b"" when none came within timeout_s."""
        ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, timeout_s))
        if not ready:
            return b""
        data = os.read(self._process.stdout.fileno(), n)
        if not data:
            raise self._gone()
        return data

    def write(self, data):
        """Send all of data. Raises DisconnectedError when QEMU has ended or takes nothing for 5 s."""
        descriptor = self._process.stdin.fileno()
        while data:
            _, ready, _ = select.select([], [descriptor], [], WRITE_TIMEOUT_S)
            if not ready:
                raise DisconnectedError(f"{self.port} takes no data", "try again")
            try:
                data = data[os.write(descriptor, data[:512]):]
            except OSError:
                raise self._gone() from None

    def set_baud(self, baud):
        """There is no speed to set."""

    def flush_input(self):
        """Forget what has arrived and not been read."""
        while self.read(4096, 0.0):
            pass

    def now(self):
        """Seconds on the clock in which timeouts run."""
        return time.monotonic()

    def sleep(self, seconds):
        time.sleep(seconds)

    def _gone(self):
        # QEMU warns of the network card that has no network.
        text = self._errors.read_text(errors="replace") if self._errors.exists() else ""
        said = [line for line in text.splitlines() if line.strip() and "warning:" not in line]
        reason = said[0] if said else "the program in it ended"
        return DisconnectedError(f"{self.port} is gone ({reason})",
                                 "apt-get install qemu-system-arm; make firmware")


def machine(qemu, program):
    """The command line of a board whose two serial lines are yet to be given; QEMU's path, the ELF's."""
    return [qemu, "-M", "mps2-an386", "-nodefaults", "-nic", "none", "-display", "none", "-monitor", "none",
            "-no-reboot", "-icount", f"shift={ICOUNT_SHIFT},align=off,sleep=on", "-kernel", program]


def section_counts(data):
    """What the port's scope wrote -> {section: int64 [k]}: instructions of every run of a section, in order.

    Sections are those of enum hal_section; the instructions of the marking are taken off. The last record may
    be cut: a request that was sent twice may be under way when the file is read.
    Raises ProtocolError when a record is damaged or missing.
    """
    records = np.frombuffer(data, SCOPE, len(data) // SCOPE.itemsize)
    numbers = np.arange(len(records)) % 65536
    if (records["mark"] != SCOPE_MARK).any() or not np.array_equal(records["number"], numbers):
        raise ProtocolError("the Cortex-M4's record of its sections is damaged",
                            "build it anew: make firmware")
    empty = records["ticks"][records["section"] == SECTION_EMPTY]
    if not len(empty):
        raise ProtocolError("the Cortex-M4 has not begun its record", "build it anew: make firmware")
    # Readings are whole ticks and an instruction takes 25.6 of them: rounding gives its number exactly.
    net = (records["ticks"].astype(np.int64) - int(empty[0])) * TICK_NS
    instructions = (net + (1 << ICOUNT_SHIFT - 1)) >> ICOUNT_SHIFT
    return {int(section): instructions[records["section"] == section]
            for section in np.unique(records["section"])}


def _end(process, folder):
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    process.stdin.close()
    process.stdout.close()
    shutil.rmtree(folder, ignore_errors=True)
