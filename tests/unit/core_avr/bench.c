// SPDX-License-Identifier: Apache-2.0
// The core on an ATmega328P, without a port: reads its case from flash, marks what it does in GPIOR0 (2k+1
// begin, 2k+2 end of section k), writes every result to GPIOR1 byte by byte and stops.
//
// case_data.h is made by tests/unit/core_avr_harness.py: image, features, codes, exposures.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>

#include "case_data.h"
#include "sg_expose.h"
#include "sg_light.h"
#include "sg_link.h"
#include "sg_model.h"
#include "sg_track.h"

enum { INFER_FLASH, FEATURES, ENCODE, OPEN, INFER_MEMORY, EXPOSE, DECODE, EMPTY };

#define BEGIN(k) (GPIOR0 = 2 * (k) + 1)
#define END(k) (GPIOR0 = 2 * (k) + 2)

static void put(const void *data, uint8_t n)
{
    const uint8_t *byte = data;
    while (n--)
        GPIOR1 = *byte++;
}

static void infer(const struct sg_model_view *view, uint16_t i, uint8_t section, struct sg_gaze *gaze)
{
    uint16_t feature[6];
    const struct sg_affine recentre = { { 0, 0 }, { 0, 0, 0, 0 } };
    memcpy_P(feature, case_feature[i], sizeof feature);
    if (section == INFER_FLASH) {
        BEGIN(INFER_FLASH);
        sg_track_infer(view, feature, 0, &recentre, gaze);
        END(INFER_FLASH);
    } else {
        BEGIN(INFER_MEMORY);
        sg_track_infer(view, feature, 0, &recentre, gaze);
        END(INFER_MEMORY);
    }
    put(gaze, sizeof *gaze);
}

static uint8_t trial[880];

static void predict(struct sg_gaze *gaze)
{
    struct sg_model_view view;
    BEGIN(OPEN);
    int8_t verdict = (int8_t)sg_model_open(&view, case_image, sizeof case_image, 1);
    END(OPEN);
    put(&verdict, 1);
    if (verdict != 0)
        return;
    for (uint16_t i = 0; i < CASE_POINTS; i++)
        infer(&view, i, INFER_FLASH, gaze);
    if (sizeof case_image > sizeof trial)
        return;
    memcpy_P(trial, case_image, sizeof case_image < sizeof trial ? sizeof case_image : sizeof trial);
    verdict = (int8_t)sg_model_open(&view, trial, sizeof case_image, 0);
    put(&verdict, 1);
    for (uint16_t i = 0; i < CASE_POINTS && verdict == 0; i++)
        infer(&view, i, INFER_MEMORY, gaze);
}

static void expose(void)
{
    static struct sg_light light;
    static struct sg_expose exposures;
    const uint16_t most[6] = { 2544, 1656, 1656, 2544, 2544, 1656 };
    sg_light_start(&light, 0, 15984);
    sg_expose_start(&exposures, most, most);
    for (uint16_t i = 0; i < CASE_READINGS; i++) {
        struct sg_reading reading;
        uint16_t feature[6];
        memset(&reading, 0, sizeof reading);
        memcpy_P(reading.lit_code, case_code[i], sizeof reading.lit_code);
        memcpy_P(reading.exposure_cycles, case_exposure[i], sizeof reading.exposure_cycles);
        for (uint8_t j = 0; j < 6; j++)
            reading.unlit_code[j] = reading.lit_code[j] >> 2;
        BEGIN(FEATURES);
        sg_light_add(&light, &reading);
        const uint8_t flags = sg_light_features(&light, feature);
        END(FEATURES);
        BEGIN(EXPOSE);
        sg_expose_cycle(&exposures, &reading, 0);
        END(EXPOSE);
        put(&flags, 1);
        put(feature, sizeof feature);
        for (uint8_t j = 0; j < 6; j++)
            put(&exposures.led[j].exposure_cycles, 2);
    }
}

int main(void)
{
    static struct sg_link_rx rx;
    struct sg_gaze gaze = { 0 };
    BEGIN(EMPTY);
    END(EMPTY);
    predict(&gaze);
    expose();

    uint8_t frame[SG_WIRE_FRAME_MAX], body[SG_WIRE_BODY_MAX];
    struct sg_head head = { .seq = 0x0100, .type = SG_MSG_GAZE, .flags = 0 };
    BEGIN(ENCODE);
    const int n = sg_wire_encode(&head, &gaze, sizeof gaze, frame);
    END(ENCODE);
    put(frame, (uint8_t)n);
    size_t used;
    BEGIN(DECODE);
    const int decoded = sg_link_feed(&rx, frame, (size_t)n, &used, &head, body);
    END(DECODE);
    put(&decoded, 2);

    cli();
    sleep_enable();
    sleep_cpu();
    for (;;)
        ;
}
