// SPDX-License-Identifier: Apache-2.0
// What every bench program of tests/nano needs: the serial line at 1 Mbaud, polled.
#ifndef BENCH_H
#define BENCH_H

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

static inline void bench_begin(void)
{
    UCSR0A = _BV(U2X0);
    UBRR0 = 1;
    UCSR0B = _BV(RXEN0) | _BV(TXEN0);
}

static inline void bench_put(uint8_t byte)
{
    while (!(UCSR0A & _BV(UDRE0)))
        ;
    UDR0 = byte;
}

static inline void bench_put16(uint16_t word)
{
    bench_put((uint8_t)word);
    bench_put((uint8_t)(word >> 8));
}

static inline uint8_t bench_get(void)
{
    while (!(UCSR0A & _BV(RXC0)))
        ;
    return UDR0;
}

#endif
