// SPDX-License-Identifier: GPL-3.0-or-later
#include "lamps.h"

#include <math.h>
#include <string.h>

#include "noise.h"

static const double LED_AMPERES = 0.020;  // stated in the comment of physics.toml, [photocurrent]
static const double FORWARD_VOLTS = 1.2;  // of an infrared LED
enum { LOAD_STEPS = 60 };                 // each halves the error at least

// Draws of ripple are independent from sample to sample: samples are 13 us apart at 1 MHz at least.
enum { RIPPLE_CYCLES = 160 };

// What an unloaded supply leaves for the resistance in series.
static double headroom_volts(const struct lamps *l, double supply)
{
    return supply - FORWARD_VOLTS - (l->wiring->photodiodes ? 0 : l->wiring->rail_volts);
}

// What makes 20 mA at the configured supply.
static double series_ohm(const struct lamps *l)
{
    return headroom_volts(l, l->physics->supply.volts) / LED_AMPERES;
}

double lamps_light(const struct lamps *l, uint64_t seed, uint64_t from, uint64_t to)
{
    double ripple = l->physics->supply.ripple_mv * 1e-3, sum = 0;
    if (ripple == 0 || to <= from || l->level == 0)
        return l->level;
    for (uint64_t at = from; at < to;) {
        uint64_t draw = at / RIPPLE_CYCLES, end = (draw + 1) * RIPPLE_CYCLES;
        if (end > to)
            end = to;
        sum += (double)(end - at) * noise_normal(seed, NOISE_RIPPLE_LIGHT, draw);
        at = end;
    }
    double mean = sum / (double)(to - from) * ripple;
    return l->level * fmax(1 + mean / headroom_volts(l, l->supply_volts), 0);
}

static void load(struct lamps *l, uint64_t cycle)
{
    double ohm = series_ohm(l), supply = l->supply_volts, rail = l->wiring->rail_volts;
    int lit = __builtin_popcount(l->on.lit), shorted = __builtin_popcount(l->on.shorted);
    int grounded = __builtin_popcount(l->on.grounded);
    for (int i = 0; i < LOAD_STEPS; i++) {
        double end = l->wiring->photodiodes ? 0 : rail;
        l->amperes = fmax(supply - FORWARD_VOLTS - end, 0) / ohm;
        double through = lit * l->amperes + shorted * fmax(supply - end, 0) / ohm;
        l->total_amperes = through + grounded * supply / ohm;
        supply = 0.5 * (supply + l->supply_volts - l->physics->supply.source_ohm * l->total_amperes);
        if (!l->wiring->photodiodes)
            rail = 0.5 * (rail + l->wiring->rail_volts + l->wiring->rail_ohm * through);
    }
    l->level = l->amperes / LED_AMPERES;
    l->rail_volts = rail;
    l->history[l->history_next++ % LAMPS_HISTORY] = (struct lamps_supply){cycle, supply};
}

void lamps_count(struct lamps *l, uint64_t cycle)
{
    for (int i = 0; i < LAMPS_COUNT; i++)
        if (l->on.lit >> i & 1) {
            l->lit_cycles[i] += cycle - l->counted_to;
            if (cycle - l->pulse_began[i] > l->longest_pulse)
                l->longest_pulse = cycle - l->pulse_began[i];
        }
    l->charge_nc += l->total_amperes * (double)(cycle - l->counted_to) / 16e6 * 1e9;
    l->counted_to = cycle;
}

void lamps_switch(struct lamps *l, struct lamps_on on, uint64_t cycle)
{
    if (!memcmp(&on, &l->on, sizeof on))
        return;
    lamps_count(l, cycle);
    for (int i = 0; i < LAMPS_COUNT; i++)
        if (on.lit & ~l->on.lit & 1 << i)
            l->pulse_began[i] = cycle;
    l->on = on;
    unsigned lit = (unsigned)__builtin_popcount(on.lit);
    if (lit > l->most_lit)
        l->most_lit = lit;
    load(l, cycle);
}

void lamps_set_supply(struct lamps *l, double volts, uint64_t cycle)
{
    lamps_count(l, cycle);
    l->supply_volts = volts;
    load(l, cycle);
}

double lamps_supply_at(const struct lamps *l, uint64_t cycle)
{
    const struct lamps_supply *h = l->history;
    for (unsigned i = 1; i <= LAMPS_HISTORY && i <= l->history_next; i++) {
        h = &l->history[(l->history_next - i) % LAMPS_HISTORY];
        if (h->since <= cycle)
            break;
    }
    return h->volts;
}

void lamps_clear(struct lamps *l, uint64_t cycle)
{
    lamps_count(l, cycle);
    memset(l->lit_cycles, 0, sizeof l->lit_cycles);
    l->longest_pulse = 0;
    l->charge_nc = 0;
    l->most_lit = (unsigned)__builtin_popcount(l->on.lit);
    for (int i = 0; i < LAMPS_COUNT; i++)
        l->pulse_began[i] = cycle;
}

void lamps_attach(struct lamps *l, const struct config *config)
{
    memset(l, 0, sizeof *l);
    l->physics = &config->physics;
    l->wiring = &config->wiring;
    l->supply_volts = config->physics.supply.volts;
    load(l, 0);
}
