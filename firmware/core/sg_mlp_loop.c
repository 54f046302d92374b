// SPDX-License-Identifier: Apache-2.0
#include "sg_mlp_loop.h"

#include "sg_rom.h"

#ifndef SG_MLP_ASSEMBLY

uint8_t sg_mlp_scale(const uint16_t *input, uint16_t *out, const uint8_t *scale, uint8_t n, uint8_t space)
{
    uint8_t clamped = 0;
    for (; n != 0; n--, scale += 4) {
        const uint16_t x = *input++;
        const uint16_t offset = sg_rom_u16(scale, space);
        const uint16_t gain_q8 = sg_rom_u16(scale + 2, space);
        const uint8_t below = x < offset ? 255 : 0;
        const uint16_t difference = below ? 0 : (uint16_t)(x - offset);
        const uint32_t a = ((uint32_t)difference * gain_q8) >> 8;
        const uint8_t above = a > 65535UL ? 255 : 0;
        clamped |= below | above;
        *out++ = above ? 65535U : (uint16_t)a;
    }
    return clamped;
}

// T of |argument| u8.8 in steps of ln 2 / 32, with the sign.
static uint16_t squashed(uint32_t q, uint8_t negative)
{
    const uint16_t u = q > 65535UL ? 65535U : (uint16_t)q;
    const uint16_t *level = &sg_mlp_tanh_table[u >> 8];
    const uint16_t low = sg_rom_word(level);
    const uint16_t rise = (uint16_t)(sg_rom_word(level + 1) - low);
    const uint16_t t = (uint16_t)(low + (uint16_t)(((uint32_t)rise * (u & 255U) + 128U) >> 8));
    return negative ? (uint16_t)(32768U - t) : (uint16_t)(32768U + t);
}

// One row's z, modulo 2^24, to what it leaves behind.
static uint16_t finished(struct sg_mlp_run *run, uint32_t z, uint16_t scale)
{
    const uint8_t negative = (z & 0x800000UL) != 0;
    const uint32_t magnitude = (negative ? 0U - z : z) & 0xFFFFFFUL;
    // |z| * scale needs 39 bits; its low byte may go early
    const uint32_t low = (uint32_t)(uint8_t)magnitude * scale + 128U;
    const uint32_t q = (magnitude >> 8) * scale + (low >> 8);
    if (!(run->kind & SG_MLP_OUTPUT))
        return squashed(q, negative);
    uint32_t y = (q + 128U) >> 8;
    if (y > 32767U) {
        y = 32767U;
        run->saturated = 255;
    }
    return (uint16_t)(negative ? 0U - y : y);
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
