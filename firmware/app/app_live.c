// SPDX-License-Identifier: Apache-2.0
// Live state: what outlives a power cycle but is not a model. Stored whole whenever it changes.
#include "app.h"

#include <string.h>

enum {
    RECORD_VERSION = 3,
    // Exposures are stored when they moved by more than an eighth, looked at every 1.05 s: 28 looks (30 s)
    // after start, then at most every 572 (10 minutes), which 10^5 EEPROM cycles bear for two years of light
    // that never rests.
    LOOKS_FIRST = 28,
    LOOKS_LATER = 572,
    // Those set by command once they have rested for so many looks: a program may try many.
    LOOKS_REST = 2,
};
_Static_assert(sizeof(struct app_live) == 56, "layout in EEPROM");
_Static_assert(sizeof(struct app_live) <= HAL_RECORD_MAX, "fits the port's store");

struct app_live app_live;
static uint8_t dirty;
static uint8_t second;                  // of device time, 1.05 s long
static uint8_t resting;                 // looks until exposures set by command are stored
static uint16_t looks = LOOKS_FIRST;

SELDOM void app_live_start(void)
{
    if (!hal_load(&app_live, sizeof app_live) || app_live.version != RECORD_VERSION) {
        // Older records have another size; their exposures were for another circuit.
        memset(&app_live, 0, sizeof app_live);
        for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
            app_live.exposure_cycles[i] = SG_EXPOSE_START_CYCLES;
            app_live.limit_cycles[i] = UINT16_MAX;
        }
        app_live.exposure_auto = 1;
        app_live.repeats = 1;
        app_live.lights = 1;
        app_live.version = RECORD_VERSION;
    }
    app.exposure_auto = app_live.exposure_auto;
    app_live.boots++;
    dirty = 1;
}

const struct sg_affine *app_recentre(void)
{
    const struct sg_model_view *model = app_model();
    return model && model->crc == app_live.model_crc ? &app_live.recentre : NULL;
}

NOT_KEPT void app_recentre_copy(struct sg_affine *to, const struct sg_affine *from)
{
    if (from)
        *to = *from;
    else
        memset(to, 0, sizeof *to);
}

SELDOM void app_recentre_set(const struct sg_affine *affine)
{
    const struct sg_model_view *model = app_model();
    app_live.model_crc = model && affine ? model->crc : 0;
    app_recentre_copy(&app_live.recentre, affine);
    dirty = 1;
    app_rate_renew();
}

void app_live_changed(void)
{
    dirty = 1;
}

SELDOM static void keep_exposures(void)
{
    if (!app.exposure_auto)             // those that move by themselves are kept in their own time
        app_exposures(app_live.exposure_cycles);
    app_live.exposure_auto = app.exposure_auto;
    dirty = 1;
}

void app_live_exposed(uint8_t one_of_many)
{
    if (one_of_many)
        resting = LOOKS_REST;
    else
        keep_exposures();
}

SELDOM void app_live_flush(void)
{
    if (resting)
        keep_exposures();
    resting = 0;
}

// Once in 1.05 s.
SELDOM static void look(void)
{
    if (resting && --resting == 0)
        keep_exposures();
    if (--looks != 0)
        return;
    looks = 1;
    if (app_exposures_far(app_live.exposure_cycles, 3)) {
        app_exposures(app_live.exposure_cycles);
        dirty = 1;
        looks = LOOKS_LATER;
    }
}

void app_live_cycle(uint32_t t_us)
{
    const uint8_t now = (uint8_t)((uint16_t)(t_us >> 16) >> 4);
    if (now != second) {
        second = now;
        look();
    }
}

void app_live_step(void)
{
    if (dirty && hal_save(&app_live, sizeof app_live))
        dirty = 0;
}
