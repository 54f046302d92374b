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

// 4096 * log2(mean capacitance over a drop of 16 * i codes), so that the sum is a feature
static const uint16_t log2_capacitance_q12[65] SG_ROM = {
    63522, 63530, 63537, 63545, 63553, 63561, 63569, 63577, 63585, 63594, 63602, 63611,
    63619, 63628, 63637, 63646, 63655, 63664, 63674, 63683, 63693, 63703, 63713, 63723,
    63733, 63744, 63755, 63765, 63776, 63788, 63799, 63811, 63823, 63835, 63847, 63860,
    63873, 63886, 63899, 63913, 63927, 63941, 63956, 63971, 63986, 64002, 64018, 64035,
    64052, 64070, 64088, 64107, 64126, 64146, 64167, 64189, 64211, 64234, 64259, 64284,
    64311, 64339, 64369, 64401, 64435,
};

// The charge to aim at: the feature it would have after 1 cycle. Where the window ends.
#define GOAL_Q12 100221L
#define BRIGHT_CODE 100U  // goal * 2.1
#define DIM_CODE 792U  // goal / 2.1

#endif
