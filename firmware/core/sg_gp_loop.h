// SPDX-License-Identifier: Apache-2.0
// The inner loops of sg_gp. Two twins with identical bits: sg_gp_loop.c, portable, and sg_gp_avr.S. Both may
// be given to the compiler: on AVR the C twin is empty, or with SG_GP_PORTABLE defined the assembly is.
#ifndef SG_GP_LOOP_H
#define SG_GP_LOOP_H

#include <stddef.h>
#include <stdint.h>

// 2^16 exp(-(i / 128)) for i = T >> 9, Q0.16; zeros from 1420 on. See make_tables.py.
enum { SG_GP_EXP_ENTRIES = 1664 };
extern const uint16_t sg_gp_exp_table[SG_GP_EXP_ENTRIES];

struct sg_gp_sum {
    uint32_t acc[2];    // azimuth and elevation; sg_gp_trend: Q.(weight_frac_bits + 12), sg_gp_loop: 24 bits
    uint32_t s2;        // (sum s^2 + 31) >> 5
    uint16_t s_u8q4[6]; // 0..4095
};

// The assembly knows these places.
_Static_assert(offsetof(struct sg_gp_sum, s2) == 8 && offsetof(struct sg_gp_sum, s_u8q4) == 12, "sum layout");

// sum->s2 from sum->s_u8q4.
void sg_gp_square(struct sg_gp_sum *sum);

// sum->acc = (sum->acc + trend * s) >> 4, to 24 bits: the upper 8 are of no meaning.
//   trend: int16[2][6] as stored, in `space`
void sg_gp_trend(struct sg_gp_sum *sum, const uint8_t *trend, uint8_t space);

// Returns row * s >> 8, below 2^14 in magnitude.   row: int8[6] as stored, in `space`
int16_t sg_gp_project(const struct sg_gp_sum *sum, const uint8_t *row, uint8_t space);

// sum->acc += weight_i * k_i over n records, modulo 2^24; the upper 8 bits of acc are of no meaning.
//
//   record    n records of 12 bytes (sg_model.h), in `space` (sg_rom.h)
//   n         1..255
void sg_gp_loop(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space);

#endif
