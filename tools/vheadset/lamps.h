// SPDX-License-Identifier: GPL-3.0-or-later
// The emitters' currents: how brightly they shine, what they take from the supply and send into the rail; and
// a tally of pulses for eye safety and power.
//
// Each path is linear: supply - source_ohm * all current, then the drop of the diode (1.2 V; none when it is
// shorted), then the resistance in series (what makes 20 mA at the configured supply, resistor and port
// driver together), then the rail (wiring leds) or ground. Light is proportional to current, and carries the
// supply's ripple.
#ifndef LAMPS_H
#define LAMPS_H

#include <stdint.h>

#include "config.h"

enum { LAMPS_COUNT = 6, LAMPS_HISTORY = 32 };

// Emitters by what is connected to their pin, which is high; bits of their numbers.
struct lamps_on { uint8_t lit, shorted, grounded; };

struct lamps_supply { uint64_t since; double volts; };

struct lamps {
    const struct physics *physics;
    const struct board_wiring *wiring;
    double supply_volts;         // unloaded
    struct lamps_on on;
    double level;                // light of each lit emitter, 1 = at 20 mA
    double amperes;              // of each lit emitter
    double total_amperes;
    double rail_volts;           // with what flows into it
    struct lamps_supply history[LAMPS_HISTORY];   // ring of loaded supply voltages
    unsigned history_next;
    // Since lamps_clear():
    uint64_t lit_cycles[LAMPS_COUNT], longest_pulse;
    unsigned most_lit;
    double charge_nc;            // through diodes, shorted ones too
    // Accounted up to:
    uint64_t counted_to, pulse_began[LAMPS_COUNT];
};

void lamps_attach(struct lamps *lamps, const struct config *config);
// From a cycle on these are on.
void lamps_switch(struct lamps *lamps, struct lamps_on on, uint64_t cycle);
void lamps_set_supply(struct lamps *lamps, double volts, uint64_t cycle);
// Mean light of an emitter that is lit now, between two cycles, 1 = at 20 mA: `level`, with the ripple of a
// session's seed. Its draws hold for 10 us each, on a grid of the device's time.
double lamps_light(const struct lamps *lamps, uint64_t seed, uint64_t from, uint64_t to);
// Supply at a recent cycle, loaded, without ripple.
double lamps_supply_at(const struct lamps *lamps, uint64_t cycle);

void lamps_clear(struct lamps *lamps, uint64_t cycle);
// Bring the tally forward: call before reading it.
void lamps_count(struct lamps *lamps, uint64_t cycle);

#endif
