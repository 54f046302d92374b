// SPDX-License-Identifier: Apache-2.0
#include "sg_track.h"

#include "sg_err.h"
#include "sg_expose.h"
#include "sg_gp.h"
#include "sg_q.h"

// The siblings do not know the wire, but their flags travel on it as they are.
_Static_assert((int)SG_GP_OUT_OF_RANGE == (int)SG_FLAG_OUT_OF_RANGE, "flag value");
_Static_assert((int)SG_EXPOSE_SATURATED == (int)SG_FLAG_SATURATED, "flag value");
_Static_assert((int)SG_EXPOSE_STARVED == (int)SG_FLAG_STARVED, "flag value");

uint8_t sg_track_features(const uint16_t code_q2[6], const uint16_t exposure_cycles[6], uint16_t feature[6])
{
    uint8_t flags = 0;
    for (uint8_t i = 0; i < SG_WIRE_CHANNELS; i++)
        flags |= sg_expose_feature(code_q2[i], exposure_cycles[i], &feature[i]);
    return flags;
}

int sg_track_infer(const struct sg_model_view *view, const uint16_t feature[6], uint8_t raw_flags,
                   const int16_t recentre_deg_q7[2], struct sg_gaze *out)
{
    uint8_t flags = raw_flags & (SG_FLAG_SATURATED | SG_FLAG_STARVED | SG_FLAG_EXPOSURE | SG_FLAG_TRIAL
                                 | SG_FLAG_RECOVERING);
    int16_t deg_q7[2] = { 0, 0 };
    int result = SG_OK;

    if (view == NULL) {
        flags |= SG_FLAG_NO_MODEL;
    } else {
        uint8_t seen;
        result = sg_gp_predict(view, feature, deg_q7, &seen);
        for (uint8_t i = 0; i < 2; i++) {
            const int32_t sum = (int32_t)deg_q7[i] + recentre_deg_q7[i];
            deg_q7[i] = sg_q_sat16(sum);
            if (deg_q7[i] != sum)
                result = SG_E_RANGE;
        }
        if (result != SG_OK)
            seen = SG_FLAG_OUT_OF_RANGE;
        flags |= seen;
        if (!(flags & (SG_FLAG_OUT_OF_RANGE | SG_FLAG_SATURATED | SG_FLAG_STARVED | SG_FLAG_RECOVERING)))
            flags |= SG_FLAG_VALID;
    }
    out->t_us = 0;
    out->azimuth_deg_q7 = deg_q7[0];
    out->elevation_deg_q7 = deg_q7[1];
    out->infer_us = 0;
    out->flags = flags;
    out->reserved = 0;
    return result;
}
