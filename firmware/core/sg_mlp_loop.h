// SPDX-License-Identifier: Apache-2.0
// The inner loops of sg_mlp. Two twins with identical bits: sg_mlp_loop.c, portable, and sg_mlp_avr.S. Both
// may be given to the compiler: on AVR the C twin is empty, or with SG_MLP_PORTABLE defined the assembly is.
#ifndef SG_MLP_LOOP_H
#define SG_MLP_LOOP_H

#include <stddef.h>
#include <stdint.h>

// 32768 tanh(i ln 2 / 32); see make_tables.py.
extern const uint16_t sg_mlp_tanh_table[257];

enum sg_mlp_kind { SG_MLP_WIDE = 1, SG_MLP_OUTPUT = 2 };    // weights of 2 bytes; linear rows

struct sg_mlp_run {
    uint8_t correction[3];  // of the assembly, for itself
    uint8_t saturated;      // or-ed: 255 when an output saturated
    uint8_t columns;        // 1..64
    uint8_t rows;           // even, 2..64; the assembly counts it down
    uint8_t kind;           // bits of enum sg_mlp_kind
    uint8_t space;          // sg_rom.h
    const uint16_t *in;     // activations, columns of them
};

// The assembly knows these places.
_Static_assert(offsetof(struct sg_mlp_run, columns) == 4, "run layout");
_Static_assert(offsetof(struct sg_mlp_run, in) == 8, "run layout");

// Activations of n inputs, 1..8.
//
//   scale    struct sg_mlp_input[n] as stored, in `space`
//   Returns  0, or 255 if one was clamped.
uint8_t sg_mlp_scale(const uint16_t *input, uint16_t *out, const uint8_t *scale, uint8_t n, uint8_t space);

// One layer.
//
//   layer    as stored (sg_mlp.h), in run->space
//   out      run->rows activations, or outputs as int16_t; not where run->in is
//   Returns  the end of the layer
// Cost   AVR assembly, weights in flash: 150, 11 per column, 120 per row, 15 per weight of 1 byte, 22 of 2.
const uint8_t *sg_mlp_layer(struct sg_mlp_run *run, const uint8_t *layer, uint16_t *out);

#endif
