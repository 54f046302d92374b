// SPDX-License-Identifier: Apache-2.0
// Automatic exposure of the six sensors, from their codes alone.
//
// The goal: unlit + 2 * (lit - unlit) = 0.9 of full scale. Gaze alone moves our light by a factor of 1.9
// either way at most, so wherever it was when an exposure was chosen, looking around neither saturates nor
// changes it. What ambient light adds is seen in the unlit code, so a change of it is acted on at once; our
// own light changing must last. Where the goal needs more than the longest exposure, that is taken: the usual
// state in the dark.
#ifndef SG_EXPOSE_H
#define SG_EXPOSE_H

#include <stdint.h>

// cdef begin
enum sg_expose_limits {
    SG_EXPOSE_CYCLES_PER_US = 16,       // exposures are counted by a 16 MHz timer
    SG_EXPOSE_MIN_CYCLES = 64,          // 4 us
    SG_EXPOSE_MAX_CYCLES = 5216,        // 326 us: the longest of any timing; no command lifts it
    SG_EXPOSE_START_CYCLES = 512,       // 32 us: from here dark and sun are one or two corrections away
    SG_EXPOSE_SATURATED_CODE = 1000,
    SG_EXPOSE_GOAL_CODES = 922,
    SG_EXPOSE_BRIGHT_CODE = 976,        // a lit code above it is too bright: gaze alone does not get there
};

enum sg_expose_patience {               // looks at a channel: one in six cycles
    SG_EXPOSE_PATIENCE_BRIGHT = 5,      // 31 ms at 1 kHz
    SG_EXPOSE_PATIENCE_DIM = 77,        // 0.46 s: longer than a blink
};

// Exposure from the wire's sixteenths of a microsecond (they are timer cycles), clipped to the limits.
uint16_t sg_expose_from_us_q4(uint16_t exposure_us_q4);

struct sg_expose_led {
    uint16_t exposure_cycles;   // in force from soon on; always within the limits
    uint16_t most_cycles;       // the user's limit and the timing's
    uint8_t unlit_peak;         // unlit code / 4, the largest of late
    uint8_t unlit_then;         // the same when the exposure was accepted
    uint8_t signal_then;        // lit less unlit code, / 4, when it was
    uint8_t stage;              // enum sg_expose_stage
    int8_t streak;              // looks in a row that were too bright (> 0) or too dim (< 0)
    uint8_t caution;            // eighths taken off the goal: exposures were full soon after the choice
    uint8_t age;                // looks since the exposure changed, up to 255
    uint8_t least_q4;           // the port takes no less than this, / 16 cycles, as far as is known
};

enum sg_expose_stage {
    SG_EXPOSE_ACQUIRE = 0,      // the next sample decides
    SG_EXPOSE_REFINE = 1,       // so does this one, if it finds much to correct
    SG_EXPOSE_VERIFY = 2,       // the next sample is taken as the measure
    SG_EXPOSE_TRACK = 3,        // only what lasts, and what ambient light does
    SG_EXPOSE_WATCH = 4,        // full soon after it was chosen: light that flickers is watched first
};

struct sg_expose {
    struct sg_expose_led led[6];
    uint8_t acquiring;          // 1: some may be
    uint8_t fallen;             // looks in a row that found an unlit code below 1/16 of its peak
    uint8_t next;               // channel to look at
    uint8_t rounds;             // of looks, for what is slow
};

// Begin at these exposures (clipped), with these limits. To hold exposures, start them there and call only
// sg_expose_taken.
void sg_expose_start(struct sg_expose *expose, const uint16_t exposure_cycles[6],
                     const uint16_t most_cycles[6]);

// What the port made of the exposures asked for: it may move them by a few per cent, and refuse short ones
// (what is taken instead is then the least). Call after every change.
void sg_expose_taken(struct sg_expose *expose, const uint16_t exposure_cycles[6]);

// One cycle: a look at the next channel; at once at those that are full (an eighth of the exposure, a
// sixteenth if the unlit code is full too); at those that are being acquired, two a cycle: after the start,
// after being full, and when ambient light fell away.
//
//   lit_code, unlit_code, exposure_cycles   as in struct sg_reading. A cycle taken with another exposure than
//                      the one in force says nothing but "saturated"; a pipeline of any depth does not correct twice.
// Returns 1 if any led[].exposure_cycles changed, else 0.
uint8_t sg_expose_cycle(struct sg_expose *expose, const uint16_t lit_code[6], const uint16_t unlit_code[6],
                        const uint16_t exposure_cycles[6]);
// cdef end

#endif
