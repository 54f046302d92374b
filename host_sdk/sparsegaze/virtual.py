# SPDX-License-Identifier: Apache-2.0
"""A virtual Nano: the simulator program of tools/vheadset, started, registered and cleaned up.

    with VirtualNano(person=3, unpaced=True) as nano:
        with Device(nano.port) as device:
            ...
"""

import json
import os
import select
import shutil
import subprocess
import tempfile
import time
import weakref
from pathlib import Path

from . import registry
from .control import EyeState, Lamps, Section, Time, VirtualControl
from .errors import VirtualError

try:
    import tomllib
except ImportError:             # Python < 3.11
    import tomli as tomllib

__all__ = ["VirtualNano", "VirtualControl", "EyeState", "Lamps", "Section", "Time",
           "locate_vheadset", "locate_bootloader"]

SOURCE_TREE = Path(__file__).resolve().parent.parent.parent
BOOTLOADERS = {                 # name: (start address, file, variable that names another file)
    "optiboot": (0x7E00, "optiboot/optiboot_atmega328.hex", "SPARSEGAZE_OPTIBOOT"),
    "atmegaboot": (0x7800, "atmega/ATmegaBOOT_168_atmega328.hex", "SPARSEGAZE_ATMEGABOOT"),
}
BOOTLOADER_FOLDERS = (
    SOURCE_TREE / "tools" / "vheadset" / "build",    # Optiboot of Debian's source: its build does not fit
    "/usr/share/arduino/hardware/arduino/avr/bootloaders",
    "/usr/local/share/arduino/hardware/arduino/avr/bootloaders",
    "~/.arduino15/packages/arduino/hardware/avr",
)
READY_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 5.0


class VirtualNano:
    """Starts on construction; a context manager that stops it on leaving.

    headset     path of a headset description (default: the LED2Gaze ring); its [board] says how it is wired
    person      seed of the simulated person
    seed        of parts, noise and behaviour; default: the person's
    unpaced     False: real time; True: its clock stands still except while a client lets it run
    auto_reset  False: a board whose reset trace is cut: opening the port does not reset it
    bootloader  "optiboot", "atmegaboot", or a path (then bootloader_start is its address)
    app         .hex or .elf that is in flash already
    state_dir   keeps flash, EEPROM and the count of power-ons between runs; default: a fresh one, removed at
                the end. Behaviour and noise follow from the seed and that count: the same seed over the
                same state repeats, a second run over it does not replay the first
    ambient     "dark", "room", "bright_room", "sun_gap";  light: "nominal", "dim", "bright"
    map         path of a response map (.sgmap) to use instead of simulating headset and person; False: no
                light at all. A map that is given is scaled so that itself has the mean photocurrent of
                physics.toml; a simulated one relative to the default headset
    link        symbolic link to make to the port; replaces an older link, refuses anything else that is there
    truth       CSV to write the eye's true state to
    physics     {"section.key": value} over the constants of physics.toml; eye.lid_follow_gain acts through
                the simulated map, so not on a map that is given
    progress    handed to the response map's computation

    port, control (VirtualControl), pid, entry (registry.Entry)
    Raises VirtualError.
    """

    def __init__(self, headset=None, person=1, seed=None, unpaced=False, auto_reset=True,
                 bootloader="optiboot", bootloader_start=None, app=None, state_dir=None, ambient="dark",
                 light="nominal", map=None, link=None, truth=None, physics=None, progress=None):
        binary = locate_vheadset()
        start, boot_hex = locate_bootloader(bootloader, bootloader_start)
        headset = Path(headset) if headset is not None else SOURCE_TREE / "headsets" / "led2gaze.toml"
        if link is not None:
            _refuse_to_replace(link)
        constants = _physics(binary, physics or {})
        reference = None
        described = _described(headset, map)
        if map is None:
            map, reference = _response_map(described, person, constants["eye.lid_follow_gain"], progress)
        # Short and private: a socket's path holds 107 bytes.
        folder = Path(tempfile.mkdtemp(prefix="sgv-"))
        self._finalizer = weakref.finalize(self, _clean, folder)
        state = Path(state_dir) if state_dir is not None else folder / "state"
        state.mkdir(parents=True, exist_ok=True)
        control = folder / "control"
        settings = {
            "bootloader": _absolute(boot_hex), "bootloader_start": f"0x{start:04X}",
            "state": _absolute(state), "control": control, "map": "none" if map is False else _absolute(map),
            "seed": int(person if seed is None else seed), "unpaced": int(bool(unpaced)),
            "auto_reset": int(bool(auto_reset)), "ambient": ambient, "light": light,
        }
        for key, path in (("app", app), ("link", link), ("truth", truth)):
            if path is not None:
                settings[key] = _absolute(path)
        if reference is not None:
            settings["map_reference"] = f"{reference:.17g}"
        settings.update(_board(described))
        settings.update(constants)
        config = folder / "config"
        config.write_text("".join(f"{key} {value}\n" for key, value in settings.items()))
        self._process, ready = _start(binary, config, folder / "errors")
        self._finalizer.detach()
        self.port = ready["port"]
        self._link = _Link(link, self.port)
        self._finalizer = weakref.finalize(self, _end, self._process, folder, self._link)
        self.pid = self._process.pid
        self.control = VirtualControl(ready.get("control", str(control)))
        self.entry = registry.Entry(
            self.port, None if link is None else _absolute(link), self.control.path, self.pid, bool(unpaced),
            settings["seed"], int(person), os.fspath(headset), bool(auto_reset))
        registry.register(self.entry)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.stop()

    @property
    def alive(self):
        return self._process.poll() is None

    def wait(self, timeout_s=None):
        """Until the simulator ends by itself. Returns its exit code, or None after `timeout_s`."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def kill(self):
        """End it at once, as a pulled cable would."""
        self._process.kill()
        self._process.wait()
        self._link.remove()
        registry.unregister(self.pid)

    def stop(self):
        """End it, saving flash and EEPROM; remove what was temporary."""
        self.control.close()
        self._finalizer()


def locate_vheadset():
    """Path of the simulator program: $SPARSEGAZE_VHEADSET, or the source tree's, built when it is missing."""
    named = os.environ.get("SPARSEGAZE_VHEADSET")
    if named:
        if not os.access(named, os.X_OK):
            raise VirtualError(f"SPARSEGAZE_VHEADSET names {named}, which is not a program",
                               "correct or unset it")
        return Path(named)
    folder = SOURCE_TREE / "tools" / "vheadset"
    binary = folder / "vheadset"
    if binary.is_file():
        return binary
    if not (folder / "Makefile").is_file():
        raise VirtualError("the virtual Nano is not part of this installation",
                           "use a source tree of sparsegaze, or set SPARSEGAZE_VHEADSET to its program")
    try:
        built = subprocess.run(["make", "-C", str(folder)], capture_output=True, text=True)
    except OSError as error:
        raise VirtualError(f"the virtual Nano cannot be built ({error.strerror}: make)",
                           "run `make setup`") from None
    if built.returncode or not binary.is_file():
        reason = next((line for line in built.stderr.splitlines() if "rror" in line), "make failed")
        raise VirtualError(f"the virtual Nano cannot be built ({reason.strip()})", "run `make setup`")
    return binary


def locate_bootloader(name="optiboot", start=None):
    """(start address, path) of a stock bootloader by name, or of a hex file given by path."""
    key = os.fspath(name).lower()
    if key not in BOOTLOADERS:
        if not os.path.isfile(name):
            raise VirtualError(f"no such bootloader: {name}",
                               f"give {' or '.join(BOOTLOADERS)}, or a hex file")
        return (0x7E00 if start is None else int(start)), Path(name)
    address, relative, variable = BOOTLOADERS[key]
    named = os.environ.get(variable)
    if named:
        if not os.path.isfile(named):
            raise VirtualError(f"{variable} names {named}, which does not exist", "correct or unset it")
        return address, Path(named)
    for folder in BOOTLOADER_FOLDERS:
        base = Path(folder).expanduser()
        named = [base / relative, base / Path(relative).name]
        for path in named + sorted(base.glob(f"*/bootloaders/{relative}")):
            if path.is_file():
                return address, path
    raise VirtualError(f"the stock bootloader {relative} is not installed",
                       f"`apt-get install arduino-core-avr`, or set {variable} to the file")


def _response_map(headset, person, lid_follow_gain, progress):
    """(path of the map, mean of the map that gives the nominal photocurrent)."""
    from .person import draw_person
    from . import simulate

    share = None if progress is None else lambda done: progress("map", done, 1.0)
    try:
        path = simulate.response_map(headset, draw_person(person, float(lid_follow_gain)),
                                     progress=share)
    except OSError as error:
        raise VirtualError(f"the response map cannot be written ({error})",
                           "make room, or set XDG_CACHE_HOME to a directory of yours") from None
    return path, simulate.REFERENCE_MEAN


def _described(headset, map):
    """The headset.Headset of a file; None where a map makes up for a file that is not there."""
    from .headset import load_headset

    return None if map is not None and not headset.is_file() else load_headset(headset)


def _board(headset):
    """The simulator's keys for how a headset (None: the default one) is wired."""
    board = {} if headset is None else headset.board
    keys = {key: board[key] for key in ("wiring", "rail_volts", "rail_ohm", "rail_noise_mv") if key in board}
    if "wiring" in board:           # else the file describes optics only
        keys["supply_pin"] = board.get("supply_pin", "none")
    return keys


def _physics(binary, changes):
    path = binary.parent / "physics.toml"
    if not path.is_file():
        path = SOURCE_TREE / "tools" / "vheadset" / "physics.toml"
    try:
        sections = tomllib.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise VirtualError(f"cannot read {path} ({error})", "check the source tree out again") from None
    flat = {f"{section}.{key}": value
            for section, values in sections.items() for key, value in values.items()}
    unknown = sorted(set(changes) - set(flat))
    if unknown:
        raise VirtualError(f"there is no physical constant {unknown[0]}", f"see {path.name}")
    flat.update(changes)
    return flat


def _start(binary, config, errors):
    """Start the simulator, wait for its ready line. Returns (process, parsed line)."""
    with open(errors, "wb") as stderr:
        try:
            process = subprocess.Popen([str(binary), "--config", str(config)], stdin=subprocess.DEVNULL,
                                       stdout=subprocess.PIPE, stderr=stderr, start_new_session=True)
        except OSError as error:
            raise VirtualError(f"cannot start {binary} ({error.strerror})",
                               "build it again: `make -C tools/vheadset`") from None
    line, deadline = b"", time.monotonic() + READY_TIMEOUT_S
    while not line.endswith(b"\n"):
        ready, _, _ = select.select([process.stdout], [], [], max(0.0, deadline - time.monotonic()))
        part = os.read(process.stdout.fileno(), 4096) if ready else b""
        if not part:
            process.kill()
            process.wait()
            process.stdout.close()
            reason = errors.read_text(errors="replace").strip().splitlines()
            raise VirtualError("the virtual Nano did not start: " + (reason[0] if reason else
                               "it ended without a word" if ready else f"silent for {READY_TIMEOUT_S:g} s"),
                               "`sparsegaze doctor` shows what is missing")
        line += part
    try:
        parsed = json.loads(line)
        parsed["port"]
    except (ValueError, KeyError, TypeError):
        process.kill()
        process.wait()
        raise VirtualError(f"the virtual Nano said {line[:80]!r} instead of its port",
                           "build it again: `make -C tools/vheadset`") from None
    return process, parsed


class _Link:
    """The symbolic link that a simulator made: removed by us when it was killed before it could."""

    def __init__(self, path, port):
        self.path, self.port = None if path is None else _absolute(path), port
        self.made = self._identity()

    def _identity(self):
        # The port's number comes back with the next simulator: its link is told from ours by inode and time.
        try:
            if self.path is not None and os.readlink(self.path) == self.port:
                found = os.lstat(self.path)
                return found.st_dev, found.st_ino, found.st_mtime_ns
        except OSError:                         # gone, or no link any more
            pass
        return None

    def remove(self):
        if self.made is not None and self._identity() == self.made:
            try:
                os.unlink(self.path)
            except OSError:                     # a folder that became read-only: nothing of ours is in it
                pass
        self.made = None


def _refuse_to_replace(link):
    if os.path.lexists(link) and not os.path.islink(link):
        raise VirtualError(f"{os.fspath(link)} exists and is not a symbolic link",
                           "remove it, or name another path for the link")


def _end(process, folder, link):
    registry.unregister(process.pid)
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    link.remove()
    if process.stdout is not None:
        process.stdout.close()
    _clean(folder)


def _clean(folder):
    shutil.rmtree(folder, ignore_errors=True)


def _absolute(path):
    text = os.path.abspath(os.fspath(path))
    if "\n" in text or "#" in text:
        raise VirtualError(f"the virtual Nano cannot take the path {text!r}",
                           "use one without '#' or line breaks")
    return text
