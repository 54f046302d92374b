// SPDX-License-Identifier: Apache-2.0
#include "sg_model.h"

#include "sg_crc32_table.h"
#include "sg_err.h"
#include "sg_rom.h"

#define HEAD(field) (offsetof(struct sg_model_head, field))
#define GUARD(field) (offsetof(struct sg_model_guard, field))
#define CRC_FROM 8U              // the CRC covers what follows it
#define HALF_C2_TOP 0x40U        // top byte of 2^22

static uint32_t crc32_byte(uint32_t crc, uint8_t byte)
{
    return (crc >> 8) ^ sg_rom_dword(&crc32_table[(uint8_t)crc ^ byte]);
}

uint32_t sg_model_crc32_at(uint32_t crc, const uint8_t *data, uint16_t n, uint8_t space)
{
    crc = ~crc;
    for (uint16_t i = 0; i < n; i++)
        crc = crc32_byte(crc, sg_rom_byte(data + i, space));
    return ~crc;
}

uint32_t sg_model_crc32(uint32_t crc, const uint8_t *data, size_t n)
{
    crc = ~crc;
    for (size_t i = 0; i < n; i++)
        crc = crc32_byte(crc, data[i]);
    return ~crc;
}

int sg_model_length(const uint8_t *image, uint32_t room, uint8_t space)
{
    if (room < SG_MODEL_HEAD_BYTES)
        return SG_E_SHORT;
    if (sg_rom_u32(image + HEAD(magic), space) != (uint32_t)SG_MODEL_MAGIC)
        return SG_E_MAGIC;
    if (sg_rom_u16(image + HEAD(version), space) != (uint16_t)SG_MODEL_VERSION)
        return SG_E_VERSION;
    const uint8_t vectors = sg_rom_byte(image + HEAD(vectors), space);
    const uint16_t length = (uint16_t)(SG_MODEL_HEAD_BYTES + (uint16_t)vectors * SG_MODEL_RECORD_BYTES);
    if (vectors < 1 || vectors > SG_MODEL_VECTORS_MAX || sg_rom_u32(image + HEAD(length), space) != length)
        return SG_E_BOUNDS;
    if (length > room)
        return SG_E_SHORT;
    return (int)length;
}

// Or of n bytes: 0 if all are.
static uint8_t any_bit(const uint8_t *data, uint8_t n, uint8_t space)
{
    uint8_t bits = 0;
    for (uint8_t i = 0; i < n; i++)
        bits |= sg_rom_byte(data + i, space);
    return bits;
}

// Fields of channels >= d that are not 0.
static uint8_t unused_channel_bits(const uint8_t *image, uint8_t channels, uint8_t space)
{
    const uint8_t unused = (uint8_t)(SG_MODEL_CHANNELS - channels);
    uint8_t bits = any_bit(image + HEAD(offset) + 2U * channels, (uint8_t)(2U * unused), space);
    bits |= any_bit(image + HEAD(gain_q12) + 2U * channels, (uint8_t)(2U * unused), space);
    bits |= any_bit(image + HEAD(trend[0]) + 4U * channels, (uint8_t)(4U * unused), space);
    bits |= any_bit(image + HEAD(trend[1]) + 4U * channels, (uint8_t)(4U * unused), space);
    return bits;
}

static int check_guards(const uint8_t *image, uint8_t guards, uint8_t channels, uint8_t space)
{
    const uint8_t *guard = image + SG_MODEL_PAGE;
    for (uint8_t i = 0; i < guards; i++) {
        // int32 in order as unsigned: flip the sign bit
        const uint32_t low = sg_rom_u32(guard + GUARD(low), space) ^ 0x80000000UL;
        const uint32_t high = sg_rom_u32(guard + GUARD(high), space) ^ 0x80000000UL;
        if (low > high)
            return SG_E_BOUNDS;
        if (any_bit(guard + GUARD(row) + channels, (uint8_t)(SG_MODEL_CHANNELS + 2 - channels), space))
            return SG_E_BOUNDS;  // row entries of unused channels, and the reserved bytes behind them
        guard += sizeof(struct sg_model_guard);
    }
    const uint8_t unused = (uint8_t)((8U - guards) * sizeof(struct sg_model_guard));
    return any_bit(guard, unused, space) ? SG_E_BOUNDS : SG_OK;
}

static int check_records(const uint8_t *record, uint8_t vectors, uint8_t channels, uint8_t space)
{
    for (; vectors != 0; vectors--) {
        if (sg_rom_byte(record + 2, space) >= HALF_C2_TOP)
            return SG_E_BOUNDS;
        if (any_bit(record + 3 + channels, (uint8_t)(SG_MODEL_CHANNELS - channels), space))
            return SG_E_BOUNDS;
        record += SG_MODEL_RECORD_BYTES;
    }
    return SG_OK;
}

int sg_model_open_checked(struct sg_model_view *view, const uint8_t *image, uint32_t room, uint8_t space,
                          uint32_t crc)
{
    const int length = sg_model_length(image, room, space);
    if (length < 0)
        return length;
    if (sg_rom_u32(image + HEAD(crc), space) != crc)
        return SG_E_CRC;
    const uint8_t vectors = sg_rom_byte(image + HEAD(vectors), space);
    const uint8_t channels = sg_rom_byte(image + HEAD(channels), space);
    const uint8_t weight_frac_bits = sg_rom_byte(image + HEAD(weight_frac_bits), space);
    const uint8_t guards = sg_rom_byte(image + HEAD(guards), space);
    if (channels < 1 || channels > SG_MODEL_CHANNELS || guards > 8)
        return SG_E_BOUNDS;
    if (weight_frac_bits < 6 || weight_frac_bits > 10)
        return SG_E_BOUNDS;
    if (sg_rom_byte(image + HEAD(kernel), space) != SG_KERNEL_RBF)
        return SG_E_BOUNDS;
    if (any_bit(image + HEAD(reserved), sizeof(struct sg_model_head) - HEAD(reserved), space))
        return SG_E_BOUNDS;
    if (unused_channel_bits(image, channels, space))
        return SG_E_BOUNDS;
    int verdict = check_guards(image, guards, channels, space);
    if (verdict == SG_OK)
        verdict = check_records(image + SG_MODEL_HEAD_BYTES, vectors, channels, space);
    if (verdict != SG_OK)
        return verdict;

    view->image = image;
    view->crc = crc;
    view->generation = sg_rom_u32(image + HEAD(generation), space);
    view->length = (uint16_t)length;
    view->space = space;
    view->vectors = vectors;
    view->channels = channels;
    view->guards = guards;
    view->weight_frac_bits = weight_frac_bits;
    view->reserved = 0;
    return SG_OK;
}

int sg_model_open(struct sg_model_view *view, const uint8_t *image, uint32_t room, uint8_t space)
{
    const int length = sg_model_length(image, room, space);
    if (length < 0)
        return length;
    const uint32_t crc = sg_model_crc32_at(0, image + CRC_FROM, (uint16_t)(length - (int)CRC_FROM), space);
    return sg_model_open_checked(view, image, room, space, crc);
}
