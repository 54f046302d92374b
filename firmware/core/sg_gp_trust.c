// SPDX-License-Identifier: Apache-2.0
#include "sg_gp_trust.h"

#include <stddef.h>

#include "sg_rom.h"

#define TRUST(field) (SG_MODEL_PAGE + offsetof(struct sg_model_trust, field))
#define GUARD(field) (offsetof(struct sg_model_guard, field))

// Where a gaze lies in the grid: the cell's first corner, and the shares of its four corners, 128 in all.
struct place {
    const uint8_t *corner[2];   // first corner of the cell, and the one above it
    uint8_t share[4];           // 00, 10 (azimuth), 01 (elevation), 11
};

// Cell and fraction Q0.7 of one axis.
static uint8_t along(int16_t deg_q7, int16_t origin_deg_q7, uint8_t scale, uint8_t nodes, uint8_t *cell)
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

static void find(const struct sg_model_view *view, const int16_t deg_q7[2], struct place *place)
{
    const uint8_t *image = view->image;
    const uint8_t space = view->space;
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
    place->corner[0] = image + SG_MODEL_HEAD_BYTES + node * SG_MODEL_NODE_BYTES;
    place->corner[1] = place->corner[0] + (uint16_t)((uint16_t)width * SG_MODEL_NODE_BYTES);
}

// 128 times what the nodes' byte `at` is at the place: below 2^15.
static uint16_t blended(const struct place *place, uint8_t at, uint8_t space)
{
    const uint8_t *low = place->corner[0] + at;
    const uint8_t *high = place->corner[1] + at;
    uint16_t sum = (uint16_t)((uint16_t)place->share[0] * sg_rom_byte(low, space));
    sum = (uint16_t)(sum + (uint16_t)place->share[1] * sg_rom_byte(low + SG_MODEL_NODE_BYTES, space));
    sum = (uint16_t)(sum + (uint16_t)place->share[2] * sg_rom_byte(high, space));
    return (uint16_t)(sum + (uint16_t)place->share[3] * sg_rom_byte(high + SG_MODEL_NODE_BYTES, space));
}

void sg_gp_trust(const struct sg_model_view *view, const struct sg_gp_sum *sum, struct sg_gp_point *point)
{
    const uint8_t *image = view->image;
    const uint8_t space = view->space;
    const uint8_t guards = sg_rom_byte(image + TRUST(guards), space);
    const uint8_t has_grid = sg_rom_byte(image + TRUST(nodes), space);
    struct place place;
    uint8_t seen = 0;
    uint16_t doubt = 0;

    if (has_grid)
        find(view, point->deg_q7, &place);
    const uint8_t *guard = image + TRUST(guard);
    for (uint8_t i = 0; i < guards; i++, guard += sizeof(struct sg_model_guard)) {
        const int16_t projection = sg_gp_project(sum, guard + GUARD(row), space);
        if (projection < (int16_t)sg_rom_u16(guard + GUARD(low), space)
            || projection > (int16_t)sg_rom_u16(guard + GUARD(high), space))
            seen = SG_GP_OUT_OF_RANGE;
        // |projection| < 2^14, |base| <= 2^14, the expectation below 2^11: 16 bits
        int16_t miss = (int16_t)(projection - (int16_t)sg_rom_u16(guard + GUARD(base), space));
        if (has_grid)
            miss = (int16_t)(miss - (int16_t)(blended(&place, i, space) >> 4));
        if (miss > 127)
            miss = 127;
        if (miss < -127)
            miss = -127;
        doubt = (uint16_t)(doubt + (uint16_t)(miss * miss));
    }
    if (doubt > sg_rom_u16(image + TRUST(limit), space))
        seen = SG_GP_OUT_OF_RANGE;
    point->doubt = doubt;
    point->flags |= seen;
    uint8_t sigma = SG_GP_SIGMA_UNKNOWN;
    if (has_grid) {
        const uint8_t gain = sg_rom_byte(image + TRUST(sigma_gain), space);
        const uint16_t more = (uint16_t)(((uint32_t)doubt * gain) >> 12);
        const uint16_t code = (uint16_t)(blended(&place, SG_MODEL_GUARDS, space) >> 7) + more;
        sigma = code < SG_GP_SIGMA_HUGE && !point->flags ? (uint8_t)code : SG_GP_SIGMA_HUGE;
    }
    point->sigma_log2_q4 = sigma;
}
