// SPDX-License-Identifier: Apache-2.0
// Receive and data-register interrupts, which are levels: echoes every byte through a ring, in interrupts
// alone, and takes only one byte per receive interrupt.
#include "bench.h"

static volatile uint8_t ring[64];
static volatile uint8_t head, tail;

ISR(USART_RX_vect)
{
    ring[head++ & 63] = UDR0;
    UCSR0B |= _BV(UDRIE0);
}

ISR(USART_UDRE_vect)
{
    UDR0 = ring[tail++ & 63];
    if (tail == head)
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
}

int main(void)
{
    bench_begin();
    UCSR0B |= _BV(RXCIE0);
    for (;;) {
        cli();
        __builtin_avr_delay_cycles(300);    // two bytes pile up: the second asks again after RETI
        sei();
        __builtin_avr_delay_cycles(20);
    }
}
