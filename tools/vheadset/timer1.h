// SPDX-License-Identifier: GPL-3.0-or-later
// Timer1 of the ATmega328P, exact to the cycle: normal and CTC modes, internal clock, compare A and B,
// overflow, the shared TEMP byte, flags that wait for their enable bit, and the edge that triggers the ADC.
// Not modelled: PWM modes (they count like normal mode), input capture, output pins, external clock, GTCCR.
#ifndef TIMER1_H
#define TIMER1_H

#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>

struct adc;

enum { TIMER1_COMPA, TIMER1_COMPB, TIMER1_OVF, TIMER1_EVENTS };

struct timer1 {
    avr_t *avr;
    struct adc *adc;                        // told about rising edges of OCF1B and TOV1
    avr_int_vector_t *vector[TIMER1_EVENTS];
    uint64_t base_cycle;                    // the counter was base_count there
    uint64_t next[TIMER1_EVENTS];           // cycle at which the flag rises
    uint16_t base_count;
    uint16_t compare[2];
    uint16_t capture;                       // ICR1: TOP of CTC mode 12
    uint8_t temp;
    unsigned divisor;                       // 0 = stopped
};

// Take the registers over; adc may be NULL.
void timer1_attach(struct timer1 *timer, avr_t *avr, struct adc *adc);
// After every reset of the chip.
void timer1_reset(struct timer1 *timer);

#endif
