// SPDX-License-Identifier: GPL-3.0-or-later
#include "timer1.h"

#include <simavr/avr_timer.h>

#include "access.h"
#include "adc.h"

enum {
    TIFR1 = 0x36, TIMSK1 = 0x6F, TCCR1A = 0x80, TCCR1B = 0x81, TCNT1L = 0x84, TCNT1H = 0x85,
    ICR1L = 0x86, ICR1H = 0x87, OCR1AL = 0x88, OCR1AH = 0x89, OCR1BL = 0x8A, OCR1BH = 0x8B,
};
static const uint64_t NEVER = UINT64_MAX;

static uint32_t top(const struct timer1 *t)
{
    const uint8_t *data = t->avr->data;
    int mode = (data[TCCR1A] & 3) | (data[TCCR1B] >> 1 & 0xC);
    return mode == 4 ? t->compare[0] : mode == 12 ? t->capture : 0xFFFF;
}

// The prescaler runs from reset on; the counter steps when the cycle number is a multiple of the divisor.
static uint16_t count_at(const struct timer1 *t, uint64_t cycle)
{
    if (!t->divisor)
        return t->base_count;
    uint64_t steps = cycle / t->divisor - t->base_cycle / t->divisor;
    uint64_t period = t->base_count > top(t) ? 0x10000 : (uint64_t)top(t) + 1;
    return (uint16_t)((t->base_count + steps) % period);
}

// First cycle after `now` at which the flag of an event rises: one step after the counter equals the value.
static uint64_t next_event(const struct timer1 *t, int event, uint64_t now)
{
    uint32_t last = top(t), count = count_at(t, now);
    uint32_t value = event == TIMER1_OVF ? 0xFFFF : t->compare[event];
    uint32_t period = count > last ? 0x10000 : last + 1;
    if (!t->divisor || (value > last && count <= last))
        return NEVER;
    uint64_t steps = (value + period - count) % period + 1;
    return (now / t->divisor + steps) * t->divisor;
}

static avr_cycle_count_t due(avr_t *avr, avr_cycle_count_t when, void *param);

static void arm(struct timer1 *t)
{
    uint64_t first = NEVER;
    for (int i = 0; i < TIMER1_EVENTS; i++)
        if (t->next[i] < first)
            first = t->next[i];
    avr_cycle_timer_cancel(t->avr, due, t);
    if (first != NEVER)
        access_at(t->avr, first, due, t);
}

static void fire_until(struct timer1 *t, uint64_t now)
{
    avr_t *avr = t->avr;
    for (int i = 0; i < TIMER1_EVENTS; i++)
        while (t->next[i] <= now) {
            uint64_t when = t->next[i];
            avr_int_vector_t *vector = t->vector[i];
            int was = avr->data[TIFR1] >> vector->raised.bit & 1;
            avr_raise_interrupt(avr, vector);
            t->next[i] = next_event(t, i, when);
            if (!was && t->adc && i != TIMER1_COMPA)
                adc_trigger(t->adc, i == TIMER1_COMPB ? ADC_TRIGGER_T1_COMPB : ADC_TRIGGER_T1_OVF, when);
        }
}

static avr_cycle_count_t due(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct timer1 *t = param;
    (void)when;
    fire_until(t, avr->cycle);
    arm(t);
    return 0;
}

static void reschedule(struct timer1 *t, uint64_t now)
{
    for (int i = 0; i < TIMER1_EVENTS; i++)
        t->next[i] = next_event(t, i, now);
    arm(t);
}

static void write_high(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    (void)avr, (void)at;
    ((struct timer1 *)param)->temp = value;
}

static void write_low(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct timer1 *t = param;
    uint64_t now = access_write_cycle(avr);
    uint16_t whole = (uint16_t)(t->temp << 8 | value);
    fire_until(t, now);
    t->base_count = count_at(t, now);
    t->base_cycle = now;
    if (at == TCNT1L)
        t->base_count = whole;
    else if (at == ICR1L)
        t->capture = whole;
    else
        t->compare[at == OCR1BL] = whole;
    reschedule(t, now);
}

static uint8_t read_count(avr_t *avr, avr_io_addr_t at, void *param)
{
    struct timer1 *t = param;
    uint16_t count = count_at(t, access_read_cycle(avr));
    t->temp = (uint8_t)(count >> 8);
    return avr->data[at] = (uint8_t)count;
}

static uint8_t read_temp(avr_t *avr, avr_io_addr_t at, void *param)
{
    return avr->data[at] = ((struct timer1 *)param)->temp;
}

static uint8_t read_compare(avr_t *avr, avr_io_addr_t at, void *param)
{
    struct timer1 *t = param;
    uint16_t whole = at <= ICR1H ? t->capture : t->compare[at >= OCR1BL];
    if (at == ICR1L)
        t->temp = (uint8_t)(whole >> 8);
    return avr->data[at] = (uint8_t)(at & 1 ? (at == ICR1H ? t->temp : whole >> 8) : whole);
}

static void write_control(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    static const unsigned divisors[8] = {0, 1, 8, 64, 256, 1024, 0, 0};
    struct timer1 *t = param;
    uint64_t now = access_write_cycle(avr);
    fire_until(t, now);
    t->base_count = count_at(t, now);
    t->base_cycle = now;
    avr->data[at] = value;
    t->divisor = divisors[avr->data[TCCR1B] & 7];
    reschedule(t, now);
}

// Writing a one clears a flag.
static void write_flags(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct timer1 *t = param;
    (void)at;
    value = access_flags_written(avr, value);
    for (int i = 0; i < TIMER1_EVENTS; i++)
        if (value >> t->vector[i]->raised.bit & 1)
            avr_clear_interrupt(avr, t->vector[i]);
}

static void write_mask(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct timer1 *t = param;
    avr->data[at] = value;
    for (int i = 0; i < TIMER1_EVENTS; i++)
        access_edge_enabled(avr, t->vector[i]);
}

void timer1_attach(struct timer1 *t, avr_t *avr, struct adc *adc)
{
    memset(t, 0, sizeof *t);
    t->avr = avr;
    t->adc = adc;
    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        avr_timer_t *stock = (avr_timer_t *)io;
        if (strcmp(io->kind, "timer") || stock->name != '1')
            continue;
        t->vector[TIMER1_COMPA] = &stock->comp[AVR_TIMER_COMPA].interrupt;
        t->vector[TIMER1_COMPB] = &stock->comp[AVR_TIMER_COMPB].interrupt;
        t->vector[TIMER1_OVF] = &stock->overflow;
    }
    access_take_write(avr, TCCR1A, write_control, t);
    access_take_write(avr, TCCR1B, write_control, t);
    access_take_write(avr, TIFR1, write_flags, t);
    access_take_write(avr, TIMSK1, write_mask, t);
    for (int low = TCNT1L; low <= OCR1BL; low += 2) {
        access_take_write(avr, (avr_io_addr_t)low, write_low, t);
        access_take_write(avr, (avr_io_addr_t)(low + 1), write_high, t);
        access_take_read(avr, (avr_io_addr_t)low, low == TCNT1L ? read_count : read_compare, t);
        access_take_read(avr, (avr_io_addr_t)(low + 1), low == TCNT1L ? read_temp : read_compare, t);
    }
    timer1_reset(t);
}

void timer1_reset(struct timer1 *t)
{
    t->base_cycle = t->avr->cycle;
    t->base_count = t->compare[0] = t->compare[1] = t->capture = 0;
    t->temp = 0;
    t->divisor = 0;
    for (int i = 0; i < TIMER1_EVENTS; i++)
        t->next[i] = NEVER;
}
