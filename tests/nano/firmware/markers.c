// SPDX-License-Identifier: Apache-2.0
// Sections of known length: 0 empty, 1 ten NOPs, 2 ten cycles with an interrupt of known length among them,
// 3 the interrupt itself, from its own first instruction. Then two frame marks and a zero byte.
#include "bench.h"

#define BEGIN(k) "ldi r24, 2 * " #k " + 1\n\tout %[mark], r24\n\t"
#define END(k) "ldi r24, 2 * " #k " + 2\n\tout %[mark], r24\n\t"
#define FIVE "nop\n\tnop\n\tnop\n\tnop\n\tnop\n\t"
#define MARK : : [mark] "I"(_SFR_IO_ADDR(GPIOR0)) : "r24"

// vector jmp 3, ldi 1, out 1 | 5 nops | ldi 1, out 1, reti 4; r24 is the main program's to lose
ISR(TIMER1_COMPA_vect, ISR_NAKED)
{
    __asm__ volatile(BEGIN(3) FIVE END(3) "reti" MARK);
}

int main(void)
{
    bench_begin();
    TCCR1B = _BV(CS10);
    for (uint8_t i = 0; i < 3; i++) {
        __asm__ volatile(BEGIN(0) END(0) MARK);
        __asm__ volatile(BEGIN(1) FIVE FIVE END(1) MARK);
        OCR1A = TCNT1 + 100;
        TIFR1 = _BV(OCF1A);
        TIMSK1 = _BV(OCIE1A);
        while (!(TIFR1 & _BV(OCF1A)))
            ;
        // The interrupt waits for the second instruction after SEI.
        __asm__ volatile(BEGIN(2) "sei\n\t" FIVE "nop\n\tnop\n\tnop\n\tcli\n\t" END(2) MARK);
    }
    GPIOR1 = 1;
    __builtin_avr_delay_cycles(1599);
    GPIOR1 = 2;
    bench_put(7);
    bench_put(0);
    for (;;)
        ;
}
