// SPDX-License-Identifier: Apache-2.0
#include "sg_gp.h"

#include <stddef.h>

#include "sg_err.h"
#include "sg_gp_loop.h"
#include "sg_q.h"
#include "sg_rom.h"

#define HEAD(field) (offsetof(struct sg_model_head, field))
#define TRUST(field) (SG_MODEL_PAGE + offsetof(struct sg_model_trust, field))

// The loops read on from where they are pointed at.
_Static_assert(HEAD(trend) == HEAD(bias) + 8 && HEAD(gain_q12) == HEAD(offset) + 12, "model layout");
_Static_assert(TRUST(scale) == TRUST(origin_deg_q7) + 6 && TRUST(nodes) == TRUST(origin_deg_q7) + 8
               && SG_MODEL_HEAD_BYTES == TRUST(origin_deg_q7) + SG_GP_GRID_FROM, "model layout");

// Does any gaze explain these features? point: deg_q7 and flags given, flags may gain OUT_OF_RANGE.
static void trust(const struct sg_model_view *view, const struct sg_gp_sum *sum, struct sg_gp_point *point)
{
    const uint8_t *image = view->image;
    const uint8_t space = view->space;
    struct sg_gp_place place;
    struct sg_gp_opinion opinion;

    sg_gp_find(point->deg_q7, image + TRUST(origin_deg_q7), space, &place);
    sg_gp_judge(sum, &place, image + TRUST(guard), space, &opinion);
    uint8_t out = point->flags | opinion.out;
    if (opinion.doubt > sg_rom_u16(image + TRUST(limit), space))
        out = SG_GP_OUT_OF_RANGE;
    const uint8_t gain = sg_rom_byte(image + TRUST(sigma_gain), space);
    const uint16_t more = (uint16_t)(((uint32_t)opinion.doubt * gain) >> 8) >> 4;  // 24 bits; at most 4014
    const uint16_t code = (uint16_t)(opinion.sigma_log2_q4 + more);
    point->doubt = opinion.doubt;
    point->flags = out;
    point->sigma_log2_q4 = code < SG_GP_SIGMA_HUGE && !out ? (uint8_t)code : (uint8_t)SG_GP_SIGMA_HUGE;
}

int sg_gp_predict(const struct sg_model_view *view, const uint16_t feature[6], struct sg_gp_point *point)
{
    const uint8_t *image = view->image;
    const uint8_t space = view->space;
    struct sg_gp_sum sum;

    const uint8_t clamped = sg_gp_scale(&sum, feature, image + HEAD(offset), space);
    sg_gp_trend(&sum, image + HEAD(bias), space);
    sg_gp_loop(&sum, image + view->records, view->vectors, space);
    const uint8_t saturated = sg_gp_round(&sum, view->weight_frac_bits, point->deg_q7);
    point->flags = clamped | saturated;
    trust(view, &sum, point);
    return saturated ? SG_E_RANGE : SG_OK;
}
