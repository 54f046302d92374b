// SPDX-License-Identifier: Apache-2.0
// Photocurrents of one sensing cycle: ADC codes, lit and unlit, to six features.
//
// A node is held at 0 V, let go for an exposure, and sampled against the 1.1 V reference. The same again
// without our light. What was collected more is ours: charge of the lit code minus charge of the unlit one,
// over the exposure, on a logarithmic scale. Ambient light is interpolated to the moment of the lit sample,
// or averaged while it rests.
//
// Charge on a node at V, its junction reverse-biased by the rail less V, its sample capacitor come from
// V_before:
//   Q = F(1.8) - F(1.8 - V) + (6 + 14) pF * V - 14 pF * V_before,  F(r) = 40 pF * 0.7/0.6 * (1 + r/0.7)^0.6
// In units of a code at 0 V, with x = code / 1024 (make_tables.py fits k1 and k2):
//   q(code) = code * (1 + (k1 + curve / 1024) * x + k2 * x^2)
//   signal = q(lit) - q(unlit) - s * (lit - unlit, both of the channel sampled before)
// The unlit code meant is that of the lit moment, u, three sixths of a phase (18 slots a cycle, 3 of them)
// before the unlit sample. Exact for light that rests and, but for the rounding of b and c, for 110 Hz; of
// 100 and 120 Hz 0.3 % of the amplitude is left at 999 us, 2.2 % at 2 ms. With this and the two previous
// unlit codes:
//   u = u0 + b (u1 - u0) + c (u2 - u0),  th = 2 pi 110 Hz * period, ph = th / 6,
//   b = sin(ph/2) sin(th - ph/2) / sin(th/2)^2,   c = -sin(ph/2) sin((th - ph)/2) / (sin(th) sin(th/2))
#ifndef SG_LIGHT_H
#define SG_LIGHT_H

#include <stdint.h>

#include "sg_reading.h"
#include "sg_rom.h"

// cdef begin
enum sg_light_limits {
    SG_LIGHT_CHANNELS = 6,
    SG_LIGHT_NOBODY = 255,
    SG_LIGHT_SATURATED_CODE = 1000,     // at and above, the charge is unknown
    SG_LIGHT_STARVED_CODES = 4,         // a mean signal below says nothing: 4 times the noise of a cycle
    SG_LIGHT_REPEATS_MAX = 16,
};

// Bits returned by sg_light_features; the values are those of enum sg_flag (sg_wire.h), which this module
// does not include.
enum sg_light_flag { SG_LIGHT_SATURATED = 8, SG_LIGHT_STARVED = 16 };

struct sg_light_channel {
    int32_t sum_q5;                 // signal of the cycles added, 1/32 code at 0 V
    uint16_t exposure_cycles;       // that of everything here
    int16_t unit_q12;               // feature of 1/32 code in this exposure
    uint16_t unlit_q5[2];           // of the previous cycle and the one before it, while light moves
    uint16_t mean_q5;               // of unlit codes
    int16_t slope_q16;              // 2 k1 and the channel's curve
    uint8_t settled;                // cycles with this exposure, up to 16; before, the mean follows fast
    uint8_t cycles;                 // added since the last features
    uint8_t flags;                  // bits of enum sg_light_flag, of the cycles added
    uint8_t reserved;
};

struct sg_light {
    struct sg_light_channel channel[6];
    uint8_t before_q8;              // b of above
    uint8_t earlier_q8;             // -c
    uint16_t moving;                // mean square of the sum of the unlit codes' departures, 1/64 code^2
    uint8_t wiring;                 // enum sg_wiring: 0 or 1
    uint8_t state;                  // bits: 1 a gap came before, 2 ambient light begins to move, 4 it moves
    int8_t zero_q5;                 // the least that a mean unlit code can mean, 0 or less
    uint8_t dither;                 // 0..15: a mean must not stop short of what it follows
};

// Begin, or begin anew after a change of timing or wiring: nothing is known, curves are 0.
//   wiring         enum sg_wiring: which channel is sampled right after which
//   period_cycles  of a sensing cycle; taken as 15984..31986
void sg_light_start(struct sg_light *light, uint8_t wiring, uint16_t period_cycles);

// By self-calibration. In force from the next cycle on.
//   curve_q10  curvature, 1/1024, on top of the nominal junction's k1
//   zero_q2    code that the converter would read at 0 V if codes could be negative, 1/4 code, -128..0: how
//              far down the mean of unlit codes that are clipped at 0 may be thought to be
void sg_light_curve(struct sg_light *light, const int8_t curve_q10[6], int8_t zero_q2);

// A gap in the cycles (a pause between frames, a lost cycle): unlit codes of before are no longer neighbours
// in time. What rests is kept; what moves begins anew.
void sg_light_gap(struct sg_light *light);

// One cycle: added to the frame. Exposures may differ from those of the cycle before (what was known of the
// channel's ambient light then begins anew).
// Accuracy   of the charge: see tests/unit/test_core_light.py. A late release is made up for exactly, as long
//            as the light rests; a channel later than half its exposure is STARVED.
void sg_light_add(struct sg_light *light, const struct sg_reading *reading);

// Features of the cycles added since the last call, from the mean of their photocurrents:
//   feature   4096 * log2(I / 62.5 pA), clamped to 0..65535 (62.5 pA .. 4.096 uA), nominal parts.
//             A channel to which nothing was added keeps its feature and flags.
// SATURATED or STARVED: the value is a bound, not a measurement. light->channel[i].flags tells which channel.
// Returns    bits of enum sg_light_flag, or-ed over the channels.
uint8_t sg_light_features(struct sg_light *light, uint16_t feature[6]);
// cdef end

#ifdef SG_LIGHT_ASSEMBLY
#include "sg_light_avr.h"
#endif

#endif
