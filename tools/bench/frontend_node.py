# SPDX-License-Identifier: Apache-2.0
"""Circuits that make a voltage of a photocurrent, and how they are read (frontend_methods.py compares
them).

A node starts held, is let go for an exposure, and has then swung by v because of the charge q it collected:
q = F(b1) - F(b2 - v) + (Cp + Cs) v - Cs v_before (anode sensed; the cathode sensed alike, downwards),
where F is the junction's charge law, b1 and b2 the bias at release and at sample with their noise, Cs the
sample capacitor and v_before what it held.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import frontend_physics as physics
import numpy as np
from frontend_physics import P

CAPACITANCE_PART = 0.10  # spread of the capacitances, ours: physics.toml has none
NEIGHBOUR = (0.2, 1.0)  # swing of the channel before, relative to this one's
TICK_US = 1 / 16
RIPPLE_V = P.supply.ripple_mv * 1e-3


@dataclass(frozen=True)
class Method:
    """A circuit and how it is read."""

    name: str
    title: str
    bias_v: float = physics.RAIL_V
    bias_noise_v: float = physics.RAIL_NOISE_V
    cathode: bool = False  # sensed, held at the supply; else the anode, held at ground
    reference: str = "bandgap"
    before: str = (
        "subtracted"  # the sample capacitor's content: ground | subtracted (first of a pair: ground) | any
    )
    reads: int = 1
    reader: str = "adc"  # adc | bandgap (comparator) | divider (comparator)

    @property
    def headroom_v(self):
        """Over an emitter's resistor; it emits into the rail where there is one."""
        rail = physics.RAIL_V if self.bias_v == physics.RAIL_V else 0.0
        return P.supply.volts - physics.FORWARD_V - rail

    @property
    def full_v(self):
        """The reference."""
        return P.supply.volts if self.reference == "supply" else P.adc.bandgap_v

    @property
    def extra_pf(self):
        """On the node beside the junction when it is read."""
        return P.node.pin_pf + (P.node.sample_hold_pf if self.reader == "adc" else 0.0)


RAIL = Method("rail", "anode, cathode on a quiet 1.8 V rail")
METHODS = (
    Method("cathode_5v", "cathode against 5 V (the paper)", 5.0, RIPPLE_V, True, "supply"),
    Method("cathode_1v1", "cathode against 1.1 V", 5.0, RIPPLE_V, True),
    Method("anode_supply", "anode, cathode on a supply pin", 5.0, RIPPLE_V),
    Method("zero_bias", "anode, cathode grounded", 0.0, 0.0),
    RAIL,
    replace(RAIL, name="rail_ground", title="rail, ground before every channel", before="ground"),
    replace(RAIL, name="rail_any", title="rail, sample capacitor as it comes", before="any"),
    replace(RAIL, name="rail_x2", title="rail, held and read twice", reads=2),
    replace(RAIL, name="rail_x4", title="rail, held and read 4 times", reads=4),
    replace(RAIL, name="comparator_bandgap", title="rail, time to 1.1 V", reader="bandgap"),
    replace(RAIL, name="comparator_divider", title="rail, time to a divider's voltage", reader="divider"),
)


@lru_cache(maxsize=1024)
def node_of(method, junction=1.0, extra=1.0, forward_na=P.node.leakage_na):
    """The Node of these, made once."""
    return Node(method, junction, extra, forward_na)


class Node:
    """Swing against charge of one method's node, ideal or with drawn capacitances.

    junction, extra    relative capacitances: 1 is nominal;  forward_na    saturation current of the
    junction
    """

    def __init__(self, method, junction=1.0, extra=1.0, forward_na=P.node.leakage_na):
        self.method, self.junction, self.extra, self.forward_na = method, junction, extra, forward_na
        self.extra_pf = method.extra_pf * extra
        top = 0.6 if method.bias_v == 0 else min(method.bias_v + 0.2, 5.2)
        self.swing_v = np.linspace(-0.2, top, 3001)
        self.level_pc = self.charge(self.swing_v)

    def charge(self, v):
        """h(v): charge collected for a swing, noise and the sample capacitor's content apart."""
        bias = self.method.bias_v
        return self.junction * (physics.junction_pc(bias) - physics.junction_pc(bias - v)) + self.extra_pf * v

    def capacitance(self, v):
        """dq/dv at a swing."""
        return self.junction * physics.junction_pf(self.method.bias_v - v) + self.extra_pf

    def swing(self, charge_pc):
        """Inverse of charge."""
        return np.interp(charge_pc, self.level_pc, self.swing_v)

    def collected(self, current_na, exposure_us):
        """Charge after an exposure. At zero bias the junction itself carries away what it collects."""
        if self.method.bias_v > 0:
            return np.asarray(current_na * exposure_us * 1e-3)
        steps, shape = 100, np.broadcast_shapes(np.shape(current_na), np.shape(exposure_us))
        charge = np.zeros(shape)
        sampler_pf = P.node.sample_hold_pf * self.extra  # joins only at the sample
        own = self.swing_v, self.level_pc - sampler_pf * self.swing_v
        step = np.asarray(exposure_us) * 1e-3 / steps

        def flow(q):
            v = np.interp(q, own[1], own[0])
            lost = np.expm1(np.clip(v, 0, 0.6) / (physics.IDEALITY * physics.THERMAL_V))
            return current_na - self.forward_na * lost

        for _ in range(steps):  # midpoint rule, held back where the law is stiff
            half = charge + 0.5 * step * flow(charge)
            charge = np.maximum(charge + step * flow(half), 0)
        return charge


def threshold_v(method, node, total_na, exposure_us):
    """The bandgap, or a divider's voltage that this current reaches just in this time."""
    if method.reader == "bandgap":
        return P.adc.bandgap_v
    return float(min(node.swing(total_na * exposure_us * 1e-3), P.adc.bandgap_v))


def threshold_noise_v(method, at):
    return (
        physics.BANDGAP_NOISE_V if method.reader == "bandgap" else physics.RAIL_NOISE_V / physics.RAIL_V * at
    )


def readable(method, node, total_na, exposure_us):
    """Whether the reading is within the range of what reads it."""
    charge = node.collected(total_na, exposure_us)
    v = float(node.swing(charge))
    if method.reader != "adc":
        at = threshold_v(method, node, total_na, exposure_us)
        return bool(charge * (1 + 1e-9) >= node.charge(at) and at > 5 * P.comparator.noise_mv * 1e-3)
    if method.bias_v == 0:  # above, the junction carries away as much as it collects
        return v < 0.25
    code = (method.bias_v - v if method.cathode else v) / method.full_v * physics.CODES
    return bool(
        (0.02 * physics.CODES if method.cathode else 0) <= code < physics.FULL_CODE
        or (method.reference == "supply" and code >= physics.FULL_CODE)
    )


def slope(node, exposure_us, total_na):
    """dq/dI at zero bias, pC/nA."""
    step = 0.01 * total_na
    two = [node.collected(total_na + sign * step, exposure_us) for sign in (-1.0, 1.0)]
    return float((two[1] - two[0]) / (2 * step))
