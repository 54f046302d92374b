// SPDX-License-Identifier: Apache-2.0
// Between the source files of the application: what the pipeline (main.c), the requests (app_requests.c), the
// models (app_models.c) and the live state (app_live.c) share.
#ifndef APP_H
#define APP_H

#include <stdint.h>

#include "hal.h"
#include "sg_err.h"
#include "sg_expose.h"
#include "sg_link.h"
#include "sg_model.h"
#include "sg_track.h"
#include "sg_wire.h"

// Not inlined: everything ends up in main() otherwise, and what a function has on the stack stays there while
// others, later, go deeper.
#define NOT_KEPT __attribute__((noinline))
// The same for what runs seldom: compiled for size.
#define SELDOM __attribute__((noinline, cold))

#define APP_FIRMWARE_VERSION 0x000100UL      // product version, major minor patch: 0.1.0

// Everything that is not a model or a live record. One instance, in main.c.
struct app_state {
    struct sg_link_rx link;
    struct sg_expose_led led[HAL_CHANNELS];
    uint16_t exposure_min_cycles;       // the board's limits, inside the core's
    uint16_t exposure_max_cycles;
    uint16_t slot_bytes;
    uint16_t tx_dropped;
    uint16_t rx_rejected;
    uint16_t saturated;
    uint16_t starved;
    uint16_t exposure_changes;
    uint8_t stream;                     // bits of enum sg_stream
    uint8_t exposure_auto;
};
extern struct app_state app;

// A frame's streams; the counts take the place of the features once those are sent.
struct app_streams {
    union {
        struct sg_raw raw;
        struct sg_counts counts;
    };
    struct sg_gaze gaze;
};

// Of a request and then its answer, or of a frame's streams, in one place: RAM is short, an answer is made
// when its request is read, and a frame begins and ends between requests. One instance, in app_requests.c.
union app_body {
    struct sg_hello hello;
    struct sg_status status;
    struct sg_ping ping;
    struct sg_pong pong;
    struct sg_mode mode;
    struct sg_infer infer;
    struct sg_gaze gaze;
    struct sg_model_info info;
    struct sg_model_at at;
    struct sg_model_data data;
    struct sg_model_verdict verdict;
    struct sg_exposure exposure;
    struct sg_recentre recentre;
    struct app_streams streams;
    uint8_t bytes[SG_WIRE_BODY_MAX];
};
extern union app_body app_body;

// main.c
void app_count(uint16_t *counter);                          // up to 65535
uint16_t app_exposure_limit(uint16_t exposure_cycles);      // into the board's limits
uint8_t app_send(uint8_t type, uint16_t seq, const void *body, uint8_t n, uint8_t keep_free);   // 1 if queued

void app_describe(struct sg_hello *hello);

// app_models.c
void app_models_start(void);                                // validate both slots, take the newest
const struct sg_model_view *app_model(void);                // in use, NULL: none
uint8_t app_model_slot(void);                               // enum sg_slot of the model in use
void app_model_info(struct sg_model_info *info);
int8_t app_model_read(const struct sg_model_at *at, struct sg_model_data *data);
int8_t app_model_verify(uint8_t slot, uint16_t seq);        // SG_OK: begun, answers by itself when done
int8_t app_trial_write(const struct sg_model_data *data);
int8_t app_trial_use(uint16_t seq);                         // SG_OK: begun, answers by itself when done
int8_t app_trial_leave(struct sg_model_verdict *verdict);    // and what is in use then
void app_models_step(void);                                 // one piece of a check under way

// app_live.c
void app_live_start(void);                                  // load, count the boot
uint16_t app_live_boots(void);
void app_live_exposures(uint16_t exposure_cycles[HAL_CHANNELS], uint8_t *automatic);     // as stored
const struct sg_affine *app_recentre(void);                 // in force for the model in use; NULL: none
void app_recentre_set(const struct sg_affine *affine);      // NULL: none
void app_live_keep_exposures(void);                         // store them as they are now
void app_live_frame(void);                                  // once per frame: notice exposures that moved
void app_live_step(void);

#endif
