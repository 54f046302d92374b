// SPDX-License-Identifier: Apache-2.0
// Senses with LED 0 while the other five light, every 2 ms, and sends the code; answers 'p' with the number
// of samples so far. The watchdog is fed until 'w' comes.
#include "bench.h"

static void convert(uint8_t admux)
{
    ADMUX = admux;
    ADCSRA = _BV(ADEN) | _BV(ADSC) | _BV(ADIF) | 7;
    while (!(ADCSRA & _BV(ADIF)))
        ;
}

int main(void)
{
    uint16_t samples = 0;
    uint8_t feed = 1;
    wdt_enable(WDTO_120MS);
    bench_begin();
    TCCR1B = _BV(CS10);
    for (;;) {
        uint16_t start = TCNT1;
        DDRC = 0x3F;
        PORTC = 0;
        convert(_BV(REFS1) | _BV(REFS0) | 15);
        PORTC = 0x3E;
        DDRC = 0x3E;
        __builtin_avr_delay_cycles(2000);
        convert(_BV(REFS1) | _BV(REFS0));
        PORTC = 0;
        samples++;
        bench_put16(ADC);
        if (UCSR0A & _BV(RXC0)) {
            uint8_t command = UDR0;
            if (command == 'p')
                bench_put16(samples);
            if (command == 'w')
                feed = 0;
        }
        if (feed)
            wdt_reset();
        while ((uint16_t)(TCNT1 - start) < 32000)
            ;
    }
}
