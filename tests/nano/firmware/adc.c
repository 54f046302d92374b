// SPDX-License-Identifier: Apache-2.0
// The converter and the LEDs on the bench. A command byte from the host starts an experiment; its answer
// follows.
//   'T' ticks16            auto-trigger at OCR1B = ticks, the multiplexer moved on right after: code16
//   'P'                    one software start: duration16 until ADIF, in cycles
//   'L'                    started on a high channel, multiplexer moved to a low one: both codes
//   'F'                    ADIF: set after a conversion, cleared by writing one: two bytes
//   'E'                    matches while OCF1B stays set, then after clearing it: conversions seen, two bytes
//   'C' admux              one conversion: code16
//   'I'                    interrupts counted while free running for 10 conversions' time
//   'X' lit, flags, ticks16, dark16   an exposure of LED 0, held low before, to OCR1B = ticks: code16
//        flags 1: pull-up on   2: sample capacitor from LED 1, high   4: lights out at `dark` ticks
//        8: prescaler 64   16: against the bandgap   32: lights of port D, not of port C
//        GPIOR1 = 2 right after lights on and lights out, 1 right after the release
//   'Q' n, slot16, admux...  n conversions at prescaler 64, one every slot cycles by Timer1 compare B, the
//        multiplexer moved on 80 cycles after each match, all nodes let go just before: n code16
#include "bench.h"

enum { SLOW = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0), FAST = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1) };

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

static uint16_t convert_as(uint8_t admux)
{
    ADMUX = admux;
    ADCSRA = SLOW | _BV(ADSC) | _BV(ADIF);
    while (!(ADCSRA & _BV(ADIF)))
        ;
    return ADC;
}

static uint16_t convert(uint8_t channel)
{
    return convert_as(_BV(REFS0) | channel);
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
    DDRC = 0x3F;
    PORTC = flags & 2 ? 2 : 0;
    convert(flags & 2 ? 1 : 15);
    if (flags & 32)
        PORTD = lit;
    lit = flags & 32 ? 0 : lit & 0x3E;
    __asm__ volatile("out %[port], %[lit]\n\tout %[mark], %[two]"
                     : : [port] "I"(_SFR_IO_ADDR(PORTC)), [lit] "r"(lit), [mark] "I"(_SFR_IO_ADDR(GPIOR1)),
                       [two] "r"((uint8_t)2));
    __builtin_avr_delay_cycles(80);
    arm(ticks);
    if (flags & 8)
        ADCSRA = FAST | _BV(ADATE) | _BV(ADIF);
    if (flags & 16)
        ADMUX = _BV(REFS1) | _BV(REFS0);
    TCCR1B = _BV(CS10);
    __asm__ volatile("out %[ddr], %[mask]\n\tout %[mark], %[one]"
                     : : [ddr] "I"(_SFR_IO_ADDR(DDRC)), [mask] "r"((uint8_t)0x3E),
                       [mark] "I"(_SFR_IO_ADDR(GPIOR1)), [one] "r"((uint8_t)1));
    if (flags & 1)
        PORTC = lit | 1;
    if (flags & 4) {
        while (TCNT1 < dark)
            ;
        if (flags & 32)
            __asm__ volatile("out %[port], __zero_reg__\n\tout %[mark], %[two]"
                             : : [port] "I"(_SFR_IO_ADDR(PORTD)), [mark] "I"(_SFR_IO_ADDR(GPIOR1)),
                               [two] "r"((uint8_t)2));
        else
            __asm__ volatile("out %[port], __zero_reg__\n\tout %[mark], %[two]"
                             : : [port] "I"(_SFR_IO_ADDR(PORTC)), [mark] "I"(_SFR_IO_ADDR(GPIOR1)),
                               [two] "r"((uint8_t)2));
    }
    bench_put16(finish());
    PORTC = 0;
    PORTD = 0;
}

static void slots(void)
{
    uint8_t admux[20], n = bench_get();
    uint16_t slot = get16(), codes[20];
    for (uint8_t i = 0; i < n && i < 20; i++)
        admux[i] = bench_get();
    PORTC = 0;
    DDRC = 0x3F;
    arm(slot);
    ADMUX = admux[0];
    ADCSRA = FAST | _BV(ADATE) | _BV(ADIF);
    DDRC = 0;
    __asm__ volatile("out %[mark], %[one]\n\tsts %[ctl], %[one]"
                     : : [mark] "I"(_SFR_IO_ADDR(GPIOR1)), [one] "r"((uint8_t)1),
                       [ctl] "i"(_SFR_MEM_ADDR(TCCR1B)));
    for (uint8_t i = 0; i < n && i < 20; i++) {
        while (!(TIFR1 & _BV(OCF1B)))
            ;
        __builtin_avr_delay_cycles(80);
        if (i + 1 < n) {
            ADMUX = admux[i + 1];
            OCR1B = (uint16_t)((i + 2) * slot);
        }
        TIFR1 = _BV(OCF1B);
        while (!(ADCSRA & _BV(ADIF)))
            ;
        codes[i] = ADC;
        ADCSRA = FAST | _BV(ADATE) | _BV(ADIF);
    }
    ADCSRA = SLOW | _BV(ADIF);
    for (uint8_t i = 0; i < n && i < 20; i++)
        bench_put16(codes[i]);
}

int main(void)
{
    bench_begin();
    DDRD |= 0xFC;
    convert(0);
    for (;;)
        switch (bench_get()) {
        case 'T': triggered(); break;
        case 'P': phase(); break;
        case 'L': latch(); break;
        case 'F': flag(); break;
        case 'E': edge(); break;
        case 'C': bench_put16(convert_as(bench_get())); break;
        case 'I': count_interrupts(); break;
        case 'X': expose(); break;
        case 'Q': slots(); break;
        }
}
