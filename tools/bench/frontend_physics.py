# SPDX-License-Identifier: Apache-2.0
"""Laws of a sensing node and of what reads it, with the constants of tools/vheadset/physics.toml.

Charges in pC, capacitances in pF, volts, currents in nA, times in us: 1 nA for 1 us is 1e-3 pC.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

try:
    import tomllib
except ImportError:  # Python < 3.11
    import tomli as tomllib

PHYSICS = Path(__file__).resolve().parents[1] / "vheadset" / "physics.toml"
BUILT_IN_V, GRADING = 0.7, 0.4  # of the junction: comment of [node] junction_pf
SLOW_KHZ, FAST_KHZ, FAST_FACTOR = 200.0, 1000.0, 2.25  # comments of [adc]
BANDGAP_NOISE_V, BANDGAP_PART = 0.2e-3, 0.10
RAIL_V, RAIL_NOISE_V = 1.8, 0.2e-3  # our own parts: a shunt regulator and 10 uF (headset file, [board])
FORWARD_V = 1.2  # of an emitter
RIPPLE_US = 10.0  # the supply's ripple is drawn anew so often, and the light follows it
IDEALITY, THERMAL_V = 2.0, 0.02585  # forward law of the junction; its saturation current is the leakage
ELECTRON_PC = 1.602e-7
CODES = 1024
FULL_CODE = 1000  # SG_LIGHT_SATURATED_CODE


def constants():
    """physics.toml as nested namespaces: constants().adc.noise_lsb."""
    with open(PHYSICS, "rb") as file:
        sections = tomllib.load(file)
    return SimpleNamespace(**{name: SimpleNamespace(**values) for name, values in sections.items()})


P = constants()


def junction_pf(reverse_v):
    """Capacitance of the junction at a reverse voltage; forward down to -0.69 V."""
    return P.node.junction_pf / (1 + np.asarray(reverse_v) / BUILT_IN_V) ** GRADING


def junction_pc(reverse_v):
    """Its charge: the integral of junction_pf from 0."""
    power = 1 - GRADING
    scale = P.node.junction_pf * BUILT_IN_V / power
    return scale * ((1 + np.asarray(reverse_v) / BUILT_IN_V) ** power - 1)


def worse(adc_khz):
    """By how much noise and INL are larger than at 200 kHz and below."""
    return 1 + (FAST_FACTOR - 1) * np.clip((adc_khz - SLOW_KHZ) / (FAST_KHZ - SLOW_KHZ), 0, None)


def adc_noise_lsb(adc_khz):
    """RMS of a code about its mean, quantisation included."""
    return np.sqrt((P.adc.noise_lsb * worse(adc_khz)) ** 2 + 1 / 12)


def conversion_us(adc_khz):
    """Of one conversion after the first."""
    return 13e3 / adc_khz


def emission_noise(headroom_v, exposure_us):
    """RMS over mean of the light in an exposure, by the ripple on what drives the emitters' resistors."""
    draws = np.maximum(np.asarray(exposure_us, float) / RIPPLE_US, 1.0)
    return P.supply.ripple_mv * 1e-3 / headroom_v / np.sqrt(draws)


def inl_curve(rng):
    """A drawn smooth curve over 0..1 with both ends at 0 and largest magnitude 1: a function."""
    phase = 2 * np.pi * rng.random(3)

    def shape(x):
        waves = [
            np.sin(np.pi * (k + 1) * x + phase[k])
            - np.sin(phase[k])
            - x * (np.sin(np.pi * (k + 1) + phase[k]) - np.sin(phase[k]))
            for k in range(3)
        ]
        return np.sum(waves, axis=0)

    peak = np.abs(shape(np.linspace(0, 1, 65))).max()
    return lambda x: shape(np.clip(x, 0, 1)) / max(peak, 1e-3)


def bits(relative_rms):
    """Effective bits of a reading: those of an ideal converter whose full scale is the reading itself."""
    relative_rms = np.asarray(relative_rms, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = -np.log2(np.sqrt(12) * relative_rms)
    return np.where(np.isfinite(relative_rms), np.clip(found, 0, 16), 0.0)
