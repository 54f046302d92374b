// SPDX-License-Identifier: GPL-3.0-or-later
#include "setting.h"

#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "nano.h"

enum key {
    KEY_AMBIENT, KEY_AMBIENT_NA, KEY_AMBIENT_FLICKER, KEY_FLICKER_HZ, KEY_LIGHT, KEY_LID, KEY_MICROSACCADES,
    KEY_PUPIL, KEY_SUPPLY, KEY_WARMER, KEY_SLIP_X, KEY_SLIP_Y, KEY_SLIP_Z, KEY_FAULT_0,
};
static const double LID_AUTO = -1;

static const struct { const char *name; double low, high; } NUMBERS[] = {
    [KEY_AMBIENT_NA] = {"ambient_na", 0, 1e6}, [KEY_AMBIENT_FLICKER] = {"ambient_flicker", 0, 1},
    [KEY_FLICKER_HZ] = {"flicker_hz", 0.1, 1e4}, [KEY_LID] = {"lid", 0, 1},
    [KEY_MICROSACCADES] = {"microsaccades", 0, 1}, [KEY_PUPIL] = {"pupil_mean_mm", 1.5, 8},
    [KEY_SUPPLY] = {"supply_volts", 4.2, 5.5}, [KEY_WARMER] = {"warmer_k", -60, 60},
    [KEY_SLIP_X] = {"slip_x", -20, 20}, [KEY_SLIP_Y] = {"slip_y", -20, 20},
    [KEY_SLIP_Z] = {"slip_z", -20, 20},
};

static bool real(const char *text, double low, double high, double *out)
{
    char *end;
    double value = strtod(text, &end);
    if (end == text || *end || !isfinite(value) || value < low || value > high)
        return false;
    *out = value;
    return true;
}

static const char *parse_fault(const struct nano *nano, const char *part, const char *kind,
                               struct setting *out)
{
    static const char *const kinds[] = {"none", "open", "short", "short_ground", "covered", "finger", NULL};
    int parts = nano->config.wiring.photodiodes ? LEDS_PARTS : LEDS_COUNT, i = part[0] - '0', k = 0;
    if (i < 0 || i >= parts || part[1])
        return parts == LEDS_COUNT ? "there are LEDs 0..5"
                                   : "there are photodiodes 0..5 and emitters 6..8";
    while (kinds[k] && strcmp(kinds[k], kind))
        k++;
    if (!kinds[k])
        return "a fault is none, open, short, short_ground, covered or finger";
    if (i >= LEDS_COUNT && k != FAULT_NONE && k != FAULT_OPEN && k != FAULT_COVERED)
        return "an emitter's fault is none, open or covered";
    *out = (struct setting){KEY_FAULT_0 + i, k};
    return NULL;
}

const char *setting_parse(const struct nano *nano, const char *key, const char *value, struct setting *out)
{
    enum ambient ambient;
    enum light_level light;
    if (!strcmp(key, "ambient")) {
        if (config_ambient(value, &ambient))
            return "bad value: ambient is dark, room, bright_room or sun_gap";
        *out = (struct setting){KEY_AMBIENT, ambient};
        return NULL;
    }
    if (!strcmp(key, "light")) {
        if (config_light(value, &light))
            return "bad value: light is nominal, dim or bright";
        *out = (struct setting){KEY_LIGHT, light};
        return NULL;
    }
    if (!strncmp(key, "fault_", 6))
        return parse_fault(nano, key + 6, value, out);
    if (!strcmp(key, "lid") && !strcmp(value, "auto")) {
        *out = (struct setting){KEY_LID, LID_AUTO};
        return NULL;
    }
    for (int i = 0; i < (int)(sizeof NUMBERS / sizeof *NUMBERS); i++)
        if (NUMBERS[i].name && !strcmp(key, NUMBERS[i].name)) {
            out->key = i;
            if (!real(value, NUMBERS[i].low, NUMBERS[i].high, &out->number)
                || (i == KEY_MICROSACCADES && out->number != rint(out->number))) {
                static char why[80];
                snprintf(why, sizeof why, "bad value: %s is %g to %g%s", key, NUMBERS[i].low, NUMBERS[i].high,
                         i == KEY_LID ? ", or auto" : "");
                return why;
            }
            return NULL;
        }
    return "the keys are ambient, ambient_na, ambient_flicker, flicker_hz, light, supply_volts, warmer_k, "
           "fault_0.., lid, microsaccades, pupil_mean_mm, slip_x, slip_y and slip_z";
}

void setting_apply(struct nano *nano, const struct setting *s, uint64_t cycle)
{
    struct leds *leds = &nano->leds;
    struct person *person = &nano->person;
    leds_settle(leds, cycle);
    switch (s->key) {
    case KEY_AMBIENT: light_set_ambient(&leds->light, (enum ambient)s->number); break;
    case KEY_AMBIENT_NA: leds->light.ambient_na = s->number; break;
    case KEY_AMBIENT_FLICKER: leds->light.flicker = s->number; break;
    case KEY_FLICKER_HZ: light_set_flicker_hz(&leds->light, s->number, cycle); break;
    case KEY_LIGHT: light_set_level(&leds->light, (enum light_level)s->number); break;
    case KEY_LID: person->lid_forced = s->number; break;
    case KEY_MICROSACCADES: person->microsaccades = s->number != 0; break;
    case KEY_PUPIL: person->pupil_mean_mm = s->number; break;
    case KEY_SUPPLY: lamps_set_supply(&leds->lamps, s->number, cycle); break;
    case KEY_WARMER: leds->warmer_k = s->number; break;
    case KEY_SLIP_X: case KEY_SLIP_Y: case KEY_SLIP_Z:
        person->slip_mm[s->key - KEY_SLIP_X] = s->number;
        break;
    default: leds_set_fault(leds, s->key - KEY_FAULT_0, (enum led_fault)s->number, cycle);
    }
    leds->light.response_known = false;
}
