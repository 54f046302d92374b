// SPDX-License-Identifier: Apache-2.0
// The serial line on the bench. Commands:
//   'S' n          say n bytes 0, 1, 2 ... as fast as the line goes
//   'D'             wait 2 ms without reading, then answer the status and data of everything in the receiver
//   'U'             cycles between writing two bytes and UDRE, TXC coming back: three 16-bit words
#include "bench.h"

static void say(void)
{
    uint8_t count = bench_get();
    for (uint8_t i = 0; i < count; i++)
        bench_put(i);
}

static void drain(void)
{
    uint8_t found[10], n = 0;
    __builtin_avr_delay_cycles(32000);
    while ((UCSR0A & _BV(RXC0)) && n < sizeof found) {
        found[n++] = UCSR0A & (_BV(FE0) | _BV(DOR0));
        found[n++] = UDR0;
    }
    bench_put(n);
    for (uint8_t i = 0; i < n; i++)
        bench_put(found[i]);
}

static void transmitter(void)
{
    while (!(UCSR0A & _BV(UDRE0)))
        ;
    __builtin_avr_delay_cycles(2000);
    TCCR1B = _BV(CS10);
    UCSR0A = _BV(U2X0) | _BV(TXC0);
    uint16_t start = TCNT1;
    UDR0 = 0x55;
    uint8_t at_once = UCSR0A & _BV(UDRE0);
    UDR0 = 0xAA;
    while (!(UCSR0A & _BV(UDRE0)))
        ;
    uint16_t first = TCNT1 - start;
    while (!(UCSR0A & _BV(TXC0)))
        ;
    uint16_t last = TCNT1 - start;
    bench_put(at_once);
    bench_put16(first);
    bench_put16(last);
}

int main(void)
{
    bench_begin();
    for (;;)
        switch (bench_get()) {
        case 'S': say(); break;
        case 'D': drain(); break;
        case 'U': transmitter(); break;
        }
}
