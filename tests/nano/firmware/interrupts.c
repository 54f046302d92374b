// SPDX-License-Identifier: Apache-2.0
// Cycles of an interrupt's round trip, by TCNT1 around one instruction: without, with, and out of sleep.
#include "bench.h"

#include <avr/sleep.h>

// vector (jmp 3) + reti (4): what is left is the entry
ISR(TIMER1_COMPA_vect, ISR_NAKED)
{
    reti();
}

static uint8_t timed(uint8_t pending)
{
    uint8_t before, after;
    cli();
    TIMSK1 = 0;
    OCR1A = TCNT1 + 60;
    TIFR1 = _BV(OCF1A);
    if (pending) {
        TIMSK1 = _BV(OCIE1A);
        while (!(TIFR1 & _BV(OCF1A)))
            ;
    }
    __asm__ volatile("lds %0, %2\n\tsei\n\tnop\n\tlds %1, %2\n\tcli"
                     : "=&r"(before), "=r"(after) : "i"(_SFR_MEM_ADDR(TCNT1L)));
    return (uint8_t)(after - before);
}

static uint16_t asleep(void)
{
    uint16_t at, after;
    cli();
    SMCR = _BV(SE);
    at = TCNT1 + 200;
    OCR1A = at;
    TIFR1 = _BV(OCF1A);
    TIMSK1 = _BV(OCIE1A);
    __asm__ volatile("sei\n\tsleep\n\tlds %A0, %1\n\tlds %B0, %2\n\tcli"
                     : "=r"(after) : "i"(_SFR_MEM_ADDR(TCNT1L)), "i"(_SFR_MEM_ADDR(TCNT1H)));
    return after - at;
}

int main(void)
{
    bench_begin();
    TCCR1B = _BV(CS10);
    bench_put(timed(0));
    bench_put(timed(1));
    bench_put16(asleep());
    for (;;)
        ;
}
