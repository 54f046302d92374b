// SPDX-License-Identifier: Apache-2.0
// The part of sg_light that every cycle runs for every channel. Two twins with identical bits: sg_light_loop.c,
// portable and whole, and sg_light_avr.S, which does the ordinary cases and leaves the others to it.
#ifndef SG_LIGHT_LOOP_H
#define SG_LIGHT_LOOP_H

#include <stddef.h>
#include <stdint.h>

#include "sg_light.h"

enum {
    SG_LIGHT_SETTLED = 16,              // the mean of unlit codes follows by 1/16 from then on
    SG_LIGHT_STEP_Q5 = 4 * 32,          // five times the noise: what rested has moved
    SG_LIGHT_LEAP_Q5 = 32 * 32,         // of which nobody knows whether the lit exposure saw it
    SG_LIGHT_MOVING_FULL = 256,
    SG_LIGHT_UNIT = 32,
};

// What passes from channel to channel within a cycle.
struct sg_light_pass {
    int16_t brought_q5;         // lit less unlit code (as meant) sampled right before, 0 after ground
    uint16_t lit_code;          // as sampled right before, 0 after ground
    uint16_t unlit_code;
    int16_t departure;          // sum of the sixteenths of unlit departures from their means, 1/32 code
    uint16_t moving_q8;         // how much of the interpolation to believe, 256 and above: all
};

// Add one channel's codes.
void sg_light_one(struct sg_light *light, const struct sg_reading *reading, uint8_t i, struct sg_light_pass *pass);

// Add all six, in the order of `order`: first and second of three pairs, in program memory.
void sg_light_loop(struct sg_light *light, const struct sg_reading *reading, const uint8_t order[6],
                   struct sg_light_pass *pass);

// 4096 * log2(1 + i / 64), in program memory.
extern const uint16_t sg_light_log2_table[65];

// floor(4096 * log2(x)), within 1; x in 1..65535.
uint16_t sg_light_log2_q12(uint16_t x);

// What is known of a channel's ambient light is this code and no more.
void sg_light_settle(struct sg_light_channel *channel, uint16_t unlit_q5);

// 1/32 of a code.
static inline uint16_t sg_light_q5(uint16_t code)
{
    return (uint16_t)(code << 5);
}

#endif
