// SPDX-License-Identifier: Apache-2.0
#include "sg_gp.h"

#include <stddef.h>

#include "sg_err.h"
#include "sg_gp_loop.h"
#include "sg_q.h"
#include "sg_rom.h"

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

static uint8_t guarded(const struct sg_model_view *view, const struct sg_gp_sum *sum)
{
    const uint8_t *guard = view->image + SG_MODEL_PAGE;
    const uint8_t space = view->space;
    for (uint8_t i = 0; i < view->guards; i++) {
        const int32_t projection = sg_gp_project(sum, guard + offsetof(struct sg_model_guard, row), space);
        const uint32_t low = sg_rom_u32(guard + offsetof(struct sg_model_guard, low), space);
        const uint32_t high = sg_rom_u32(guard + offsetof(struct sg_model_guard, high), space);
        if (projection < sg_q_signed32(low) || projection > sg_q_signed32(high))
            return SG_GP_OUT_OF_RANGE;
        guard += sizeof(struct sg_model_guard);
    }
    return 0;
}

int sg_gp_predict(const struct sg_model_view *view, const uint16_t feature[6], int16_t deg_q7[2],
                  uint8_t *flags)
{
    const uint8_t *image = view->image;
    const uint8_t space = view->space;
    const uint8_t *offset = image + offsetof(struct sg_model_head, offset);
    const uint8_t *gain_q12 = image + offsetof(struct sg_model_head, gain_q12);
    struct sg_gp_sum sum;
    uint8_t seen = 0;

    sum.acc[0] = sg_rom_u32(image + offsetof(struct sg_model_head, bias), space);
    sum.acc[1] = sg_rom_u32(image + offsetof(struct sg_model_head, bias) + 4, space);
    uint32_t sum_s2 = 0;
    for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++) {
        // A channel that is not used has gain 0, so its s is 0.
        const uint16_t s = scaled(feature[j], sg_rom_u16(offset, space), sg_rom_u16(gain_q12, space), &seen);
        sum.s_u8q4[j] = s;
        sum_s2 += (uint32_t)s * s;
        offset += 2;
        gain_q12 += 2;
    }
    sum.s2 = sum_s2 >> 5;
    sg_gp_trend(&sum, image + offsetof(struct sg_model_head, trend), space);
    seen |= guarded(view, &sum);
    sg_gp_loop(&sum, image + SG_MODEL_HEAD_BYTES, view->vectors, space);

    int result = SG_OK;
    for (uint8_t i = 0; i < 2; i++) {
        // Q.(weight_frac_bits + 16) -> Q8.7; the first 8 bits may go before the rounding, and cost nothing
        const uint8_t bits = (uint8_t)(view->weight_frac_bits + 1U);
        const int32_t deg = sg_q_round_shift(sg_q_signed32(sum.acc[i]) >> 8, bits);
        deg_q7[i] = sg_q_sat16(deg);
        if (deg_q7[i] != deg) {
            seen = SG_GP_OUT_OF_RANGE;
            result = SG_E_RANGE;
        }
    }
    *flags = seen;
    return result;
}
