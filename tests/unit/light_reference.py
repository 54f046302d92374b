# SPDX-License-Identifier: Apache-2.0
"""The sensing chain in float64, independent of the core: photocurrents to ADC codes, codes to photocurrents.

The charge balance is that of physics.toml's node on a rail of 1.8 V, in closed form; nothing here is a
polynomial. Currents in nA, charges in pC, exposures in timer cycles of 1/16 us, codes of 1.1 V / 1024.
"""
import numpy as np

from sparsegaze._core import ffi, lib

RAIL_V, REFERENCE_V = 1.8, 1.1
LIT_RAIL_V = RAIL_V + 0.3 * 4 * 0.020   # four emitters of 20 mA lift it
JUNCTION_PF, JUNCTION_V, POWER = 40.0, 0.7, 0.4
PIN_PF, SAMPLE_PF = 6.0, 14.0
UNIT_NA = 0.0625
PAIRS = {lib.SG_WIRING_LEDS: ((5, 0), (1, 4), (2, 3)), lib.SG_WIRING_PHOTODIODES: ((0, 3), (1, 4), (2, 5))}
# One random error of a code at an ADC clock of 250 kHz: physics.toml's 0.7 at 200 kHz, growing to 2.25 times
# at 1 MHz.
NOISE_LSB = 0.7 * (1 + 1.25 * 50 / 800)
SLOTS, LIT_TO_UNLIT_SLOTS = 18, 3
CLOCK_HZ = 16e6
GAUSS = np.polynomial.legendre.leggauss(5)[::-1]
SUN_NA, ROOM_NA, BRIGHT_ROOM_NA = 2000.0, 20.0, 200.0
CAPS = (1656, 2544)                     # longest exposures at the shortest period: first and second of a pair


def junction_pc(volts, rail=RAIL_V):
    """Charge that lifts the junction from 0 V, pC."""
    def at(reverse):
        return JUNCTION_PF * JUNCTION_V / (1 - POWER) * (1 + reverse / JUNCTION_V) ** (1 - POWER)
    return at(rail) - at(rail - volts)


def node_pc(code, before=0.0, rail=RAIL_V):
    """Charge collected by a node that reads `code` when the sample capacitor came from `before`, pC."""
    volts = REFERENCE_V * np.asarray(code, float) / 1024
    brought = SAMPLE_PF * REFERENCE_V * np.asarray(before, float) / 1024
    return junction_pc(volts, rail) + (PIN_PF + SAMPLE_PF) * volts - brought


_CODES = np.linspace(-300, 1900, 22001)
_CHARGE = {rail: node_pc(_CODES, 0.0, rail) for rail in (RAIL_V, LIT_RAIL_V)}


def read(charge_pc, before=0.0, rail=RAIL_V):
    """The code, unrounded, of a collected charge; the inverse of node_pc (error below 1e-5 of a code)."""
    return np.interp(charge_pc + SAMPLE_PF * REFERENCE_V * before / 1024, _CHARGE[rail], _CODES)


def collected_pc(current_na, cycles):
    """nA over timer cycles, pC."""
    return np.asarray(current_na, float) * np.asarray(cycles, float) / CLOCK_HZ * 1e3


def true_feature(current_na):
    """4096 log2(I / 62.5 pA)."""
    return 4096 * np.log2(np.asarray(current_na, float) / UNIT_NA)


def feature_noise(signal_na, lit_code, unlit_share, cycles, neighbour=False, repeats=1):
    """Standard deviation of a feature from the codes' random errors, analytic.

    unlit_share: variance of the unlit code meant over that of one code: 1 alone, 1/31 at rest,
    0.68 interpolated.
    neighbour: the second of a pair carries its share of the first one's errors too."""
    noise = np.sqrt(NOISE_LSB ** 2 + 1 / 12)
    slope_pc = (node_pc(lit_code + 0.5) - node_pc(lit_code - 0.5))
    variance = 1 + unlit_share
    if neighbour:
        variance *= 1 + (SAMPLE_PF * REFERENCE_V / 1024 / slope_pc) ** 2
    return 4096 / np.log(2) * noise * slope_pc * np.sqrt(variance / repeats) / collected_pc(signal_na, cycles)


class Board:
    """Six sensors, an ADC, and light as a function of time: makes struct sg_reading cycle by cycle.

    signal_na   [6] or function(cycle number) -> [6]: our light
    ambient_na  [6] or function(seconds) -> [6]
    noise_lsb, offset_lsb   of the ADC
    """

    def __init__(self, signal_na, ambient_na=0.0, exposure=None, wiring=lib.SG_WIRING_LEDS, period=15984,
                 noise_lsb=0.0, offset_lsb=0.0, seed=1):
        self.signal, self.ambient, self.wiring, self.period = signal_na, ambient_na, wiring, period
        self.noise_lsb, self.offset_lsb = noise_lsb, offset_lsb
        self.rng, self.k, self.start = np.random.default_rng(seed), 0, 0.0
        self.exposure = np.zeros(6, int)
        for first, second in PAIRS[wiring]:
            self.exposure[[first, second]] = CAPS
        if exposure is not None:
            self.exposure = np.broadcast_to(np.asarray(exposure), 6).astype(int).copy()

    def _ambient_pc(self, end_s, cycles):
        """Ambient charge of exposures that end at end_s, both arrays of 6: five-point Gauss rule."""
        if not callable(self.ambient):
            return np.broadcast_to(np.asarray(self.ambient, float), 6) * cycles / CLOCK_HZ * 1e3
        length = cycles / CLOCK_HZ
        total = np.zeros(6)
        for weight, node in zip(*GAUSS):
            times = end_s + (node - 1) * length / 2
            total += weight / 2 * np.array([self.ambient(times[i])[i] for i in range(6)])
        return total * length * 1e3

    def _seen(self, volts_code):
        seen = volts_code + self.offset_lsb + self.noise_lsb * self.rng.standard_normal(3)
        return np.clip(np.floor(seen + 0.5), 0, 1023).astype(int)

    def cycle(self, late_lit=0, late_unlit=0, held=0, gap_cycles=0):
        """One struct sg_reading; late_*: cycles per channel by which the releases came late."""
        late_lit, late_unlit = (np.broadcast_to(np.asarray(x), 6) for x in (late_lit, late_unlit))
        signal = self.signal(self.k) if callable(self.signal) else self.signal
        signal = np.broadcast_to(np.asarray(signal, float), 6)
        slot = self.period / SLOTS / CLOCK_HZ
        first, second = np.array(PAIRS[self.wiring]).T
        place = np.zeros(6)
        place[first], place[second] = 6 * np.arange(3) + 1, 6 * np.arange(3) + 2
        codes = {}
        for kind, late, lag in (("lit", late_lit, 0), ("unlit", late_unlit, LIT_TO_UNLIT_SLOTS)):
            cycles = self.exposure - late
            charge = self._ambient_pc(self.start + slot * (place + lag), cycles)
            rail = RAIL_V
            if kind == "lit":
                charge = charge + collected_pc(signal, cycles)
                rail = LIT_RAIL_V if self.wiring == lib.SG_WIRING_LEDS else RAIL_V
            before = np.array([held if kind == "lit" else 0, 0, 0])
            volts = read(charge[first], before, rail)
            codes[kind] = np.zeros(6, int)
            codes[kind][first] = self._seen(volts)
            codes[kind][second] = self._seen(read(charge[second], volts, rail))
        out = ffi.new("struct sg_reading *", {
            "lit_code": codes["lit"].tolist(), "unlit_code": codes["unlit"].tolist(), "held_code": held,
            "exposure_cycles": self.exposure.tolist(), "late_lit_cycles": np.minimum(late_lit, 255).tolist(),
            "late_unlit_cycles": np.minimum(late_unlit, 255).tolist()})
        self.k += 1
        self.start += (self.period + gap_cycles) / CLOCK_HZ
        return out


class Light:
    """struct sg_light of the core."""

    def __init__(self, board=None, wiring=lib.SG_WIRING_LEDS, period=15984, curve=None, zero_q2=0):
        self.state = ffi.new("struct sg_light *")
        lib.sg_light_start(self.state, board.wiring if board else wiring, board.period if board else period)
        lib.sg_light_curve(self.state, curve or [0] * 6, zero_q2)
        self.feature = ffi.new("uint16_t[6]")

    def frame(self, *readings):
        """(features [6] int, flags) of the frame made of these cycles."""
        for reading in readings:
            lib.sg_light_add(self.state, reading)
        flags = lib.sg_light_features(self.state, self.feature)
        return np.array(list(self.feature)), flags

    def run(self, board, frames, repeats=1, **kwargs):
        """Features [frames, 6] and flags [frames]."""
        rows = [self.frame(*(board.cycle(**kwargs) for _ in range(repeats))) for _ in range(frames)]
        return np.array([f for f, _ in rows]), np.array([g for _, g in rows])


def settle(board, light, cycles=60):
    """Run past the first averages."""
    light.run(board, cycles)
