// SPDX-License-Identifier: Apache-2.0
// Live state: what outlives a power cycle but is not a model. Stored whole whenever it changes.
#include "app.h"

enum {
    RECORD_VERSION = 1,
    // Exposures are stored when they moved by more than an eighth, looked at every 256 frames (0.98 s): 31
    // looks (30 s) after start, then at most every 610 (10 minutes), which 10^5 EEPROM cycles bear for two
    // years of light that never rests.
    LOOKS_FIRST = 31,
    LOOKS_LATER = 610,
};

struct live_record {
    uint32_t model_crc;                 // of the model that `recentre_deg_q7` was made with
    int16_t recentre_deg_q7[2];
    uint16_t exposure_cycles[HAL_CHANNELS];
    uint16_t boots;
    uint8_t exposure_auto;
    uint8_t version;
};
_Static_assert(sizeof(struct live_record) == 24, "layout in EEPROM");
_Static_assert(sizeof(struct live_record) <= HAL_RECORD_MAX, "fits the port's store");

static struct live_record live;
static uint8_t dirty;
static uint8_t frames;
static uint16_t looks = LOOKS_FIRST;

void app_live_start(void)
{
    if (!hal_load(&live, sizeof live) || live.version != RECORD_VERSION) {
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

const int16_t *app_recentre(void)
{
    static const int16_t none[2] = { 0, 0 };
    const struct sg_model_view *model = app_model();
    return model && model->crc == live.model_crc ? live.recentre_deg_q7 : none;
}

void app_recentre_set(int16_t az_deg_q7, int16_t el_deg_q7)
{
    const struct sg_model_view *model = app_model();
    live.model_crc = model ? model->crc : 0;
    live.recentre_deg_q7[0] = az_deg_q7;
    live.recentre_deg_q7[1] = el_deg_q7;
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
