// SPDX-License-Identifier: Apache-2.0
// The application: a frame's way from the readings of its cycles to bytes on the line. It knows the core and
// hal.h and nothing of the chip.
#include "app.h"

#include <string.h>

enum {
    // Stream frames leave this much of the send queue to answers that come by themselves: all others have
    // their room before the request is heard.
    REPLY_RESERVE = 24,
    // A blink leaves the calibrated range before the lids are where they were: this long after the last frame
    // out of range a gaze may look right and be wrong.
    RECOVERY_256US = 176,               // 45 ms
    BLINK_256US = 43,                   // out of range for so long
    DOUBT_256US = 9,                    // after each: lids that close are in range and out of it by turns
    // No eye turns by more than a degree in a millisecond. What moves by that and so much more is noise, such as
    // sunlight beside little of ours makes of a gaze; its neighbours are no better, whatever they say.
    JUMP_DEG_Q1 = 3,                    // a degree in 1024 us is one in 512 us
    CALM_256US = 32,
    FRESH_256US = 20,                   // the next frame of four cycles
    // One of these beside a frame's work: two at once make the next frame late.
    BYTES_US = 130,                     // a look at the line
    DECODE_US = 150,                    // a packet
    REQUEST_US = 157,                   // a request, and its answer
    // One that makes a frame late is done after so many cycles, if no frame is late yet: it takes 500 us, a
    // long one and receiving the next 2 us a byte more, and readings are lost when work is behind by a period.
    PATIENCE_CYCLES = 6,
    PATIENCE_MOST_CYCLES = 80,          // whatever happens
};

struct app_state app;

// A request for an inference, until there is time for it.
static struct {
    struct sg_infer point;
    uint16_t seq;
    uint8_t waiting;                    // 0: none; and cycles that it has waited, in a stream
} asked;

// The frame under way.
static uint32_t first_us;               // mean sample time of its first cycle
static uint16_t frame_seq;
static uint8_t left;                    // cycles still to come
static uint8_t under_way;
static uint16_t last_us;                // of the last sample
static uint8_t refused;                 // something came on the line and found no time
static uint8_t waited;                  // cycles that it has waited
static const struct hal_cycle *unseen;  // taken up, and exposure and health have not looked at it

// A request, until there is time for it; its body is still where it was decoded.
static struct {
    struct sg_head head;
    uint32_t zero_us;
    uint8_t bytes;
    uint8_t waiting;
} heard;

static uint16_t previous_exposure[HAL_CHANNELS];
// A frame is never 65 ms: bytes tell times apart.
static uint8_t before_256us;            // when the frame before was sensed
static uint8_t hold_256us;              // no gaze is called valid for so long
static uint8_t out_256us;               // for so long out of range, at most BLINK_256US
static uint8_t before_deg_q1[2];        // the gaze before, modulo 128 deg

void app_count(uint16_t *counter)
{
    if (*counter != UINT16_MAX)
        ++*counter;
}

uint8_t app_send(uint8_t type, uint16_t seq, const void *body, uint8_t n, uint8_t keep_free)
{
    const struct sg_head head = { .seq = seq, .type = type, .flags = 0 };
    return hal_send(&head, body, n, keep_free);
}

static void send_stream(uint8_t type, const void *body, uint8_t n)
{
    if (!app_send(type, frame_seq, body, n, REPLY_RESERVE))
        app_count(&app.status.tx_dropped);
}

SELDOM void app_infer_later(const struct sg_infer *point, uint16_t seq)
{
    asked.point = *point;
    asked.seq = seq;
    asked.waiting = 1;
}

// What takes as long as an inference and is done in the place of one, or when there is time for both: 1 if there
// was something.
NOT_KEPT static uint8_t long_work(void)
{
    if (!asked.waiting)
        return app_models_finish();
    HAL_BEGIN(HAL_SECTION_REQUEST);
    sg_track_infer(app_model(), asked.point.feature, 0, app_recentre(), &app_body.gaze);
    HAL_END(HAL_SECTION_REQUEST);
    // Not queued only while the line is full of answers: again in the next turn.
    if (app_send(SG_MSG_INFER | SG_REPLY, asked.seq, &app_body.gaze, sizeof app_body.gaze, 0))
        asked.waiting = 0;
    return 1;
}

// What takes a part of a frame's time is begun only if the next frame is not late for it.
uint8_t app_time_for(uint8_t us)
{
    return app.roomy || (uint16_t)(hal_now_us16() - last_us) + us < app.busy_us;
}

// The same for what comes on the line, whose patience ends.
static uint8_t time_for_line(uint8_t us)
{
    if (app_time_for(us)
        || (waited > PATIENCE_CYCLES
            && (waited > PATIENCE_MOST_CYCLES || app_time_for((uint8_t)(heard.bytes << 1)))))
        return 1;
    refused = 1;
    return 0;
}

uint8_t app_listens(uint8_t byte)
{
    if (asked.waiting | heard.waiting)
        return 0;
    return time_for_line(byte ? BYTES_US : DECODE_US);
}

NOT_KEPT static void answer(void)
{
    if (!heard.waiting)
        return;
    // With room for an answer and for as much of the streams, so that none of them is left out for it, unless the
    // line never has that.
    if (!hal_send(NULL, NULL, SG_WIRE_BODY_MAX, waited > PATIENCE_CYCLES ? 0 : SG_WIRE_FRAME_MAX)) {
        refused = 1;
        return;
    }
    if (!time_for_line(REQUEST_US))
        return;
    heard.waiting = waited = 0;
    memcpy(app_body.bytes, app.link.frame + SG_WIRE_HEAD_BYTES, heard.bytes);
    app_request(&heard.head, heard.bytes, heard.zero_us);
}

void app_on_byte(uint8_t byte, uint32_t zero_us)
{
    if (byte != 0) {
        sg_link_put(&app.link, byte);
        return;
    }
    const int n = sg_link_end(&app.link, &heard.head, app.link.frame + SG_WIRE_HEAD_BYTES);
    if (n < 0) {
        waited = 0;
        return;
    }
    heard.zero_us = zero_us;
    heard.bytes = (uint8_t)n;
    heard.waiting = 1;
    answer();
}

static uint8_t acquires(void)
{
    return app.exposure_auto && app.expose.acquiring;
}

// Compared with the frame before, as sensed.
static uint8_t exposures_changed(const struct sg_reading *reading)
{
    uint8_t changed = 0;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        if (previous_exposure[i] != reading->exposure_cycles[i])
            changed = SG_FLAG_EXPOSURE;
        previous_exposure[i] = reading->exposure_cycles[i];
    }
    return changed;
}

NOT_KEPT static void send_raw(struct sg_raw *raw, const struct sg_model_view *model, const struct sg_affine *recentre)
{
    raw->model_crc = model ? model->crc : 0;
    memcpy(raw->feature, app.feature, sizeof raw->feature);
    raw->reserved = 0;
    app_recentre_copy(&raw->recentre, recentre);
    send_stream(SG_MSG_RAW, raw, sizeof *raw);
}

NOT_KEPT static void send_counts(struct sg_counts *counts, const struct sg_reading *reading, uint32_t t_us)
{
    counts->t_us = t_us;
    memcpy(counts->lit_code, reading->lit_code, sizeof counts->lit_code);
    memcpy(counts->unlit_code, reading->unlit_code, sizeof counts->unlit_code);
    // 1/16 us is a cycle.
    memcpy(counts->exposure_us_q4, reading->exposure_cycles, sizeof counts->exposure_us_q4);
    send_stream(SG_MSG_COUNTS, counts, sizeof *counts);
}

SELDOM static void count_readings(void)
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        if (app.light.channel[i].flags & SG_LIGHT_SATURATED)
            app_count(&app.status.saturated);
        if (app.light.channel[i].flags & SG_LIGHT_STARVED)
            app_count(&app.status.starved);
    }
}

// Is this angle farther from that of the frame before than an eye can turn?
static uint8_t jumps(int16_t deg_q7, uint8_t axis, uint8_t most_q1)
{
    const uint8_t deg_q1 = (uint8_t)((uint16_t)deg_q7 >> 6);
    const uint8_t off = (uint8_t)(deg_q1 - before_deg_q1[axis] + most_q1);
    before_deg_q1[axis] = deg_q1;
    return off > (uint8_t)(most_q1 << 1);
}

// The frame whose last cycle this is: features -> gaze -> streams, the gaze first, somebody waits for it.
static void finish_frame(const struct hal_cycle *cycle)
{
    // Cycles follow each other evenly: their mean is the mean of the first and the last.
    const uint16_t half_us = (uint16_t)(cycle->t_us - first_us) >> 1;
    const uint32_t t_us = first_us + half_us;
    const uint16_t span_us = (uint16_t)(cycle->t_us - t_us) + cycle->span_us;
    const struct sg_model_view *model = app_model();
    const struct sg_affine *recentre = app_recentre();
    struct app_streams *out = &app_body.streams;

    HAL_BEGIN(HAL_SECTION_FEATURE);
    uint8_t flags = sg_light_features(&app.light, app.feature);
    HAL_END(HAL_SECTION_FEATURE);
    if (flags)
        count_readings();
    flags |= exposures_changed(&cycle->reading);
    if (app_fault())
        flags |= SG_FLAG_FAULT;
    const uint8_t since = (uint8_t)((uint8_t)((uint16_t)t_us >> 8) - before_256us);
    before_256us = (uint8_t)((uint16_t)t_us >> 8);
    if (hold_256us > since) {
        hold_256us = (uint8_t)(hold_256us - since);
        flags |= SG_FLAG_RECOVERING;
    } else {
        hold_256us = 0;
    }
    uint8_t odd = flags & SG_FLAG_EXPOSURE;
    if (acquires()) {               // some are far too short
        flags |= SG_FLAG_RECOVERING;
        odd = 1;
    }
    // What one code said of the ambient light outlasts the frame.
    if (odd && app_timing()->repeats > 1 && hold_256us < FRESH_256US)
        hold_256us = FRESH_256US;

    HAL_BEGIN(HAL_SECTION_INFER);
    sg_track_infer(model, app.feature, flags, recentre, &out->gaze);
    HAL_END(HAL_SECTION_INFER);
    // Lids stay away for long; noise does not, nor does light that has just changed. Where an exposure follows
    // it, features say nothing about the lids.
    if (!(out->gaze.flags & SG_FLAG_OUT_OF_RANGE) || odd || (flags & (SG_FLAG_SATURATED | SG_FLAG_STARVED))) {
        out_256us = 0;
    } else {
        out_256us = (uint8_t)(out_256us + since);
        if (hold_256us < DOUBT_256US)
            hold_256us = DOUBT_256US;
        if (out_256us >= BLINK_256US) {
            hold_256us = RECOVERY_256US;
            out_256us = BLINK_256US;
        }
    }
    const uint8_t most = (uint8_t)((since >> 1) + JUMP_DEG_Q1);    // at most 125
    if ((jumps(out->gaze.azimuth_deg_q7, 0, most) | jumps(out->gaze.elevation_deg_q7, 1, most)) && !odd) {
        if (hold_256us < CALM_256US)
            hold_256us = CALM_256US;
        flags |= SG_FLAG_RECOVERING;
        out->gaze.flags = (uint8_t)((out->gaze.flags & ~SG_FLAG_VALID) | SG_FLAG_RECOVERING);
    }

    HAL_BEGIN(HAL_SECTION_OUTPUT);
    const uint8_t stream = app.settling ? app.stream_kept : app.stream;
    if (stream & SG_STREAM_GAZE) {
        out->gaze.t_us = t_us;
        out->gaze.infer_us = hal_now_us16() - (uint16_t)t_us - span_us;
        send_stream(SG_MSG_GAZE, &out->gaze, sizeof out->gaze);
    }
    if (stream & SG_STREAM_RAW) {
        out->raw.t_us = t_us;
        out->raw.span_us = span_us;
        out->raw.flags = flags;
        send_raw(&out->raw, model, recentre);
    }
    if (stream & SG_STREAM_COUNTS)
        send_counts(&out->counts, &cycle->reading, t_us);
    HAL_END(HAL_SECTION_OUTPUT);
}

// Take up a cycle: is it the next of the frame under way?
static void take(const struct hal_cycle *cycle)
{
    if (!under_way || cycle->seq != frame_seq || cycle->left != left - 1) {
        frame_seq++;
        if (cycle->left != app_timing()->repeats - 1 || cycle->seq != frame_seq || app.pause)
            sg_light_gap(&app.light);
        if (under_way)                  // cycles of a frame that lost its last one
            sg_light_features(&app.light, app.feature);
        frame_seq = cycle->seq;
        first_us = cycle->t_us;
    }
    left = cycle->left;
    under_way = left != 0;
    sg_light_add(&app.light, &cycle->reading);
    // The light that moved rests in all likelihood: no reason to interpolate. After the cycle: what it says of
    // channels beside those with new exposures is no light.
    if (acquires())
        app.light.moving = app.light.state = 0;
}

void app_on_cycle(const struct hal_cycle *cycle)
{
    const uint8_t first = !app.sensed;
    if (first) {                        // what follows has to share the time with frames
        app.sensed = 1;
        app_rate_renew();
    }
    take(cycle);
    const uint8_t last = !under_way;
    if (app_probing()) {
        if (last && app.stream)
            app_count(&app.status.tx_dropped);
    } else {
        const uint8_t put_off = app.stream && asked.waiting && asked.waiting < PATIENCE_MOST_CYCLES;
        if (put_off)
            asked.waiting++;
        if (last && (put_off || !long_work()))
            finish_frame(cycle);
        else if (last && app.stream)
            app_count(&app.status.tx_dropped);
        if (!first)                     // which has enough to do
            unseen = cycle;
    }
    app.settling -= app.settling != 0;
    app_live_cycle(cycle->t_us);
    last_us = (uint16_t)cycle->t_us + cycle->span_us;
    if (refused && waited != UINT8_MAX)
        waited++;
    refused = 0;
}

SELDOM void app_describe(struct sg_hello *hello)
{
    hal_describe(hello);
    hello->firmware = APP_FIRMWARE_VERSION;
    hello->wire_version = SG_WIRE_VERSION;
    hello->model_version = SG_MODEL_VERSION;
    hello->trial_bytes = HAL_TRIAL_BYTES;
    hello->channels = HAL_CHANNELS;
    hello->frame_period_us = app_frame_us();
}

SELDOM static void start(void)
{
    struct sg_hello hello;
    struct hal_timing timing;

    hal_boot();
    app_describe(&hello);
    app.slot_bytes = (uint16_t)hello.slot_bytes;
    app.probe = APP_NO_PROBE;
    app_models_start();
    app_live_start();
    app_rate_start(&timing);
    app_sense_start(&timing);
}

int main(void)
{
    start();
    while (hal_poll()) {
        app_sense_cycle(unseen);        // after the frame: its gaze waits for nothing
        unseen = NULL;
        answer();
        if (app.infer_fits || (asked.waiting && app_time_for(0)))
            long_work();
        app_sense_step();
        app_models_step();
        app_live_step();
    }
    return 0;
}
