// SPDX-License-Identifier: GPL-3.0-or-later
#include "charge.h"

#include <math.h>

const double CHARGE_CEILING_VOLTS = 0.25;
static const double BUILT_IN_VOLTS = 0.7, GRADING = 0.4;

double charge_pc(struct charge_node n, double volts)
{
    double power = 1 - GRADING, scale = n.junction_pf * BUILT_IN_VOLTS / power;
    if (n.junction_pf == 0)
        return n.fixed_pf * volts;
    return n.fixed_pf * volts - scale * pow(1 + (n.rail_volts - volts) / BUILT_IN_VOLTS, power);
}

double charge_pf(struct charge_node n, double volts)
{
    return n.fixed_pf + n.junction_pf / pow(1 + (n.rail_volts - volts) / BUILT_IN_VOLTS, GRADING);
}

double charge_ceiling_pc(struct charge_node n)
{
    return n.junction_pf > 0 ? charge_pc(n, n.rail_volts + CHARGE_CEILING_VOLTS) : INFINITY;
}

double charge_volts(struct charge_node n, double wanted_pc)
{
    if (n.junction_pf == 0)
        return n.fixed_pf > 0 ? wanted_pc / n.fixed_pf : 0;
    double ceiling = n.rail_volts + CHARGE_CEILING_VOLTS, volts = 0;
    if (wanted_pc >= charge_ceiling_pc(n))
        return ceiling;
    for (int i = 0; i < 40; i++) {
        double step = (charge_pc(n, volts) - wanted_pc) / charge_pf(n, volts);
        volts = fmin(volts - step, ceiling);
        if (fabs(step) < 1e-12)
            break;
    }
    return volts;
}
