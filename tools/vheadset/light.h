// SPDX-License-Identifier: GPL-3.0-or-later
// What falls on the sensors: the lit emitters' light by way of the simulated person, and ambient light.
// Currents are those of a nominal sensor; spreads of parts are the board's (leds.h).
#ifndef LIGHT_H
#define LIGHT_H

#include <stdbool.h>
#include <stdint.h>

#include "config.h"

struct person;
struct sim_map;

enum { LIGHT_PAIRS = 36 };

struct light {
    const struct physics *physics;
    const struct sim_map *map;      // NULL: no emitter reaches a sensor
    struct person *person;
    double cycles_per_true_second;
    double reference;               // mean of the map that gives nominal_na
    double scale_na;                // photocurrent per map unit
    double sensitivity;             // of this level of light, relative to nominal
    double ambient_na;              // at nominal light
    double flicker, flicker_hz, flicker_phase;
    uint64_t response_cycle;
    bool response_known;
    double response[LIGHT_PAIRS];
};

void light_attach(struct light *light, const struct physics *physics, const struct sim_map *map,
                  struct person *person, const struct config *config, double cycles_per_true_second);
// Draw the flicker's phase from the seed of a session.
void light_seed(struct light *light, uint64_t seed);
void light_set_level(struct light *light, enum light_level level);
void light_set_ambient(struct light *light, enum ambient ambient);
// Another frequency from a cycle on; the wave goes on where it is.
void light_set_flicker_hz(struct light *light, double hz, uint64_t cycle);

// Mean photocurrent of the ambient light between two cycles, nA: the integral, not a sample.
double light_ambient_na(const struct light *light, uint64_t from, uint64_t to);
// Response map at a cycle, [sensor][emitter]; one of up to 50 us before or after will do. NULL: no map.
const double *light_response(struct light *light, uint64_t cycle);

#endif
