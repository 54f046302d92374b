// SPDX-License-Identifier: GPL-3.0-or-later
#include "adc.h"

#include <math.h>
#include <simavr/avr_adc.h>

#include "access.h"
#include "leds.h"
#include "noise.h"

enum { ADCL = 0x78, ADCH = 0x79, ADCSRA = 0x7A, ADCSRB = 0x7B, ADMUX = 0x7C };
enum { ADEN = 0x80, ADSC = 0x40, ADATE = 0x20, ADIF = 0x10 };
enum { TRIGGER_SYNC_CYCLES = 3, CHANNEL_TEMPERATURE = 8, CHANNEL_BANDGAP = 14, CHANNEL_GROUND = 15 };

// Stated in the comments of physics.toml, [adc].
static const double SLOW_CLOCK_HZ = 200e3, FAST_CLOCK_HZ = 1e6, FAST_CLOCK_FACTOR = 2.25;
static const double BANDGAP_PART = 0.1, BANDGAP_NOISE_VOLTS = 0.2e-3;

static avr_cycle_count_t on_end(avr_t *avr, avr_cycle_count_t when, void *param);

static avr_cycle_count_t on_join(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    adc_catch_up(param, when);
    return 0;
}

static avr_cycle_count_t on_sample(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    adc_catch_up(param, when);
    return 0;
}

// Start at an ADC clock edge. half_clocks: from the start to sample and hold.
static void start(struct adc *a, uint64_t edge, bool triggered)
{
    unsigned divisor = 1u << (a->avr->data[ADCSRA] & 7);
    a->divisor = divisor < 2 ? 2 : divisor;
    a->admux = a->avr->data[ADMUX];
    a->busy = true;
    a->avr->data[ADCSRA] |= ADSC;
    a->join_at = edge;
    a->sample_at = edge + a->divisor * (a->first ? 27 : triggered ? 4 : 3) / 2;
    a->end_at = edge + a->divisor * (a->first ? 50 : triggered ? 27 : 26) / 2;
    a->first = false;
    access_at(a->avr, a->join_at, on_join, a);
    access_at(a->avr, a->sample_at, on_sample, a);
    access_at(a->avr, a->end_at, on_end, a);
}

void adc_trigger(struct adc *a, enum adc_source source, uint64_t cycle)
{
    const uint8_t *data = a->avr->data;
    if ((data[ADCSRA] & (ADEN | ADATE)) != (ADEN | ADATE) || (data[ADCSRB] & 7) != source || a->busy)
        return;
    a->prescale_base = cycle + TRIGGER_SYNC_CYCLES;
    start(a, a->prescale_base, true);
}

void adc_catch_up(struct adc *a, uint64_t cycle)
{
    int channel = a->admux & 15;
    if (a->before)
        a->before(a->before_param, cycle);
    if (a->join_at && a->join_at <= cycle) {
        if (channel < LEDS_COUNT)
            leds_join(a->leds, channel, a->join_at, a->held_volts);
        a->join_at = 0;
    }
    if (!a->sample_at || a->sample_at > cycle)
        return;
    uint64_t at = a->sample_at;
    a->sample_at = 0;
    if (a->log)
        a->log(a->log_param, "adc", channel, at);
    if (channel < LEDS_COUNT)
        a->held_volts = leds_sample(a->leds, channel, at);
    else if (channel == CHANNEL_TEMPERATURE)
        a->held_volts = 0.314 + 0.001 * a->leds->warmer_k;
    else if (channel == CHANNEL_BANDGAP)
        a->held_volts = a->bandgap_volts
                      + BANDGAP_NOISE_VOLTS * noise_normal(a->seed, NOISE_BANDGAP, a->conversions);
    else if (channel == CHANNEL_GROUND)
        a->held_volts = 0;
    else if (channel == a->leds->wiring->supply_channel)
        a->held_volts = leds_divider(a->leds, at);
    // Another of A6 and A7 is wired to nothing: the capacitor keeps what it had.
}

// Integral non-linearity at a fraction of the range: a fixed smooth curve with both ends at zero, largest
// magnitude 1.
static double inl_shape(const struct adc *a, double x)
{
    double sum = 0;
    for (int k = 0; k < 3; k++)
        sum += sin(M_PI * (k + 1) * x + a->inl_phase[k]) - sin(a->inl_phase[k])
             - x * (sin(M_PI * (k + 1) + a->inl_phase[k]) - sin(a->inl_phase[k]));
    return sum * a->inl_scale;
}

struct reference_noise { double supply_volts, bandgap_volts; };

static double reference(const struct adc *a, uint64_t cycle, const struct reference_noise *noise)
{
    switch (a->admux >> 6) {
    case 1:
        return lamps_supply_at(&a->leds->lamps, cycle) + noise->supply_volts;
    case 3:
        return a->bandgap_volts + noise->bandgap_volts;
    default:  // AREF carries only a capacitor on a Nano: it reads as nothing
        return 1e-3;
    }
}

static uint16_t convert(struct adc *a, uint64_t sampled_at)
{
    uint64_t n = a->conversions++;
    double clock_hz = a->avr->frequency / (double)a->divisor;
    double fast = fmax(clock_hz - SLOW_CLOCK_HZ, 0) / (FAST_CLOCK_HZ - SLOW_CLOCK_HZ);
    double worse = 1.0 + (FAST_CLOCK_FACTOR - 1.0) * fast;
    struct reference_noise noise = {
        a->physics->supply.ripple_mv * 1e-3 * noise_normal(a->seed, NOISE_RIPPLE_REFERENCE, n),
        BANDGAP_NOISE_VOLTS * noise_normal(a->seed, NOISE_BANDGAP_REFERENCE, n),
    };
    double full = reference(a, sampled_at, &noise);
    double error_lsb = a->offset_lsb
                     + a->physics->adc.noise_lsb * worse * noise_normal(a->seed, NOISE_ADC, n)
                     + a->physics->adc.inl_lsb * worse * inl_shape(a, fmin(fmax(a->held_volts / full, 0), 1));
    double input = a->held_volts * a->gain + error_lsb * full / 1024;
    unsigned code = 0;
    for (int bit = 9; bit >= 0; bit--) {
        uint64_t at = sampled_at + (uint64_t)a->divisor * (unsigned)(10 - bit);
        unsigned trial = code | 1u << bit;
        if (input >= (trial - 0.5) / 1024 * reference(a, at, &noise))
            code = trial;
    }
    return (uint16_t)code;
}

static avr_cycle_count_t on_end(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct adc *a = param;
    adc_catch_up(a, when);
    uint16_t code = convert(a, when - (uint64_t)a->divisor * 23 / 2);
    if (!a->locked) {
        uint16_t shown = a->admux & 0x20 ? (uint16_t)(code << 6) : code;
        avr->data[ADCL] = (uint8_t)shown;
        avr->data[ADCH] = (uint8_t)(shown >> 8);
    }
    a->busy = false;
    avr->data[ADCSRA] &= (uint8_t)~ADSC;
    avr_raise_interrupt(avr, a->vector);
    if ((avr->data[ADCSRA] & ADATE) && (avr->data[ADCSRB] & 7) == ADC_TRIGGER_FREE)
        start(a, when, false);
    return 0;
}

static uint8_t read_result(avr_t *avr, avr_io_addr_t at, void *param)
{
    ((struct adc *)param)->locked = at == ADCL;
    return avr->data[at];
}

static void write_nothing(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    (void)avr, (void)at, (void)value, (void)param;
}

static void write_control(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct adc *a = param;
    uint8_t was = avr->data[at];
    uint64_t now = access_write_cycle(avr);
    adc_catch_up(a, now);
    avr->data[at] = (uint8_t)((value & ~(ADSC | ADIF)) | (was & (ADSC | ADIF)));
    if (value & ADIF)
        avr_clear_interrupt(avr, a->vector);
    access_edge_enabled(avr, a->vector);
    if (!(value & ADEN)) {
        avr->data[at] &= (uint8_t)~ADSC;
        avr_cycle_timer_cancel(avr, on_join, a);
        avr_cycle_timer_cancel(avr, on_sample, a);
        leds_part(a->leds, now);
        avr_cycle_timer_cancel(avr, on_end, a);
        a->busy = false;
        a->sample_at = a->join_at = 0;
        return;
    }
    if (!(was & ADEN)) {
        a->first = true;
        a->prescale_base = now;
    }
    if ((value & ADSC) && !a->busy) {
        unsigned divisor = 1u << (value & 7);
        if (divisor < 2)
            divisor = 2;
        start(a, now + divisor - (now - a->prescale_base) % divisor, false);
    }
}

void adc_attach(struct adc *a, avr_t *avr, struct leds *leds, const struct physics *physics, uint64_t seed)
{
    memset(a, 0, sizeof *a);
    a->avr = avr;
    a->leds = leds;
    a->physics = physics;
    a->vector = &((avr_adc_t *)access_module(avr, "adc"))->adc;
    a->offset_lsb = physics->adc.offset_lsb * (noise_uniform(seed, NOISE_ADC_PART, 0) < 0.5 ? -1 : 1);
    a->gain = 1 + physics->adc.gain_error * (noise_uniform(seed, NOISE_ADC_PART, 1) < 0.5 ? -1 : 1);
    double bandgap_part = BANDGAP_PART * (2 * noise_uniform(seed, NOISE_BANDGAP, 0) - 1);
    a->bandgap_volts = physics->adc.bandgap_v * (1 + bandgap_part);
    for (int k = 0; k < 3; k++)
        a->inl_phase[k] = 2 * M_PI * noise_uniform(seed, NOISE_ADC_INL, (uint64_t)k);
    double peak = 0;
    a->inl_scale = 1;
    for (int i = 0; i <= 64; i++)
        peak = fmax(peak, fabs(inl_shape(a, i / 64.0)));
    a->inl_scale = 1 / fmax(peak, 1e-3);
    access_take_write(avr, ADCSRA, write_control, a);
    access_take_write(avr, ADCSRB, NULL, NULL);
    access_take_write(avr, ADMUX, NULL, NULL);
    access_take_read(avr, ADCSRA, NULL, NULL);
    access_take_write(avr, ADCL, write_nothing, a);
    access_take_write(avr, ADCH, write_nothing, a);
    access_take_read(avr, ADCL, read_result, a);
    access_take_read(avr, ADCH, read_result, a);
    adc_reset(a);
}

void adc_reset(struct adc *a)
{
    a->busy = a->locked = false;
    a->first = true;
    a->sample_at = a->join_at = 0;
    leds_part(a->leds, a->avr->cycle);
    a->prescale_base = a->avr->cycle;
}
