// SPDX-License-Identifier: Apache-2.0
// The inner loop of sg_gp. Two twins with identical bits: sg_gp_loop.c, portable, and sg_gp_avr.S. The build
// links exactly one of them; only sg_gp.c calls it.
#ifndef SG_GP_LOOP_H
#define SG_GP_LOOP_H

#include <stdint.h>

// 2^-(i/64) for i = 0..1023 as pairs (level Q0.16, drop to the next level Q10.6). make_tables.py made it.
extern const uint16_t sg_gp_exp_table[2048];

// acc[0..1] += sum over n records of weight_i * k_i, modulo 2^32.
//
//   acc       Q.(weight_frac_bits + 16), azimuth and elevation
//   record    n records of 13 bytes (sg_model.h), in `space` (sg_rom.h)
//   s_u8q4    6 entries, 0..4095
//   s2        (sum s^2) >> 5
//   n         1..255
void sg_gp_loop(uint32_t acc[2], const uint8_t *record, const uint16_t s_u8q4[6], uint32_t s2, uint8_t n,
                uint8_t space);

#endif
