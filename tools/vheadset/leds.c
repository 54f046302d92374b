// SPDX-License-Identifier: GPL-3.0-or-later
#include "leds.h"

#include <math.h>
#include <string.h>

#include "adc.h"
#include "noise.h"

static const char *const DRIVE_NAMES[LEDS_COUNT] = {
    "drive0", "drive1", "drive2", "drive3", "drive4", "drive5"
};
enum { EMITTER_PIN = 2 };
static const double PULLUP_OHM = 35e3, DRIVER_OHM = 25;    // of a port pin: datasheet, pin pull-up and driver
static const double LEAKAGE_DOUBLES_K = 10;                // comment of physics.toml, [node]
static const double DIVIDER = 0.04;                        // 240k and 10k: stiff for the sampler
static const double COVERED = 0.01, FINGER_LIGHT = 5, FINGER_AMBIENT = 0.1;

static struct led_part *part_of(struct leds *l, int pin)
{
    return &l->part[l->led[pin].part];
}

// As a sensor sees it: open, the pin has its own capacitance only.
static struct charge_node node_of(struct leds *l, int i, double noise_volts)
{
    const struct node_physics *n = &l->physics->node;
    double junction_pf = part_of(l, i)->fault == FAULT_OPEN ? 0 : n->junction_pf;
    return (struct charge_node){junction_pf, n->pin_pf + (l->joined == i ? n->sample_hold_pf : 0),
                                l->lamps.rail_volts + noise_volts};
}

static bool conducts(struct leds *l, int i)
{
    enum led_fault fault = part_of(l, i)->fault;
    return fault == FAULT_SHORT || fault == FAULT_SHORT_GROUND;
}

static bool driven(const struct led *led)
{
    return led->drive == LED_LOW || led->drive == LED_HIGH;
}

// No charge is kept there: whatever hangs on it takes its voltage.
static bool stiff(struct leds *l, int i)
{
    return driven(&l->led[i]) || conducts(l, i);
}

static double supply_ripple(const struct leds *l, uint64_t n)
{
    return l->physics->supply.ripple_mv * 1e-3 * noise_normal(l->seed, NOISE_RIPPLE_SAMPLE, n);
}

static double rail_noise(const struct leds *l, enum noise_purpose purpose, uint64_t n)
{
    return l->wiring->rail_noise_mv * 1e-3 * noise_normal(l->seed, purpose, n);
}

static double stiff_volts(struct leds *l, int i, uint64_t cycle, double supply_noise, double noise_volts)
{
    enum led_fault fault = part_of(l, i)->fault;
    if (l->led[i].drive == LED_LOW)
        return 0;
    if (l->led[i].drive == LED_HIGH) {
        bool loaded = !l->wiring->photodiodes && fault != FAULT_OPEN;
        double drop = loaded ? DRIVER_OHM * l->lamps.amperes : 0;
        return lamps_supply_at(&l->lamps, cycle) - drop + supply_noise;
    }
    return fault == FAULT_SHORT ? l->lamps.rail_volts + noise_volts : 0;
}

static double volts_of(struct leds *l, int i, uint64_t cycle, double supply_noise, double noise_volts)
{
    if (stiff(l, i))
        return stiff_volts(l, i, cycle, supply_noise, noise_volts);
    if (l->led[i].drive == LED_PULLUP)
        return l->led[i].volts;
    return charge_volts(node_of(l, i, noise_volts), l->led[i].charge_pc);
}

// Light of a lit emitter relative to that of a nominal one at the same current.
static double brightness(const struct leds *l, int emitter)
{
    const struct led_part *part = &l->part[l->wiring->photodiodes ? LEDS_COUNT + emitter
                                                                  : l->led[emitter].part];
    return part->emitter * (part->fault == FAULT_COVERED ? COVERED : 1)
         * (1 + l->physics->photocurrent.heat_per_k * l->warmer_k);
}

// Photocurrent and leakage of a pin between two cycles, nA.
static double current_na(struct leds *l, int i, uint64_t from, uint64_t to)
{
    const struct led_part *part = part_of(l, i);
    if (part->fault == FAULT_OPEN)
        return 0;
    double cover = part->fault == FAULT_COVERED ? COVERED : 1;
    double leakage_na = part->leakage_na * exp2(l->warmer_k / LEAKAGE_DOUBLES_K);
    double ambient_na = light_ambient_na(&l->light, from, to) * cover
                      * (part->fault == FAULT_FINGER ? FINGER_AMBIENT : 1);
    const double *response = l->lamps.on.lit ? light_response(&l->light, from + (to - from) / 2) : NULL;
    double sum = 0, all = 0;
    if (response) {
        double light = lamps_light(&l->lamps, l->seed, from, to);
        int emitters = l->wiring->photodiodes ? LEDS_EMITTERS : LEDS_COUNT;
        for (int pin = 0; pin < emitters; pin++)
            if (l->lamps.on.lit >> pin & 1) {
                int column = l->wiring->photodiodes ? pin : l->led[pin].part;
                double bright = light * brightness(l, pin);
                sum += response[l->led[i].part * emitters + column] * bright;
                all += bright;
            }
        if (part->fault == FAULT_FINGER)
            sum += FINGER_LIGHT * l->light.reference * all / (LEDS_COUNT - 1);
    }
    return leakage_na + part->sensor * (ambient_na + l->light.scale_na * sum * cover);
}

static void collect(struct leds *l, int i, uint64_t to)
{
    struct led *led = &l->led[i];
    led->charge_pc += current_na(l, i, led->since, to) * (double)(to - led->since) / 16.0 * 1e-3;
    led->charge_pc = fmin(led->charge_pc, charge_ceiling_pc(node_of(l, i, 0)));
}

// Charge a node through the pull-up, until the junction conducts; photocurrent is negligible beside it.
static void pull_up(struct leds *l, int i, uint64_t to)
{
    struct led *led = &l->led[i];
    struct charge_node node = node_of(l, i, 0);
    double supply = lamps_supply_at(&l->lamps, to), left_s = (double)(to - led->since) / 16e6;
    double most = node.junction_pf > 0 ? fmin(supply, node.rail_volts + CHARGE_CEILING_VOLTS) : supply;
    while (left_s > 0 && most - led->volts > 1e-6) {
        double tau = PULLUP_OHM * charge_pf(node, led->volts) * 1e-12;
        double step = fmin(left_s, tau / 16);
        led->volts = fmin(led->volts + (supply - led->volts) * -expm1(-step / tau), most);
        left_s -= step;
    }
}

static void bring_to(struct leds *l, int i, uint64_t to)
{
    struct led *led = &l->led[i];
    if (to <= led->since || stiff(l, i))
        return;
    if (led->drive == LED_FLOAT)
        collect(l, i, to);
    else
        pull_up(l, i, to);
    led->since = to;
}

static void bring_all(struct leds *l, uint64_t to)
{
    for (int i = 0; i < LEDS_COUNT; i++)
        bring_to(l, i, to);
}

// What a node keeps that was at some voltage: nothing above its ceiling.
static double charge_at(struct charge_node node, double volts)
{
    bool above = node.junction_pf > 0 && volts > node.rail_volts + CHARGE_CEILING_VOLTS;
    return above ? charge_ceiling_pc(node) : charge_pc(node, volts);
}

// A node that was at some voltage begins to keep its charge.
static void let_go(struct leds *l, int i, double volts)
{
    struct led *led = &l->led[i];
    led->volts = volts;
    led->charge_pc = charge_at(node_of(l, i, rail_noise(l, NOISE_RAIL_RELEASE, l->releases++)), volts);
}

static void record(const struct leds *l, const char *what, int value, uint64_t cycle)
{
    if (l->log)
        l->log(l->log_param, what, value, cycle);
}

static enum led_drive drive_of(const struct leds *l, int i)
{
    uint8_t bit = (uint8_t)(1 << i);
    if (l->pins.ddr_c & bit)
        return l->pins.port_c & bit ? LED_HIGH : LED_LOW;
    return (l->pins.port_c & bit) && l->pins.pull_ups ? LED_PULLUP : LED_FLOAT;
}

static void enter(struct leds *l, int i, enum led_drive drive, uint64_t now)
{
    struct led *led = &l->led[i];
    if (led->drive == drive)
        return;
    bring_to(l, i, now);
    double volts = volts_of(l, i, now, 0, 0);
    bool released = drive == LED_FLOAT;
    led->drive = drive;
    led->since = led->event = now;
    record(l, DRIVE_NAMES[i], drive, now);
    if (released)
        let_go(l, i, volts);
    else
        led->volts = volts;
}

static struct lamps_on emitters_on(struct leds *l)
{
    struct lamps_on on = {0, 0, 0};
    if (l->wiring->photodiodes) {
        for (int i = 0; i < LEDS_EMITTERS; i++)
            if (l->pins.port_d & l->pins.ddr_d & 1 << (EMITTER_PIN + i)
                && l->part[LEDS_COUNT + i].fault != FAULT_OPEN)
                on.lit |= (uint8_t)(1 << i);
        return on;
    }
    for (int i = 0; i < LEDS_COUNT; i++) {
        enum led_fault fault = part_of(l, i)->fault;
        uint8_t *which = fault == FAULT_SHORT ? &on.shorted
                       : fault == FAULT_SHORT_GROUND ? &on.grounded : &on.lit;
        if (drive_of(l, i) == LED_HIGH && fault != FAULT_OPEN)
            *which |= (uint8_t)(1 << i);
    }
    return on;
}

static void shine(struct leds *l, uint64_t cycle)
{
    uint8_t was = l->lamps.on.lit;
    lamps_switch(&l->lamps, emitters_on(l), cycle);
    if (l->lamps.on.lit != was)
        record(l, "lit", l->lamps.on.lit, cycle);
}

void leds_drive(struct leds *l, const struct leds_pins *pins, uint64_t now)
{
    leds_settle(l, now);
    l->pins = *pins;
    shine(l, now);
    for (int i = 0; i < LEDS_COUNT; i++)     // released against the rail of the new lights
        enter(l, i, drive_of(l, i), now);
}

void leds_settle(struct leds *l, uint64_t cycle)
{
    adc_catch_up(l->adc, cycle);
    bring_all(l, cycle);
}

// Parts were changed: floating nodes keep the voltages they had.
static void rewire(struct leds *l, const double *volts, uint64_t cycle)
{
    for (int i = 0; i < LEDS_COUNT; i++)
        if (l->led[i].drive == LED_FLOAT)
            l->led[i].charge_pc = charge_at(node_of(l, i, 0), volts[i]);
    shine(l, cycle);
}

static void look(struct leds *l, double *volts, uint64_t cycle)
{
    leds_settle(l, cycle);
    for (int i = 0; i < LEDS_COUNT; i++)
        volts[i] = volts_of(l, i, cycle, 0, 0);
}

void leds_set_fault(struct leds *l, int part, enum led_fault fault, uint64_t cycle)
{
    double volts[LEDS_COUNT];
    look(l, volts, cycle);
    l->part[part].fault = fault;
    rewire(l, volts, cycle);
}

void leds_swap(struct leds *l, int a, int b, uint64_t cycle)
{
    double volts[LEDS_COUNT];
    look(l, volts, cycle);
    int part = l->led[a].part;
    l->led[a].part = l->led[b].part;
    l->led[b].part = part;
    rewire(l, volts, cycle);
}

void leds_join(struct leds *l, int pin, uint64_t cycle, double held_volts)
{
    struct led *led = &l->led[pin];
    double sampler_pf = l->physics->node.sample_hold_pf;
    if (!stiff(l, pin)) {
        bring_to(l, pin, cycle);
        led->charge_pc += sampler_pf * held_volts;
        if (led->drive == LED_PULLUP)
            led->volts += (held_volts - led->volts) * sampler_pf
                        / (charge_pf(node_of(l, pin, 0), led->volts) + sampler_pf);
    }
    l->joined = pin;
}

double leds_sample(struct leds *l, int pin, uint64_t cycle)
{
    uint64_t n = l->samples++;
    bring_to(l, pin, cycle);
    if (!driven(&l->led[pin]))
        l->led[pin].event = cycle;
    double volts = volts_of(l, pin, cycle, supply_ripple(l, n), rail_noise(l, NOISE_RAIL_SAMPLE, n));
    if (l->joined == pin)
        l->led[pin].charge_pc -= l->physics->node.sample_hold_pf * volts;
    l->joined = -1;
    return volts;
}

void leds_part(struct leds *l, uint64_t cycle)
{
    int pin = l->joined;
    if (pin < 0)
        return;
    bring_to(l, pin, cycle);
    l->led[pin].charge_pc -= l->physics->node.sample_hold_pf * volts_of(l, pin, cycle, 0, 0);
    l->joined = -1;
}

double leds_divider(struct leds *l, uint64_t cycle)
{
    return DIVIDER * (lamps_supply_at(&l->lamps, cycle) + supply_ripple(l, l->samples++));
}

double leds_peek(struct leds *l, int i, uint64_t cycle)
{
    struct leds copy = *l;
    bring_to(&copy, i, cycle);
    return volts_of(&copy, i, cycle, 0, 0);
}

uint8_t leds_digital(struct leds *l, uint64_t cycle)
{
    uint8_t value = (uint8_t)(l->pins.port_c & l->pins.ddr_c);
    leds_settle(l, cycle);
    for (int i = 0; i < LEDS_COUNT; i++)
        if (!(l->pins.ddr_c >> i & 1) && volts_of(l, i, cycle, 0, 0) > l->lamps.supply_volts / 2)
            value |= (uint8_t)(1 << i);
    return value;
}

void leds_seed(struct leds *l, uint64_t seed)
{
    l->seed = seed;
    light_seed(&l->light, seed);
}

void leds_attach(struct leds *l, struct adc *adc, struct person *person, const struct sim_map *map,
                 const struct config *config, double cycles_per_true_second)
{
    const struct physics *p = &config->physics;
    memset(l, 0, sizeof *l);
    l->joined = -1;
    l->adc = adc;
    l->physics = p;
    l->wiring = &config->wiring;
    double spread = p->photocurrent.part_spread;
    for (int i = 0; i < LEDS_PARTS; i++) {
        struct led_part *part = &l->part[i];
        uint64_t draw = (uint64_t)(i % LEDS_COUNT);
        part->sensor = noise_spread(spread, config->seed, NOISE_SENSOR_SPREAD, draw);
        part->emitter = noise_spread(spread, config->seed, NOISE_EMITTER_SPREAD, draw);
        part->leakage_na = p->node.leakage_na
                         * noise_spread(p->node.leakage_spread, config->seed, NOISE_LEAKAGE, draw);
    }
    for (int i = 0; i < LEDS_COUNT; i++)
        l->led[i].part = i;
    light_attach(&l->light, p, map, person, config, cycles_per_true_second);
    lamps_attach(&l->lamps, config);
    leds_empty(l, 0);
}

void leds_empty(struct leds *l, uint64_t cycle)
{
    for (int i = 0; i < LEDS_COUNT; i++) {
        l->led[i].since = l->led[i].event = cycle;
        let_go(l, i, 0);
    }
}
