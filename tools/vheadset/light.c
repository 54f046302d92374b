// SPDX-License-Identifier: GPL-3.0-or-later
#include "light.h"

#include <math.h>
#include <string.h>

#include "../../sim_c/sim_map.h"
#include "noise.h"
#include "person.h"

// Stated in the comments of physics.toml, [ambient].
static const double ROOM_FLICKER = 0.3, BRIGHT_ROOM_FLICKER = 0.5;
static const uint64_t RESPONSE_REUSE_CYCLES = 800;  // 50 us: the fastest saccade turns 0.03 deg

const double *light_response(struct light *l, uint64_t cycle)
{
    uint64_t apart = cycle > l->response_cycle ? cycle - l->response_cycle : l->response_cycle - cycle;
    if (!l->map)
        return NULL;
    if (!l->response_known || apart > RESPONSE_REUSE_CYCLES) {
        struct person_view view;
        person_view_at(l->person, (double)cycle / 16.0, &view);
        sim_map_eval(l->map, &view.state, l->response);
        l->response_cycle = cycle;
        l->response_known = true;
    }
    return l->response;
}

static double radians_per_cycle(const struct light *l)
{
    return 2 * M_PI * l->flicker_hz / l->cycles_per_true_second;
}

double light_ambient_na(const struct light *l, uint64_t from, uint64_t to)
{
    double steady = l->ambient_na * l->sensitivity;
    if (l->flicker == 0 || to <= from)
        return steady;
    double w = radians_per_cycle(l);
    double end = w * (double)to + l->flicker_phase, begin = w * (double)from + l->flicker_phase;
    double wave = (sin(end) - sin(begin)) / (w * (double)(to - from));
    return steady * (1 - l->flicker * wave);
}

void light_seed(struct light *l, uint64_t seed)
{
    l->flicker_phase = 2 * M_PI * noise_uniform(seed, NOISE_FLICKER_PHASE, 0);
}

void light_set_flicker_hz(struct light *l, double hz, uint64_t cycle)
{
    double before = radians_per_cycle(l) * (double)cycle;
    l->flicker_hz = hz;
    l->flicker_phase = fmod(l->flicker_phase + before - radians_per_cycle(l) * (double)cycle, 2 * M_PI);
}

void light_set_ambient(struct light *l, enum ambient ambient)
{
    const double na[] = {l->physics->ambient.dark_na, l->physics->ambient.room_na,
                         l->physics->ambient.bright_room_na, l->physics->ambient.sun_gap_na};
    const double flicker[] = {0, ROOM_FLICKER, BRIGHT_ROOM_FLICKER, 0};
    l->ambient_na = na[ambient];
    l->flicker = flicker[ambient];
}

void light_set_level(struct light *l, enum light_level level)
{
    const double na[] = {l->physics->photocurrent.nominal_na, l->physics->photocurrent.dim_na,
                         l->physics->photocurrent.bright_na};
    l->sensitivity = na[level] / na[LIGHT_NOMINAL];
    l->scale_na = l->map ? na[level] / l->reference : 0;
}

void light_attach(struct light *l, const struct physics *physics, const struct sim_map *map,
                  struct person *person, const struct config *config, double cycles_per_true_second)
{
    memset(l, 0, sizeof *l);
    l->physics = physics;
    l->map = map;
    l->person = person;
    l->cycles_per_true_second = cycles_per_true_second;
    l->reference = config->map_reference > 0 || !map ? config->map_reference : sim_map_mean(map);
    l->flicker_hz = noise_uniform(config->seed, NOISE_FLICKER, 0) < 0.5 ? 100 : 120;
    light_set_ambient(l, config->ambient);
    light_set_level(l, config->light);
}
