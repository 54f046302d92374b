// SPDX-License-Identifier: Apache-2.0
// Photocurrents of one sensing cycle: ADC codes, lit and unlit, to six features.
//
// A node is held at 0 V, let go for an exposure, and sampled against the 1.1 V reference. The same again without
// our light. What was collected more is ours: charge of the lit code minus charge of the unlit one, over the
// exposure, on a logarithmic scale. Ambient light is interpolated to the moment of the lit sample, or averaged
// while it rests.
#ifndef SG_LIGHT_H
#define SG_LIGHT_H

#include <stdint.h>

// cdef begin
enum sg_light_limits {
    SG_LIGHT_CHANNELS = 6,
    SG_LIGHT_NOBODY = 255,
    SG_LIGHT_SATURATED_CODE = 1000,     // at and above, the charge is unknown
    SG_LIGHT_REPEATS_MAX = 16,
};

// Bits returned by sg_light_features; the values are those of enum sg_flag (sg_wire.h), which this module does not
// include.
enum sg_light_flag { SG_LIGHT_SATURATED = 8, SG_LIGHT_STARVED = 16 };

// What the port saw in one sensing cycle.
struct sg_reading {
    uint16_t lit_code[6];           // 0..1023
    uint16_t unlit_code[6];
    uint16_t exposure_cycles[6];    // release to sample as planned, the same lit and unlit
    uint8_t late_lit_cycles[6];     // how much shorter than planned it was, 255 = that or more
    uint8_t late_unlit_cycles[6];
    uint16_t held_code;             // what the sample capacitor held before the cycle's first lit sample, mostly 0
};
// cdef end

#endif
