// SPDX-License-Identifier: Apache-2.0
// Instruction and Timer1 timing, as TCNT1 shows it. Sends a byte per probe (see test_timing.py).
#include "bench.h"

// TCNT1L before and after some instructions, less the two cycles of the first LDS
#define PROBE(code) __extension__({                                                                        \
    uint8_t before_, after_;                                                                               \
    __asm__ volatile("lds %0, %2\n\t" code "\n\tlds %1, %2" : "=&r"(before_), "=&r"(after_)                \
                     : "i"(_SFR_MEM_ADDR(TCNT1L)) : "r0", "r1", "r26", "r27", "memory");                   \
    (uint8_t)(after_ - before_ - 2); })

int main(void)
{
    bench_begin();
    TCCR1B = _BV(CS10);
    bench_put(PROBE(""));
    bench_put(PROBE("nop"));
    bench_put(PROBE("mul r24, r25"));
    bench_put(PROBE("rcall 1f\n\trjmp 2f\n1:\tret\n2:"));
    bench_put(PROBE("push r24\n\tpop r24"));

    // The flag of a compare value rises with the cycle after the match: distance from a stopped counter.
    TCCR1B = 0;
    TCNT1 = 0;
    OCR1A = 10;
    TIFR1 = _BV(OCF1A) | _BV(TOV1);
    uint8_t early, late;
    __asm__ volatile("sts %[ctl], %[on]\n\t"     // counts from the end of this
                     "nop\n\tnop\n\tnop\n\tnop\n\tnop\n\tnop\n\tnop\n\tnop\n\tnop\n\tnop\n\t"
                     "in %[early], %[flags]\n\t" // cycle 10 begins: TCNT1 = 10, not yet
                     "in %[late], %[flags]\n\t"  // cycle 11: set
                     : [early] "=&r"(early), [late] "=&r"(late)
                     : [ctl] "i"(_SFR_MEM_ADDR(TCCR1B)), [on] "r"((uint8_t)_BV(CS10)),
                       [flags] "I"(_SFR_IO_ADDR(TIFR1)));
    bench_put(early & _BV(OCF1A));
    bench_put(late & _BV(OCF1A));

    // Only the bit addressed by SBI is cleared.
    TCNT1 = 0xFFF0;
    while (!(TIFR1 & _BV(TOV1)))
        ;
    __asm__ volatile("sbi %0, %1" : : "I"(_SFR_IO_ADDR(TIFR1)), "I"(OCF1A));
    bench_put(TIFR1 & (_BV(TOV1) | _BV(OCF1A)));

    // CTC: period is OCR1A + 1; a flag waits for its enable bit (checked by the interrupt that then comes).
    TCCR1B = 0;
    TCNT1 = 0;
    OCR1A = 99;
    TIFR1 = 0xFF;
    TCCR1B = _BV(WGM12) | _BV(CS10);
    uint16_t highest = 0;
    for (uint8_t i = 0; i < 250; i++) {
        uint16_t now = TCNT1;
        if (now > highest)
            highest = now;
    }
    bench_put((uint8_t)highest);
    bench_put(TIFR1 & _BV(TOV1));
    for (;;)
        ;
}
