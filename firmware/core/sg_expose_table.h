// SPDX-License-Identifier: Apache-2.0
// Made by make_tables.py; edit that.
#ifndef SG_EXPOSE_TABLE_H
#define SG_EXPOSE_TABLE_H

#include <stdint.h>

#include "sg_rom.h"

// 4096 * log2(1 + i / 64)
static const uint16_t log2_mantissa_q12[65] SG_ROM = {
    0, 92, 182, 271, 358, 445, 530, 613, 696, 778, 858, 937,
    1016, 1093, 1169, 1244, 1319, 1392, 1465, 1536, 1607, 1677, 1746, 1814,
    1882, 1949, 2015, 2080, 2145, 2208, 2272, 2334, 2396, 2457, 2518, 2578,
    2637, 2696, 2754, 2812, 2869, 2926, 2982, 3037, 3092, 3146, 3200, 3254,
    3307, 3359, 3412, 3463, 3514, 3565, 3615, 3665, 3715, 3764, 3812, 3861,
    3908, 3956, 4003, 4050, 4096,
};

// 4096 * log2(mean capacitance over a drop of 64 * i quarter codes), so that the sum is a feature
static const uint16_t log2_capacitance_q12[65] SG_ROM = {
    55330, 55338, 55345, 55353, 55361, 55369, 55377, 55385, 55393, 55402, 55410, 55419,
    55427, 55436, 55445, 55454, 55463, 55472, 55482, 55491, 55501, 55511, 55521, 55531,
    55541, 55552, 55563, 55573, 55584, 55596, 55607, 55619, 55631, 55643, 55655, 55668,
    55681, 55694, 55707, 55721, 55735, 55749, 55764, 55779, 55794, 55810, 55826, 55843,
    55860, 55878, 55896, 55915, 55934, 55954, 55975, 55997, 56019, 56042, 56067, 56092,
    56119, 56147, 56177, 56209, 56243,
};

// The charge to aim at: the feature it would have after 1 cycle. Where the window ends.
#define GOAL_Q12 98280L
#define BRIGHT_CODE_Q2 1309U  // goal * 2.1
#define DIM_CODE_Q2 3423U  // goal / 2.1

#endif
