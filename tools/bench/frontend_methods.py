# SPDX-License-Identifier: Apache-2.0
"""Ways to read a photocurrent off an LED, compared: random noise and static error against exposure time.

Each reading is lit minus unlit over the exposure; in the dark the unlit one is averaged over UNLIT_MEAN
frames, in ambient light it is the newest alone. Random noise is drawn (monte_carlo) and computed
(closed_form); static error is the spread over drawn parts (frontend_static.py), as they come (`raw`: gain,
offset, bandgap, capacitance, crosstalk) and after self-calibration, which learns gain and curvature of
each channel, while the exposure ranges over a quarter of itself to itself.
"""

import frontend_physics as physics
import frontend_static
import numpy as np
from frontend_node import METHODS, RIPPLE_V, TICK_US, node_of, readable, slope, threshold_noise_v, threshold_v
from frontend_physics import P

EXPOSURES_US = (4, 8, 16, 32, 64, 103, 131, 159, 220, 300, 400, 600)
CLOCKS_KHZ = (125, 250, 500, 1000)
LIGHTS = ((200, 0), (75, 0), (600, 0), (200, 2000))  # photocurrent, ambient: nA
CHOSEN = ("rail", 250, 131)  # and the mean of its two longest exposures at 1 kHz
UNLIT_MEAN = 16
MARGIN_US, RESET_US = 7.5, 5.0  # events between two slots; holding a node between two comparator readings
FRAME_US, PHASES, PAIR, CHANNELS = 1000.0, 3, 2, 6
SERVICE_US = 3.0  # from the end of a conversion to the trigger of the next


def monte_carlo(method, adc_khz, exposure_us, photocurrent_na, ambient_na, rng, n=4000):
    """Relative RMS of n drawn readings of an ideal part about their mean; nan where it cannot be read."""
    node = node_of(method)
    unlit = 1 if ambient_na else UNLIT_MEAN
    lit_na = photocurrent_na + ambient_na
    lit_q = node.collected(lit_na, exposure_us)
    unlit_q = node.collected(ambient_na, exposure_us)
    if not readable(method, node, photocurrent_na + ambient_na, exposure_us):
        return np.nan
    if method.reader != "adc":
        return _drawn_crossings(method, node, exposure_us, photocurrent_na, ambient_na, rng, n)
    bright = physics.emission_noise(method.headroom_v, exposure_us) * rng.standard_normal((1, n))
    more = (
        photocurrent_na
        * bright
        * (slope(node, exposure_us, lit_na) if method.bias_v == 0 else exposure_us * 1e-3)
    )
    lit = _drawn_charge(method, node, adc_khz, lit_q + more, rng, (1, n))
    dark = (
        np.zeros((1, 1))
        if method.name == "cathode_1v1"
        else _drawn_charge(method, node, adc_khz, unlit_q, rng, (unlit, n))
    )
    found = lit.mean(0) - np.mean(dark, axis=0)
    if method.bias_v == 0:  # through the forward law: by the slope of charge over current
        found = found / slope(node, exposure_us, photocurrent_na + ambient_na)
        return float(found.std() / photocurrent_na)
    return float(found.std() / (photocurrent_na * exposure_us * 1e-3))


def _drawn_charge(method, node, adc_khz, charge_pc, rng, shape):
    """Charges read in `shape` exposures that collected charge_pc."""
    cs = P.node.sample_hold_pf
    first, second = method.bias_noise_v * rng.standard_normal((2, *shape))
    charge = charge_pc + np.sqrt(physics.ELECTRON_PC * np.maximum(charge_pc, 0)) * rng.standard_normal(shape)
    bias = method.bias_v
    if method.cathode:
        moved = physics.junction_pc(bias + first) - physics.junction_pc(bias) + P.node.pin_pf * first
        v = node.swing(charge - moved - cs * RIPPLE_V * rng.standard_normal(shape))
        read_v = bias - v
    else:
        # -F(b2 - v) + C v = q - F(b1): with w = v - (b2 - b) the law of quiet bias, moved by C (b2 - b).
        moved = physics.junction_pc(bias + first) - physics.junction_pc(bias)
        v = node.swing(charge - moved - node.extra_pf * second) + second
        read_v = v
    held = 0.0
    if method.before == "subtracted":  # its code is known but for the converter's noise
        held = physics.adc_noise_lsb(adc_khz) * method.full_v / physics.CODES * rng.standard_normal(shape)
    codes = []
    for _ in range(method.reads):
        noise = RIPPLE_V if method.reference == "supply" else physics.BANDGAP_NOISE_V
        full = method.full_v + noise * rng.standard_normal(shape)
        lsb = P.adc.noise_lsb * physics.worse(adc_khz) * rng.standard_normal(shape)
        codes.append(np.floor(read_v / full * physics.CODES + lsb + 0.5))
    read = np.mean(codes, axis=0) * method.full_v / physics.CODES
    return node.charge(bias - read if method.cathode else read) - cs * held


def _drawn_crossings(method, node, exposure_us, photocurrent_na, ambient_na, rng, n):
    """The same by time to threshold, in whole ticks."""
    at = threshold_v(method, node, photocurrent_na + ambient_na, exposure_us)

    light = physics.emission_noise(method.headroom_v, node.charge(at) / (photocurrent_na + ambient_na) * 1e3)

    def current(na, mean):
        noise = np.hypot(P.comparator.noise_mv * 1e-3, threshold_noise_v(method, at))
        v = at + noise * rng.standard_normal((mean, n))
        e1, e2 = method.bias_noise_v * rng.standard_normal((2, mean, n))
        charge = node.charge(v - e2) + node.extra_pf * e2 + physics.junction_pf(method.bias_v) * e1
        phase = rng.random((mean, n))
        ticks = np.floor(charge / (na * 1e-3) / TICK_US + phase) - phase + 0.5
        return node.charge(at) / (ticks * TICK_US) * 1e3

    bright = photocurrent_na * (1 + light * rng.standard_normal((1, n)))
    lit = current(bright + ambient_na, 1).mean(0)
    dark = current(ambient_na, 1).mean(0) if ambient_na else 0.0
    return float((lit - dark).std() / photocurrent_na)


def closed_form(method, adc_khz, exposure_us, photocurrent_na, ambient_na):
    """The same, by propagation of every source of noise to first order."""
    node = node_of(method)
    total = photocurrent_na + ambient_na
    if not readable(method, node, total, exposure_us):
        return np.nan
    if method.reader != "adc":
        return _closed_crossings(method, node, exposure_us, photocurrent_na, ambient_na)
    unlit = 1 if ambient_na else UNLIT_MEAN
    lit = charge_noise(method, node, adc_khz, node.collected(total, exposure_us))
    dark = charge_noise(method, node, adc_khz, node.collected(ambient_na, exposure_us)) / np.sqrt(unlit)
    noise = np.hypot(lit, 0 if method.name == "cathode_1v1" else dark)
    light = physics.emission_noise(method.headroom_v, exposure_us)
    if method.bias_v == 0:
        return float(np.hypot(noise / slope(node, exposure_us, total) / photocurrent_na, light))
    return float(np.hypot(noise / (photocurrent_na * exposure_us * 1e-3), light))


def charge_noise(method, node, adc_khz, charge_pc):
    """RMS of one read charge, pC."""
    v = node.swing(charge_pc)
    read_v = method.bias_v - v if method.cathode else v
    c, cs = node.capacitance(v), P.node.sample_hold_pf
    lsb_v = method.full_v / physics.CODES
    reference = RIPPLE_V if method.reference == "supply" else physics.BANDGAP_NOISE_V
    read = np.hypot(physics.adc_noise_lsb(adc_khz) * lsb_v, read_v / method.full_v * reference)
    parts = [c * read / np.sqrt(method.reads), np.sqrt(physics.ELECTRON_PC * np.maximum(charge_pc, 0))]
    if method.cathode:
        parts += [(physics.junction_pf(method.bias_v) + P.node.pin_pf) * RIPPLE_V, cs * RIPPLE_V]
    else:
        for reverse_v in (method.bias_v, method.bias_v - v):
            parts.append(physics.junction_pf(reverse_v) * method.bias_noise_v)
    if method.before == "subtracted":
        parts.append(cs * physics.adc_noise_lsb(adc_khz) * lsb_v)
    return np.sqrt(sum(np.square(part) for part in parts))


def _closed_crossings(method, node, exposure_us, photocurrent_na, ambient_na):
    at = threshold_v(method, node, photocurrent_na + ambient_na, exposure_us)
    q, c = node.charge(at), node.capacitance(at)
    volts = np.hypot(P.comparator.noise_mv * 1e-3, threshold_noise_v(method, at))
    coupled = [physics.junction_pf(b) * method.bias_noise_v for b in (method.bias_v, method.bias_v - at)]

    def noise_na(na):
        tick = TICK_US / np.sqrt(12) * na * 1e-3
        return na * np.sqrt((c * volts) ** 2 + np.sum(np.square(coupled)) + tick**2) / q

    lit, dark = noise_na(photocurrent_na + ambient_na), noise_na(ambient_na) if ambient_na else 0.0
    light = physics.emission_noise(method.headroom_v, q / (photocurrent_na + ambient_na) * 1e3)
    return float(np.hypot(np.hypot(lit, dark) / photocurrent_na, light))


def longest_us(method, adc_khz):
    """Longest exposures (first and second of a pair) with which six channels, lit and unlit, make 1000
    frames/s.

    (0, 0): not at this clock. A slot is one conversion; read once, a channel is exposed while others
    convert. Held and read several times, nothing may shine meanwhile; a comparator serves one channel at a
    time.
    """
    if method.reader != "adc":
        alone = FRAME_US / (2 * CHANNELS) - RESET_US
        return alone, alone
    ground = {"ground": PAIR, "subtracted": 1, "any": 0}[method.before]
    least = physics.conversion_us(adc_khz) + SERVICE_US
    slots = PAIR * method.reads + ground
    if method.reads > 1:
        alone = max(FRAME_US / (2 * PHASES) - slots * least - MARGIN_US, 0.0)
        return alone, alone
    slot = FRAME_US / (2 * PHASES * slots)
    if slot < least:
        return 0.0, 0.0
    return slot * (1 + min(ground, 1)) - MARGIN_US, slot * slots - MARGIN_US


def table(draws=1000, seed=5):
    """The rows of `bits`: every method, clock, exposure and light.

    random_bits by closed form and drawn_bits by Monte Carlo (None: out of range); static_bits after
    self-calibration, static_raw_bits before; feasible_at_1khz: with this exposure as the pair's mean.
    """
    rows = []
    for method in METHODS:
        for adc_khz in CLOCKS_KHZ if method.reader == "adc" else (0,):
            most = np.mean(longest_us(method, adc_khz))
            for photocurrent_na, ambient_na in LIGHTS:
                for exposure_us in EXPOSURES_US:
                    at = method, adc_khz, exposure_us, photocurrent_na, ambient_na
                    closed = closed_form(*at)
                    row = {
                        "method": method.name,
                        "adc_khz": adc_khz,
                        "exposure_us": exposure_us,
                        "photocurrent_na": photocurrent_na,
                        "ambient_na": ambient_na,
                        "random_bits": None,
                        "drawn_bits": None,
                        "static_bits": None,
                        "static_raw_bits": None,
                        "feasible_at_1khz": bool(exposure_us <= most and np.isfinite(closed)),
                        "chosen": (method.name, adc_khz, exposure_us) == CHOSEN,
                    }
                    if np.isfinite(closed):
                        rng = np.random.default_rng([seed, len(rows)])
                        raw, after = frontend_static.error(*at, seed)
                        row["random_bits"] = _number(closed)
                        row["drawn_bits"] = _number(monte_carlo(*at, rng, draws))
                        row["static_bits"], row["static_raw_bits"] = _number(after), _number(raw)
                    rows.append(row)
    return rows


def _number(relative_rms):
    return round(float(physics.bits(relative_rms)), 3) if np.isfinite(relative_rms) else None
