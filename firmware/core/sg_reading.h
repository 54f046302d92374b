// SPDX-License-Identifier: Apache-2.0
// One sensing cycle in codes of the converter: what light (sg_light.h) and exposure (sg_expose.h) are made of.
#ifndef SG_READING_H
#define SG_READING_H

#include <stdint.h>

// cdef begin
// What the port saw in one sensing cycle.
struct sg_reading {
    uint16_t lit_code[6];           // 0..1023
    uint16_t unlit_code[6];
    uint16_t exposure_cycles[6];    // release to sample as planned, the same lit and unlit
    uint8_t late_lit_cycles[6];     // how much shorter than planned it was, 255 = that or more
    uint8_t late_unlit_cycles[6];
    uint16_t held_code;             // what the sample capacitor held before the first lit sample, mostly 0
};
// cdef end

#endif
