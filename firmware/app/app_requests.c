// SPDX-License-Identifier: Apache-2.0
// Requests: one well-formed packet in, one answer out. No length from the line is trusted (PROTOCOL.md P3,
// P4).
#include "app.h"

#include <stddef.h>
#include <string.h>

enum { REBOOT_KEY = 0xA5, SETTLING_CYCLES = 4, STREAM_ALL = SG_STREAM_RAW | SG_STREAM_GAZE | SG_STREAM_COUNTS };

union app_body app_body;

SELDOM static void refuse(uint8_t type, uint16_t seq, int8_t error)
{
    const struct sg_error why = { .error = error, .type = type };
    app_count(&app.status.rx_rejected);
    app_send(SG_MSG_ERROR, seq, &why, sizeof why, 0);
}

// Shortest body of a request, bytes; -1: there is no such request.
SELDOM static int8_t shortest(uint8_t type)
{
    switch (type) {
    case SG_MSG_HELLO:
    case SG_MSG_STATUS:
    case SG_MSG_MODEL_INFO:
        return 0;
    case SG_MSG_PING:
        return sizeof(struct sg_ping);
    case SG_MSG_MODE:
    case SG_MSG_TRIAL_USE:
    case SG_MSG_REBOOT:
    case SG_MSG_BAUD:
    case SG_MSG_PROBE:
        return sizeof(struct sg_mode);
    case SG_MSG_INFER:
        return sizeof(struct sg_infer);
    case SG_MSG_SETTINGS:
        return sizeof(struct sg_settings);
    case SG_MSG_CURVE:
        return sizeof(struct sg_curve);
    case SG_MSG_MODEL_READ:
    case SG_MSG_MODEL_VERIFY:
        return sizeof(struct sg_model_at);
    case SG_MSG_TRIAL_WRITE:
        return offsetof(struct sg_model_data, data);
    case SG_MSG_EXPOSURE:
        return sizeof(struct sg_exposure);
    case SG_MSG_RECENTRE:
        return sizeof(struct sg_recentre);
    default:
        return -1;
    }
}

SELDOM __attribute__((noclone)) static void status(struct sg_status *out)
{
    *out = app.status;
    hal_report(out);
    out->t_us = hal_now_us();
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        out->exposure_us_q4[i] = app.expose.led[i].exposure_cycles;
        out->fault[i] = app.health.fault[i];
    }
    out->boot_count = app_live.boots;
    const uint16_t bad = app.link.bad_crc + app.link.bad_length;
    out->rx_bad = bad < app.link.bad_crc ? UINT16_MAX : bad;
    out->stream = app.stream;
    out->exposure_auto = app.exposure_auto;
    out->active = app_model_slot();
    out->alarm |= app_alarm();
}

SELDOM static int8_t exposure(struct sg_exposure *io)
{
    if (io->op > SG_EXPOSURE_LIMIT)
        return SG_E_ARG;
    app_expose_by(io->op, io->exposure_us_q4);
    app_exposures(io->exposure_us_q4);
    io->op = app.exposure_auto ? SG_EXPOSURE_AUTO : SG_EXPOSURE_HOLD;
    io->reserved = 0;
    return SG_OK;
}

SELDOM static int8_t curve(struct sg_curve *io)
{
    if (io->op > SG_SETTINGS_SET || io->zero_q2 > 0)
        return SG_E_ARG;
    if (io->op == SG_SETTINGS_SET) {
        memcpy(app_live.curve_q10, io->curve_q10, sizeof app_live.curve_q10);
        app_live.zero_q2 = io->zero_q2;
        app_live_changed();
        sg_light_curve(&app.light, app_live.curve_q10, app_live.zero_q2);
    }
    memcpy(io->curve_q10, app_live.curve_q10, sizeof io->curve_q10);
    io->zero_q2 = app_live.zero_q2;
    return SG_OK;
}

SELDOM static int8_t recentre(struct sg_recentre *io)
{
    if (io->op > SG_RECENTRE_CLEAR)
        return SG_E_ARG;
    if (io->op == SG_RECENTRE_SET && !app_model())
        return SG_E_STATE;              // a correction belongs to a model
    if (io->op == SG_RECENTRE_SET)
        app_recentre_set(&io->affine);
    else if (io->op == SG_RECENTRE_CLEAR)
        app_recentre_set(NULL);
    app_recentre_copy(&io->affine, app_recentre());
    io->reserved = 0;
    return SG_OK;
}

SELDOM static int8_t trial_write(uint8_t n)
{
    if (app_body.data.length > n - offsetof(struct sg_model_data, data))
        return SG_E_SHORT;
    const int8_t result = app_trial_write(&app_body.data);
    // The answer's fields are the request's, in another order.
    const struct sg_model_at at = { .offset = app_body.data.offset, .slot = app_body.data.slot,
                                    .length = app_body.data.length };
    app_body.at = at;
    return result;
}

// `body` holds the n bytes of the request, and then its answer.
SELDOM __attribute__((noclone)) void app_request(const struct sg_head *head, uint8_t n, uint32_t arrived_us)
{
    uint8_t answer_bytes = 0;
    int8_t result = SG_OK;
    uint8_t answered = 0;               // later, by who does it
    const int8_t least = shortest(head->type);
    const uint8_t mode = app_body.bytes[offsetof(struct sg_mode, mode)];    // if it is a request that has one

    if (least < 0 || n < (uint8_t)least) {
        refuse(head->type, head->seq, least < 0 ? SG_E_UNKNOWN : SG_E_SHORT);
        return;
    }
    switch (head->type) {
    case SG_MSG_HELLO:
        app_describe(&app_body.hello);
        answer_bytes = sizeof app_body.hello;
        break;
    case SG_MSG_STATUS:
        status(&app_body.status);
        answer_bytes = sizeof app_body.status;
        break;
    case SG_MSG_PING:
        app_body.pong.rx_us = arrived_us;
        app_body.pong.tx_us = hal_now_us();
        answer_bytes = sizeof app_body.pong;
        break;
    case SG_MSG_MODE:
        if (mode & ~STREAM_ALL)
            result = SG_E_ARG;
        else if (app.stream != mode) {
            app.stream_kept = app.stream & mode;
            app.settling = SETTLING_CYCLES;
            app.stream = mode;
            app_rate_renew();
        }
        answer_bytes = sizeof app_body.mode;
        break;
    case SG_MSG_INFER:
        app_infer_later(&app_body.infer, head->seq);
        answered = 1;
        break;
    case SG_MSG_MODEL_INFO:
        app_model_info(&app_body.info);
        answer_bytes = sizeof app_body.info;
        break;
    case SG_MSG_MODEL_READ: {
        const struct sg_model_at at = app_body.at;
        result = app_model_read(&at, &app_body.data);
        answer_bytes = offsetof(struct sg_model_data, data) + at.length;
        break;
    }
    case SG_MSG_MODEL_VERIFY:
        result = app_model_verify(app_body.at.slot, head->seq);
        answered = 1;
        break;
    case SG_MSG_TRIAL_WRITE:
        result = trial_write(n);
        answer_bytes = sizeof app_body.at;
        break;
    case SG_MSG_TRIAL_USE:
        if (mode > 1)
            result = SG_E_ARG;
        else if (mode == 1) {
            result = app_trial_use(head->seq);
            answered = 1;
        } else {
            result = app_trial_leave(&app_body.verdict);
            answer_bytes = sizeof app_body.verdict;
        }
        break;
    case SG_MSG_EXPOSURE:
        result = exposure(&app_body.exposure);
        answer_bytes = sizeof app_body.exposure;
        break;
    case SG_MSG_SETTINGS:
        result = app_settings(&app_body.settings);
        answer_bytes = sizeof app_body.settings;
        break;
    case SG_MSG_CURVE:
        result = curve(&app_body.curve);
        answer_bytes = sizeof app_body.curve;
        break;
    case SG_MSG_PROBE:
        result = app_probe(mode, head->seq);
        answered = 1;
        break;
    case SG_MSG_RECENTRE:
        result = recentre(&app_body.recentre);
        answer_bytes = sizeof app_body.recentre;
        break;
    case SG_MSG_REBOOT:
        result = mode == REBOOT_KEY ? SG_OK : SG_E_ARG;
        answer_bytes = sizeof app_body.mode;
        break;
    case SG_MSG_BAUD:
        result = mode <= 1 ? SG_OK : SG_E_ARG;
        answer_bytes = sizeof app_body.mode;
        break;
    }

    if (result != SG_OK) {
        refuse(head->type, head->seq, result);
        return;
    }
    if (answered)
        return;
    app_send(head->type | SG_REPLY, head->seq, app_body.bytes, answer_bytes, 0);
    uint8_t after = mode;               // enum hal_after
    if (head->type == SG_MSG_REBOOT) {
        app_live_flush();
        after = HAL_AFTER_REBOOT;
    } else if (head->type == SG_MSG_BAUD) {
        app.slow_line = mode;
        app_rate_renew();
    } else {
        return;
    }
    hal_after_sending(after);
}
