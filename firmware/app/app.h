// SPDX-License-Identifier: Apache-2.0
// Between the source files of the application: what the pipeline (main.c), exposure and health (app_sense.c),
// the timing (app_rate.c), the requests (app_requests.c), the models (app_models.c) and the live state
// (app_live.c) share.
#ifndef APP_H
#define APP_H

#include <stdint.h>

#include "hal.h"
#include "sg_err.h"
#include "sg_expose.h"
#include "sg_health.h"
#include "sg_light.h"
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
    struct sg_light light;
    struct sg_expose expose;
    struct sg_health health;
    struct sg_status status;            // its counters of the application
    uint16_t feature[HAL_CHANNELS];     // of the last frame
    uint16_t slot_bytes;
    uint8_t stream;                     // bits of enum sg_stream
    uint8_t stream_kept;                // those that are sent while the timing of `stream` is not in force yet,
    uint8_t settling;                   // for so many cycles
    uint8_t exposure_auto;              // stored when exposures are
    uint8_t slow_line;                  // 500 kbaud
    uint8_t probe;                      // the only emitter, or APP_NO_PROBE
    uint8_t sensed;                     // a cycle has come
    uint8_t pause;                      // between frames
    uint8_t infer_fits;                 // beside that of every frame, one for a request
    uint8_t roomy;                      // beside a frame's work, any request
    uint16_t busy_us;                   // from a cycle's last sample until work makes the next frame late
};
extern struct app_state app;
enum { APP_NO_PROBE = 255 };
// Is there time for so much more work before the next frame is late?
uint8_t app_time_for(uint8_t us);

// Live state, as it lies in EEPROM. One instance, in app_live.c; who changes it says so by app_live_changed().
struct app_live {
    uint32_t model_crc;                 // of the model that `recentre` was made with
    struct sg_affine recentre;
    uint16_t exposure_cycles[HAL_CHANNELS];
    uint16_t boots;
    uint8_t exposure_auto;
    uint8_t version;
    uint16_t limit_cycles[HAL_CHANNELS];    // of automatic exposure
    uint16_t rate_hz;                   // wanted; 0: as fast as can be
    int8_t curve_q10[HAL_CHANNELS];
    int8_t zero_q2;
    uint8_t reserved[3];
    uint8_t repeats;
    uint8_t wiring;
    uint8_t power;
    uint8_t lights;
};
extern struct app_live app_live;

// A frame's streams; the counts take the place of the raw frame once that is sent.
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
    struct sg_settings settings;
    struct sg_curve curve;
    struct sg_probe probe;
    struct sg_recentre recentre;
    struct app_streams streams;
    uint8_t bytes[SG_WIRE_BODY_MAX];
};
extern union app_body app_body;

// main.c
void app_count(uint16_t *counter);                          // up to 65535
uint8_t app_send(uint8_t type, uint16_t seq, const void *body, uint8_t n, uint8_t keep_free);   // 1 if queued
void app_describe(struct sg_hello *hello);
void app_infer_later(const struct sg_infer *point, uint16_t seq);       // answers by itself when done

// app_requests.c
void app_request(const struct sg_head *head, uint8_t n, uint32_t arrived_us);   // its body: app_body, n bytes

// app_sense.c
void app_sense_start(const struct hal_timing *begin);       // and the port
void app_sense_timing(const struct hal_timing *wanted);     // from soon on
const struct hal_timing *app_timing(void);                  // in force
void app_sense_cycle(const struct hal_cycle *cycle);        // exposure and health of one channel, or two; NULL: none
void app_sense_step(void);                                  // on with a change of exposures
uint8_t app_alarm(void);                                    // bits of enum sg_alarm
uint8_t app_fault(void);                                    // 1: the gaze is not to be trusted
// Exposures wanted now; and is one of them off these by more than 1/2^shift?
void app_exposures(uint16_t cycles[HAL_CHANNELS]);
uint8_t app_exposures_far(const uint16_t cycles[HAL_CHANNELS], uint8_t shift);
void app_expose_by(uint8_t op, const uint16_t exposure_us_q4[HAL_CHANNELS]);    // enum sg_exposure_op
int8_t app_probe(uint8_t emitter, uint16_t seq);            // SG_OK: begun, answers by itself when done
uint8_t app_probing(void);                                  // 1: the cycle just added belongs to a probe

// app_rate.c
void app_rate_start(struct hal_timing *timing);
void app_rate_renew(void);              // after a change of settings, model, streams or line
int8_t app_settings(struct sg_settings *io);
uint16_t app_frame_us(void);            // from frame to frame

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
void app_models_step(void);                                 // on with a check under way
// Its end, which takes as long as an inference or two: 1 if there was one.
uint8_t app_models_finish(void);

// app_live.c
void app_live_start(void);                                  // load, count the boot
const struct sg_affine *app_recentre(void);                 // in force for the model in use; NULL: none
void app_recentre_copy(struct sg_affine *to, const struct sg_affine *from);     // NULL: none, all 0
void app_recentre_set(const struct sg_affine *affine);      // NULL: none
void app_live_changed(void);
// Exposures or what makes them were set: stored at once, or those that may be one of many once they rest.
void app_live_exposed(uint8_t one_of_many);
void app_live_flush(void);                                  // at once
void app_live_cycle(uint32_t t_us);                         // notice exposures that moved
void app_live_step(void);

#endif
