// SPDX-License-Identifier: Apache-2.0
#include "sg_gp.h"

#include <stddef.h>

#include "sg_err.h"
#include "sg_gp_loop.h"
#include "sg_gp_trust.h"
#include "sg_q.h"
#include "sg_rom.h"

#define HEAD(field) (offsetof(struct sg_model_head, field))

// Feature (1/4096 octave) to u8.4 steps of one channel. Sets *flags where it has to clamp.
static uint16_t scaled(uint16_t feature, uint16_t offset, uint16_t gain_q12, uint8_t *flags)
{
    if (gain_q12 == 0)
        return 0;
    if (feature < offset) {
        *flags = SG_GP_OUT_OF_RANGE;
        return 0;
    }
    const uint16_t difference = (uint16_t)(feature - offset);
    const uint32_t s_q12 = (uint32_t)difference * gain_q12;
    if (s_q12 >= 4096UL << 12) {
        *flags = SG_GP_OUT_OF_RANGE;
        return 4095;
    }
    return (uint16_t)(s_q12 >> 8) >> 4;  // 24 bits are left: the narrow shift is the cheap one
}

int sg_gp_predict(const struct sg_model_view *view, const uint16_t feature[6], struct sg_gp_point *point)
{
    const uint8_t *image = view->image;
    const uint8_t space = view->space;
    struct sg_gp_sum sum;
    uint8_t seen = 0;

    sum.acc[0] = sg_rom_u32(image + HEAD(bias), space);
    sum.acc[1] = sg_rom_u32(image + HEAD(bias) + 4, space);
    for (uint8_t j = 0; j < 2U * SG_MODEL_CHANNELS; j += 2) {
        // A channel that is not used has gain 0, so its s is 0.
        const uint16_t offset = sg_rom_u16(image + HEAD(offset) + j, space);
        const uint16_t gain_q12 = sg_rom_u16(image + HEAD(gain_q12) + j, space);
        sum.s_u8q4[j >> 1] = scaled(feature[j >> 1], offset, gain_q12, &seen);
    }
    sg_gp_square(&sum);
    sg_gp_trend(&sum, image + HEAD(trend), space);
    sg_gp_loop(&sum, image + view->records, view->vectors, space);

    int result = SG_OK;
    const uint8_t bits = (uint8_t)(view->weight_frac_bits + 1U);
    for (uint8_t i = 0; i < 2; i++) {
        // Q.(weight_frac_bits + 8) in 24 bits -> Q8.7
        const int32_t acc = sg_q_signed32(sum.acc[i] << 8) >> 8;
        const int32_t deg = sg_q_round_shift(acc, bits);
        point->deg_q7[i] = sg_q_sat16(deg);
        if (point->deg_q7[i] != deg) {
            seen = SG_GP_OUT_OF_RANGE;
            result = SG_E_RANGE;
        }
    }
    point->flags = seen;
    sg_gp_trust(view, &sum, point);
    return result;
}
