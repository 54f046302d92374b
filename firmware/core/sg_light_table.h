// SPDX-License-Identifier: Apache-2.0
// Made by make_tables.py; edit that.
#ifndef SG_LIGHT_TABLE_H
#define SG_LIGHT_TABLE_H

// Feature of 1/32 code collected in 1 cycle.
#define UNIT_Q12 35078L

// Curvature of sg_light_loop.c, Q0.16: 2 k1; the same and half a step of x in 3 k2 x; a step of that;
// k2 over 256, as a power of two.
#define TWICE_K1_Q16 5995
#define SG_LIGHT_SLOPE_Q16 6001
#define SG_LIGHT_CUBIC 12
#define SG_LIGHT_SQUARE_SHIFT 2

// Share of the sample capacitor in the capacitance at rest, Q0.16.
#define SHARE_Q16 20834

// Weights of earlier unlit codes by period, nearest of every 2048 cycles from 15984 on: b
// and -c of sg_light.h, Q0.8.
#define PERIOD_FROM 15984U
#define PERIOD_BITS 11
#define PERIOD_NODES 9
#define BEFORE_Q8 { 77, 74, 74, 74, 73, 71, 70, 70, 67 }
#define EARLIER_MINUS_Q8 { 20, 19, 20, 21, 22, 22, 23, 25, 25 }

#endif
