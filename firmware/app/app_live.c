// SPDX-License-Identifier: Apache-2.0
// Live state: what outlives a power cycle but is not a model. Stored whole whenever it changes.
#include "app.h"

#include <stddef.h>
#include <string.h>

enum {
    RECORD_VERSION = 2,
    // Exposures are stored when they moved by more than an eighth, looked at every 256 frames (0.98 s): 31
    // looks (30 s) after start, then at most every 610 (10 minutes), which 10^5 EEPROM cycles bear for two
    // years of light that never rests.
    LOOKS_FIRST = 31,
    LOOKS_LATER = 610,
};

struct live_record {
    uint32_t model_crc;                 // of the model that `recentre` was made with
    struct sg_affine recentre;
    uint16_t exposure_cycles[HAL_CHANNELS];
    uint16_t boots;
    uint8_t exposure_auto;
    uint8_t version;
};
_Static_assert(sizeof(struct live_record) == 28, "layout in EEPROM");
_Static_assert(sizeof(struct live_record) <= HAL_RECORD_MAX, "fits the port's store");

// Version 1 had no gains; all else stood in the same order.
enum {
    GAINS_AT = offsetof(struct live_record, recentre.gain_q9),
    AFTER_GAINS = GAINS_AT + sizeof(((struct sg_affine *)0)->gain_q9),
    V1_BYTES = sizeof(struct live_record) - (AFTER_GAINS - GAINS_AT),
};

static struct live_record live;
static uint8_t dirty;
static uint8_t frames;
static uint16_t looks = LOOKS_FIRST;

static uint8_t load_v1(void)
{
    uint8_t *byte = (uint8_t *)&live;
    if (!hal_load(byte, V1_BYTES))
        return 0;
    memmove(byte + AFTER_GAINS, byte + GAINS_AT, V1_BYTES - GAINS_AT);
    memset(byte + GAINS_AT, 0, AFTER_GAINS - GAINS_AT);
    if (live.version != 1)
        return 0;
    live.version = RECORD_VERSION;
    return 1;
}

void app_live_start(void)
{
    if ((!hal_load(&live, sizeof live) || live.version != RECORD_VERSION) && !load_v1()) {
        live = (struct live_record){ .exposure_auto = 1, .version = RECORD_VERSION };
        for (uint8_t i = 0; i < HAL_CHANNELS; i++)
            live.exposure_cycles[i] = SG_EXPOSE_START_CYCLES;
    }
    live.boots++;
    dirty = 1;
}

uint16_t app_live_boots(void)
{
    return live.boots;
}

void app_live_exposures(uint16_t exposure_cycles[HAL_CHANNELS], uint8_t *automatic)
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++)
        exposure_cycles[i] = live.exposure_cycles[i];
    *automatic = live.exposure_auto != 0;
}

const struct sg_affine *app_recentre(void)
{
    const struct sg_model_view *model = app_model();
    return model && model->crc == live.model_crc ? &live.recentre : NULL;
}

void app_recentre_set(const struct sg_affine *affine)
{
    const struct sg_model_view *model = app_model();
    live.model_crc = model ? model->crc : 0;
    memset(&live.recentre, 0, sizeof live.recentre);
    if (affine)
        live.recentre = *affine;
    dirty = 1;
}

void app_live_keep_exposures(void)
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++)
        live.exposure_cycles[i] = app.led[i].exposure_cycles;
    live.exposure_auto = app.exposure_auto;
    dirty = 1;
}

void app_live_frame(void)
{
    if (++frames != 0 || --looks != 0)
        return;
    looks = 1;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        const uint16_t now = app.led[i].exposure_cycles, stored = live.exposure_cycles[i];
        const uint16_t moved = now > stored ? now - stored : stored - now;
        if (moved > stored >> 3) {
            app_live_keep_exposures();
            looks = LOOKS_LATER;
            return;
        }
    }
}

void app_live_step(void)
{
    if (dirty && hal_save(&live, sizeof live))
        dirty = 0;
}
