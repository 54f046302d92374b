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
    const uint32_t s = ((uint32_t)(uint16_t)(feature - offset) * gain_q12) >> 12;
    if (s > 4095U) {
        *flags = SG_GP_OUT_OF_RANGE;
        return 4095;
    }
    return (uint16_t)s;
}

static uint8_t guarded(const struct sg_model_view *view, const uint16_t s[SG_MODEL_CHANNELS])
{
    const uint8_t *guard = view->image + SG_MODEL_PAGE;
    for (uint8_t i = 0; i < view->guards; i++) {
        int32_t projection = 0;
        const uint8_t *row = guard + offsetof(struct sg_model_guard, row);
        for (uint8_t j = 0; j < view->channels; j++)
            projection += (int32_t)(int8_t)sg_rom_byte(row + j, view->space) * (int16_t)s[j];
        const uint32_t low = sg_rom_u32(guard + offsetof(struct sg_model_guard, low), view->space);
        const uint32_t high = sg_rom_u32(guard + offsetof(struct sg_model_guard, high), view->space);
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
    struct sg_gp_sum sum = { .s2 = 0 };
    uint8_t seen = 0;

    sum.acc[0] = sg_rom_u32(image + offsetof(struct sg_model_head, bias), view->space);
    sum.acc[1] = sg_rom_u32(image + offsetof(struct sg_model_head, bias) + 4, view->space);
    for (uint8_t j = 0; j < view->channels; j++) {
        const uint8_t *channel = image + 2U * j;
        const uint8_t *trend = image + offsetof(struct sg_model_head, trend) + 4U * j;
        const uint16_t offset = sg_rom_u16(channel + offsetof(struct sg_model_head, offset), view->space);
        const uint16_t gain_q12 = sg_rom_u16(channel + offsetof(struct sg_model_head, gain_q12), view->space);
        const uint16_t s = scaled(feature[j], offset, gain_q12, &seen);
        sum.s_u8q4[j] = s;
        sum.s2 += (uint32_t)s * s;
        sum.acc[0] += sg_rom_u32(trend, view->space) * s;
        sum.acc[1] += sg_rom_u32(trend + 4 * SG_MODEL_CHANNELS, view->space) * s;
    }
    sum.s2 >>= 5;
    seen |= guarded(view, sum.s_u8q4);
    sg_gp_loop(&sum, image + SG_MODEL_HEAD_BYTES, view->vectors, view->space);

    int result = SG_OK;
    for (uint8_t i = 0; i < 2; i++) {
        // Q.(weight_frac_bits + 16) -> Q8.7
        const int32_t deg = sg_q_round_shift(sg_q_signed32(sum.acc[i]), (uint8_t)(view->weight_frac_bits + 9U));
        deg_q7[i] = sg_q_sat16(deg);
        if (deg_q7[i] != deg) {
            seen = SG_GP_OUT_OF_RANGE;
            result = SG_E_RANGE;
        }
    }
    *flags = seen;
    return result;
}
