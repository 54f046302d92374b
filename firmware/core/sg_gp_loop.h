// SPDX-License-Identifier: Apache-2.0
// The inner loops of sg_gp. Two twins with identical bits: sg_gp_loop.c, portable, and sg_gp_avr.S. Both may
// be given to the compiler: on AVR the C twin is empty, or with SG_GP_PORTABLE defined the assembly is.
#ifndef SG_GP_LOOP_H
#define SG_GP_LOOP_H

#include <stddef.h>
#include <stdint.h>

#include "sg_rom.h"

#ifdef SG_GP_ASSEMBLY
#define SG_GP_LOOP static inline
#else
#define SG_GP_LOOP
#endif

// 2^16 exp(-(i / 64)) for i = T >> 10, Q0.16: in words while it needs them, then in bytes, to the first that is 0.
// See make_tables.py.
enum { SG_GP_EXP_WORDS = 384, SG_GP_EXP_BYTES = 711 - SG_GP_EXP_WORDS };
extern const uint16_t sg_gp_exp_table[SG_GP_EXP_WORDS];
extern const uint8_t sg_gp_exp_tail[SG_GP_EXP_BYTES];

struct sg_gp_sum {
    uint32_t acc[2];    // azimuth and elevation, Q.(weight_frac_bits + 8), 24 bits
    uint32_t s2;        // (sum s^2 + 31) >> 5
    uint16_t s_u8q4[6]; // 0..4095
    uint8_t s_u8[6];    // s >> 4
};

// Where a gaze lies in the grid: nodes of the cell's two rows, and the shares of its corners, 128 in all.
struct sg_gp_place {
    const uint8_t *node[2];     // lower and upper row: the first of two nodes each
    uint8_t share[4];           // 00, 10 (one further in azimuth), 01 (in elevation), 11
};

// The assembly knows these places.
_Static_assert(offsetof(struct sg_gp_sum, s2) == 8 && offsetof(struct sg_gp_sum, s_u8q4) == 12
               && offsetof(struct sg_gp_sum, s_u8) == 24, "sum layout");

// The rest of *sum from six features.
//   offset   uint16[6], and behind them uint16[6] gains Q4.12, as stored, in `space`
// Returns 0, or SG_GP_OUT_OF_RANGE where it had to clamp.
SG_GP_LOOP uint8_t sg_gp_scale(struct sg_gp_sum *sum, const uint16_t feature[6], const uint8_t *offset, uint8_t space);

// sum->acc = (bias + trend * s) >> 4, to 24 bits: the upper 8 are of no meaning.
//   bias   int32[2], and behind it the trend, int16[2][6], as stored, in `space`
SG_GP_LOOP void sg_gp_trend(struct sg_gp_sum *sum, const uint8_t *bias, uint8_t space);

// sum->acc to Q8.7, rounded half up. Returns 0, or SG_GP_OUT_OF_RANGE where an angle had to saturate.
uint8_t sg_gp_round(const struct sg_gp_sum *sum, uint8_t weight_frac_bits, int16_t deg_q7[2]);

// Find a gaze in the grid.
//   origin   of struct sg_model_trust as stored, in `space`; scale and nodes follow, the grid SG_GP_GRID_FROM on
enum { SG_GP_GRID_FROM = 80 };
SG_GP_LOOP void sg_gp_find(const int16_t deg_q7[2], const uint8_t *origin, uint8_t space, struct sg_gp_place *place);

// What the model says of a point, before its limit is asked.
struct sg_gp_opinion {
    uint16_t doubt;             // m
    uint8_t sigma_log2_q4;      // of the grid
    uint8_t out;                // SG_GP_OUT_OF_RANGE if a projection is outside its range, else 0
};

_Static_assert(sizeof(struct sg_gp_opinion) == 4, "opinion layout");

//   guard   struct sg_model_guard[4] as stored, in `space`, as the nodes of `place` are; a guard that is not in
//           use is zero and costs what the others do
SG_GP_LOOP void sg_gp_judge(const struct sg_gp_sum *sum, const struct sg_gp_place *place, const uint8_t *guard,
                 uint8_t space, struct sg_gp_opinion *opinion);

// sum->acc += weight_i * k_i over n records, modulo 2^24; the upper 8 bits of acc are of no meaning.
//
//   record    n records of 12 bytes (sg_model.h), in `space` (sg_rom.h)
//   n         1..255
SG_GP_LOOP void sg_gp_loop(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space);

#ifdef SG_GP_ASSEMBLY
#include "sg_gp_avr.h"
#endif

#endif
