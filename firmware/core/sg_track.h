// SPDX-License-Identifier: Apache-2.0
// One pipeline step, features in, frame out. The device calls it once per frame; `replay` and the
// bit-identity check call the same function on the host.
#ifndef SG_TRACK_H
#define SG_TRACK_H

#include <stdint.h>

#include "sg_health.h"
#include "sg_model.h"
#include "sg_wire.h"

// cdef begin
// Gaze of one frame.
//
//   view              an opened model, or NULL: the gaze is then 0, 0 with SG_FLAG_NO_MODEL
//   feature           6 features, 1/4096 octave
//   raw_flags         of the sg_raw the features come from; SATURATED, STARVED, EXPOSURE, FAULT and
//                     RECOVERING are passed on
//   recentre          correction of the model's output g, NULL for none: g + offset + floor(G g / 512 + 1/2),
//                     G g and the sum exact in 32 bits (|G g| <= 2^23), then saturated
//   out               whole frame, written last: it may lie over `feature`. t_us and infer_us are 0: the
//                     caller owns the clock. sigma is that of the model's output, uncorrected
// SG_FLAG_VALID is set only when there is a model and none of OUT_OF_RANGE, SATURATED, STARVED, EXPOSURE,
// FAULT, RECOVERING is set. (A frame in which an exposure changed holds fewer cycles of it, and its ambient
// light is known from one code.)
// Returns SG_OK, or SG_E_RANGE when an angle saturated (the frame is then OUT_OF_RANGE and not VALID).
int sg_track_infer(const struct sg_model_view *view, const uint16_t feature[6], uint8_t raw_flags,
                   const struct sg_affine *recentre, struct sg_gaze *out);

// What sg_health has to know of the model: fills in sight->offset and sight->gain_q12 for a channel; 0, 0
// without a model.
void sg_track_range(const struct sg_model_view *view, uint8_t channel, struct sg_health_sight *sight);
// cdef end

#endif
