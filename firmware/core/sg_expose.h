// SPDX-License-Identifier: Apache-2.0
// Automatic exposure of the six sensors, from their codes alone.
//
// The goal: unlit + 2 * (lit - unlit) = 0.9 of full scale. Our own light varies: gaze moves it by a factor of
// 4.4 from end to end at some sensors, shut lids throw back up to 3 times as much. So exposures follow its
// peaks: they are shortened when a code is (nearly) full, by no more than that takes, and lengthened when the
// brightest of seconds would have fitted twice. Within a few blinks they rest. What ambient light adds is
// seen in the unlit code, so a change of it is acted on at once. Where the goal needs more than the longest
// exposure, that is taken: the usual state in the dark.
#ifndef SG_EXPOSE_H
#define SG_EXPOSE_H

#include <stdint.h>

#include "sg_reading.h"

// cdef begin
enum sg_expose_limits {
    SG_EXPOSE_CYCLES_PER_US = 16,       // exposures are counted by a 16 MHz timer
    SG_EXPOSE_MIN_CYCLES = 64,          // 4 us
    SG_EXPOSE_MAX_CYCLES = 5216,        // 326 us: the longest of any timing; no command lifts it
    SG_EXPOSE_START_CYCLES = 512,       // 32 us: from here dark and sun are one or two corrections away
    SG_EXPOSE_SATURATED_CODE = 1000,
    SG_EXPOSE_GOAL_CODES = 922,
    SG_EXPOSE_BRIGHT_CODE = 976,        // a lit code above it is too bright
};

enum sg_expose_patience {               // looks at a channel: one in six cycles
    SG_EXPOSE_PATIENCE_BRIGHT = 5,      // 31 ms at 1 kHz
    SG_EXPOSE_PATIENCE_DIM = 120,       // 0.7 s: longer than a blink
    SG_EXPOSE_PATIENCE_TIMES = 5,       // as long as these times 256 looks, 1.5 s: longer than from blink to blink
};

// Exposure from the wire's sixteenths of a microsecond (they are timer cycles), clipped to the limits.
uint16_t sg_expose_from_us_q4(uint16_t exposure_us_q4);

struct sg_expose_led {
    uint16_t exposure_cycles;   // in force from soon on; always within the limits
    uint16_t most_cycles;       // the user's limit and the timing's
    uint8_t unlit_peak;         // unlit code / 4, the largest of late
    uint8_t unlit_then;         // the same when the exposure was accepted
    uint8_t signal_then;        // lit less unlit code, / 4, that the exposure leaves room for twice
    uint8_t signal_peak;        // the largest since the last long patience ended
    uint8_t stage;              // enum sg_expose_stage
    int8_t streak;              // looks in a row that were too bright (> 0) or far too dim (< 0)
    uint8_t caution;            // eighths taken off the goal: exposures were full soon after the choice
    uint8_t least_q3;           // the port takes no less than this, / 8 cycles, as far as is known
};

enum sg_expose_stage {
    SG_EXPOSE_ACQUIRE = 0,      // the next sample decides
    SG_EXPOSE_REFINE = 1,       // so does this one, if it finds much to correct
    SG_EXPOSE_VERIFY = 2,       // the next sample is taken as the measure
    SG_EXPOSE_YOUNG = 3,        // from here on only what lasts, and what ambient light does
    SG_EXPOSE_TRACK = 8,        // 30 ms later: a crest comes within 10 ms
    SG_EXPOSE_WATCH = 9,        // full soon after it was chosen: light that flickers is watched first
};

struct sg_expose {
    struct sg_expose_led led[6];
    uint8_t acquiring;          // 1: some may be
    uint8_t fallen;             // looks in a row that found an unlit code below 1/16 of its peak
    uint8_t next;               // channel to look at
    uint8_t rounds;             // of looks, mod 256
    uint8_t times;              // that they were full, mod SG_EXPOSE_PATIENCE_TIMES
    uint8_t drowned;            // 1: a channel of this cycle is full without our light
};

// Begin at these exposures (clipped), with these limits. To hold exposures, start them there and call only
// sg_expose_taken.
void sg_expose_start(struct sg_expose *expose, const uint16_t exposure_cycles[6],
                     const uint16_t most_cycles[6]);

// What the port made of the exposures asked for: it may move them by a few per cent, and refuse short ones
// (what is taken instead is then the least). Call after every change.
void sg_expose_taken(struct sg_expose *expose, const uint16_t exposure_cycles[6]);

// One cycle: a look at the next channel; at once at those that are full (our light alone: half of the
// exposure; else an eighth, or a sixteenth if the unlit code is full too; soon after a choice what the unlit
// code of that crest and half more asks for, unless it is full too) and at all that are being acquired:
// after the start, after being full, and when ambient light fell away. A channel taken with another exposure
// than the one in force says nothing: a pipeline of any depth does not correct twice.
//   wiring     enum sg_wiring
// Returns 1 if any led[].exposure_cycles changed, else 0.
uint8_t sg_expose_cycle(struct sg_expose *expose, const struct sg_reading *reading, uint8_t wiring);
// cdef end

#endif
