# SPDX-License-Identifier: Apache-2.0
"""A stand-in for an open Device and the person in front of it: linear optics, exact, instant.

For what a run of targets does with its frames. The real chain is tested on the virtual Nano.
"""

from collections import namedtuple
from types import SimpleNamespace

import numpy as np

from sparsegaze import replay, wire
from sparsegaze.device import Frame
from sparsegaze.errors import DisconnectedError
from sparsegaze.model import DeviceModel
from sparsegaze.wire import Gaze, Raw, Recentre, lib

FRAME_US = 3840
OPTICS = np.array(
    [[60, 10], [-55, 20], [15, -70], [-20, 60], [45, 45], [-40, -40]], float
)  # feature steps per degree
MIDDLE = 30000
Pong = namedtuple("Pong", "rx_us tx_us")


def linear_model(generation=1, inverse=None, n_vectors=64):
    """The DeviceModel of gaze = inverse (feature - MIDDLE) (default: of OPTICS), [2, 6] deg per step."""
    # s = (feature - offset) / 2
    inverse = np.linalg.pinv(OPTICS) if inverse is None else inverse
    unit = 2.0**-20
    offset = MIDDLE - 4095
    trend = np.round(2 * inverse / unit).astype(np.int64)
    bias = np.round(inverse @ np.full(6, offset - MIDDLE) / unit).astype(np.int64)
    return DeviceModel.from_parts(
        np.full(6, offset),
        np.full(6, 2048),
        bias,
        trend,
        np.zeros((n_vectors, 6), np.int64),
        np.zeros((n_vectors, 2), np.int64),
        8,
        generation=generation,
    )


def fit_linear(recording, n_vectors=None, **options):
    """What distil.fit_recording does, for linear optics, at once."""
    x = recording.features[recording.valid].astype(float) - MIDDLE
    inverse = np.linalg.lstsq(x, recording.target_deg[recording.valid], rcond=1e-3)[0].T
    miss = x @ inverse.T - recording.target_deg[recording.valid]
    return SimpleNamespace(
        gp=None,
        model=linear_model(0, inverse, n_vectors or 64),
        report={"loo_rms_deg": float(np.sqrt((miss**2).sum(axis=1).mean()))},
    )


class FakeScreen:
    """Schedules targets in the fake person's own time line."""

    name = "fake"

    def __init__(self, person):
        self.person, self._onsets, self.closed = person, [], False

    def open(self, device):
        self.person.schedule = []

    def reach_deg(self):
        return None

    def look(self, target_deg, now_us):
        self.person.schedule.append((now_us, tuple(target_deg)))

    def start(self, targets_deg, onsets_us, dwell_s):
        self.person.schedule += [(int(t), tuple(d)) for t, d in zip(onsets_us, targets_deg)]
        self._onsets = [int(t) for t in onsets_us]

    def tick(self, now_us):
        pass

    def onsets_us(self):
        return self._onsets

    def close(self):
        self.closed = True


class FakeDevice:
    """What session, capture, validate, recentre and live use of Device.

    model       DeviceModel or None;  noise feature steps rms;  shift_deg: where the eye really looks, off the
                target;  warp: 2 x 2, what a shifted headset makes of where the eye looks
    blinks      [(begin_us, end_us)];  raw_flags: function t_us -> flags
    unplug_us   the cable is pulled then;  interrupt_us: Ctrl-C then;  drop: sequence numbers that get lost
    spoil       function (seq, Gaze) -> Gaze, for gazes that the host would not compute
    """

    def __init__(
        self,
        model=None,
        noise=8.0,
        shift_deg=(0.0, 0.0),
        warp=((1.0, 0.0), (0.0, 1.0)),
        blinks=(),
        raw_flags=None,
        unplug_us=None,
        interrupt_us=None,
        drop=(),
        spoil=None,
        seed=0,
    ):
        self.model, self.noise, self.shift, self.blinks = (
            model,
            noise,
            np.array(shift_deg, float),
            list(blinks),
        )
        self.warp = np.array(warp, float)
        self.raw_flags = raw_flags or (lambda t_us: 0)
        self.unplug_us, self.interrupt_us, self.drop, self.spoil = unplug_us, interrupt_us, set(drop), spoil
        self.rng = np.random.default_rng(seed)
        self.schedule, self.t_us, self.seq = [], 2_000_000, 500
        self.link = SimpleNamespace(control=None, now=lambda: self.t_us * 1e-6, sleep=self._sleep)
        self.stored_us = None
        self.hello = SimpleNamespace(board_text="fake board", firmware_text="0.0.0")
        self.clock = SimpleNamespace(drift=0.0)
        self.affine = wire.affine((0, 0))
        self.stream, self.lost, self.bad, self.incomplete = [], 0, 0, 0
        self.screen = FakeScreen(self)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.stream.append("closed")

    def ping(self):
        return Pong(self.t_us, self.t_us)

    def set_stream(self, raw=False, gaze=False, counts=False):
        self.stream.append((raw, gaze))

    def _sleep(self, seconds):
        self.t_us += int(seconds * 1e6)

    def status(self):
        """The record of a change counts as written 0.2 s after it."""
        done = self.stored_us is not None and self.t_us >= self.stored_us
        return SimpleNamespace(eeprom_writes=3 + done)

    def model_info(self):
        return SimpleNamespace(active=lib.SG_SLOT_A if self.model else lib.SG_SLOT_NONE)

    def read_model(self, slot=None):
        return self.model.image

    def recentre(self, offset_deg=None, gain=None, clear=False):
        if clear or offset_deg is not None:
            self.stored_us = self.t_us + 200_000
        if clear:
            self.affine = wire.affine((0, 0))
        elif offset_deg is not None:
            self.affine = wire.affine(offset_deg, gain)
        return Recentre(self.affine, lib.SG_RECENTRE_GET, 0)

    def eye_deg(self, t_us):
        now = (0.0, 0.0)
        for onset, target in self.schedule:
            if t_us >= onset + 250_000:  # latency and saccade
                now = target
        return np.array(now) + self.shift

    def frames(self, timeout_s=2.0):
        raw_on, gaze_on = self.stream[-1]
        while True:
            self.t_us += FRAME_US
            self.seq += 1
            if self.unplug_us is not None and self.t_us >= self.unplug_us:
                raise DisconnectedError("/dev/fake is gone", "check the cable")
            if self.interrupt_us is not None and self.t_us >= self.interrupt_us:
                raise KeyboardInterrupt
            if self.seq in self.drop:
                self.lost += 1
                continue
            signal = MIDDLE + OPTICS @ self.warp @ self.eye_deg(self.t_us) + self.rng.normal(0, self.noise, 6)
            if any(begin <= self.t_us < end for begin, end in self.blinks):
                signal += 1500
            feature = np.clip(np.round(signal), 0, 65535).astype(np.uint16)
            flags = self.raw_flags(self.t_us)
            q7, gaze_flags, sigma = replay.infer(
                self.model,
                feature[None],
                np.array([flags], np.uint8),
                np.array(tuple(self.affine), replay.AFFINE),
            )
            gaze = Gaze(self.t_us, *map(int, (*q7[0], 700, gaze_flags[0], sigma[0])))
            if self.spoil:
                gaze = self.spoil(self.seq, gaze)
            crc = self.model.crc if self.model else 0
            raw = Raw(self.t_us, crc, self.affine, tuple(int(v) for v in feature), 1500, flags, 0)
            yield Frame(
                self.seq,
                self.t_us,
                self.t_us * 1e-6 + 5.0,
                raw if raw_on else None,
                gaze if gaze_on else None,
                None,
            )
