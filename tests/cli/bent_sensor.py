# SPDX-License-Identifier: Apache-2.0
"""The fake device with sensors such as a board has them: whole converter codes, noise, charge that bends."""

import numpy as np
from fake_device import MIDDLE, FakeDevice

from sparsegaze.curvefit import NOMINAL
from sparsegaze.wire import Counts

FULL = 12.0  # codes of our light, a microsecond, at feature MIDDLE
FIRST, SECOND, CARRIED = [5, 1, 2], [0, 4, 3], 14 / 44  # pairs of sensors; pF of the sampler in a node's
BEHIND = np.linspace(-1.56, 1.4, 75)  # codes, and the mean of the whole ones that noise of 0.75 makes of them
_ERRORS = np.random.default_rng(0).normal(0, 0.75, 20_000)
CLIPPED = np.array([np.mean(np.maximum(np.round(level + _ERRORS), 0)) for level in BEHIND])
LEAKAGE = (0.02, 0.005, 0.002, 0.04, 0.01, 0.015)  # codes a microsecond: about 1 nA, as parts come


class BentSensor(FakeDevice):
    """As FakeDevice, whose frames have counts.

    bend      [6] true curves;  light  of our LEDs, 1: 600 codes in the 50 us of the automatic exposure
    ambient   function t_us -> codes a microsecond that come without our light
    wander    function t_us -> (azimuth, elevation) added to where the eye looks, degrees
    zero      code of the converter at 0 V;  leakage  [6] codes a microsecond that always come
    """

    def __init__(
        self,
        bend=(0.0,) * 6,
        light=1.0,
        ambient=lambda t_us: 0.0,
        wander=None,
        zero=0.0,
        code_noise=0.7,
        leakage=LEAKAGE,
        **options,
    ):
        super().__init__(noise=0.0, **options)
        self.bend, self.light, self.ambient = np.array(bend, float), light, ambient
        self.wander, self.zero, self.code_noise = wander, zero, code_noise
        self.leakage, self.resting = np.array(leakage, float), None

    def eye_deg(self, t_us):
        here = super().eye_deg(t_us)
        return here if self.wander is None else here + np.array(self.wander(t_us))

    def sense(self, signal):
        exposure = np.array(self.exposures) / 16
        rate = self.light * FULL * np.exp2((np.asarray(signal) - MIDDLE) / 4096)
        around = self.ambient(self.t_us) + self.leakage
        lit, unlit = (self._codes((ours + around) * exposure) for ours in (rate, 0.0))
        # The mean of unlit codes, through noise and clipping down to the stored zero, as sg_light takes it.
        if self.exposures != self.resting:
            self.resting, self.mean, self.settled = self.exposures, unlit.astype(float), 0
        self.settled += 1
        self.mean += (unlit - self.mean) / (4 if self.settled < 16 else 16)
        behind = np.maximum(np.interp(self.mean, CLIPPED, BEHIND), min(self.zero_q2 / 4, 0))
        ours = lit - np.where(self.mean < 1.25, behind, self.mean)
        bend = NOMINAL + np.array(self.curves) / 1024
        charge = ours * (1 + bend * (lit + unlit) / 1024)
        charge[SECOND] -= CARRIED * ours[FIRST]
        feature = np.where(charge > 2, 30000 + 4096 * np.log2(np.maximum(charge, 1) / exposure / FULL), 0)
        counts = Counts(self.t_us, tuple(map(int, lit)), tuple(map(int, unlit)), self.exposures)
        return np.clip(np.round(feature), 0, 65535).astype(np.uint16), counts

    def _codes(self, charge):
        """Codes of what nodes collected; a pair's second also has what the sample capacitor brings."""
        charge = np.array(charge, float)
        charge[SECOND] += CARRIED * self._code(charge)[FIRST]
        code = self._code(charge) + self.zero + self.rng.normal(0, self.code_noise, 6)
        return np.clip(np.round(code), 0, 1023)

    def _code(self, charge):
        bend = NOMINAL + self.bend
        return (np.sqrt(1 + 4 * bend * charge / 1024) - 1) / (2 * bend / 1024)
