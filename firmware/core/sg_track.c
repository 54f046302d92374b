// SPDX-License-Identifier: Apache-2.0
#include "sg_track.h"

#include "sg_err.h"
#include "sg_expose.h"
#include "sg_gp.h"
#include "sg_light.h"
#include "sg_q.h"
#include "sg_rom.h"

// The siblings do not know the wire, but their flags travel on it as they are.
_Static_assert((int)SG_GP_OUT_OF_RANGE == (int)SG_FLAG_OUT_OF_RANGE, "flag value");
_Static_assert((int)SG_LIGHT_SATURATED == (int)SG_FLAG_SATURATED, "flag value");
_Static_assert((int)SG_LIGHT_STARVED == (int)SG_FLAG_STARVED, "flag value");
_Static_assert((int)SG_LIGHT_CHANNELS == (int)SG_WIRE_CHANNELS, "channels");
_Static_assert((int)SG_HEALTH_OPEN == (int)SG_FAULT_OPEN && (int)SG_HEALTH_SHORT == (int)SG_FAULT_SHORT
               && (int)SG_HEALTH_LOW == (int)SG_FAULT_LOW && (int)SG_HEALTH_HIGH == (int)SG_FAULT_HIGH,
               "fault value");
_Static_assert((int)SG_EXPOSE_SATURATED_CODE == (int)SG_LIGHT_SATURATED_CODE
               && (int)SG_HEALTH_FULL_CODE == (int)SG_LIGHT_SATURATED_CODE, "one idea of full");

// One angle of two, k, corrected. Its row of G g, Q7, rounded, is at most 2^14 in size. Q9 times Q7 is Q16, at most
// 2^22. Returns 0 if it saturated.
static __attribute__((noinline)) uint8_t correct(const struct sg_affine *affine, uint8_t k,
                                                 const int16_t deg_q7[2], int16_t *corrected_q7)
{
    const int8_t *row_q9 = affine->gain_q9 + 2 * k;
    int32_t sum = (int32_t)deg_q7[k] + affine->offset_deg_q7[k];
    // Most devices have no gain.
    if (row_q9[0] | row_q9[1])
        sum += (int16_t)(((int32_t)row_q9[0] * deg_q7[0] + (int32_t)row_q9[1] * deg_q7[1] + 256) >> 9);
    *corrected_q7 = sg_q_sat16(sum);
    return *corrected_q7 == sum;
}

int sg_track_infer(const struct sg_model_view *view, const uint16_t feature[6], uint8_t raw_flags,
                   const struct sg_affine *recentre, struct sg_gaze *out)
{
    uint8_t flags = raw_flags & (SG_FLAG_SATURATED | SG_FLAG_STARVED | SG_FLAG_EXPOSURE | SG_FLAG_FAULT
                                 | SG_FLAG_RECOVERING);
    uint8_t sigma_log2_q4 = SG_GP_SIGMA_UNKNOWN;
    int result = SG_OK;

    out->t_us = 0;
    out->infer_us = 0;
    out->azimuth_deg_q7 = out->elevation_deg_q7 = 0;
    if (view == NULL) {
        flags |= SG_FLAG_NO_MODEL;
    } else {
        struct sg_gp_point point;
        result = sg_gp_predict(view, feature, &point);
        out->azimuth_deg_q7 = point.deg_q7[0];
        out->elevation_deg_q7 = point.deg_q7[1];
        if (recentre != NULL && !(correct(recentre, 0, point.deg_q7, &out->azimuth_deg_q7)
                                  & correct(recentre, 1, point.deg_q7, &out->elevation_deg_q7)))
            result = SG_E_RANGE;
        flags |= result == SG_OK ? point.flags : (uint8_t)SG_FLAG_OUT_OF_RANGE;
        sigma_log2_q4 = result == SG_OK ? point.sigma_log2_q4 : (uint8_t)SG_GP_SIGMA_HUGE;
        if (!(flags & (SG_FLAG_OUT_OF_RANGE | SG_FLAG_SATURATED | SG_FLAG_STARVED | SG_FLAG_EXPOSURE
                       | SG_FLAG_FAULT | SG_FLAG_RECOVERING)))
            flags |= SG_FLAG_VALID;
    }
    out->flags = flags;
    out->sigma_log2_q4 = sigma_log2_q4;
    return result;
}

void sg_track_range(const struct sg_model_view *view, uint8_t channel, struct sg_health_sight *sight)
{
    if (view == NULL) {
        sight->offset = sight->gain_q12 = 0;
        return;
    }
    const uint8_t *at = view->image + (uint8_t)(channel << 1);
    sight->offset = sg_rom_u16(at + offsetof(struct sg_model_head, offset), view->space);
    sight->gain_q12 = sg_rom_u16(at + offsetof(struct sg_model_head, gain_q12), view->space);
}
