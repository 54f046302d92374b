// SPDX-License-Identifier: Apache-2.0
#include "sg_gp_loop.h"

#include <stddef.h>

#include "sg_gp.h"
#include "sg_q.h"
#include "sg_rom.h"

#ifndef SG_GP_ASSEMBLY

// 2^16 exp(-t / 2^16), t in 20.4, below 2^23.
static inline uint16_t kernel_q16(uint32_t t)
{
    uint16_t index = (uint16_t)(t >> 8) >> 2;  // 23 bits: whole bytes first, they cost nothing
    if (index >= SG_GP_EXP_WORDS) {
        // A level below 256 has no upper byte to fall by; the last is 0, and so is what follows.
        index = (uint16_t)(index - SG_GP_EXP_WORDS);
        if (index >= SG_GP_EXP_BYTES)
            index = SG_GP_EXP_BYTES - 1U;
        return sg_rom_byte(&sg_gp_exp_tail[index], SG_ROM_FLASH);
    }
    const uint16_t level_q16 = sg_rom_word(&sg_gp_exp_table[index]);
    const uint8_t fraction_q8 = (uint8_t)((uint16_t)t >> 2);
    return (uint16_t)(level_q16 - ((uint16_t)((uint16_t)(level_q16 >> 8) * fraction_q8) >> 6));
}

// weight * k without the product of the low bytes, which leaves a multiple of 256.
static inline uint32_t weighed(uint16_t weight, uint16_t k_q16)
{
    const uint16_t low = (uint16_t)((uint16_t)(uint8_t)weight * (uint8_t)k_q16);
    return (uint32_t)(int32_t)sg_q_signed16(weight) * k_q16 - low;
}

static inline uint8_t scale(struct sg_gp_sum *sum, const uint16_t feature[6], const uint8_t *offset,
                            uint8_t space)
{
    uint32_t squares = 31;
    uint8_t out = 0;
    for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++, offset += 2) {
        // A channel that is not used has offset and gain 0, so its s is 0.
        const uint16_t from = sg_rom_u16(offset, space);
        const uint16_t gain_q12 = sg_rom_u16(offset + 2 * SG_MODEL_CHANNELS, space);
        uint16_t difference = (uint16_t)(feature[j] - from);
        if (feature[j] < from) {
            out = SG_GP_OUT_OF_RANGE;
            difference = 0;
        }
        const uint32_t s_q12 = (uint32_t)difference * gain_q12;
        uint16_t s = (uint16_t)(s_q12 >> 8) >> 4;
        if (s_q12 >= 4096UL << 12) {
            out = SG_GP_OUT_OF_RANGE;
            s = 4095;
        }
        sum->s_u8q4[j] = s;
        sum->s_u8[j] = (uint8_t)(s >> 4);
        squares += (uint32_t)s * s;
    }
    sum->s2 = squares >> 5;
    return out;
}

uint8_t sg_gp_scale(struct sg_gp_sum *sum, const uint16_t feature[6], const uint8_t *offset, uint8_t space)
{
    // Each of these functions twice, so that no byte asks again where it comes from.
    return space == SG_ROM_FLASH ? scale(sum, feature, offset, SG_ROM_FLASH)
                                 : scale(sum, feature, offset, SG_ROM_MEMORY);
}

static inline void start(struct sg_gp_sum *sum, const uint8_t *bias, uint8_t space)
{
    const uint8_t *trend = bias + 8;
    for (uint8_t i = 0; i < 2; i++) {
        uint32_t acc = sg_rom_u32(bias + 4U * i, space);
        for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++, trend += 2)
            acc += (uint32_t)((int32_t)sg_q_signed16(sg_rom_u16(trend, space)) * (int16_t)sum->s_u8q4[j]);
        sum->acc[i] = (uint32_t)(sg_q_signed32(acc) >> 4);
    }
}

void sg_gp_trend(struct sg_gp_sum *sum, const uint8_t *bias, uint8_t space)
{
    if (space == SG_ROM_FLASH)
        start(sum, bias, SG_ROM_FLASH);
    else
        start(sum, bias, SG_ROM_MEMORY);
}

uint8_t sg_gp_round(const struct sg_gp_sum *sum, uint8_t weight_frac_bits, int16_t deg_q7[2])
{
    uint8_t out = 0;
    for (uint8_t i = 0; i < 2; i++) {
        // 24 bits, Q.(weight_frac_bits + 8), to Q.17 and from there to Q8.7: most models have 9 bits already
        int32_t acc = sg_q_signed32(sum->acc[i] << 8) >> 8;
        for (uint8_t bits = weight_frac_bits; bits < 9; bits++)
            acc *= 2;
        const int32_t deg = ((acc >> 8) + 2) >> 2;
        deg_q7[i] = sg_q_sat16(deg);
        if (deg_q7[i] != deg)
            out = SG_GP_OUT_OF_RANGE;
    }
    return out;
}

// Cell and fraction Q0.7 of one axis.
static uint8_t along(int16_t deg_q7, int16_t origin_deg_q7, uint8_t scale, uint8_t nodes, uint8_t *cell)
{
    const uint8_t last = (uint8_t)(nodes - 2U);
    *cell = 0;
    if (deg_q7 < origin_deg_q7)
        return 0;
    const uint16_t difference = (uint16_t)((uint16_t)deg_q7 - (uint16_t)origin_deg_q7);  // below 3 * 2^14
    const uint32_t t = (uint32_t)difference * scale;    // Q8.16
    *cell = (uint8_t)(t >> 16);
    if (*cell <= last)
        return (uint8_t)((uint16_t)t >> 9);
    *cell = last;
    return 127;
}

void sg_gp_find(const int16_t deg_q7[2], const uint8_t *origin, uint8_t space, struct sg_gp_place *place)
{
    uint8_t cell[2], fraction_q7[2];
    const uint8_t wide = sg_rom_byte(origin + 8, space);
    for (uint8_t i = 0; i < 2; i++)
        fraction_q7[i] = along(deg_q7[i], sg_q_signed16(sg_rom_u16(origin + 2U * i, space)),
                               sg_rom_byte(origin + 6 + i, space), sg_rom_byte(origin + 8 + i, space), &cell[i]);
    const uint8_t both = (uint8_t)((uint16_t)((uint16_t)fraction_q7[0] * fraction_q7[1]) >> 7);
    place->share[3] = both;
    place->share[2] = (uint8_t)(fraction_q7[1] - both);
    place->share[1] = (uint8_t)(fraction_q7[0] - both);
    place->share[0] = (uint8_t)(128U - fraction_q7[0] - place->share[2]);
    const uint16_t node = (uint16_t)((uint16_t)((uint16_t)cell[1] * wide) + cell[0]);
    place->node[0] = origin + SG_GP_GRID_FROM + node * SG_MODEL_NODE_BYTES;
    place->node[1] = place->node[0] + (uint16_t)((uint16_t)wide * SG_MODEL_NODE_BYTES);
}

// 128 times the nodes' byte `at` at the place: below 2^15.
static inline uint16_t blended(const struct sg_gp_place *place, uint8_t at, uint8_t space)
{
    const uint8_t *lower = place->node[0] + at;
    const uint8_t *upper = place->node[1] + at;
    uint16_t sum = (uint16_t)(place->share[0] * sg_rom_byte(lower, space));
    sum = (uint16_t)(sum + (uint16_t)(place->share[1] * sg_rom_byte(lower + SG_MODEL_NODE_BYTES, space)));
    sum = (uint16_t)(sum + (uint16_t)(place->share[2] * sg_rom_byte(upper, space)));
    return (uint16_t)(sum + (uint16_t)(place->share[3] * sg_rom_byte(upper + SG_MODEL_NODE_BYTES, space)));
}

static inline void judge(const struct sg_gp_sum *sum, const struct sg_gp_place *place, const uint8_t *guard,
                         uint8_t space, struct sg_gp_opinion *opinion)
{
    uint16_t doubt = 0;
    uint8_t out = 0;
    for (uint8_t i = 0; i < SG_MODEL_GUARDS; i++, guard += sizeof(struct sg_model_guard)) {
        const uint8_t *row = guard + offsetof(struct sg_model_guard, row);
        int16_t projection = 0;     // at most 63 * 255
        for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++)
            projection = (int16_t)(projection + (int16_t)((int8_t)sg_rom_byte(row++, space) * sum->s_u8[j]));
        const uint16_t low = sg_rom_u16(guard + offsetof(struct sg_model_guard, low), space);
        const uint16_t high = sg_rom_u16(guard + offsetof(struct sg_model_guard, high), space);
        if (projection < sg_q_signed16(low) || projection > sg_q_signed16(high))
            out = SG_GP_OUT_OF_RANGE;
        // |projection| <= 16065, |base| <= 14336, the expectation at most 2040: 16 bits
        const int16_t base = sg_q_signed16(sg_rom_u16(guard + offsetof(struct sg_model_guard, base), space));
        int16_t miss = (int16_t)(projection - base - (int16_t)(blended(place, i, space) >> 4));
        if (miss < 0)
            miss = (int16_t)-miss;
        const uint8_t most = miss > 127 ? 127 : (uint8_t)miss;
        doubt = (uint16_t)(doubt + (uint16_t)(most * most));
    }
    opinion->doubt = doubt;
    opinion->sigma_log2_q4 = (uint8_t)(blended(place, SG_MODEL_GUARDS, space) >> 7);
    opinion->out = out;
}

void sg_gp_judge(const struct sg_gp_sum *sum, const struct sg_gp_place *place, const uint8_t *guard,
                 uint8_t space, struct sg_gp_opinion *opinion)
{
    if (space == SG_ROM_FLASH)
        judge(sum, place, guard, SG_ROM_FLASH, opinion);
    else
        judge(sum, place, guard, SG_ROM_MEMORY, opinion);
}

static inline void accumulate(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space)
{
    // 8 more bits below, which stay 0: a shift at each end instead of one at every product
    uint32_t acc_azimuth = sum->acc[0] << 8;
    uint32_t acc_elevation = sum->acc[1] << 8;
    uint8_t s[2 * SG_MODEL_CHANNELS];   // s in bytes, low and high by turns
    for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++) {
        s[2U * j] = (uint8_t)sum->s_u8q4[j];
        s[2U * j + 1U] = (uint8_t)(sum->s_u8q4[j] >> 8);
    }
    for (; n != 0; n--) {
        uint32_t t = sum->s2 + ((uint32_t)sg_rom_u16(record, space) << 8);
        record += 2;
        uint16_t high = 0;      // six products with the high bytes (< 16) fit 16 bits together
        const uint8_t *byte = s;
        for (uint8_t left = SG_MODEL_CHANNELS; left != 0; left--) {
            const uint8_t c = sg_rom_byte(record++, space);
            t -= (uint16_t)((uint16_t)*byte++ * c);
            high = (uint16_t)(high + (uint16_t)*byte++ * c);
        }
        const uint16_t k_q16 = kernel_q16(t - ((uint32_t)high << 8));
        acc_azimuth += weighed(sg_rom_u16(record, space), k_q16);
        acc_elevation += weighed(sg_rom_u16(record + 2, space), k_q16);
        record += 4;
    }
    sum->acc[0] = acc_azimuth >> 8;
    sum->acc[1] = acc_elevation >> 8;
}

void sg_gp_loop(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space)
{
    if (space == SG_ROM_FLASH)
        accumulate(sum, record, n, SG_ROM_FLASH);
    else
        accumulate(sum, record, n, SG_ROM_MEMORY);
}

#endif
