# SPDX-License-Identifier: Apache-2.0
"""Stream packets -> frames: the parts of one sensing frame put together, counters unwrapped, gaps counted."""

from collections import deque

from . import wire
from .clock import Unwrap
from .wire import Counts, Gaze, Raw, lib

_PARTS = {lib.SG_MSG_RAW: ("raw", Raw, lib.SG_STREAM_RAW),
          lib.SG_MSG_GAZE: ("gaze", Gaze, lib.SG_STREAM_GAZE),
          lib.SG_MSG_COUNTS: ("counts", Counts, lib.SG_STREAM_COUNTS)}


TURN = 1 << 16                  # numbers of frames
LONG_US = 10_000_000            # within which they cannot come half round, at any rate
NEAR_FRAMES = 64                # this near, two frames tell the period


class Assembler:
    """Collects RAW, GAZE and COUNTS packets into frames.

    frame       called as frame(seq=, t_us=, host_time=, raw=, gaze=, counts=)
    keep        finished frames kept when nobody drains them; older ones are dropped and counted as lost
    near        unwraps the first 32-bit device time, so that frames and pings count from the same zero
    lost        frames missing by sequence number
    incomplete  frames that lack a part which the stream mode promises
    restarts    times device time went back by more than a frame: the device restarted
    """

    def __init__(self, frame, keep, near):
        self._frame = frame
        self._keep = keep
        self._near = near
        self._bits = 0
        self.clear()

    def clear(self):
        """Start again: nothing pending, all counts zero."""
        self.lost = self.incomplete = self.restarts = 0
        self._done = deque()
        self._begin()

    def expect(self, bits):
        """Parts that make a frame whole (bits of enum sg_stream)."""
        self._bits = bits

    def take(self, packet, host_time):
        """Take one stream packet that arrived at `host_time`."""
        name, kind, bit = _PARTS[packet.type]
        value = wire.parse(kind, packet.body)
        if packet.seq != self._open_seq or bit & self._have:
            self._finish()
            self._open_seq = packet.seq
        self._have |= bit
        self._parts[name] = value
        self._t_us = value.t_us
        self._host_time = host_time
        if self._bits and self._have & self._bits == self._bits:
            self._finish()

    def drain(self):
        """The frames finished since the last call, in order."""
        while self._done:
            yield self._done.popleft()

    def _begin(self):
        self._seq = Unwrap(16)
        self._time = Unwrap(32)
        self._last_seq = None
        self._period_us = 0.0
        self._close()

    def _close(self):
        self._parts = {}
        self._have = 0
        self._open_seq = None

    def _finish(self):
        if not self._parts:
            return
        if self._time.last is None:
            self._time.rebase(self._t_us, self._near(self._t_us))
        step, elapsed_us = self._seq.step(self._open_seq), self._time.step(self._t_us)
        if self._last_seq is not None and elapsed_us < 0:
            # Only a restart sets device time back. Numbering goes on, so that nobody sees time run backwards.
            self.restarts += 1
            seq, t_us = self._seq.last + 1, self._time.last + 1
            self._begin_at(seq, t_us)
        else:
            step += self._turns(step, elapsed_us)
            if step > 1:
                self.lost += step - 1
            elif self._last_seq is not None and step == 0:
                self._close()           # the same frame again
                return
            seq = self._open_seq if self._last_seq is None else self._last_seq + step
            self._seq.rebase(self._open_seq, seq)
            t_us = self._time(self._t_us)
            if 0 < step < NEAR_FRAMES:
                self._period_us = elapsed_us / step
        self._last_seq = seq
        if self._bits & ~self._have:
            self.incomplete += 1
        if len(self._done) >= self._keep:
            self._done.popleft()
            self.lost += 1
        self._done.append(self._frame(seq=seq, t_us=t_us, host_time=self._host_time,
                                      raw=self._parts.get("raw"),
                                      gaze=self._parts.get("gaze"), counts=self._parts.get("counts")))
        self._close()

    def _turns(self, step, elapsed_us):
        """Frames to add to a step of the 16-bit numbers, which come round once a minute at 1 kHz: whole turns
        that have passed unseen, by device time."""
        if self._last_seq is None or not self._period_us or elapsed_us < LONG_US:
            return 0
        return TURN * round((elapsed_us / self._period_us - step) / TURN)

    def _begin_at(self, seq, t_us):
        """After a restart: continue unwrapping so that the present packet becomes `seq` at `t_us`."""
        self._seq.rebase(self._open_seq, seq)
        self._time.rebase(self._t_us, t_us)
