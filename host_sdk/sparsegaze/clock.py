# SPDX-License-Identifier: Apache-2.0
"""The device's clock against the host's, from pings."""

from collections import deque
from typing import NamedTuple

import numpy as np

KEEP = 256                      # pings
JITTER_FLOOR_S = 100e-6         # a round trip this much longer than the best counts half as much
SPAN_FOR_DRIFT_S = 0.5          # below this baseline the scatter of the pings would pass for drift
DRIFT_LIMIT = 0.03              # a resonator is within 1 %; more is scatter


class Ping(NamedTuple):
    host_s: float               # middle between sending and hearing
    device_us: int              # middle between the device's hearing and answering, unwrapped
    round_trip_s: float         # on the host, the device's own time taken off


class Unwrap:
    """Counters of `bits` bits -> growing integers; steps back by less than half the range stay steps back."""

    def __init__(self, bits):
        self._range = 1 << bits
        self._shift = 0
        self.last = None            # unwrapped

    def __call__(self, value):
        self.last = value if self.last is None else self.last + self.step(value)
        return self.last

    def rebase(self, value, unwrapped):
        """From now on `value` stands for `unwrapped`."""
        self._shift = unwrapped - value
        self.last = unwrapped

    def step(self, value):
        """Signed distance of `value` from the last one; 0 before the first."""
        if self.last is None:
            return 0
        half = self._range >> 1
        return ((value + self._shift - self.last + half) & (self._range - 1)) - half


class Clock:
    """host = offset + (1 + drift) * device, fitted over the pings; short round trips weigh most.

    offset_s      host time at device time 0; None before the first ping
    drift         relative: host seconds per device second, minus 1; 0 until the pings span half a second
    round_trip_s  the shortest seen
    """

    def __init__(self):
        self.reset()

    def reset(self):
        """Forget everything: the device has restarted."""
        self.offset_s = None
        self.drift = 0.0
        self.round_trip_s = None
        self._pings = deque(maxlen=KEEP)
        self._unwrap = Unwrap(32)

    def add(self, sent_s, heard_s, rx_us, tx_us):
        """Take one ping: host times of sending and hearing, device times (32 bit) of the same."""
        rx = self._unwrap(rx_us)
        tx = rx + ((tx_us - rx_us) & 0xFFFFFFFF)
        trip = max(heard_s - sent_s - (tx - rx) * 1e-6, 0.0)
        self._pings.append(Ping((sent_s + heard_s) / 2, (rx + tx) / 2, trip))
        self._fit()

    def to_host(self, t_us):
        """Host time in seconds of a device time (unwrapped us, as Frame.t_us); None before the first ping."""
        if self.offset_s is None:
            return None
        return self.offset_s + (1 + self.drift) * t_us * 1e-6

    def to_device(self, host_s):
        """Device time in us (float, unwrapped) of a host time; None before the first ping."""
        if self.offset_s is None:
            return None
        return (host_s - self.offset_s) / (1 + self.drift) * 1e6

    def unwrap(self, t_us):
        """A 32-bit device time near the present as unwrapped us."""
        return t_us if self._unwrap.last is None else self._unwrap.last + self._unwrap.step(t_us)

    @property
    def pings(self):
        return len(self._pings)

    def _fit(self):
        host = np.array([ping.host_s for ping in self._pings])
        device = np.array([ping.device_us * 1e-6 for ping in self._pings])
        trip = np.array([ping.round_trip_s for ping in self._pings])
        self.round_trip_s = float(trip.min())
        weight = 1 / (1 + (trip - trip.min()) / JITTER_FLOOR_S) ** 2
        weight /= weight.sum()
        middle_host, middle_device = weight @ host, weight @ device
        x, y = device - middle_device, host - middle_host
        spread = weight @ (x * x)
        if np.ptp(device) >= SPAN_FOR_DRIFT_S and spread > 0:
            drift = float(weight @ (x * y) / spread) - 1
            if abs(drift) < DRIFT_LIMIT:
                self.drift = drift
        self.offset_s = float(middle_host - (1 + self.drift) * middle_device)
