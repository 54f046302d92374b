# SPDX-License-Identifier: Apache-2.0
"""Which ports there are: running virtual Nanos, one JSON file each in a private place, and serial ports."""

import json
import os
import stat
import tempfile
from pathlib import Path
from typing import NamedTuple, Optional

from .errors import VirtualError


class Entry(NamedTuple):
    """One running virtual Nano."""

    port: str                   # the pty's slave, /dev/pts/N
    link: Optional[str]         # symbolic link to it, if one was asked for
    control: str                # unix stream socket
    pid: int                    # of the simulator
    unpaced: bool               # True: its clock stands still except when a client lets it run
    seed: int                   # parts, noise and behaviour
    person: int                 # seed of the simulated person
    headset: str
    auto_reset: bool            # False: opening the port does not reset it


class PortInfo(NamedTuple):
    """One line of `sparsegaze list`."""

    port: str
    kind: str                   # "virtual", "usb" or "serial"
    description: str
    virtual: Optional[Entry] = None


def directory():
    """The private directory of the files, made when missing. Raises VirtualError if it is not ours."""
    uid = os.getuid() if hasattr(os, "getuid") else 0
    base = os.environ.get("XDG_RUNTIME_DIR") or ("/tmp" if os.path.isdir("/tmp") else tempfile.gettempdir())
    path = Path(base) / f"sparsegaze-{uid}"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        info = os.lstat(path)
    except OSError as error:
        raise VirtualError(f"cannot use {path} ({error.strerror})",
                           "set XDG_RUNTIME_DIR to a directory of yours") from None
    # What stands in these files decides which sockets we talk to: a directory planted by another is refused.
    private = stat.S_ISDIR(info.st_mode) and info.st_uid == uid and not info.st_mode & 0o022
    if hasattr(os, "getuid") and not private:
        raise VirtualError(f"{path} is not a private directory of this user",
                           "remove it or set XDG_RUNTIME_DIR")
    return path


def register(entry):
    """Write the entry's file (whole or not at all). Returns its path."""
    path = directory() / f"{entry.pid}.json"
    scratch = path.with_suffix(".tmp")
    scratch.write_text(json.dumps(entry._asdict()) + "\n")
    os.replace(scratch, path)
    return path


def unregister(pid):
    """Remove the entry of simulator `pid`, if there is one."""
    try:
        (directory() / f"{int(pid)}.json").unlink()
    except FileNotFoundError:
        pass


def entries():
    """The virtual Nanos that are running now, oldest process id first. Files of dead ones are removed."""
    found = []
    for path in directory().glob("*.json"):
        try:
            entry = Entry(**json.loads(path.read_text()))
        except (OSError, ValueError, TypeError):
            _discard(path)
            continue
        if _alive(entry.pid) and os.path.exists(entry.port) and os.path.exists(entry.control):
            found.append(entry)
        else:
            _discard(path)
    return sorted(found, key=lambda entry: entry.pid)


def find(port):
    """The Entry whose port (or link to it) is `port`, or None."""
    if os.name == "nt" or "://" in port or not port.startswith((os.sep, ".")) and not os.path.exists(port):
        return None
    real = os.path.realpath(port)
    for entry in entries():
        if os.path.realpath(entry.port) == real:
            return entry
    return None


def ports():
    """Every port one could try, as a list of PortInfo: virtual Nanos, then USB, then other serial ports."""
    from serial.tools import list_ports

    rows = []
    for entry in entries():
        text = f"virtual Nano, {Path(entry.headset).stem}, person {entry.person}"
        text += ", unpaced" if entry.unpaced else ", real time"
        text += "" if entry.auto_reset else ", no auto-reset"
        rows.append(PortInfo(entry.link or entry.port, "virtual", text, entry))
    real = []
    for info in list_ports.comports():
        usb = info.vid is not None
        text = info.description if info.description and info.description != "n/a" else "serial port"
        if usb:
            text += f" ({info.vid:04X}:{info.pid:04X})"
        real.append(PortInfo(info.device, "usb" if usb else "serial", text))
    return rows + sorted(real, key=lambda row: (row.kind != "usb", row.port))


def _discard(path):
    try:
        path.unlink()
    except OSError:
        pass


def _alive(pid):
    if os.name == "nt":             # no virtual Nano runs there, and os.kill() means something else
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OSError):
        return True
    return True
