// SPDX-License-Identifier: GPL-3.0-or-later
// Charge on the anode of a reverse-biased junction whose cathode is at the rail.
//
//   q(V) = fixed_pf V - F(rail - V),   F(r) = C0 0.7/0.6 (1 + r/0.7)^0.6  [pC, V, pF]
//
// F is the integral of C0 / (1 + r/0.7)^0.4. The anode starts at V = 0 and rises; what has been collected is
// q(V) - q(0). q depends on the rail: with a charge that stays, a rail that moves takes the node along by the
// share of the junction in the whole capacitance.
#ifndef CHARGE_H
#define CHARGE_H

struct charge_node {
    double junction_pf;  // C0, at zero bias; 0 = no junction there
    double fixed_pf;     // pin, and sampler while joined
    double rail_volts;
};

// Illuminated, the junction stops at a forward voltage: where there is one, V is never above the rail plus
// this.
extern const double CHARGE_CEILING_VOLTS;

// volts <= rail_volts + CHARGE_CEILING_VOLTS where there is a junction.
double charge_pc(struct charge_node node, double volts);
// At the ceiling; infinite without a junction.
double charge_ceiling_pc(struct charge_node node);
// Its inverse, to 1e-12 V, by Newton's method; the ceiling for a charge above that of the ceiling.
double charge_volts(struct charge_node node, double charge_pc);
// dq/dV.
double charge_pf(struct charge_node node, double volts);

#endif
