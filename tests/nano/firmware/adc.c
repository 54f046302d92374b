// SPDX-License-Identifier: Apache-2.0
// The converter and the LEDs on the bench. A command byte from the host starts an experiment; its answer
// follows.
//   'T' ticks16            auto-trigger at OCR1B = ticks, the multiplexer moved on right after: code16
//   'P'                    one software start: duration16 until ADIF, in cycles
//   'L'                    started on a high channel, multiplexer moved to a low one: both codes
//   'F'                    ADIF: set after a conversion, cleared by writing one: two bytes
//   'E'                    matches while OCF1B stays set, then after clearing it: conversions seen, two bytes
//   'B'                    the bandgap against AVcc: code16
//   'I'                    interrupts counted while free running for 10 conversions' time
//   'X' lit, flags, ticks16, dark16   an exposure of LED 0: code16
//        flags 1: leave the pull-up on   2: sample capacitor from a low channel   4: lights out at `dark`
//        ticks
#include "bench.h"

enum { SLOW = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0) };

static volatile uint8_t interrupts;

ISR(ADC_vect)
{
    interrupts++;
}

static uint16_t get16(void)
{
    uint8_t low = bench_get();
    return (uint16_t)(low | bench_get() << 8);
}

static uint16_t convert(uint8_t channel)
{
    ADMUX = _BV(REFS0) | channel;
    ADCSRA = SLOW | _BV(ADSC) | _BV(ADIF);
    while (!(ADCSRA & _BV(ADIF)))
        ;
    return ADC;
}

static void arm(uint16_t ticks)
{
    ADMUX = _BV(REFS0);
    ADCSRB = _BV(ADTS2) | _BV(ADTS0);
    TCCR1A = 0;
    TCCR1B = 0;
    TCNT1 = 0;
    OCR1B = ticks;
    TIFR1 = _BV(OCF1B);
    ADCSRA = SLOW | _BV(ADATE) | _BV(ADIF);
}

static uint16_t finish(void)
{
    while (!(ADCSRA & _BV(ADIF)))
        ;
    uint16_t code = ADC;
    ADCSRA = SLOW | _BV(ADIF);
    return code;
}

static void triggered(void)
{
    arm(get16());
    __asm__ volatile("out %[mark], %[one]\n\tsts %[ctl], %[one]"
                     : : [mark] "I"(_SFR_IO_ADDR(GPIOR1)), [one] "r"((uint8_t)1),
                       [ctl] "i"(_SFR_MEM_ADDR(TCCR1B)));
    while (!(TIFR1 & _BV(OCF1B)))
        ;
    ADMUX = _BV(REFS0) | 1;
    bench_put16(finish());
}

static void phase(void)
{
    TCCR1B = _BV(CS10);
    ADMUX = _BV(REFS0);
    ADCSRA = SLOW | _BV(ADIF);
    uint16_t before = TCNT1;
    ADCSRA = SLOW | _BV(ADSC);
    while (!(ADCSRA & _BV(ADIF)))
        ;
    bench_put16(TCNT1 - before);
}

static void latch(void)
{
    PORTC = 1;
    DDRC = 3;
    ADMUX = _BV(REFS0);
    ADCSRA = SLOW | _BV(ADSC) | _BV(ADIF);
    __builtin_avr_delay_cycles(3 * 128);
    ADMUX = _BV(REFS0) | 1;
    bench_put16(finish());
    bench_put16(convert(1));
}

static void flag(void)
{
    convert(0);
    bench_put(ADCSRA & _BV(ADIF));
    ADCSRA = SLOW | _BV(ADIF);
    bench_put(ADCSRA & _BV(ADIF));
}

static uint8_t converts(void)
{
    ADCSRA = SLOW | _BV(ADATE) | _BV(ADIF);
    TCNT1 = 0;
    __builtin_avr_delay_cycles(4000);
    uint8_t seen = (ADCSRA & _BV(ADIF)) != 0;
    ADCSRA = SLOW | _BV(ADATE) | _BV(ADIF);
    return seen;
}

static void edge(void)
{
    arm(500);
    TCCR1B = _BV(CS10);
    converts();             // sets OCF1B, which stays
    bench_put(converts());
    TIFR1 = _BV(OCF1B);
    bench_put(converts());
    ADCSRA = SLOW | _BV(ADIF);
}

static void count_interrupts(void)
{
    ADCSRB = 0;
    interrupts = 0;
    ADCSRA = SLOW | _BV(ADATE) | _BV(ADIE) | _BV(ADIF) | _BV(ADSC);
    sei();
    __builtin_avr_delay_cycles(14UL * 128 + 9UL * 13 * 128);
    cli();
    ADCSRA = SLOW;
    bench_put(interrupts);
    while (ADCSRA & _BV(ADSC))
        ;
    ADCSRA = SLOW | _BV(ADIF);
}

static void expose(void)
{
    uint8_t lit = bench_get(), flags = bench_get();
    uint16_t ticks = get16(), dark = get16();
    uint8_t port = flags & 1;
    DDRD |= 0xFC;
    DDRC = 0x3F;
    PORTC = 1;
    convert(flags & 2 ? 1 : 0);
    PORTD = (uint8_t)((lit & 0x3E) << 2) | 1;
    __builtin_avr_delay_cycles(80);
    arm(ticks);
    TCCR1B = _BV(CS10);
    __asm__ volatile("out %[ddr], %[mask]\n\tout %[port], %[value]\n\tout %[mark], %[one]"
                     : : [ddr] "I"(_SFR_IO_ADDR(DDRC)), [mask] "r"((uint8_t)0x3E),
                       [port] "I"(_SFR_IO_ADDR(PORTC)), [value] "r"(port),
                       [mark] "I"(_SFR_IO_ADDR(GPIOR1)), [one] "r"((uint8_t)1));
    if (flags & 4) {
        while (TCNT1 < dark)
            ;
        __asm__ volatile("out %[port], %[one]\n\tout %[mark], %[two]"
                         : : [port] "I"(_SFR_IO_ADDR(PORTD)), [one] "r"((uint8_t)1),
                           [mark] "I"(_SFR_IO_ADDR(GPIOR1)), [two] "r"((uint8_t)2));
    }
    bench_put16(finish());
}

int main(void)
{
    bench_begin();
    PORTD = 1;
    convert(0);
    for (;;)
        switch (bench_get()) {
        case 'T': triggered(); break;
        case 'P': phase(); break;
        case 'L': latch(); break;
        case 'F': flag(); break;
        case 'E': edge(); break;
        case 'B': bench_put16(convert(14)); break;
        case 'I': count_interrupts(); break;
        case 'X': expose(); break;
        }
}
