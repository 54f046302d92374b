// SPDX-License-Identifier: Apache-2.0
#include "sg_gp_loop.h"

#include "sg_model.h"
#include "sg_rom.h"

#ifndef SG_GP_ASSEMBLY

// 2^16 exp(-t / (16 u^2)) = 2^(16 - t / 65536), t in 20.4.
static uint16_t kernel_q16(uint32_t t)
{
    if (t >= 0x100000UL)
        return 0;
    const uint16_t *entry = &sg_gp_exp_table[((uint16_t)(t >> 8) & 0x0FFCU) >> 1];  // two words per t >> 10
    const uint16_t fraction_q10 = (uint16_t)t & 1023U;
    const uint16_t drop_q6 = sg_rom_word(entry);
    const uint16_t level_q16 = sg_rom_word(entry + 1);
    return (uint16_t)(level_q16 - (uint16_t)(((uint32_t)drop_q6 * fraction_q10) >> 16));
}

void sg_gp_trend(struct sg_gp_sum *sum, const uint8_t *trend, uint8_t space)
{
    for (uint8_t i = 0; i < 2; i++)
        for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++, trend += 4)
            sum->acc[i] += sg_rom_u32(trend, space) * sum->s_u8q4[j];
}

int32_t sg_gp_project(const struct sg_gp_sum *sum, const uint8_t *row, uint8_t space)
{
    int32_t projection = 0;
    for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++)
        projection += (int32_t)(int8_t)sg_rom_byte(row + j, space) * (int16_t)sum->s_u8q4[j];
    return projection;
}

static inline void accumulate(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space)
{
    uint32_t acc_azimuth = sum->acc[0];
    uint32_t acc_elevation = sum->acc[1];
    for (; n != 0; n--) {
        const uint32_t half_c2 = sg_rom_u16(record, space) | ((uint32_t)sg_rom_byte(record + 2, space) << 16);
        // c * s in bytes: the six products with the high byte of s (< 16) fit 16 bits together.
        uint32_t low = 0;
        uint16_t high = 0;
        for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++) {
            const uint8_t c = sg_rom_byte(record + 3 + j, space);
            const uint16_t s = sum->s_u8q4[j];
            low += (uint16_t)((uint16_t)(uint8_t)s * c);
            high = (uint16_t)(high + (uint16_t)(uint8_t)(s >> 8) * c);
        }
        const int32_t t = (int32_t)(sum->s2 + half_c2 - low - ((uint32_t)high << 8));
        const uint16_t k_q16 = kernel_q16(t < 0 ? 0UL : (uint32_t)t);
        const int16_t weight_azimuth = (int16_t)sg_rom_u16(record + 9, space);
        const int16_t weight_elevation = (int16_t)sg_rom_u16(record + 11, space);
        acc_azimuth += (uint32_t)(int32_t)weight_azimuth * k_q16;
        acc_elevation += (uint32_t)(int32_t)weight_elevation * k_q16;
        record += SG_MODEL_RECORD_BYTES;
    }
    sum->acc[0] = acc_azimuth;
    sum->acc[1] = acc_elevation;
}

void sg_gp_loop(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space)
{
    // Two loops, so that no byte asks again where it comes from.
    if (space == SG_ROM_FLASH)
        accumulate(sum, record, n, SG_ROM_FLASH);
    else
        accumulate(sum, record, n, SG_ROM_MEMORY);
}

#endif
