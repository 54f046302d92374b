// SPDX-License-Identifier: Apache-2.0
// The application: one frame's way from ADC codes to bytes on the line. It knows the core and hal.h and
// nothing of the chip.
#include "app.h"

#include <string.h>

enum {
    // Stream frames leave this much of the send queue to answers.
    REPLY_RESERVE = SG_WIRE_FRAME_MAX,
    // A blink leaves the calibrated range before the lids are where they were: this long after the last frame
    // out of range a gaze may look right and be wrong. 31 ms at 3.84 ms.
    RECOVERY_FRAMES = 8,
};

struct app_state app;

static uint16_t previous_exposure[HAL_CHANNELS];
static uint8_t recovery;                // frames left that are RECOVERING

void app_count(uint16_t *counter)
{
    if (*counter != UINT16_MAX)
        ++*counter;
}

uint16_t app_exposure_limit(uint16_t exposure_cycles)
{
    if (exposure_cycles < app.exposure_min_cycles)
        return app.exposure_min_cycles;
    return exposure_cycles > app.exposure_max_cycles ? app.exposure_max_cycles : exposure_cycles;
}

uint8_t app_send(uint8_t type, uint16_t seq, const void *body, uint8_t n, uint8_t keep_free)
{
    const struct sg_head head = { .seq = seq, .type = type, .flags = 0 };
    return hal_send(&head, body, n, keep_free);
}

static void send_stream(uint8_t type, uint16_t seq, const void *body, uint8_t n)
{
    if (!app_send(type, seq, body, n, REPLY_RESERVE))
        app_count(&app.tx_dropped);
}

// Compared with the frame before, as sensed: a change takes effect in the middle of a frame or one later.
static uint8_t exposures_changed(const struct hal_frame *frame)
{
    uint8_t changed = 0;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        changed |= frame->exposure_cycles[i] != previous_exposure[i];
        previous_exposure[i] = frame->exposure_cycles[i];
    }
    return changed ? SG_FLAG_EXPOSURE : 0;
}

SELDOM static void expose_next(const struct hal_frame *frame)
{
    uint16_t exposure[HAL_CHANNELS];
    uint8_t changed = 0;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        struct sg_expose_led *led = &app.led[i];
        const uint16_t before = led->exposure_cycles;
        sg_expose_step(led, frame->code_q2[i], frame->exposure_cycles[i]);
        led->exposure_cycles = app_exposure_limit(led->exposure_cycles);
        exposure[i] = led->exposure_cycles;
        if (before != exposure[i]) {
            changed = 1;
            app_count(&app.exposure_changes);
        }
    }
    if (changed)
        hal_expose(exposure);
}

static void count_readings(const struct hal_frame *frame)
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        if (frame->code_q2[i] <= SG_EXPOSE_SATURATED_Q2)
            app_count(&app.saturated);
        if (frame->code_q2[i] > 4096 - SG_EXPOSE_STARVED_Q2)
            app_count(&app.starved);
    }
}

static void stream(const struct hal_frame *frame, struct app_streams *out)
{
    // The gaze goes first: it is the one that somebody waits for.
    if (app.stream & SG_STREAM_GAZE)
        send_stream(SG_MSG_GAZE, frame->seq, &out->gaze, sizeof out->gaze);
    if (app.stream & SG_STREAM_RAW)
        send_stream(SG_MSG_RAW, frame->seq, &out->raw, sizeof out->raw);
    if (app.stream & SG_STREAM_COUNTS) {
        out->counts.t_us = frame->t_us;
        for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
            out->counts.count_q2[i] = frame->code_q2[i];
            out->counts.exposure_us_q2[i] = sg_expose_to_us_q2(frame->exposure_cycles[i]);
        }
        send_stream(SG_MSG_COUNTS, frame->seq, &out->counts, sizeof out->counts);
    }
}

void app_on_frame(const struct hal_frame *frame)
{
    const struct sg_model_view *model = app_model();
    const struct sg_affine *recentre = app_recentre();
    struct app_streams *out = &app_body.streams;

    HAL_BEGIN(HAL_SECTION_FEATURE);
    uint8_t flags = sg_track_features(frame->code_q2, frame->exposure_cycles, out->raw.feature);
    HAL_END(HAL_SECTION_FEATURE);
    flags |= exposures_changed(frame);
    if (app_model_slot() == SG_SLOT_RAM)
        flags |= SG_FLAG_TRIAL;
    if (recovery) {
        flags |= SG_FLAG_RECOVERING;
        recovery--;
    }
    out->raw.flags = flags;
    out->raw.model_crc = model ? model->crc : 0;
    out->raw.t_us = frame->t_us;
    out->raw.span_us = frame->span_us;
    out->raw.reserved = 0;
    memset(&out->raw.recentre, 0, sizeof out->raw.recentre);
    if (recentre)
        out->raw.recentre = *recentre;

    HAL_BEGIN(HAL_SECTION_INFER);
    sg_track_infer(model, out->raw.feature, flags, recentre, &out->gaze);
    HAL_END(HAL_SECTION_INFER);
    if (out->gaze.flags & SG_FLAG_OUT_OF_RANGE)
        recovery = RECOVERY_FRAMES;
    out->gaze.t_us = frame->t_us;
    out->gaze.infer_us = (uint16_t)(hal_now_us() - (frame->t_us + frame->span_us));

    HAL_BEGIN(HAL_SECTION_OUTPUT);
    stream(frame, out);
    HAL_END(HAL_SECTION_OUTPUT);

    if (flags & (SG_FLAG_SATURATED | SG_FLAG_STARVED))
        count_readings(frame);
    if (app.exposure_auto)
        expose_next(frame);
    app_live_frame();
}

void app_describe(struct sg_hello *hello)
{
    hal_describe(hello);
    hello->firmware = APP_FIRMWARE_VERSION;
    hello->wire_version = SG_WIRE_VERSION;
    hello->model_version = SG_MODEL_VERSION;
    hello->trial_bytes = HAL_TRIAL_BYTES;
    hello->channels = HAL_CHANNELS;
}

SELDOM static void start(void)
{
    uint16_t exposure[HAL_CHANNELS];
    struct sg_hello hello;

    hal_boot();
    app_describe(&hello);
    app.exposure_min_cycles = hello.exposure_min_us * (uint16_t)SG_EXPOSE_CYCLES_PER_US;
    app.exposure_max_cycles = hello.exposure_max_us * (uint16_t)SG_EXPOSE_CYCLES_PER_US;
    app.slot_bytes = (uint16_t)hello.slot_bytes;
    app_models_start();
    app_live_start();
    app_live_exposures(exposure, &app.exposure_auto);
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        sg_expose_start(&app.led[i], app_exposure_limit(exposure[i]));
        exposure[i] = app.led[i].exposure_cycles;
    }
    hal_start(exposure);
}

int main(void)
{
    start();
    while (hal_poll()) {
        app_models_step();
        app_live_step();
    }
    return 0;
}
