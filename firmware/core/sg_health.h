// SPDX-License-Identifier: Apache-2.0
// Is a channel at fault? From its codes, its exposure, and the range that the model was calibrated in.
//
// Faults must last PATIENCE looks, and must be gone as long to be forgotten. One channel every eighth cycle
// is enough.
#ifndef SG_HEALTH_H
#define SG_HEALTH_H

#include <stdint.h>

// cdef begin
// The values are those of enum sg_fault (sg_wire.h), which this module does not include.
enum sg_health_fault {
    SG_HEALTH_OPEN = 1,         // no current at all, lit or not, at half the longest exposure or more
    SG_HEALTH_SHORT = 2,        // full at the shortest exposure, lit or not
    SG_HEALTH_LOW = 4,          // an octave or more below the calibrated range
    SG_HEALTH_HIGH = 8,         // one and a half octaves or more above its middle
};
enum sg_health_limits {
    SG_HEALTH_PATIENCE = 6,             // looks at a channel: 0.29 s at 48 ms a look
    SG_HEALTH_NOTHING_CODE = 4,         // at and below, lit and unlit, nothing came
    SG_HEALTH_FULL_CODE = 1000,
    SG_HEALTH_SHORT_CYCLES = 256,       // full even at this exposure: no port's least is longer
};

// One channel in one cycle.
struct sg_health_sight {
    uint16_t lit_code;
    uint16_t unlit_code;
    uint16_t before_code;       // lit code sampled right before this one, 0: none
    uint16_t exposure_cycles;
    uint16_t most_cycles;       // the longest that the timing allows
    uint16_t feature;
    uint16_t offset;            // of the model (struct sg_model_head); its range is 0 <= x - offset and
    uint16_t gain_q12;          // ((x - offset) * gain_q12) >> 12 <= 4095. Gain 0: no model, or not in it
};

struct sg_health {
    uint8_t fault[6];           // bits of enum sg_health_fault
    uint8_t dark[6];            // looks in a row (up and down) that spoke for OPEN or SHORT
    uint8_t far[6];             // for LOW or HIGH
    uint8_t least[6];           // lit codes / 4 of the neighbour that the channel seems to mirror
    uint8_t most[6];
};

void sg_health_start(struct sg_health *health);

// Look at one channel. Returns 1 if any channel is at fault.
uint8_t sg_health_look(struct sg_health *health, uint8_t channel, const struct sg_health_sight *sight);
// cdef end

#endif
