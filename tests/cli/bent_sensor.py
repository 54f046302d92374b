# SPDX-License-Identifier: Apache-2.0
"""The fake device with sensors such as a board has them: whole converter codes, noise, charge that bends."""

import numpy as np
from fake_device import MIDDLE, FakeDevice

from sparsegaze.curvefit import NOMINAL
from sparsegaze.wire import Counts

FULL = 12.0  # codes of our light, a microsecond, at feature MIDDLE


class BentSensor(FakeDevice):
    """As FakeDevice, whose frames have counts.

    bend      [6] true curves;  light  of our LEDs, 1: 600 codes in the 50 us of the automatic exposure
    ambient   function t_us -> codes a microsecond that come without our light
    wander    function t_us -> (azimuth, elevation) added to where the eye looks, degrees
    zero      code of the converter at 0 V
    """

    def __init__(
        self,
        bend=(0.0,) * 6,
        light=1.0,
        ambient=lambda t_us: 0.0,
        wander=None,
        zero=0.0,
        code_noise=0.6,
        **options,
    ):
        super().__init__(noise=0.0, **options)
        self.bend, self.light, self.ambient = np.array(bend, float), light, ambient
        self.wander, self.zero, self.code_noise = wander, zero, code_noise

    def eye_deg(self, t_us):
        here = super().eye_deg(t_us)
        return here if self.wander is None else here + np.array(self.wander(t_us))

    def sense(self, signal):
        exposure = np.array(self.exposures) / 16
        rate = self.light * FULL * np.exp2((np.asarray(signal) - MIDDLE) / 4096)
        around = self.ambient(self.t_us)
        lit, unlit = (self._code((ours + around) * exposure) for ours in (rate, 0.0))
        # The device takes the stored zero where unlit codes say nothing of it.
        ours = lit - np.where(unlit < 2, unlit + np.minimum(self.zero_q2 / 4, 0), unlit)
        bend = NOMINAL + np.array(self.curves) / 1024
        charge = ours * (1 + bend * (lit + unlit) / 1024)
        with np.errstate(all="ignore"):
            feature = np.where(ours > 2, 30000 + 4096 * np.log2(charge / exposure / FULL), 0)
        counts = Counts(self.t_us, tuple(map(int, lit)), tuple(map(int, unlit)), self.exposures)
        return np.clip(np.round(feature), 0, 65535).astype(np.uint16), counts

    def _code(self, charge):
        bend = NOMINAL + self.bend
        code = (np.sqrt(1 + 4 * bend * charge / 1024) - 1) / (2 * bend / 1024)
        return np.clip(np.round(code + self.zero + self.rng.normal(0, self.code_noise, 6)), 0, 1023)
