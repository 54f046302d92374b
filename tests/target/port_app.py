# SPDX-License-Identifier: Apache-2.0
"""bad_app.c on a virtual Nano: told what to do, and what it answers, and what its pins did meanwhile.

Structs travel as they lie in the microcontroller's memory: little endian, no padding.
"""

import csv
import struct
from collections import namedtuple

from sparsegaze import wire
from sparsegaze.wire import Status, lib

LEDS = 6
CYCLES_PER_US = 16
SLOTS = 18
SAMPLE_CYCLES = 132             # trigger to sample
PAIRS = ((5, 0), (1, 4), (2, 3))
PHOTODIODE_PAIRS = ((0, 3), (1, 4), (2, 5))
LOW, HIGH, PULLUP, FLOAT = range(4)     # how a pin is driven, as the virtual Nano numbers it

TYPE_CYCLE, TYPE_EXPOSURE, TYPE_TIMING = 0x50, 0x51, 0x52
Cycle = namedtuple("Cycle", "t_us span_us seq left lit unlit exposure late_lit late_unlit held")
Timing = namedtuple("Timing", "frame_cycles period_cycles repeats wiring lights probe sleep",
                    defaults=(0, 15984, 1, 0, 1, 255, 0))
CYCLE_FORMAT = "<IHHB6H6H6H6B6BH"
TIMING_FORMAT = "<IHBBBBB"
Sample = namedtuple("Sample", "channel cycle lit released mask")


def parse_cycle(body):
    f = struct.unpack(CYCLE_FORMAT, body)
    return Cycle(*f[:4], f[4:10], f[10:16], f[16:22], f[22:28], f[28:34], f[34])


class PortApp:
    """Talks to bad_app.c over `link`; the clock moves by `link` only."""

    def __init__(self, nano, link, folder):
        self.nano = nano
        self.link = link
        self._folder = folder
        self._decoder = wire.Decoder()

    def packets(self, seconds):
        """Packets that come within some seconds of virtual time."""
        found, end = [], self.link.now() + seconds
        while self.link.now() < end:
            found += self._decoder.feed(self.link.read(4096, end - self.link.now()))
        return found

    def _ask(self, data, kind, seconds=0.05):
        self.link.write(data)
        end = self.link.now() + seconds
        while self.link.now() < end:
            for packet in self._decoder.feed(self.link.read(256, 0.001)):
                if packet.type == kind:
                    return packet.body
        raise AssertionError("no answer")

    def expose(self, exposures):
        """Set exposures (cycles); what was taken."""
        body = self._ask(b"e" + struct.pack("<6H", *exposures), TYPE_EXPOSURE)
        return struct.unpack("<6H", body)

    def timing(self, **changes):
        """Set the timing; what was taken."""
        body = self._ask(b"t" + struct.pack(TIMING_FORMAT, *Timing(**changes)), TYPE_TIMING)
        return Timing(*struct.unpack(TIMING_FORMAT, body))

    def status(self):
        return wire.parse(Status, self._ask(b"s", lib.SG_MSG_STATUS | lib.SG_REPLY))

    def cycles(self, seconds):
        """What app_on_cycle() was given."""
        self.link.write(b"c\1")
        packets = self.packets(seconds)
        self.link.write(b"c\0")
        self.packets(0.01)
        return [parse_cycle(packet.body) for packet in packets if packet.type == TYPE_CYCLE]

    def noise(self, on):
        """Keep the line from the device full, or no longer."""
        self.link.write(b"n" + bytes([on]))

    def moments(self, seconds, meanwhile=None):
        """[(what, value, cycle)] of what happened at the pins: drive<i>, lit, adc, release, sample."""
        path = self._folder / "moments.csv"
        self.nano.control.frames(path)
        (meanwhile or self.link.sleep)(seconds)
        self.nano.control.frames(None)
        with open(path, newline="") as file:
            rows = [(row[0].partition(":"), int(row[1])) for row in csv.reader(file) if row[1].isdigit()]
        return [(what, int(value) if value else None, cycle) for (what, _, value), cycle in rows]


def samples(moments, leds=LEDS):
    """Every conversion of a sensor: channel, cycle, whether lit, cycle of its release (None: it was held)."""
    found, released, mask = [], [None] * leds, 0
    for what, value, cycle in moments:
        if what.startswith("drive"):
            i = int(what[5:])
            released[i] = cycle if value == FLOAT else None
        elif what == "lit":
            mask = value
        elif what == "adc" and value < leds:
            found.append(Sample(value, cycle, mask != 0, released[value], mask))
    return found


def lit_windows(moments):
    """[(mask, from, to)]: emitters lit between two cycles."""
    found, mask, since = [], 0, None
    for what, value, cycle in moments:
        if what == "lit":
            if mask and since is not None:
                found.append((mask, since, cycle))
            mask, since = value, cycle
    return found
