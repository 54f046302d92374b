// SPDX-License-Identifier: Apache-2.0
// The part of sg_light that every cycle runs for every channel. Two twins with identical bits:
// sg_light_loop.c, portable and whole, and sg_light_avr.S, which does the ordinary cases and leaves the
// others to it.
#ifndef SG_LIGHT_LOOP_H
#define SG_LIGHT_LOOP_H

#include <stddef.h>
#include <stdint.h>

#include "sg_light.h"

enum {
    SG_LIGHT_SETTLED = 16,              // the mean of unlit codes follows by 1/16 from then on
    SG_LIGHT_STEP_Q5 = 112,             // 3.5 codes, 4.3 times the noise: what rested has moved
    SG_LIGHT_LEAP_Q5 = 32 * 32,         // of what moves, when it is nearly all that there was
    // Mean square of what six channels depart together; noise alone is 256. Interpolate from, average below:
    SG_LIGHT_MOVING_FROM = 1024,
    SG_LIGHT_RESTING_BELOW = 640,
    SG_LIGHT_MOVING_MOST = 4096,
    SG_LIGHT_DEPARTURE_MOST = 63,
    SG_LIGHT_GAP = 1,
    SG_LIGHT_BEGINS = 2,
    SG_LIGHT_MOVES = 4,
    SG_LIGHT_UNIT = 32,
    SG_LIGHT_CLIPPED_Q5 = 40,
};

// What passes from channel to channel within a cycle.
struct sg_light_pass {
    int16_t missed_q5;          // in: held from before the cycle by the sample capacitor; out: to add
    uint16_t lit_code;          // as sampled right before, 0 after ground
    uint16_t unlit_code;
    int16_t departure;          // sum of the sixteenths of unlit departures from their means, 1/32 code
    int16_t unlit_more_q5;      // what a late release took from the unlit code before, 0 after ground
};

// The assembly knows these places.
#define PLACE(type, field, at) _Static_assert(offsetof(struct type, field) == (at), #type " layout")
_Static_assert(sizeof(struct sg_light_channel) == 20, "channel layout");
PLACE(sg_light_channel, exposure_cycles, 4);
PLACE(sg_light_channel, unit_q12, 6);
PLACE(sg_light_channel, unlit_q5, 8);
PLACE(sg_light_channel, mean_q5, 12);
PLACE(sg_light_channel, slope_q16, 14);
PLACE(sg_light_channel, settled, 16);
PLACE(sg_light_channel, cycles, 17);
PLACE(sg_light_channel, flags, 18);
PLACE(sg_light, before_q8, 120);
PLACE(sg_light, earlier_q8, 121);
PLACE(sg_light, moving, 122);
PLACE(sg_light, wiring, 124);
PLACE(sg_light, state, 125);
PLACE(sg_light, zero_q5, 126);
PLACE(sg_light, dither, 127);
PLACE(sg_reading, unlit_code, 12);
PLACE(sg_reading, exposure_cycles, 24);
PLACE(sg_reading, late_lit_cycles, 36);
PLACE(sg_reading, late_unlit_cycles, 42);
PLACE(sg_reading, held_code, 48);
PLACE(sg_light_pass, missed_q5, 0);
PLACE(sg_light_pass, lit_code, 2);
PLACE(sg_light_pass, unlit_code, 4);
PLACE(sg_light_pass, departure, 6);
PLACE(sg_light_pass, unlit_more_q5, 8);
#undef PLACE

// 4096 * log2(1 + i / 64), in program memory.
extern const uint16_t sg_light_log2_table[65];

// Level behind a mean unlit code below SG_LIGHT_CLIPPED_Q5, both 1/32 code, the level plus 128: a code is
// never negative, so noise raises a mean near 0.
extern const uint8_t sg_light_clipped_table[SG_LIGHT_CLIPPED_Q5];

// 4096 * log2(x), x in 1..65535: rounded, at most 1.5 off.
uint16_t sg_light_log2_q12(uint16_t x);

// Begin with another exposure: what the channel has of this frame is dropped.
void sg_light_begin(struct sg_light_channel *channel, uint16_t exposure_cycles, uint16_t unlit_code);

// One channel's codes, up to the unlit code meant at the lit moment, which is returned, 1/32 code.
int16_t sg_light_meant(struct sg_light *light, const struct sg_reading *reading, uint8_t i,
                       struct sg_light_pass *pass);

// Feature of the cycles added to a channel, at least one; sets STARVED. The cycles stay.
uint16_t sg_light_feature(struct sg_light_channel *channel);

// Make up the earlier unlit codes that light->state says are none.
void sg_light_prepare(struct sg_light *light, const struct sg_reading *reading);

// Channels in the order of sampling, by wiring, in program memory: six LEDs, or six photodiodes.
extern const uint8_t sg_light_order[2][6];

// The twins themselves are sg_light_add and sg_light_features.

// 1/32 of a code.
static inline uint16_t sg_light_q5(uint16_t code)
{
    return (uint16_t)(code << 5);
}

#endif
