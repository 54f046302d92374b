# SPDX-License-Identifier: Apache-2.0
"""A stand-in for an open Device and the person in front of it: linear optics, exact, instant.

For what a run of targets does with its frames. The real chain is tested on the virtual Nano.
"""

from collections import namedtuple
from types import SimpleNamespace

import numpy as np

from sparsegaze import replay, wire
from sparsegaze.device import Frame
from sparsegaze.errors import DeviceError, DisconnectedError
from sparsegaze.model import DeviceModel
from sparsegaze.sensing import Sensing
from sparsegaze.wire import Curve, Exposure, Gaze, Probe, Raw, Recentre, Settings, Status, lib

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
    """What fit.fit_recording does, for linear optics, at once."""
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
    frame_us    from frame to frame;  limit_hz  that settings reach;  fault [6], alarm, supply_mv of status
    refuse      names of settings that are refused;  see  6 x 6 octaves of probes, None: too little
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
        frame_us=FRAME_US,
        limit_hz=1001,
        fault=(0,) * 6,
        alarm=0,
        supply_mv=5000,
        refuse=(),
        see=None,
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
        self.hello = SimpleNamespace(
            board_text="fake board",
            firmware_text="0.0.0",
            wire_version=lib.SG_WIRE_VERSION,
            model_version=lib.SG_MODEL_VERSION,
            channels=6,
            cpu_hz=16_000_000,
            exposure_min_us=4,
            exposure_max_us=330,
            slot_bytes=1536,
            trial_bytes=0,
        )
        self.port, self.baud = "PORT", 1_000_000
        self.frame_us, self.limit_hz, self.refuse, self.see = frame_us, limit_hz, set(refuse), see
        self.fault, self.alarm, self.supply_mv = tuple(fault), alarm, supply_mv
        self.sensing = {"rate_hz": 0, "repeats": 1, "wiring": 0, "power": 0, "rolling": 0, "lights": 1}
        self.exposures, self.automatic, self.limits = (800,) * 6, True, None     # 1/16 us
        self.curves, self.zero_q2 = (0,) * 6, 0                                  # 1/1024; 1/4 code
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
        self.stream.append((raw, gaze, counts))

    def _sleep(self, seconds):
        self.t_us += int(seconds * 1e6)

    def status(self):
        """The record of a change counts as written 0.2 s after it."""
        done = self.stored_us is not None and self.t_us >= self.stored_us
        zero = {name: 0 for name in Status._fields}
        return Status(**{
            **zero,
            "t_us": self.t_us,
            "exposure_us_q4": self.exposures,
            "exposure_auto": int(self.automatic),
            "eeprom_writes": 3 + done,
            "fault": self.fault,
            "alarm": self.alarm | (0 if self.sensing["lights"] else lib.SG_ALARM_LIGHTS_OFF),
            "supply_mv": self.supply_mv,
            "reset_cause": lib.SG_RESET_EXTERNAL,
            "boot_count": 7,
        })

    def model_info(self):
        image, none = self.model, lib.SG_E_MAGIC
        return SimpleNamespace(
            active=lib.SG_SLOT_A if image else lib.SG_SLOT_NONE,
            verdict=(lib.SG_OK if image else none, none, none),
            crc=(image.crc if image else 0, 0, 0),
            generation=(1, 0, 0),
            vectors=(image.vectors if image else 0, 0, 0),
            channels=(6, 0, 0),
        )

    def sync_clock(self, n=8):
        return SimpleNamespace(round_trip_s=0.001, drift=0.0)

    def set_baud(self, baud):
        self.baud = baud

    def _changed(self):
        self.stored_us = self.t_us + 200_000

    def settings_back(self, before):
        return Sensing.settings_back(self, before)

    def settings(self, **wanted):
        """As sensing.Sensing.settings; the rate in force is the one wanted, or the limit."""
        values = {name: value for name, value in wanted.items() if value is not None}
        for name, words in (("wiring", wire.WIRINGS), ("power", wire.POWERS)):
            if name in values:
                values[name] = words[values[name]]
        if self.refuse & set(values):
            raise DeviceError(lib.SG_E_ARG, "the device refused request 0x0F: an argument is out of range")
        self.sensing.update({name: int(value) for name, value in values.items()})
        if values:
            self._changed()
        limit = self.limit_hz // self.sensing["repeats"]
        rate = min(self.sensing["rate_hz"] or limit, limit)
        rest = (self.sensing[name] for name in ("repeats", "wiring", "power", "rolling", "lights"))
        return Settings(self.sensing["rate_hz"], limit, 999, round(1e6 / rate), 0, *rest)

    def exposure(self, us=None, auto=None, limit_us=None):
        if us is not None:
            most = 16 * self.hello.exposure_max_us
            self.exposures = tuple(min(max(int(round(16 * v)), 64), most) for v in us)
            self.automatic = False
        if limit_us is not None:
            self.limits = tuple(limit_us)
        if auto is not None:
            self.automatic = auto
        if us is not None or limit_us is not None or auto is not None:
            self._changed()
        return Exposure(self.exposures, lib.SG_EXPOSURE_AUTO if self.automatic else lib.SG_EXPOSURE_HOLD, 0)

    def curve(self, curve=None, zero_codes=None):
        if curve is not None:
            self.curves = tuple(int(round(1024 * v)) for v in curve)
        if zero_codes is not None:
            self.zero_q2 = int(round(4 * zero_codes))
        if curve is not None or zero_codes is not None:
            self._changed()
        return Curve(self.curves, self.zero_q2, 0)

    def probe(self, emitter):
        column = [None] * 6 if self.see is None else [row[emitter] for row in self.see]
        return Probe(tuple(0 if v is None else int(round(4096 * v)) for v in column), emitter, 0)

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
        raw_on, gaze_on, counts_on = self.stream[-1]
        while True:
            self.t_us += self.frame_us
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
            feature, counts = self.sense(signal)
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
                counts if counts_on else None,
            )

    def sense(self, signal):
        """(features, Counts or None) of the light, given as features [6]."""
        return np.clip(np.round(signal), 0, 65535).astype(np.uint16), None
