// SPDX-License-Identifier: Apache-2.0
#include "sg_gp.h"

#include <stddef.h>

#include "sg_err.h"
#include "sg_gp_loop.h"
#include "sg_q.h"
#include "sg_rom.h"

#define HEAD(field) (offsetof(struct sg_model_head, field))
#define TRUST(field) (SG_MODEL_PAGE + offsetof(struct sg_model_trust, field))

// sg_gp_trend and sg_gp_scale read on.
_Static_assert(HEAD(trend) == HEAD(bias) + 8 && HEAD(gain_q12) == HEAD(offset) + 12, "model layout");

// Cell and fraction Q0.7 of one axis.
static inline uint8_t along(int16_t deg_q7, int16_t origin_deg_q7, uint8_t scale, uint8_t nodes, uint8_t *cell)
{
    const int32_t difference = (int32_t)deg_q7 - origin_deg_q7;     // 17 bits
    const uint8_t last = (uint8_t)(nodes - 2U);
    if (difference < 0) {
        *cell = 0;
        return 0;
    }
    const uint32_t t = (uint32_t)(uint16_t)difference * scale;     // Q8.16; below 2^16 since both are Q8.7 +-16384
    *cell = (uint8_t)(t >> 16);
    if (*cell > last) {
        *cell = last;
        return 127;
    }
    return (uint8_t)((uint16_t)t >> 9);
}

static inline void find(const uint8_t *image, const int16_t deg_q7[2], uint8_t space, struct sg_gp_place *place)
{
    uint8_t cell[2], fraction_q7[2];
    for (uint8_t i = 0; i < 2; i++)
        fraction_q7[i] = along(deg_q7[i], (int16_t)sg_rom_u16(image + TRUST(origin_deg_q7) + 2U * i, space),
                               sg_rom_byte(image + TRUST(scale) + i, space),
                               sg_rom_byte(image + TRUST(nodes) + i, space), &cell[i]);
    const uint8_t width = sg_rom_byte(image + TRUST(nodes), space);
    const uint8_t both = (uint8_t)((uint16_t)((uint16_t)fraction_q7[0] * fraction_q7[1]) >> 7);
    place->share[3] = both;
    place->share[2] = (uint8_t)(fraction_q7[1] - both);
    place->share[1] = (uint8_t)(fraction_q7[0] - both);
    place->share[0] = (uint8_t)(128U - fraction_q7[0] - place->share[2]);
    const uint16_t node = (uint16_t)((uint16_t)cell[1] * width + cell[0]);
    place->node[0] = image + SG_MODEL_HEAD_BYTES + node * SG_MODEL_NODE_BYTES;
    place->node[1] = place->node[0] + (uint16_t)((uint16_t)width * SG_MODEL_NODE_BYTES);
}

// Does any gaze explain these features? point: deg_q7 and flags given, flags may gain OUT_OF_RANGE.
static void trust(const struct sg_model_view *view, const struct sg_gp_sum *sum, struct sg_gp_point *point)
{
    const uint8_t *image = view->image;
    const uint8_t space = view->space;
    struct sg_gp_place place;
    struct sg_gp_opinion opinion;

    if (space == SG_ROM_FLASH)
        find(image, point->deg_q7, SG_ROM_FLASH, &place);
    else
        find(image, point->deg_q7, SG_ROM_MEMORY, &place);
    sg_gp_judge(sum, &place, image + TRUST(guard), space, &opinion);
    uint8_t out = point->flags | opinion.out;
    if (opinion.doubt > sg_rom_u16(image + TRUST(limit), space))
        out = SG_GP_OUT_OF_RANGE;
    const uint8_t gain = sg_rom_byte(image + TRUST(sigma_gain), space);
    const uint16_t more = (uint16_t)(((uint32_t)opinion.doubt * gain) >> 12);  // at most 4014
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
    uint8_t out = sg_gp_scale(&sum, feature, image + HEAD(offset), space);
    sg_gp_trend(&sum, image + HEAD(bias), space);
    sg_gp_loop(&sum, image + view->records, view->vectors, space);

    int result = SG_OK;
    for (uint8_t i = 0; i < 2; i++) {
        // 24 bits, Q.(weight_frac_bits + 8), to Q.17 and from there to Q8.7: most models have 9 bits already
        int32_t acc = sg_q_signed32(sum.acc[i] << 8) >> 8;
        for (uint8_t bits = view->weight_frac_bits; bits < 9; bits++)
            acc *= 2;
        const int32_t deg = ((acc >> 8) + 2) >> 2;
        point->deg_q7[i] = sg_q_sat16(deg);
        if (point->deg_q7[i] != deg) {
            out = SG_GP_OUT_OF_RANGE;
            result = SG_E_RANGE;
        }
    }
    point->flags = out;
    trust(view, &sum, point);
    return result;
}
