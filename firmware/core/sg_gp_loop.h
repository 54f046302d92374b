// SPDX-License-Identifier: Apache-2.0
// The inner loops of sg_gp. Two twins with identical bits: sg_gp_loop.c, portable, and sg_gp_avr.S. Both may
// be given to the compiler: on AVR the C twin is empty, or with SG_GP_PORTABLE defined the assembly is.
#ifndef SG_GP_LOOP_H
#define SG_GP_LOOP_H

#include <stddef.h>
#include <stdint.h>

// exp(-T / (16 u^2)) over T >> 10 as 1024 pairs (drop to the next level Q10.6, level Q0.16); see
// make_tables.py.
extern const uint16_t sg_gp_exp_table[2048];

struct sg_gp_sum {
    uint32_t acc[2];    // azimuth and elevation, Q.(weight_frac_bits + 16), modulo 2^32
    uint32_t s2;        // (sum s^2) >> 5
    uint16_t s_u8q4[6]; // 0..4095
};

// The assembly knows these places.
_Static_assert(offsetof(struct sg_gp_sum, s2) == 8 && offsetof(struct sg_gp_sum, s_u8q4) == 12, "sum layout");

// sum->acc += trend * s.   trend: int32[2][6] as stored, in `space`
void sg_gp_trend(struct sg_gp_sum *sum, const uint8_t *trend, uint8_t space);

// Returns row * s.   row: int8[6] as stored, in `space`. Below 2^22 in magnitude.
int32_t sg_gp_project(const struct sg_gp_sum *sum, const uint8_t *row, uint8_t space);

// sum->acc += weight_i * k_i over n records.
//
//   record    n records of 13 bytes (sg_model.h), in `space` (sg_rom.h)
//   n         1..255
//
// Cost   AVR assembly: 195 cycles per record from flash, 183 from memory.
void sg_gp_loop(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space);

#endif
