// SPDX-License-Identifier: GPL-3.0-or-later
#include "config.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

// The board's own parts, README.md: a shunt regulator of 1.8 V, the divider on A7.
static const double RAIL_VOLTS = 1.8, RAIL_OHM = 0.3, RAIL_NOISE_MV = 0.2;
static const int SUPPLY_CHANNEL = 7;
// A lit LED needs its forward voltage and something to set its current by.
static const double SUPPLY_OVER_RAIL_VOLTS = 1.3;

#define PHYSICS(section, key, low, high) \
    { #section "." #key, offsetof(struct physics, section.key), low, high }

static const struct {
    const char *name;
    size_t offset;
    double low, high;
} PHYSICS_KEYS[] = {
    PHYSICS(photocurrent, nominal_na, 1e-3, 1e6), PHYSICS(photocurrent, dim_na, 1e-3, 1e6),
    PHYSICS(photocurrent, bright_na, 1e-3, 1e6), PHYSICS(photocurrent, part_spread, 0, 2),
    PHYSICS(photocurrent, heat_per_k, -1, 1),
    PHYSICS(node, junction_pf, 0.1, 1e4), PHYSICS(node, pin_pf, 0, 1e4),
    PHYSICS(node, sample_hold_pf, 0, 1e4), PHYSICS(node, leakage_na, 0, 1e6),
    PHYSICS(node, leakage_spread, 0, 4),
    PHYSICS(adc, noise_lsb, 0, 100), PHYSICS(adc, inl_lsb, 0, 100), PHYSICS(adc, offset_lsb, 0, 100),
    PHYSICS(adc, gain_error, 0, 0.5), PHYSICS(adc, bandgap_v, 0.1, 5),
    PHYSICS(comparator, offset_mv, 0, 1000), PHYSICS(comparator, noise_mv, 0, 1000),
    PHYSICS(comparator, delay_ns, 0, 1e6),
    PHYSICS(supply, volts, 2, 6), PHYSICS(supply, source_ohm, 0, 20), PHYSICS(supply, ripple_mv, 0, 1000),
    PHYSICS(clock, error, 0, 0.2),
    PHYSICS(ambient, room_na, 0, 1e6), PHYSICS(ambient, bright_room_na, 0, 1e6),
    PHYSICS(ambient, sun_gap_na, 0, 1e6), PHYSICS(ambient, dark_na, 0, 1e6),
    PHYSICS(eye, fixation_bias_deg, 0, 20), PHYSICS(eye, fixation_drift_deg, 0, 20),
    PHYSICS(eye, pupil_mm, 1, 9), PHYSICS(eye, blinks_per_min, 0, 120), PHYSICS(eye, lid_follow_gain, 0, 2),
};
enum { PHYSICS_COUNT = sizeof PHYSICS_KEYS / sizeof *PHYSICS_KEYS };

void config_list_physics(FILE *out)
{
    for (int i = 0; i < PHYSICS_COUNT; i++)
        fprintf(out, "%s\n", PHYSICS_KEYS[i].name);
}

static int pick(const char *name, const char *const *names, int *out)
{
    for (int i = 0; names[i]; i++)
        if (!strcmp(name, names[i])) {
            *out = i;
            return 0;
        }
    return -1;
}

int config_ambient(const char *name, enum ambient *out)
{
    static const char *const names[] = {"dark", "room", "bright_room", "sun_gap", NULL};
    int i;
    if (pick(name, names, &i))
        return -1;
    *out = (enum ambient)i;
    return 0;
}

int config_light(const char *name, enum light_level *out)
{
    static const char *const names[] = {"nominal", "dim", "bright", NULL};
    int i;
    if (pick(name, names, &i))
        return -1;
    *out = (enum light_level)i;
    return 0;
}

static int number(const char *text, double low, double high, double *out)
{
    char *end;
    errno = 0;
    double value = strtod(text, &end);
    if (end == text || *end || !isfinite(value) || value < low || value > high)
        return -1;
    *out = value;
    return 0;
}

static int whole(const char *text, uint64_t high, uint64_t *out)
{
    char *end;
    errno = 0;
    uint64_t value = strtoull(text, &end, 0);
    if (errno || end == text || *end || *text == '-' || value > high)
        return -1;
    *out = value;
    return 0;
}

// Store one key. Returns 0, -1 bad value, -2 unknown key.
static int store(struct config *c, bool *seen, const char *key, const char *value)
{
    const struct { const char *name; char *to; } paths[] = {
        {"bootloader", c->bootloader}, {"state", c->state}, {"app", c->app}, {"map", c->map},
        {"link", c->link}, {"control", c->control}, {"truth", c->truth},
    };
    for (size_t i = 0; i < sizeof paths / sizeof *paths; i++)
        if (!strcmp(key, paths[i].name)) {
            if (strlen(value) >= CONFIG_PATH_BYTES)
                return -1;
            strcpy(paths[i].to, strcmp(value, "none") ? value : "");
            return 0;
        }
    for (int i = 0; i < PHYSICS_COUNT; i++)
        if (!strcmp(key, PHYSICS_KEYS[i].name)) {
            seen[i] = true;
            return number(value, PHYSICS_KEYS[i].low, PHYSICS_KEYS[i].high,
                          (double *)((char *)&c->physics + PHYSICS_KEYS[i].offset));
        }
    uint64_t n = 0;
    if (!strcmp(key, "bootloader_start")) {
        int bad = whole(value, 0x7FFE, &n) || n % 128;
        c->bootloader_start = (uint32_t)n;
        return bad ? -1 : 0;
    }
    if (!strcmp(key, "seed"))
        return whole(value, UINT64_MAX, &c->seed);
    if (!strcmp(key, "unpaced") || !strcmp(key, "auto_reset")) {
        int bad = whole(value, 1, &n);
        *(key[0] == 'u' ? &c->unpaced : &c->auto_reset) = n != 0;
        return bad;
    }
    if (!strcmp(key, "wiring")) {
        static const char *const names[] = {"leds", "photodiodes", NULL};
        int i = 0, bad = pick(value, names, &i);
        c->wiring.photodiodes = i == 1;
        return bad;
    }
    if (!strcmp(key, "supply_pin")) {
        static const char *const names[] = {"A6", "A7", "none", NULL};
        int i = 0, bad = pick(value, names, &i);
        c->wiring.supply_channel = i == 2 ? -1 : 6 + i;
        return bad;
    }
    if (!strcmp(key, "rail_volts"))
        return number(value, 1, 3.5, &c->wiring.rail_volts);
    if (!strcmp(key, "rail_ohm"))
        return number(value, 0, 20, &c->wiring.rail_ohm);
    if (!strcmp(key, "rail_noise_mv"))
        return number(value, 0, 100, &c->wiring.rail_noise_mv);
    if (!strcmp(key, "pupil_mean_mm"))
        return number(value, 1.5, 8, &c->pupil_mean_mm);
    if (!strcmp(key, "map_reference"))
        return number(value, 1e-30, 1e30, &c->map_reference);
    if (!strcmp(key, "ambient"))
        return config_ambient(value, &c->ambient);
    if (!strcmp(key, "light"))
        return config_light(value, &c->light);
    return -2;
}

int config_read(struct config *config, const char *path, char *error, size_t error_bytes)
{
    bool seen[PHYSICS_COUNT] = {false};
    char line[CONFIG_PATH_BYTES + 128];
    FILE *file = fopen(path, "r");
    memset(config, 0, sizeof *config);
    config->bootloader_start = 0x7E00;
    config->auto_reset = true;
    config->wiring = (struct board_wiring){false, RAIL_VOLTS, RAIL_OHM, RAIL_NOISE_MV, SUPPLY_CHANNEL};
    if (!file) {
        snprintf(error, error_bytes, "cannot read %s: %s", path, strerror(errno));
        return -1;
    }
    for (int row = 1; fgets(line, sizeof line, file); row++) {
        line[strcspn(line, "#\r\n")] = 0;
        char *key = line + strspn(line, " \t");
        if (!*key)
            continue;
        char *value = key + strcspn(key, " \t");
        if (*value)
            *value++ = 0;
        value += strspn(value, " \t");
        for (size_t n = strlen(value); n && (value[n - 1] == ' ' || value[n - 1] == '\t');)
            value[--n] = 0;
        int bad = store(config, seen, key, value);
        if (bad) {
            snprintf(error, error_bytes, "%s:%d: %s `%.60s`", path, row,
                     bad == -2 ? "unknown key" : "bad value for", key);
            fclose(file);
            return -1;
        }
    }
    fclose(file);
    for (int i = 0; i < PHYSICS_COUNT; i++)
        if (!seen[i]) {
            snprintf(error, error_bytes, "%s: missing key `%s`", path, PHYSICS_KEYS[i].name);
            return -1;
        }
    if (config->physics.supply.volts < config->wiring.rail_volts + SUPPLY_OVER_RAIL_VOLTS) {
        snprintf(error, error_bytes, "%s: supply.volts %g leaves no room over rail_volts %g to light an LED",
                 path, config->physics.supply.volts, config->wiring.rail_volts);
        return -1;
    }
    if (!*config->state || !*config->control) {
        snprintf(error, error_bytes, "%s: missing key `%s`", path, *config->state ? "control" : "state");
        return -1;
    }
    return 0;
}
