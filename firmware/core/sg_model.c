// SPDX-License-Identifier: Apache-2.0
#include "sg_model.h"

#include "sg_crc32_table.h"
#include "sg_err.h"
#include "sg_q.h"
#include "sg_rom.h"

#define HEAD(field) (offsetof(struct sg_model_head, field))
#define TRUST(field) (SG_MODEL_PAGE + offsetof(struct sg_model_trust, field))
#define GUARD(field) (offsetof(struct sg_model_guard, field))
_Static_assert(HEAD(offset) == HEAD(trend) + 24 && HEAD(gain_q12) == HEAD(offset) + 12
               && HEAD(version) == HEAD(gain_q12) + 12, "model layout");
#define CRC_FROM 8U              // the CRC covers what follows it

// What runs when a model is checked and never for a frame: compiled for size.
#define SELDOM __attribute__((noinline, cold))

// Half a byte.
SELDOM static uint32_t crc32_on(uint32_t crc)
{
    return (crc >> 4) ^ sg_rom_dword(&crc32_table[(uint8_t)crc & 15U]);
}

static uint32_t crc32_byte(uint32_t crc, uint8_t byte)
{
    return crc32_on(crc32_on(crc ^ byte));
}

uint32_t sg_model_crc32_at(uint32_t crc, const uint8_t *data, uint16_t n, uint8_t space)
{
    crc = ~crc;
    for (uint16_t i = 0; i < n; i++)
        crc = crc32_byte(crc, sg_rom_byte(data + i, space));
    return ~crc;
}

SELDOM uint32_t sg_model_crc32(uint32_t crc, const uint8_t *data, size_t n)
{
    crc = ~crc;
    for (size_t i = 0; i < n; i++)
        crc = crc32_byte(crc, data[i]);
    return ~crc;
}

// Bytes of the grid, 0 if there cannot be one.
SELDOM static uint16_t grid_bytes(const uint8_t *image, uint8_t space)
{
    const uint8_t wide = sg_rom_byte(image + TRUST(nodes), space);
    const uint8_t high = sg_rom_byte(image + TRUST(nodes) + 1, space);
    if (wide < 2 || wide > SG_MODEL_NODES_MAX || high < 2 || high > SG_MODEL_NODES_MAX)
        return 0;
    return (uint16_t)((uint16_t)((uint16_t)wide * high) * SG_MODEL_NODE_BYTES);
}

SELDOM int sg_model_length(const uint8_t *image, uint16_t room, uint8_t space)
{
    if (room < SG_MODEL_HEAD_BYTES)
        return SG_E_SHORT;
    if (sg_rom_u32(image + HEAD(magic), space) != (uint32_t)SG_MODEL_MAGIC)
        return SG_E_MAGIC;
    if (sg_rom_u16(image + HEAD(version), space) != (uint16_t)SG_MODEL_VERSION)
        return SG_E_VERSION;
    const uint8_t vectors = sg_rom_byte(image + HEAD(vectors), space);
    const uint16_t grid = grid_bytes(image, space);
    if (vectors < 1 || vectors > SG_MODEL_VECTORS_MAX || grid == 0)
        return SG_E_BOUNDS;
    // at most 256 + 2880 + 234 * 12: 16 bits
    const uint16_t records = (uint16_t)((uint16_t)vectors * SG_MODEL_RECORD_BYTES);
    const uint16_t length = (uint16_t)(SG_MODEL_HEAD_BYTES + grid + records);
    if (length > SG_MODEL_SLOT_BYTES || sg_rom_u16(image + HEAD(length), space) != length
        || sg_rom_u16(image + HEAD(length) + 2, space) != 0)
        return SG_E_BOUNDS;
    if (length > room)
        return SG_E_SHORT;
    return (int)length;
}

// Or of n bytes: 0 if all are.
SELDOM static uint8_t any_bit(const uint8_t *data, uint8_t n, uint8_t space)
{
    uint8_t bits = 0;
    for (uint8_t i = 0; i < n; i++)
        bits |= sg_rom_byte(data + i, space);
    return bits;
}

// Fields of channels >= d that are not 0: of the trends, the offsets and the gains, which lie in a row.
SELDOM static uint8_t unused_channel_bits(const uint8_t *image, uint8_t channels, uint8_t space)
{
    const uint8_t used = (uint8_t)(channels << 1);
    uint8_t bits = 0;
    for (uint8_t at = HEAD(trend); at < HEAD(version); at = (uint8_t)(at + 2 * SG_MODEL_CHANNELS))
        bits |= any_bit(image + (uint8_t)(at + used), (uint8_t)(2 * SG_MODEL_CHANNELS - used), space);
    return bits;
}

// Two's complement of 16 bits between two limits.
SELDOM static uint8_t within(uint16_t value, int16_t low, int16_t high)
{
    return sg_q_signed16(value) >= low && sg_q_signed16(value) <= high;
}

// A channel without gain has no offset either.
SELDOM static uint8_t idle_offset(const uint8_t *image, uint8_t space)
{
    uint8_t idle = 0;
    for (uint8_t j = 0; j < 2U * SG_MODEL_CHANNELS; j += 2)
        idle |= !sg_rom_u16(image + HEAD(gain_q12) + j, space) && sg_rom_u16(image + HEAD(offset) + j, space);
    return idle;
}

SELDOM static int check_guards(const uint8_t *image, uint8_t guards, uint8_t channels, uint8_t space)
{
    const uint8_t *guard = image + TRUST(guard);
    for (uint8_t i = 0; i < guards; i++, guard += sizeof(struct sg_model_guard)) {
        const uint16_t low = sg_rom_u16(guard + GUARD(low), space);
        const uint16_t high = sg_rom_u16(guard + GUARD(high), space);
        if (sg_q_signed16(low) > sg_q_signed16(high))
            return SG_E_BOUNDS;
        if (!within(sg_rom_u16(guard + GUARD(base), space), -14336, 14336))
            return SG_E_BOUNDS;
        uint8_t size = 0;
        for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++) {
            const uint8_t entry = sg_rom_byte(guard + GUARD(row) + j, space);
            size = (uint8_t)(size + (entry < 128 ? entry : (uint8_t)-entry));   // at most 63 + 128
            if (size > 63)
                return SG_E_BOUNDS;
        }
        if (any_bit(guard + GUARD(row) + channels, (uint8_t)(SG_MODEL_CHANNELS - channels), space))
            return SG_E_BOUNDS;
    }
    const uint8_t unused = (uint8_t)((SG_MODEL_GUARDS - guards) * sizeof(struct sg_model_guard));
    return any_bit(guard, unused, space) ? SG_E_BOUNDS : SG_OK;
}

SELDOM static int check_grid(const uint8_t *image, uint8_t space)
{
    for (uint8_t i = 0; i < 2; i++) {
        if (!within(sg_rom_u16(image + TRUST(origin_deg_q7) + 2U * i, space), -16384, 16384))
            return SG_E_BOUNDS;
        if (!sg_rom_byte(image + TRUST(scale) + i, space))
            return SG_E_BOUNDS;
    }
    return SG_OK;
}

SELDOM static int check_record(const uint8_t *record, uint8_t channels, uint8_t space)
{
    uint32_t c2 = 31;       // rounds 8 * sum c^2 / 256 up
    for (uint8_t j = 0; j < SG_MODEL_CHANNELS; j++) {
        const uint8_t c = sg_rom_byte(record + 2 + j, space);
        if (c && j >= channels)
            return SG_E_BOUNDS;
        c2 += (uint16_t)((uint16_t)c * c);
    }
    return sg_rom_u16(record, space) == (uint16_t)(c2 >> 5) ? SG_OK : SG_E_BOUNDS;
}

SELDOM uint16_t sg_model_part(const uint8_t *image, uint16_t at, uint8_t space)
{
    const uint16_t records = (uint16_t)(SG_MODEL_HEAD_BYTES + grid_bytes(image, space));
    if (at < SG_MODEL_HEAD_BYTES)
        return SG_MODEL_HEAD_BYTES;
    return (uint16_t)(at + (at < records ? SG_MODEL_NODE_BYTES : SG_MODEL_RECORD_BYTES));
}

SELDOM int sg_model_check_part(const uint8_t *image, uint16_t at, uint8_t space)
{
    const uint16_t records = (uint16_t)(SG_MODEL_HEAD_BYTES + grid_bytes(image, space));
    const uint8_t *part = image + at;
    if (at < records) {
        const uint8_t guards = sg_rom_byte(image + TRUST(guards), space);
        if (guards > SG_MODEL_GUARDS || any_bit(part + guards, (uint8_t)(SG_MODEL_GUARDS - guards), space))
            return SG_E_BOUNDS;
        return SG_OK;
    }
    return check_record(part, sg_rom_byte(image + HEAD(channels), space), space);
}

SELDOM int sg_model_open_checked(struct sg_model_view *view, const uint8_t *image, uint16_t room, uint8_t space,
                                 uint32_t crc, int parts)
{
    const int length = sg_model_length(image, room, space);
    if (length < 0)
        return length;
    if (sg_rom_u32(image + HEAD(crc), space) != crc)
        return SG_E_CRC;
    const uint8_t vectors = sg_rom_byte(image + HEAD(vectors), space);
    const uint8_t channels = sg_rom_byte(image + HEAD(channels), space);
    const uint8_t weight_frac_bits = sg_rom_byte(image + HEAD(weight_frac_bits), space);
    const uint8_t guards = sg_rom_byte(image + TRUST(guards), space);
    const uint16_t records = (uint16_t)(SG_MODEL_HEAD_BYTES + grid_bytes(image, space));
    if (channels < 1 || channels > SG_MODEL_CHANNELS || guards > SG_MODEL_GUARDS)
        return SG_E_BOUNDS;
    if (weight_frac_bits < 5 || weight_frac_bits > 9)
        return SG_E_BOUNDS;
    if (sg_rom_byte(image + HEAD(kernel), space) != SG_KERNEL_RBF)
        return SG_E_BOUNDS;
    for (uint8_t i = 0; i < 8; i += 4) {
        const int32_t bias = sg_q_signed32(sg_rom_u32(image + HEAD(bias) + i, space));
        if (bias > 0x40000000L || bias < -0x40000000L)
            return SG_E_BOUNDS;
    }
    if (any_bit(image + HEAD(pad), sizeof(struct sg_model_head) - HEAD(pad), space)
        || any_bit(image + TRUST(pad), SG_MODEL_HEAD_BYTES - TRUST(pad), space))
        return SG_E_BOUNDS;
    if (unused_channel_bits(image, channels, space) || idle_offset(image, space))
        return SG_E_BOUNDS;
    if (check_guards(image, guards, channels, space) != SG_OK || check_grid(image, space) != SG_OK
        || parts != SG_OK)
        return SG_E_BOUNDS;

    view->image = image;
    view->crc = crc;
    view->generation = sg_rom_u32(image + HEAD(generation), space);
    view->length = (uint16_t)length;
    view->records = records;
    view->space = space;
    view->vectors = vectors;
    view->channels = channels;
    view->weight_frac_bits = weight_frac_bits;
    return SG_OK;
}

SELDOM int sg_model_open(struct sg_model_view *view, const uint8_t *image, uint32_t room, uint8_t space)
{
    const uint16_t most = room > SG_MODEL_SLOT_BYTES ? (uint16_t)SG_MODEL_SLOT_BYTES : (uint16_t)room;
    const int length = sg_model_length(image, most, space);
    if (length < 0)
        return length;
    const uint32_t crc = sg_model_crc32_at(0, image + CRC_FROM, (uint16_t)(length - (int)CRC_FROM), space);
    int parts = SG_OK;
    for (uint16_t at = SG_MODEL_HEAD_BYTES; at < (uint16_t)length && parts == SG_OK;
         at = sg_model_part(image, at, space))
        parts = sg_model_check_part(image, at, space);
    return sg_model_open_checked(view, image, most, space, crc, parts);
}
