# SPDX-License-Identifier: Apache-2.0
"""The control socket of a virtual Nano: time, the simulated person's targets, power, light, counters.

`us` is everywhere the virtual microsecond: CPU cycles / 16 since power-on, not restarted by resets.
"""

import os
import socket
from typing import NamedTuple

from .errors import DisconnectedError, VirtualError

FAULTS = ("none", "open", "short", "short_ground", "covered", "finger")
REPLY_TIMEOUT_S = 60.0          # real seconds for one answer; an `advance` computes before it answers


class Time(NamedTuple):
    cycle: int
    us: int
    running: bool


class EyeState(NamedTuple):
    us: float
    azimuth_deg: float
    elevation_deg: float
    pupil_mm: float
    lid_opening: float
    target_azimuth_deg: float
    target_elevation_deg: float
    blink: float


class Section(NamedTuple):
    """Cycles of one marked section: with interrupts (gross) and, where known, without (net)."""

    count: int
    least: float
    mean: float
    most: float


class Lamps(NamedTuple):
    """Emitters lit (their numbers), current of all (A), supply and rail under it (V)."""

    lit: tuple
    amperes: float
    supply_volts: float
    rail_volts: float


class VirtualControl:
    """A connection to the control socket at `path`. Opened on first use. Context manager.

    Raises VirtualError when the simulator refuses a command, DisconnectedError when it is gone.
    """

    def __init__(self, path):
        self.path = os.fspath(path)
        self._socket = None
        self._buffer = b""

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()

    def close(self):
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._buffer = b""

    def command(self, line):
        """Send one command line, return what follows `ok` in the answer, stripped."""
        if "\n" in line:
            raise VirtualError(f"a control command is one line, not {line!r}")
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
                self._socket.settimeout(REPLY_TIMEOUT_S)
                self._socket.connect(self.path)
            self._socket.sendall(line.encode() + b"\n")
            while b"\n" not in self._buffer:
                part = self._socket.recv(65536)
                if not part:
                    raise ConnectionResetError
                self._buffer += part
        except socket.timeout:
            self.close()
            raise VirtualError(f"the virtual Nano did not answer `{line}`",
                               "stop it and start it again") from None
        except OSError as error:
            self.close()
            reason = error.strerror or "connection closed"
            raise DisconnectedError(f"the virtual Nano behind {self.path} is gone ({reason})",
                                    "start it again with `sparsegaze virtual`") from None
        reply, self._buffer = self._buffer.split(b"\n", 1)
        text = reply.decode("utf-8", "replace").strip()
        if text == "ok" or text.startswith("ok "):
            return text[2:].strip()
        reason = text[4:] if text.startswith("err ") else text
        raise VirtualError(f"the virtual Nano refused `{line}`: {reason}")

    # time ---------------------------------------------------------------------------------------------------

    def time(self):
        cycle, us, running = self.command("time").split()[:3]
        return Time(int(cycle), int(us), running == "1")

    def lockstep(self, on):
        """True: the virtual clock stands still except inside advance()."""
        self.command(f"lockstep {int(bool(on))}")

    def advance(self, us, host_bytes):
        """Run until `us`, having first taken host bytes up to `host_bytes` in all since lockstep began.

        Returns (us, device_bytes): the time reached, and the bytes sent by the device since lockstep began.
        """
        now, device_bytes = self.command(f"advance {us} {host_bytes}").split()[:2]
        return int(now), int(device_bytes)

    def barrier(self):
        """Returns once the simulator has noticed earlier openings and changes of speed of its port."""
        # It looks at the port between two rounds of commands. A connection made after an answer belongs to a
        # later round than that answer.
        self.time()
        with VirtualControl(self.path) as later:
            later.time()

    # the person ---------------------------------------------------------------------------------------------

    def target(self, us, azimuth_deg, elevation_deg):
        """From `us` on the person looks at this direction (after the human latency)."""
        self.command(f"target {int(us)} {azimuth_deg:.6f} {elevation_deg:.6f}")

    def targets_clear(self):
        self.command("targets clear")

    def follow(self, on):
        """False: the eye is put on the targets exactly, without human behaviour."""
        self.command(f"follow {int(bool(on))}")

    def motion(self, on):
        """False: fixation without drift, microsaccades, hippus, blinks and bias."""
        self.command(f"motion {int(bool(on))}")

    def state(self):
        return EyeState(*(float(word) for word in self.command("state").split()[:8]))

    def truth(self, path=None):
        """Write the true state to `path` every millisecond; None stops."""
        self.command(f"truth {_path(path)}")

    # the board ----------------------------------------------------------------------------------------------

    def reset(self):
        self.command("reset")

    def power(self, on):
        self.command(f"power {'on' if on else 'off'}")

    def cut(self, cycle):
        """Power fails at this CPU cycle; a write under way is left corrupt."""
        self.command(f"cut {int(cycle)}")

    def set(self, key, value):
        """Change ambient, ambient_na, ambient_flicker, flicker_hz, light, supply_volts, lid, ... at once."""
        self.command(f"set {key} {value}")

    def set_at(self, cycle, key, value):
        """The same at exactly this CPU cycle, in the middle of an exposure if need be."""
        self.command(f"set_at {int(cycle)} {key} {value}")

    def set_at_clear(self):
        """Forget what set_at() still holds."""
        self.command("set_at clear")

    def ambient(self, na, flicker=0.0, hz=None):
        """Ambient light as numbers: nA on a nominal LED, depth of flicker 0..1, its frequency (Hz)."""
        self.set("ambient_na", f"{na:.9g}")
        self.set("ambient_flicker", f"{flicker:.9g}")
        if hz is not None:
            self.set("flicker_hz", f"{hz:.9g}")

    def supply(self, volts):
        """Supply before its source resistance, 4.2 to 5.5 V."""
        self.set("supply_volts", f"{volts:.9g}")

    def fault(self, part, kind):
        """Make part 0..5 "none", "open", "short", "short_ground", "covered" or "finger" (FAULTS).

        Parts 6..8 are the emitters of the photodiode wiring: "none", "open" or "covered".
        """
        self.command(f"fault {part} {kind}")

    def swap(self, first, second):
        """Exchange the parts on two pins, 0..5; once more undoes it."""
        self.command(f"swap {first} {second}")

    def lamps(self):
        """Lamps: which emitters are lit now, and what that does to the board."""
        mask, amperes, supply, rail = self.command("lamps").split()[:4]
        lit = tuple(i for i in range(8) if int(mask) >> i & 1)
        return Lamps(lit, float(amperes), float(supply), float(rail))

    def markers(self):
        """{section: Section} of gross cycles, keys "0".."5"; keys with an n ("0n") are net of interrupts."""
        sections = {}
        for item in self.command("markers").replace(";", " ").split():
            name, count, least, mean, most = item.split(":")[:5]
            sections[name] = Section(int(count), float(least), float(mean), float(most))
        return sections

    def markers_clear(self):
        self.command("markers clear")

    def counters(self):
        """{name: count} since power-on, and of light and sleep since counters_clear().

        lit_cycles_0..5, longest_pulse_cycles, asleep_cycles in CPU cycles; most_lit: emitters at once;
        led_charge_nc: what their drivers gave, nC; longest_rx_cycles: that a byte waited in the receiver.
        """
        items = (item.split("=", 1) for item in self.command("counters").split())
        return {key: int(float(value)) for key, value in items}

    def counters_clear(self):
        """Begin the tally of light and sleep anew; the other counters go on."""
        self.command("counters clear")

    def frames(self, path=None):
        """Log the cycles of first release, last sample and sent delimiters to `path`; None stops."""
        self.command(f"frames on {_path(path)}" if path is not None else "frames off")

    def quit(self):
        self.command("quit")


def _path(path):
    if path is None:
        return "off"
    text = os.path.abspath(os.fspath(path))
    if "\n" in text:
        raise VirtualError("a path given to the virtual Nano may not hold a line break")
    return text
