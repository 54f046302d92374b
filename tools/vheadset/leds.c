// SPDX-License-Identifier: GPL-3.0-or-later
#include "leds.h"

#include <math.h>
#include <stdlib.h>
#include <simavr/avr_ioport.h>

#include "../../sim_c/sim_map.h"
#include "access.h"
#include "adc.h"
#include "noise.h"
#include "person.h"

enum { PINC = 0x26, DDRC = 0x27, PORTC = 0x28, DDRD = 0x2A, PORTD = 0x2B, MCUCR = 0x55, PUD = 0x10 };
static const double BUILT_IN_VOLTS = 0.7, GRADING = 0.4, FLOOR_VOLTS = -0.25, FORWARD_VOLTS = 1.2;
static const double PULLUP_OHM = 35e3;
// Stated in the comments of physics.toml, [photocurrent], [node] and [ambient].
static const double LED_AMPERES = 0.020, LEAKAGE_DOUBLES_K = 10;
static const double ROOM_FLICKER = 0.3, BRIGHT_ROOM_FLICKER = 0.5;
static const uint64_t RESPONSE_REUSE_CYCLES = 800;  // 50 us: the fastest saccade turns 0.03 deg

double leds_charge_pc(const struct physics *p, double volts, double extra_pf)
{
    double power = 1 - GRADING, scale = p->node.junction_pf * BUILT_IN_VOLTS / power;
    double junction = scale * (pow(1 + volts / BUILT_IN_VOLTS, power) - 1);
    return junction + (p->node.pin_pf + extra_pf) * volts;
}

static double capacitance_pf(const struct physics *p, double volts)
{
    return p->node.junction_pf / pow(1 + volts / BUILT_IN_VOLTS, GRADING) + p->node.pin_pf;
}

double leds_volts(const struct physics *p, double charge_pc, double extra_pf)
{
    if (charge_pc <= leds_charge_pc(p, FLOOR_VOLTS, extra_pf))
        return FLOOR_VOLTS;
    double volts = charge_pc / (capacitance_pf(p, 2.5) + extra_pf);
    for (int i = 0; i < 40; i++) {
        if (volts < FLOOR_VOLTS)
            volts = FLOOR_VOLTS;
        double excess_pc = leds_charge_pc(p, volts, extra_pf) - charge_pc;
        double step = excess_pc / (capacitance_pf(p, volts) + extra_pf);
        volts -= step;
        if (fabs(step) < 1e-12)
            break;
    }
    return volts;
}

static uint8_t lit_at(const struct leds *l, uint64_t cycle)
{
    for (unsigned i = 1; i <= LEDS_HISTORY; i++) {
        const struct led_stretch *h = &l->history[(l->history_next - i) % LEDS_HISTORY];
        if (h->since <= cycle)
            return h->lit;
    }
    return l->lit;
}

double leds_supply_volts(const struct leds *l, uint64_t cycle)
{
    return l->physics->supply.volts
         - l->physics->supply.source_ohm * LED_AMPERES * __builtin_popcount(lit_at(l, cycle));
}

double leds_temperature_k(const struct leds *l)
{
    return l->warmer_k;
}

static double ripple(const struct leds *l, enum noise_purpose purpose, uint64_t n)
{
    return l->physics->supply.ripple_mv * 1e-3 * noise_normal(l->seed, purpose, n);
}

// Response map at the middle of a stretch.
static const double *response_at(struct leds *l, uint64_t cycle)
{
    uint64_t apart = cycle > l->response_cycle ? cycle - l->response_cycle : l->response_cycle - cycle;
    if (!l->response_known || apart > RESPONSE_REUSE_CYCLES) {
        struct person_view view;
        person_view_at(l->person, (double)cycle / 16.0, &view);
        sim_map_eval(l->map, &view.state, l->response);
        l->response_cycle = cycle;
        l->response_known = true;
    }
    return l->response;
}

// Mean photocurrent of the ambient light between two cycles, nA, for a nominal part.
static double ambient_na(const struct leds *l, uint64_t from, uint64_t to)
{
    double steady = l->ambient_na * l->sensitivity;
    if (l->ambient_flicker == 0 || to <= from)
        return steady;
    double w = 2 * M_PI * l->flicker_hz / l->cycles_per_true_second;
    double end = w * (double)to + l->flicker_phase, begin = w * (double)from + l->flicker_phase;
    double wave = (sin(end) - sin(begin)) / (w * (double)(to - from));
    return steady * (1 - l->ambient_flicker * wave);
}

static double joined_pf(const struct leds *l, int i)
{
    return l->joined == i ? l->physics->node.sample_hold_pf : 0;
}

// Bring a floating node's voltage forward.
static void discharge(struct leds *l, int i, uint64_t to)
{
    struct led *led = &l->led[i];
    double charge_fc = 0;  // nA times us
    for (int k = 0; k < led->stretches; k++) {
        uint64_t from = led->stretch[k].since;
        uint64_t end = k + 1 < led->stretches ? led->stretch[k + 1].since : to;
        if (end > to)
            end = to;
        if (end <= from)
            continue;
        double current_na = led->leakage_na * exp2(l->warmer_k / LEAKAGE_DOUBLES_K)
                          + led->sensor * ambient_na(l, from, end);
        uint8_t lit = (uint8_t)(led->stretch[k].lit & ~(1u << i));
        if (lit && l->map) {
            const double *row = response_at(l, from + (end - from) / 2) + i * LEDS_COUNT;
            double sum = 0;
            for (int e = 0; e < LEDS_COUNT; e++)
                if (lit >> e & 1)
                    sum += row[e] * l->led[e].emitter;
            current_na += l->scale_na * led->sensor * sum
                        * (1 + l->physics->photocurrent.heat_per_k * l->warmer_k);
        }
        charge_fc += current_na * (double)(end - from) / 16.0;
    }
    double extra_pf = joined_pf(l, i);
    led->volts = leds_volts(l->physics, leds_charge_pc(l->physics, led->volts, extra_pf) - charge_fc * 1e-3,
                            extra_pf);
    led->since = to;
    led->stretch[0] = (struct led_stretch){to, l->lit};
    led->stretches = 1;
}

// Charge a node through the pull-up; photocurrent is negligible beside it.
static void pull_up(struct leds *l, int i, uint64_t to)
{
    struct led *led = &l->led[i];
    double supply = leds_supply_volts(l, to), left_s = (double)(to - led->since) / 16e6;
    while (left_s > 0 && supply - led->volts > 1e-6) {
        double tau = PULLUP_OHM * (capacitance_pf(l->physics, led->volts) + joined_pf(l, i)) * 1e-12;
        double step = fmin(left_s, tau / 16);
        led->volts += (supply - led->volts) * -expm1(-step / tau);
        left_s -= step;
    }
    led->since = to;
}

static void bring_to(struct leds *l, int i, uint64_t to)
{
    struct led *led = &l->led[i];
    if (to <= led->since)
        return;
    if (led->drive == LED_FLOAT)
        discharge(l, i, to);
    else if (led->drive == LED_PULLUP)
        pull_up(l, i, to);
    else if (led->drive == LED_REVERSE)
        led->volts = leds_supply_volts(l, to);
    led->since = to;
}

static enum led_drive drive_of(const struct leds *l, int i)
{
    int cathode = 1 << i, anode = 4 << i;
    bool anode_out = l->ddr_d & anode, anode_high = l->port_d & anode;
    if (l->ddr_c & cathode) {
        if (l->port_c & cathode)
            return LED_REVERSE;
        return anode_out && anode_high ? LED_EMIT : LED_OFF;
    }
    if ((l->port_c & cathode) && !(l->avr->data[MCUCR] & PUD))
        return LED_PULLUP;
    return anode_out ? LED_FLOAT : LED_OPEN;
}

static void enter(struct leds *l, int i, enum led_drive drive, uint64_t now)
{
    struct led *led = &l->led[i];
    enum led_drive was = led->drive;
    if (was == drive)
        return;
    if (drive == LED_FLOAT || drive == LED_PULLUP || drive == LED_OPEN) {
        bring_to(l, i, now);
        if (was == LED_REVERSE)
            led->volts = leds_supply_volts(l, now) + ripple(l, NOISE_RIPPLE_RELEASE, l->releases++);
    }
    led->drive = drive;
    led->since = now;
    led->stretches = 0;
    if (drive == LED_OFF || drive == LED_EMIT)
        led->volts = 0;
    else if (drive == LED_REVERSE)
        led->volts = leds_supply_volts(l, now);
    else if (drive == LED_FLOAT)
        led->stretch[led->stretches++] = (struct led_stretch){now, l->lit};
}

static void pins_changed(struct leds *l, uint64_t now)
{
    enum led_drive drive[LEDS_COUNT];
    uint8_t lit = 0;
    adc_catch_up(l->adc, now);
    for (int i = 0; i < LEDS_COUNT; i++) {
        drive[i] = drive_of(l, i);
        if (drive[i] == LED_EMIT)
            lit |= (uint8_t)(1 << i);
    }
    if (lit != l->lit) {
        l->history[l->history_next++ % LEDS_HISTORY] = (struct led_stretch){now, lit};
        l->lit = lit;
        for (int i = 0; i < LEDS_COUNT; i++) {
            struct led *led = &l->led[i];
            if (led->drive != LED_FLOAT)
                continue;
            if (led->stretches == LEDS_STRETCHES)
                discharge(l, i, now);  // leaves one stretch that begins now
            else
                led->stretch[led->stretches++] = (struct led_stretch){now, lit};
        }
    }
    for (int i = 0; i < LEDS_COUNT; i++)
        enter(l, i, drive[i], now);
    // A cathode input whose anode is driven high is pulled up through the diode.
    for (int i = 0; i < LEDS_COUNT; i++)
        if (l->led[i].drive == LED_FLOAT && (l->port_d & 4 << i)) {
            bring_to(l, i, now);
            l->led[i].volts = fmax(l->led[i].volts, leds_supply_volts(l, now) - FORWARD_VOLTS);
        }
}

static bool driven(const struct led *led)
{
    return led->drive == LED_OFF || led->drive == LED_EMIT || led->drive == LED_REVERSE;
}

void leds_join(struct leds *l, int channel, uint64_t cycle, double held_volts)
{
    struct led *led = &l->led[channel];
    double sampler_pf = l->physics->node.sample_hold_pf;
    if (!driven(led)) {
        bring_to(l, channel, cycle);
        double total_pc = leds_charge_pc(l->physics, led->volts, 0) + sampler_pf * held_volts;
        led->volts = leds_volts(l->physics, total_pc, sampler_pf);
    }
    l->joined = channel;
}

double leds_sample(struct leds *l, int channel, uint64_t cycle)
{
    struct led *led = &l->led[channel];
    uint64_t n = l->samples++;
    if (!driven(led))
        bring_to(l, channel, cycle);
    l->joined = -1;
    if (led->drive == LED_REVERSE)
        return leds_supply_volts(l, cycle) + ripple(l, NOISE_RIPPLE_SAMPLE, n);
    return driven(led) ? 0 : led->volts;
}

void leds_part(struct leds *l, uint64_t cycle)
{
    if (l->joined >= 0 && !driven(&l->led[l->joined]))
        bring_to(l, l->joined, cycle);
    l->joined = -1;
}

double leds_peek(struct leds *l, int i, uint64_t cycle)
{
    struct leds *copy = malloc(sizeof *copy);
    if (!copy)
        return NAN;
    *copy = *l;
    bring_to(copy, i, cycle);
    double volts = copy->led[i].volts;
    free(copy);
    return volts;
}

static void on_port_c(avr_irq_t *irq, uint32_t value, void *param)
{
    struct leds *l = param;
    (void)irq;
    l->port_c = (uint8_t)value;
    pins_changed(l, access_write_cycle(l->avr));
}

static void on_ddr_c(avr_irq_t *irq, uint32_t value, void *param)
{
    struct leds *l = param;
    (void)irq;
    l->ddr_c = (uint8_t)value;
    pins_changed(l, access_write_cycle(l->avr));
}

static void on_port_d(avr_irq_t *irq, uint32_t value, void *param)
{
    struct leds *l = param;
    (void)irq;
    l->port_d = (uint8_t)value;
    pins_changed(l, access_write_cycle(l->avr));
}

static void on_ddr_d(avr_irq_t *irq, uint32_t value, void *param)
{
    struct leds *l = param;
    (void)irq;
    l->ddr_d = (uint8_t)value;
    pins_changed(l, access_write_cycle(l->avr));
}

// Digital level of the cathodes: libsimavr has no notion of a floating pin.
static uint8_t read_pins(avr_t *avr, avr_io_addr_t at, void *param)
{
    struct leds *l = param;
    uint64_t now = access_read_cycle(avr);
    uint8_t value = (uint8_t)(l->port_c & l->ddr_c);
    adc_catch_up(l->adc, now);
    for (int i = 0; i < LEDS_COUNT; i++)
        if (!(l->ddr_c >> i & 1)) {
            bring_to(l, i, now);
            if (l->led[i].volts > l->physics->supply.volts / 2)
                value |= (uint8_t)(1 << i);
        }
    return avr->data[at] = value;
}

void leds_seed(struct leds *l, uint64_t seed)
{
    l->seed = seed;
    l->flicker_phase = 2 * M_PI * noise_uniform(seed, NOISE_FLICKER_PHASE, 0);
}

void leds_set_ambient(struct leds *l, enum ambient ambient)
{
    const double na[] = {l->physics->ambient.dark_na, l->physics->ambient.room_na,
                         l->physics->ambient.bright_room_na, l->physics->ambient.sun_gap_na};
    const double flicker[] = {0, ROOM_FLICKER, BRIGHT_ROOM_FLICKER, 0};
    l->ambient_na = na[ambient];
    l->ambient_flicker = flicker[ambient];
}

void leds_set_light(struct leds *l, enum light light)
{
    const double na[] = {l->physics->photocurrent.nominal_na, l->physics->photocurrent.dim_na,
                         l->physics->photocurrent.bright_na};
    l->sensitivity = na[light] / na[LIGHT_NOMINAL];
    double mean = l->map_reference > 0 || !l->map ? l->map_reference : sim_map_mean(l->map);
    l->scale_na = l->map ? na[light] / mean : 0;
}

void leds_attach(struct leds *l, avr_t *avr, struct adc *adc, struct person *person,
                 const struct sim_map *map, const struct config *config, double cycles_per_true_second)
{
    static const struct { char port; int irq; avr_irq_notify_t call; } hooks[] = {
        {'C', IOPORT_IRQ_REG_PORT, on_port_c}, {'C', IOPORT_IRQ_DIRECTION_ALL, on_ddr_c},
        {'D', IOPORT_IRQ_REG_PORT, on_port_d}, {'D', IOPORT_IRQ_DIRECTION_ALL, on_ddr_d},
    };
    const struct physics *p = &config->physics;
    memset(l, 0, sizeof *l);
    l->avr = avr;
    l->joined = -1;
    l->adc = adc;
    l->person = person;
    l->map = map;
    l->map_reference = config->map_reference;
    l->physics = p;
    l->cycles_per_true_second = cycles_per_true_second;
    l->flicker_hz = noise_uniform(config->seed, NOISE_FLICKER, 0) < 0.5 ? 100 : 120;
    double spread = p->photocurrent.part_spread;
    for (int i = 0; i < LEDS_COUNT; i++) {
        struct led *led = &l->led[i];
        led->sensor = noise_spread(spread, config->seed, NOISE_SENSOR_SPREAD, (uint64_t)i);
        led->emitter = noise_spread(spread, config->seed, NOISE_EMITTER_SPREAD, (uint64_t)i);
        led->leakage_na = p->node.leakage_na
                        * noise_spread(p->node.leakage_spread, config->seed, NOISE_LEAKAGE, (uint64_t)i);
    }
    leds_set_ambient(l, config->ambient);
    leds_set_light(l, config->light);
    for (size_t i = 0; i < sizeof hooks / sizeof *hooks; i++) {
        avr_irq_t *irq = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(hooks[i].port), hooks[i].irq);
        irq->flags &= (uint8_t)~IRQ_FLAG_FILTERED;  // a reset changes pins behind its back
        avr_irq_register_notify(irq, hooks[i].call, l);
    }
    access_take_read(avr, PINC, read_pins, l);
    leds_reset(l, true);
}

void leds_reset(struct leds *l, bool fresh)
{
    uint64_t now = l->avr->cycle;
    l->port_c = l->ddr_c = l->port_d = l->ddr_d = 0;
    pins_changed(l, now);
    if (fresh)
        for (int i = 0; i < LEDS_COUNT; i++) {
            l->led[i].volts = 0;
            l->led[i].since = now;
        }
}
