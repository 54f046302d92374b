// SPDX-License-Identifier: Apache-2.0
#include "sg_gp_loop.h"

#include "sg_model.h"
#include "sg_q.h"
#include "sg_rom.h"

#ifndef SG_GP_ASSEMBLY

// 2^16 exp(-t / 2^16), t in 20.4, below 2^23.
static inline uint16_t kernel_q16(uint32_t t)
{
    uint16_t index = (uint16_t)(t >> 9);
    if (index >= 1536U)
        index = 1536U;  // from here on the table holds zeros
    const uint16_t level_q16 = sg_rom_word(&sg_gp_exp_table[index]);
    const uint8_t fraction_q8 = (uint8_t)(t >> 1);
    return (uint16_t)(level_q16 - ((uint16_t)((uint16_t)(level_q16 >> 8) * fraction_q8) >> 7));
}

// weight * k in 24 bits, without the product of the low bytes.
static inline uint32_t weighed(uint16_t weight, uint16_t k_q16)
{
    const int16_t weight_high = (int16_t)weight >> 8;
    const uint8_t weight_low = (uint8_t)weight, k_low = (uint8_t)k_q16, k_high = (uint8_t)(k_q16 >> 8);
    const int32_t high = ((int32_t)(int16_t)(weight_high * k_high) << 8) + (int32_t)weight_high * k_low;
    return (uint32_t)high + (uint16_t)((uint16_t)weight_low * k_high);
}

void sg_gp_square(struct sg_gp_sum *sum)
{
    uint32_t squares = 31;
    for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++)
        squares += (uint32_t)sum->s_u8q4[j] * sum->s_u8q4[j];
    sum->s2 = squares >> 5;
}

void sg_gp_trend(struct sg_gp_sum *sum, const uint8_t *trend, uint8_t space)
{
    for (uint8_t i = 0; i < 2; i++) {
        uint32_t acc = sum->acc[i];
        for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++, trend += 2)
            acc += (uint32_t)((int32_t)(int16_t)sg_rom_u16(trend, space) * (int16_t)sum->s_u8q4[j]);
        sum->acc[i] = (uint32_t)(sg_q_signed32(acc) >> 4);
    }
}

int16_t sg_gp_project(const struct sg_gp_sum *sum, const uint8_t *row, uint8_t space)
{
    int32_t projection = 0;
    for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++)
        projection += (int32_t)(int8_t)sg_rom_byte(row + j, space) * (int16_t)sum->s_u8q4[j];
    return (int16_t)(projection >> 8);
}

static inline void accumulate(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space)
{
    uint32_t acc_azimuth = sum->acc[0];
    uint32_t acc_elevation = sum->acc[1];
    for (; n != 0; n--) {
        const uint16_t half_c2 = sg_rom_u16(record, space);
        // c * s in bytes: the six products with the high byte of s (< 16) fit 16 bits together.
        uint32_t low = 0;
        uint16_t high = 0;
        for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++) {
            const uint8_t c = sg_rom_byte(record + 2 + j, space);
            const uint16_t s = sum->s_u8q4[j];
            low += (uint16_t)((uint16_t)(uint8_t)s * c);
            high = (uint16_t)(high + (uint16_t)(uint8_t)(s >> 8) * c);
        }
        const uint16_t k_q16 = kernel_q16(sum->s2 + ((uint32_t)half_c2 << 8) - low - ((uint32_t)high << 8));
        acc_azimuth += weighed(sg_rom_u16(record + 8, space), k_q16);
        acc_elevation += weighed(sg_rom_u16(record + 10, space), k_q16);
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
