// SPDX-License-Identifier: Apache-2.0
#include "sg_mlp.h"

#include "sg_err.h"
#include "sg_mlp_loop.h"
#include "sg_model.h"
#include "sg_rom.h"

#define HEAD(field) (offsetof(struct sg_mlp_head, field))
#define CRC_FROM 8U              // the CRC covers what follows it
#define ROW_BYTES 5U             // bias and scale

struct layer {
    uint8_t columns;
    uint8_t rows;                // rounded up to even
    uint8_t padded;              // the last row is one too many
    uint8_t weight_bytes;
};

static uint8_t even(uint8_t n)
{
    return (uint8_t)((n + 1U) & 0xFEU);
}

// Layer k of an image, unchecked; k in 0..hidden.
static struct layer layer_at(const uint8_t *image, uint8_t space, uint8_t k)
{
    const uint8_t *width = image + HEAD(width);
    const uint8_t hidden = sg_rom_byte(image + HEAD(hidden), space);
    struct layer layer;
    layer.columns = sg_rom_byte(k == 0 ? image + HEAD(inputs) : width + k - 1, space);
    const uint8_t rows = sg_rom_byte(k == hidden ? image + HEAD(outputs) : width + k, space);
    layer.rows = even(rows);
    layer.padded = rows & 1U;
    layer.weight_bytes = sg_rom_byte(image + HEAD(weight_bytes) + k, space);
    return layer;
}

static uint8_t counts_are_legal(const uint8_t *image, uint8_t space)
{
    const uint8_t inputs = sg_rom_byte(image + HEAD(inputs), space);
    const uint8_t outputs = sg_rom_byte(image + HEAD(outputs), space);
    const uint8_t hidden = sg_rom_byte(image + HEAD(hidden), space);
    if (inputs < 1 || inputs > SG_MLP_INPUTS_MAX || outputs < 1 || outputs > SG_MLP_OUTPUTS_MAX)
        return 0;
    if (hidden > SG_MLP_HIDDEN_MAX)
        return 0;
    for (uint8_t k = 0; k < SG_MLP_HIDDEN_MAX; k++) {
        const uint8_t width = sg_rom_byte(image + HEAD(width) + k, space);
        if (k < hidden ? width < 1 || width > SG_MLP_WIDTH_MAX : width != 0)
            return 0;
    }
    for (uint8_t k = 0; k <= SG_MLP_HIDDEN_MAX; k++) {
        const uint8_t bytes = sg_rom_byte(image + HEAD(weight_bytes) + k, space);
        if (k <= hidden ? bytes < 1 || bytes > 2 : bytes != 0)
            return 0;
    }
    return 1;
}

// Length that legal counts imply, at most SG_MLP_LENGTH_MAX.
static uint16_t implied_length(const uint8_t *image, uint8_t space)
{
    const uint8_t hidden = sg_rom_byte(image + HEAD(hidden), space);
    uint16_t length = SG_MLP_HEAD_BYTES;
    for (uint8_t k = 0; k <= hidden; k++) {
        const struct layer layer = layer_at(image, space, k);
        const uint8_t row_bytes = (uint8_t)(ROW_BYTES + (uint8_t)(layer.columns * layer.weight_bytes));
        length = (uint16_t)(length + (uint16_t)layer.rows * row_bytes);
    }
    return length;
}

// One of a group's n rows: can its z leave 24 bits? at is its bias, weight its first weight.
static uint8_t row_is_safe(const uint8_t *at, const uint8_t *weight, const struct layer *layer, uint8_t n,
                           uint8_t space)
{
    const uint32_t stored = sg_rom_u16(at, space) | (uint32_t)sg_rom_byte(at + 2, space) << 16;
    const int32_t bias = (int32_t)(stored ^ 0x800000UL) - 0x800000L;
    int32_t positive = 0, negative = 0;
    for (uint8_t j = layer->columns; j != 0; j--) {
        const int32_t w = layer->weight_bytes == 2 ? (int32_t)sg_rom_u16(weight, space) - 32768L
                                                   : (int32_t)sg_rom_byte(weight, space) - 128L;
        if (w > 0)
            positive += w;
        else
            negative -= w;
        weight += (uint8_t)(n * layer->weight_bytes);
    }
    // sums below 2^21, so products below 2^30
    return bias + (positive + layer->columns) * 256L < 0x800000L &&
           bias - (negative + layer->columns) * 256L >= -0x800000L;
}

// Walks one layer. Returns its end, or NULL if a row could overflow, or if the row too many could saturate.
static const uint8_t *checked_layer(const uint8_t *at, const struct layer *layer, uint8_t space)
{
    for (uint8_t left = layer->rows; left != 0;) {
        const uint8_t n = left >= 4 ? 4 : 2;
        const uint8_t *weight = at + 3U * n;
        for (uint8_t i = 0; i < n; i++) {
            if (!row_is_safe(at, weight, layer, n, space))
                return NULL;
            at += 3;
            weight += layer->weight_bytes;
        }
        at += (uint16_t)((uint16_t)layer->columns * (uint8_t)(n * layer->weight_bytes)) + 2U * n;
        left = (uint8_t)(left - n);
    }
    if (layer->padded && sg_rom_u16(at - 2, space) != 0)
        return NULL;
    return at;
}

static uint8_t unused_bits(const uint8_t *image, uint8_t inputs, uint8_t space)
{
    uint8_t bits = sg_rom_byte(image + HEAD(reserved), space);
    for (uint8_t i = HEAD(pad); i < HEAD(input); i++)
        bits |= sg_rom_byte(image + i, space);
    const uint8_t used = (uint8_t)(HEAD(input) + sizeof(struct sg_mlp_input) * inputs);
    for (uint8_t i = used; i < SG_MLP_HEAD_BYTES; i++)
        bits |= sg_rom_byte(image + i, space);
    return bits;
}

int sg_mlp_open(struct sg_mlp_view *view, const uint8_t *image, uint32_t room, uint8_t space)
{
    if (room < SG_MLP_HEAD_BYTES)
        return SG_E_SHORT;
    if (sg_rom_u32(image + HEAD(magic), space) != (uint32_t)SG_MLP_MAGIC)
        return SG_E_MAGIC;
    if (sg_rom_u16(image + HEAD(version), space) != (uint16_t)SG_MLP_VERSION)
        return SG_E_VERSION;
    if (!counts_are_legal(image, space))
        return SG_E_BOUNDS;
    const uint16_t length = implied_length(image, space);
    if (sg_rom_u16(image + HEAD(length), space) != length)
        return SG_E_BOUNDS;
    if (length > room)
        return SG_E_SHORT;
    const uint32_t crc = sg_model_crc32_at(0, image + CRC_FROM, (uint16_t)(length - CRC_FROM), space);
    if (sg_rom_u32(image + HEAD(crc), space) != crc)
        return SG_E_CRC;
    const uint8_t inputs = sg_rom_byte(image + HEAD(inputs), space);
    const uint8_t hidden = sg_rom_byte(image + HEAD(hidden), space);
    if (unused_bits(image, inputs, space))
        return SG_E_BOUNDS;
    const uint8_t *at = image + SG_MLP_HEAD_BYTES;
    uint8_t widest = even(inputs);
    uint8_t wide = 0;
    for (uint8_t k = 0; k <= hidden; k++) {
        const struct layer layer = layer_at(image, space, k);
        at = checked_layer(at, &layer, space);
        if (at == NULL)
            return SG_E_BOUNDS;
        if (layer.rows > widest)
            widest = layer.rows;
        if (layer.weight_bytes == 2)
            wide |= (uint8_t)(1U << k);
    }

    view->image = image;
    view->crc = crc;
    view->length = length;
    view->space = space;
    view->inputs = inputs;
    view->outputs = sg_rom_byte(image + HEAD(outputs), space);
    view->hidden = hidden;
    for (uint8_t k = 0; k < SG_MLP_HIDDEN_MAX; k++)
        view->width[k] = sg_rom_byte(image + HEAD(width) + k, space);
    view->wide = wide;
    view->scratch_words = (uint8_t)(2U * widest);
    view->reserved = 0;
    return SG_OK;
}

int sg_mlp_predict(const struct sg_mlp_view *view, const uint16_t *input, uint16_t *scratch, int16_t *output,
                   uint8_t *flags)
{
    uint16_t *in = scratch;
    uint16_t *out = scratch + (view->scratch_words >> 1);
    const uint8_t *at = view->image + SG_MLP_HEAD_BYTES;
    struct sg_mlp_run run;
    run.space = view->space;
    run.saturated = 0;
    const uint8_t clamped = sg_mlp_scale(input, in, view->image + HEAD(input), view->inputs, view->space);
    const uint8_t *width = view->width;
    uint8_t wide = view->wide;
    run.columns = view->inputs;
    for (uint8_t left = view->hidden + 1U; left != 0; left--, wide >>= 1) {
        const uint8_t rows = left > 1 ? *width++ : view->outputs;
        run.rows = even(rows);
        run.kind = (uint8_t)((wide & SG_MLP_WIDE) | (left > 1 ? 0 : SG_MLP_OUTPUT));
        run.in = in;
        at = sg_mlp_layer(&run, at, out);
        run.columns = rows;
        uint16_t *const swap = in;
        in = out;
        out = swap;
    }
    for (uint8_t i = 0; i < view->outputs; i++)
        output[i] = (int16_t)in[i];
    // no branches: every input takes the same time
    *flags = (uint8_t)((clamped | run.saturated) & SG_MLP_OUT_OF_RANGE);
    return (int8_t)(run.saturated & (uint8_t)SG_E_RANGE);
}
