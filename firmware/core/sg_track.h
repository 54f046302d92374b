// SPDX-License-Identifier: Apache-2.0
// One pipeline step. The device calls these two functions once per frame; `replay` and the bit-identity check
// call the same functions on the host.
#ifndef SG_TRACK_H
#define SG_TRACK_H

#include <stdint.h>

#include "sg_model.h"
#include "sg_wire.h"

// cdef begin
// Features of one frame from what the ADC and the timer saw (sg_expose.h).
//
//   code_q2           6 sums of four ADC codes, 0..4092
//   exposure_cycles   6 exposures as they were, timer cycles, > 0
//   feature           6 log2 photocurrents, 1/4096 octave
// Returns SG_FLAG_SATURATED and SG_FLAG_STARVED, or-ed over the channels.
uint8_t sg_track_features(const uint16_t code_q2[6], const uint16_t exposure_cycles[6], uint16_t feature[6]);

// Gaze of one frame.
//
//   view              an opened model, or NULL: the gaze is then 0, 0 with SG_FLAG_NO_MODEL
//   feature           6 features, 1/4096 octave
//   raw_flags         of the sg_raw the features come from; SATURATED, STARVED, EXPOSURE, TRIAL and RECOVERING
//                     are passed on
//   recentre          correction of the model's output g, NULL for none: g + offset + floor(G g / 512 + 1/2),
//                     G g and the sum exact in 32 bits (|G g| <= 2^23), then saturated
//   out               whole frame, written last: it may lie over `feature`. t_us and infer_us are 0: the
//                     caller owns the clock. sigma is that of the model's output, uncorrected
// SG_FLAG_VALID is set only when there is a model and none of OUT_OF_RANGE, SATURATED, STARVED, RECOVERING is
// set.
// Returns SG_OK, or SG_E_RANGE when an angle saturated (the frame is then OUT_OF_RANGE and not VALID).
int sg_track_infer(const struct sg_model_view *view, const uint16_t feature[6], uint8_t raw_flags,
                   const struct sg_affine *recentre, struct sg_gaze *out);
// cdef end

#endif
