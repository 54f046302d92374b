// SPDX-License-Identifier: Apache-2.0
// An LED as a light meter: photocurrent from what is left of a reverse charge, and how long to expose.
//
// The reverse-biased LED is charged to Vcc, left alone for an exposure, and sampled. The photocurrent I
// takes the charge
//   Q = F(V0) - F(V),  F(V) = Qj(V) + (C_pin + C_sh) V,  Qj(V) = integral of C0 / (1 + v / 0.7 V)^0.4
// off the node, exactly, whatever the waveform. With V0 = Vref = Vcc and V = Vcc * code / 1024, Q is a
// function of the code alone:  Q = (1024 - code) * mean capacitance(code) * Vcc / 1024, and log2 of the mean
// capacitance is a slow curve: 65 nodes. The feature is a sum of logarithms; no division, and an error that
// stays small where little was collected.
//
// A reading is the sum of four codes of the one held charge, in quarters of a code (code_q2): the converter's
// own noise and that of its reference average out.
#ifndef SG_EXPOSE_H
#define SG_EXPOSE_H

#include <stdint.h>

// cdef begin
enum sg_expose_limits {
    SG_EXPOSE_CYCLES_PER_US = 16,       // exposures are counted by a 16 MHz timer
    SG_EXPOSE_MIN_CYCLES = 256,         // 16 us
    SG_EXPOSE_MAX_CYCLES = 4864,        // 304 us: eye safety, no command lifts it
    SG_EXPOSE_START_CYCLES = 1024,      // 64 us: from here dark and sun are two or three frames away
    // At and below, the node was nearly empty (0.16 V) or had long been when the sample capacitor, charged to
    // Vcc, joined it and lifted it.
    SG_EXPOSE_SATURATED_Q2 = 4 * 296,
    SG_EXPOSE_STARVED_Q2 = 4 * 8,       // a drop below this says nothing
};

// Bits returned by sg_expose_feature; the values are those of enum sg_flag (sg_wire.h), which this module
// does not include.
enum sg_expose_flag { SG_EXPOSE_SATURATED = 8, SG_EXPOSE_STARVED = 16 };

// Feature of one exposure: 4096 * log2(I / 62.5 pA), clamped to 0..65535 (62.5 pA .. 4.096 uA).
//
//   code_q2           sum of four ADC codes, 0..4092, larger ones count as 4092
//   exposure_cycles   time from release to sample, timer cycles, 1..32767; others are limited
//   feature           written in any case. Starved or saturated: the value is a bound, not a measurement.
//
// Scaling and overflow   log2 in Q4.12 unsigned from 65-entry tables, interpolated; the sum in int32.
// Accuracy   within 4 LSB (1/1000 octave) of the formula above in real numbers, for every code that is not
//            flagged and every exposure 16..304 us; tests/unit/test_core_expose.py. The constants are
//            nominal: a part's own capacitance shifts its feature by a constant that calibration absorbs.
// Returns    0, SG_EXPOSE_SATURATED or SG_EXPOSE_STARVED.
uint8_t sg_expose_feature(uint16_t code_q2, uint16_t exposure_cycles, uint16_t *feature);

// Exposure from the wire's quarter microseconds, clipped to the limits, and back. Exact for what was not
// clipped.
uint16_t sg_expose_from_us_q2(uint16_t exposure_us_q2);
uint16_t sg_expose_to_us_q2(uint16_t exposure_cycles);

// Automatic exposure of one LED. A pure state machine: start it, then give it every sample.
struct sg_expose_led {
    uint16_t exposure_cycles;   // in force from the next release on; always within the limits
    uint8_t tracking;           // 0: acquiring, every sample may correct; 1: only lasting departures do
    int8_t streak;              // samples in a row that were too bright (> 0) or too dim (< 0)
};

enum sg_expose_patience {
    SG_EXPOSE_PATIENCE_BRIGHT = 8,      // samples (31 ms at 3.84 ms)
    SG_EXPOSE_PATIENCE_DIM = 120,       // samples (0.46 s at 3.84 ms): longer than a blink
};

// Begin (or begin again) at a given exposure, clipped to the limits. To hold an exposure, start it there and
// do not step it.
void sg_expose_start(struct sg_expose_led *led, uint16_t exposure_cycles);

// One sample.
//
//   code_q2, exposure_cycles   what the ADC read (as above) and how long that exposure was. It need not be the exposure
//                           in force now: the correction is computed from the pair, so that a pipeline of
//                           any depth does not correct twice.
//
// The goal is 0.30 of all the charge on the node, and the window around it is goal/2.1 .. goal*2.1. Gaze
// alone moves the light by a factor of 1.9: wherever it was at the last correction, it stays inside the
// window, so looking around never changes an exposure and never saturates. Departures must last:
// PATIENCE_BRIGHT samples when the light rose, PATIENCE_DIM when it fell. A saturated sample is not waited
// for. A dim LED stays at the cap.
// Scaling and overflow   log2 charge Q4.12 in int32; the new exposure is clipped before it is narrowed.
// Returns 1 if led->exposure_cycles changed, else 0.
uint8_t sg_expose_step(struct sg_expose_led *led, uint16_t code_q2, uint16_t exposure_cycles);
// cdef end

#endif
