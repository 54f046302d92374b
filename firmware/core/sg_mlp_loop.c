// SPDX-License-Identifier: Apache-2.0
#include "sg_mlp_loop.h"

#include "sg_rom.h"

#ifndef SG_MLP_ASSEMBLY

// No branch here depends on data: signs and clamps are masks, so that every input takes the same time.

// All ones if x is not 0, else 0; x below 2^31.
static inline uint32_t ones_if(uint32_t x)
{
    return 0U - ((0U - x) >> 31);
}

uint8_t sg_mlp_scale(const uint16_t *input, uint16_t *out, const uint8_t *scale, uint8_t n, uint8_t space)
{
    uint8_t clamped = 0;
    for (; n != 0; n--, scale += 4) {
        const uint16_t x = *input++;
        const uint16_t offset = sg_rom_u16(scale, space);
        const uint16_t gain_q8 = sg_rom_u16(scale + 2, space);
        const uint32_t difference = (uint32_t)x - offset;
        const uint32_t below = 0U - (difference >> 31);
        const uint32_t a = ((uint32_t)(uint16_t)(difference & ~below) * gain_q8) >> 8;
        const uint32_t above = ones_if(a >> 16);
        clamped |= (uint8_t)(below | above);
        *out++ = (uint16_t)(a | above);
    }
    return clamped;
}

// T of an argument u8.8 in steps of ln 2 / 32. negative: all ones, or 0
static uint16_t squashed(uint32_t q, uint32_t negative)
{
    const uint16_t u = (uint16_t)(q | ones_if(q >> 16));
    const uint16_t *level = &sg_mlp_tanh_table[u >> 8];
    const uint16_t low = sg_rom_word(level);
    const uint16_t rise = (uint16_t)(sg_rom_word(level + 1) - low);
    const uint16_t t = (uint16_t)(low + (uint16_t)(((uint32_t)rise * (u & 255U) + 128U) >> 8));
    const uint16_t sign = (uint16_t)negative;
    return (uint16_t)((uint16_t)((t ^ sign) - sign) + 32768U);
}

// One row's z, modulo 2^24, to what it leaves behind.
static uint16_t finished(struct sg_mlp_run *run, uint32_t z, uint16_t scale)
{
    const uint32_t negative = 0U - (uint32_t)((uint8_t)(z >> 16) >> 7);
    const uint32_t magnitude = ((z ^ negative) - negative) & 0xFFFFFFUL;
    // |z| * scale needs 39 bits; its low byte may go early
    const uint32_t low = (uint32_t)(uint8_t)magnitude * scale + 128U;
    const uint32_t q = (magnitude >> 8) * scale + (low >> 8);
    if (!(run->kind & SG_MLP_OUTPUT))
        return squashed(q, negative);
    const uint32_t y = (q + 128U) >> 8;
    const uint32_t above = ones_if(y & ~32767UL);
    run->saturated |= (uint8_t)above;
    return (uint16_t)((((y | above) & 32767U) ^ negative) - negative);
}

static inline uint32_t biased(const uint8_t *bias, uint32_t correction, uint8_t space)
{
    return (sg_rom_u16(bias, space) | (uint32_t)sg_rom_byte(bias + 2, space) << 16) - correction;
}

static inline uint32_t product(const uint8_t *weight, uint16_t a, uint8_t bytes, uint8_t space)
{
    if (bytes == 1)
        return ((uint32_t)sg_rom_byte(weight, space) * a) >> 8;
    const uint16_t w = sg_rom_u16(weight, space);
    return (uint32_t)(uint8_t)(w >> 8) * a + (uint16_t)((uint16_t)(uint8_t)w * (uint8_t)(a >> 8));
}

// `bytes` and `space` are constants where these are called, so that no weight asks again what it is.
static inline const uint8_t *four_rows(struct sg_mlp_run *run, const uint8_t *at, uint32_t correction,
                                       uint16_t *out, uint8_t bytes, uint8_t space)
{
    uint32_t z0 = biased(at, correction, space);
    uint32_t z1 = biased(at + 3, correction, space);
    uint32_t z2 = biased(at + 6, correction, space);
    uint32_t z3 = biased(at + 9, correction, space);
    at += 12;
    const uint16_t *in = run->in;
    for (uint8_t j = run->columns; j != 0; j--) {
        const uint16_t a = *in++;
        z0 += product(at, a, bytes, space);
        z1 += product(at + bytes, a, bytes, space);
        z2 += product(at + 2 * bytes, a, bytes, space);
        z3 += product(at + 3 * bytes, a, bytes, space);
        at += 4 * bytes;
    }
    out[0] = finished(run, z0, sg_rom_u16(at, space));
    out[1] = finished(run, z1, sg_rom_u16(at + 2, space));
    out[2] = finished(run, z2, sg_rom_u16(at + 4, space));
    out[3] = finished(run, z3, sg_rom_u16(at + 6, space));
    return at + 8;
}

static inline const uint8_t *two_rows(struct sg_mlp_run *run, const uint8_t *at, uint32_t correction,
                                      uint16_t *out, uint8_t bytes, uint8_t space)
{
    uint32_t z0 = biased(at, correction, space);
    uint32_t z1 = biased(at + 3, correction, space);
    at += 6;
    const uint16_t *in = run->in;
    for (uint8_t j = run->columns; j != 0; j--) {
        const uint16_t a = *in++;
        z0 += product(at, a, bytes, space);
        z1 += product(at + bytes, a, bytes, space);
        at += 2 * bytes;
    }
    out[0] = finished(run, z0, sg_rom_u16(at, space));
    out[1] = finished(run, z1, sg_rom_u16(at + 2, space));
    return at + 4;
}

static inline const uint8_t *all_rows(struct sg_mlp_run *run, const uint8_t *at, uint32_t correction,
                                      uint16_t *out, uint8_t bytes, uint8_t space)
{
    uint8_t rows = run->rows;
    for (; rows >= 4; rows = (uint8_t)(rows - 4U), out += 4)
        at = four_rows(run, at, correction, out, bytes, space);
    return rows != 0 ? two_rows(run, at, correction, out, bytes, space) : at;
}

const uint8_t *sg_mlp_layer(struct sg_mlp_run *run, const uint8_t *layer, uint16_t *out)
{
    uint32_t sum = 0;
    uint16_t low = 0;
    for (uint8_t j = 0; j < run->columns; j++) {
        sum += run->in[j];
        low = (uint16_t)(low + (uint8_t)run->in[j]);
    }
    const uint8_t flash = run->space == SG_ROM_FLASH;
    if (run->kind & SG_MLP_WIDE) {
        sum = (sum << 7) - (low >> 1);
        return flash ? all_rows(run, layer, sum, out, 2, SG_ROM_FLASH)
                     : all_rows(run, layer, sum, out, 2, SG_ROM_MEMORY);
    }
    sum >>= 1;
    return flash ? all_rows(run, layer, sum, out, 1, SG_ROM_FLASH)
                 : all_rows(run, layer, sum, out, 1, SG_ROM_MEMORY);
}

#endif
