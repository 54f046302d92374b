// SPDX-License-Identifier: Apache-2.0
// Made by make_tables.py; edit that.
#ifndef SG_LIGHT_TABLE_H
#define SG_LIGHT_TABLE_H

#include <stdint.h>

#include "sg_rom.h"

// Feature of 1/32 code collected in 1 cycle.
#define UNIT_Q12 34767L

// Curvature of sg_light_loop.c, Q0.16: 2 k1; the same and half a step of x in 3 k2 x; 4 steps of that.
#define TWICE_K1_Q16 4578
#define SG_LIGHT_SLOPE_Q16 4581
#define SG_LIGHT_CUBIC 25

// Share of the sample capacitor in the capacitance at rest, Q0.16.
#define SHARE_Q16 21961

// Weights of earlier unlit codes by period, every 2048 cycles from 15984 on: b and
// -c of sg_light.h, Q0.16.
enum { PERIOD_FROM = 15984, PERIOD_BITS = 11, PERIOD_MOST = 32367 };
static const uint16_t before_q16[9] SG_ROM = {
    19465, 19310, 19135, 18939, 18723, 18485, 18224, 17941, 17634,
};
static const uint16_t earlier_minus_q16[9] SG_ROM = {
    4961, 5082, 5222, 5383, 5568, 5780, 6021, 6297, 6612,
};

#endif
