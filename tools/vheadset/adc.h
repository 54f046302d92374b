// SPDX-License-Identifier: GPL-3.0-or-later
// Analog-digital converter of the ATmega328P (datasheet chapter 23), replacing libsimavr's.
//
// Timing    the prescaler runs while ADEN is set. A software start waits for its next edge; sample and hold
//           closes 1.5 ADC clocks later, the result is there after 13 (13.5 and 25 for the first conversion
//           after ADEN). A trigger source's rising edge is seen after 3 CPU cycles, resets the prescaler
//           there, and sample and hold closes exactly 2 ADC clocks later, the result after 13.5. An edge
//           during a conversion is lost.
// Result    successive approximation against the reference of each bit's own moment, on the voltage held
//           since the sample; noise, integral non-linearity, offset and gain error from physics.toml, growing
//           with the ADC clock above 200 kHz. Channel and reference are those of the start. Reading ADCL
//           locks the register until ADCH.
// Sources   free running (ADTS 0), Timer1 compare B (5), Timer1 overflow (6).
// Not here  the other trigger sources, ADC noise reduction sleep, the comparator's multiplexer.
#ifndef ADC_H
#define ADC_H

#include <stdbool.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>

#include "config.h"

struct leds;

enum adc_source { ADC_TRIGGER_FREE = 0, ADC_TRIGGER_T1_COMPB = 5, ADC_TRIGGER_T1_OVF = 6 };

struct adc {
    avr_t *avr;
    const struct physics *physics;
    struct leds *leds;
    avr_int_vector_t *vector;
    uint64_t seed;                // of noise, set by the board for each session; parts are drawn at attach
    uint64_t prescale_base;       // an edge of every prescaler tap
    uint64_t join_at;             // sample capacitor to the input; 0 once done
    uint64_t sample_at, end_at;   // of the conversion under way; sample_at = 0 once sampled
    uint64_t conversions;         // counts draws
    double held_volts;            // on the sample capacitor
    double offset_lsb, gain, bandgap_volts;
    double inl_phase[3], inl_scale;
    bool first, busy, locked;
    uint8_t admux;                // as latched at the start
    unsigned divisor;             // as latched at the start
    void (*before)(void *param, uint64_t cycle);  // what else is due by then, called first; may be NULL
    void *before_param;
    void (*log)(void *param, const char *what, int value, uint64_t cycle);  // "adc" and channel; may be NULL
    void *log_param;
};

void adc_attach(struct adc *adc, avr_t *avr, struct leds *leds, const struct physics *physics, uint64_t seed);
void adc_reset(struct adc *adc);
// The rising edge of a trigger source at a cycle.
void adc_trigger(struct adc *adc, enum adc_source source, uint64_t cycle);
// Do what of joining and sampling is due by `cycle`: called before anything they depend on changes.
void adc_catch_up(struct adc *adc, uint64_t cycle);

#endif
