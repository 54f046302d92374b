// SPDX-License-Identifier: Apache-2.0
// Inference on an ATmega328P, for the benchmark: one model in flash, features in by GPIOR2, gazes by GPIOR1.
//
// Input: the number of rows as two bytes, then six features of two bytes a row, little endian. Output: a byte
// of sg_model_open's verdict, then struct sg_gaze for each row. GPIOR0 marks section 0: features in to gaze
// out. case_model.h is made by inference_cycles.py: the model's image.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>

#include "case_model.h"
#include "sg_model.h"
#include "sg_track.h"

enum { INFER_BEGIN = 1, INFER_END = 2 };

static void put(const void *data, uint8_t n)
{
    const uint8_t *byte = data;
    while (n--)
        GPIOR1 = *byte++;
}

static uint16_t get(void)
{
    const uint8_t low = GPIOR2;
    return (uint16_t)(low | (uint16_t)GPIOR2 << 8);
}

int main(void)
{
    static struct sg_model_view view;
    const struct sg_affine none = { { 0, 0 }, { 0, 0, 0, 0 } };
    const int8_t verdict = (int8_t)sg_model_open(&view, case_image, sizeof case_image, 1);
    put(&verdict, 1);
    for (uint16_t rows = verdict == 0 ? get() : 0; rows > 0; rows--) {
        uint16_t feature[6];
        struct sg_gaze gaze = { 0 };
        for (uint8_t j = 0; j < 6; j++)
            feature[j] = get();
        GPIOR0 = INFER_BEGIN;
        sg_track_infer(&view, feature, 0, &none, &gaze);
        GPIOR0 = INFER_END;
        put(&gaze, sizeof gaze);
    }
    cli();
    sleep_enable();
    sleep_cpu();
    for (;;)
        ;
}
