# SPDX-License-Identifier: Apache-2.0
"""Requests and their answers over a link, with the stream running in between."""

from collections import deque

from . import wire
from .errors import DeviceError, NoDeviceError
from .wire import lib

TRY_TIMEOUTS_S = (0.5, 1.0003, 2.0)  # the second try must not meet the same moment of a frame again
BUSY_WAIT_S = 0.02
WINDOW = 2                      # requests under way at a time: a longer burst overruns the receiver
MANY_TRIES = 5                  # of one of many requests: at full rate some meet a busy receiver
STREAM_KEPT = 3 * 16384         # stream packets kept while nobody takes them


class Exchange:
    """One side of the conversation with the firmware behind `link`.

    stale    answers that nobody waited for
    dropped  stream packets thrown away because nobody took them
    """

    def __init__(self, link):
        self.link = link
        self.stale = 0
        self.dropped = 0
        self.decoder = wire.Decoder()
        self._seq = 0
        self._stream = deque()
        self._stale_until = None

    def restart(self):
        """Forget all that was received: the device was reset."""
        self.decoder = wire.Decoder()
        self._stream.clear()

    def next_seq(self):
        self._seq = (self._seq + 1) & 0xFFFF
        return self._seq

    def send(self, kind, body=b"", seq=None):
        """Send one request; returns its number. The leading delimiter ends whatever half frame a disturbed
        line left."""
        seq = self.next_seq() if seq is None else seq
        self.link.write(b"\0" + wire.encode(kind, seq, body))
        return seq

    def receive(self, deadline):
        """Answers that have arrived by `deadline` (returns at the first bytes); stream packets go to
        stream()."""
        data = self.link.read(4096, max(0.0, deadline - self.link.now()))
        now = self.link.now()
        answers = []
        for packet in self.decoder.feed(data):
            if lib.SG_MSG_RAW <= packet.type <= lib.SG_MSG_COUNTS:
                if len(self._stream) == STREAM_KEPT:
                    self._stream.popleft()
                    self.dropped += 1
                self._stream.append((packet, now))
            else:
                if packet.type == self._stale_until:
                    self.forget_stream()
                answers.append(packet)
        return answers

    def stream(self):
        """(packet, host time) of the stream packets received so far, each once."""
        while self._stream:
            yield self._stream.popleft()

    def forget_stream(self, until=None):
        """Forget the stream packets received so far, and those that come before the next answer of type
        `until`; what follows it belongs to another stream, even if both arrive at once."""
        self._stream.clear()
        self._stale_until = until

    def request(self, kind, body=b"", answer=None, sent=None):
        """Send one request and return its answer, parsed as the record type `answer` (None: the body's
        bytes).

        Requests are idempotent: a lost one is sent again with its number, three tries in all.
        sent    a list that gets the host time of each sending (for pings)
        Raises DeviceError when the device refuses, NoDeviceError when it does not answer.
        """
        seq = self.next_seq()
        for timeout_s in TRY_TIMEOUTS_S:
            now = self.link.now()
            self.send(kind, body, seq)
            if sent is not None:
                sent.append(now)
            deadline = now + timeout_s
            while self.link.now() < deadline:
                found = None
                for packet in self.receive(deadline):
                    if packet.seq != seq or packet.type not in (kind | lib.SG_REPLY,
                                                                lib.SG_MSG_ERROR) or found:
                        self.stale += 1
                    else:
                        found = packet
                if found is None:
                    continue
                if found.type != lib.SG_MSG_ERROR:
                    return found.body if answer is None else wire.parse(answer, found.body)
                self._refused(found)        # or busy:
                self.link.sleep(BUSY_WAIT_S)
                self.send(kind, body, seq)
        raise self._silent()

    def request_many(self, kind, bodies, take, window=WINDOW):
        """Send many requests of one kind, `window` under way at a time; take(i, answer's body) for each, in
        any order."""
        waiting, todo = {}, deque((i, 0) for i in range(len(bodies)))
        while todo or waiting:
            while todo and len(waiting) < window:
                i, tries = todo.popleft()
                if tries == MANY_TRIES:
                    raise self._silent()
                patience_s = TRY_TIMEOUTS_S[min(tries, len(TRY_TIMEOUTS_S) - 1)]
                waiting[self.send(kind, bodies[i])] = i, tries, self.link.now() + patience_s
            for packet in self.receive(min(limit for _, _, limit in waiting.values())):
                if packet.seq not in waiting or packet.type not in (kind | lib.SG_REPLY, lib.SG_MSG_ERROR):
                    self.stale += 1
                    continue
                i, tries, _ = waiting.pop(packet.seq)
                if packet.type == lib.SG_MSG_ERROR:
                    self._refused(packet)
                    todo.appendleft((i, tries))
                    self.link.sleep(BUSY_WAIT_S)
                else:
                    take(i, packet.body)
            now = self.link.now()
            for seq in [seq for seq, (_, _, limit) in waiting.items() if now >= limit]:
                i, tries, _ = waiting.pop(seq)
                todo.appendleft((i, tries + 1))

    def _refused(self, packet):
        code, refused = wire.parse_error(packet.body)
        if code != lib.SG_E_BUSY:
            raise refusal(code, refused)

    def _silent(self):
        return NoDeviceError(f"{self.link.port} no longer answers",
                             "check the cable; if it stays silent, press the board's reset button")


def refusal(code, refused):
    """The DeviceError for enum sg_err `code` in answer to a request of type `refused`."""
    text = wire.ERROR_TEXT.get(code, f"error {code}")
    return DeviceError(code, f"the device refused request 0x{refused:02X}: {text}", {
        lib.SG_E_UNKNOWN: "flash the firmware that belongs to this SDK: `sparsegaze flash PORT`",
        lib.SG_E_MAGIC: "calibrate, or upload a model first",
    }.get(code, "`sparsegaze info PORT` shows the device's state"))
