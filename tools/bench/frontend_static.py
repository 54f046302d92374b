# SPDX-License-Identifier: Apache-2.0
"""Static error of a reading over drawn parts: as it comes, and after self-calibration
(frontend_methods.py)."""

from functools import lru_cache
from types import SimpleNamespace

import frontend_physics as physics
import numpy as np
from frontend_node import CAPACITANCE_PART, NEIGHBOUR, TICK_US, node_of, threshold_v
from frontend_physics import P

PARTS = 24
EXPOSURE_STEPS = np.linspace(0.25, 1.0, 7)


def draw(rng):
    """One board's parts: junction and extra capacitance, offset, gain, INL, bandgap, comparator,
    leakage."""
    return SimpleNamespace(
        junction=1 + CAPACITANCE_PART * rng.standard_normal(),
        extra=1 + CAPACITANCE_PART * rng.standard_normal(),
        offset_lsb=P.adc.offset_lsb * rng.choice([-1, 1]),
        gain=1 + P.adc.gain_error * rng.choice([-1, 1]),
        bandgap=1 + physics.BANDGAP_PART * (2 * rng.random() - 1),
        threshold_v=P.comparator.offset_mv * 1e-3 * rng.choice([-1, 1]),
        forward_na=P.node.leakage_na * np.exp(0.8326 * rng.standard_normal() - 0.3466),
        inl=physics.inl_curve(rng),
        seed=rng.integers(2**31),
    )


@lru_cache(maxsize=4)
def boards(seed, parts=PARTS):
    """Drawn parts of so many boards."""
    rng = np.random.default_rng(seed)
    return [draw(rng) for _ in range(parts)]


def error(method, adc_khz, exposure_us, photocurrent_na, ambient_na, seed):
    """(raw, after): relative RMS over parts. after is nan where too few exposures of the range can be
    read."""
    found = [
        one_part(method, adc_khz, exposure_us, photocurrent_na, ambient_na, part) for part in boards(seed)
    ]
    raw, after = np.array(found).T
    enough = np.isfinite(after).mean() > 0.5
    return _rms(raw), _rms(after) if enough else np.nan


def _rms(values):
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else np.nan


def one_part(method, adc_khz, exposure_us, photocurrent_na, ambient_na, part):
    """(raw, after) of one board, without noise."""
    nominal = node_of(method)
    real = node_of(method, part.junction, part.extra, part.forward_na)
    if method.reader != "adc":
        total = photocurrent_na + ambient_na
        at = threshold_v(method, nominal, total, exposure_us)
        delay = P.comparator.delay_ns * 1e-3
        scale = part.bandgap if method.reader == "bandgap" else 1.0

        def timed(na):
            return real.charge(at * scale + part.threshold_v) / (na * 1e-3) + delay

        raw = nominal.charge(at) / timed(total) * 1e3
        dark = nominal.charge(at) / timed(ambient_na) * 1e3 if ambient_na else 0.0
        # One threshold is one charge: nothing is left but the delay, known to a tick.
        after = total * 1e-3 / nominal.charge(at) * TICK_US / np.sqrt(12) * total / photocurrent_na
        return (raw - dark) / photocurrent_na - 1, after
    rng = np.random.default_rng(part.seed)
    t = exposure_us * EXPOSURE_STEPS
    (lit, lit_q), (dark, dark_q) = (
        reading(method, adc_khz, nominal, real, real.collected(na, t), part, rng)
        for na in (photocurrent_na + ambient_na, ambient_na)
    )
    charge, known = photocurrent_na * t * 1e-3, np.isfinite(lit)
    if not known.any():
        return np.nan, np.nan
    raw = ((lit_q - dark_q) / charge - 1)[known][-1]
    if known.sum() < 4:
        return raw, np.nan
    return raw, _residual(lit[known], dark[known], charge[known], method.name == "cathode_1v1")


def reading(method, adc_khz, nominal, real, charge_pc, part, rng):
    """(codes, counted upwards from no charge; charges by the nominal law) of charges [n]; nan out of
    range."""
    cs = P.node.sample_hold_pf
    own = real.swing(charge_pc)
    held_v = np.zeros_like(own) if method.before == "ground" else rng.uniform(*NEIGHBOUR, own.shape) * own
    v = real.swing(charge_pc + cs * part.extra * held_v)
    full = method.full_v * (part.bandgap if method.reference == "bandgap" else 1.0)
    read_v = method.bias_v - v if method.cathode else v
    offset = part.offset_lsb + P.adc.inl_lsb * physics.worse(adc_khz) * part.inl(read_v / full)
    code = read_v / full * physics.CODES * part.gain + offset
    if method.reference == "bandgap":
        code = np.where(code >= physics.CODES - 1, np.nan, code)
    read = code / physics.CODES * method.full_v
    q = nominal.charge(method.bias_v - read if method.cathode else read)
    up = physics.CODES - code if method.cathode else code
    if method.before == "subtracted":  # as the firmware does: by the nominal share, from the code
        q = q - cs * held_v
        up = up - cs / nominal.capacitance(own) * held_v / full * physics.CODES
    return up, q


def _residual(lit, dark, charge, constant):
    """Relative RMS about the best gain and curvature, which is what self-calibration finds."""
    dark = np.where(np.isfinite(dark), dark, 0.0)
    rows = [lit - dark, lit**2 - dark**2] if not constant else [np.ones_like(lit), lit, lit**2]
    a = np.stack(rows, axis=1) / charge[:, None]
    a = a / np.abs(a).max(axis=0)
    found, *_ = np.linalg.lstsq(a, np.ones(len(lit)), rcond=None)
    return float(np.sqrt(np.mean((a @ found - 1) ** 2)))
