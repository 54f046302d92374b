// SPDX-License-Identifier: Apache-2.0
// Which model is in use, and the checks of models while frames go on. A check runs in pieces between frames:
// a CRC over a whole slot would take longer than a frame.
#include "app.h"

#include <stddef.h>
#include <string.h>

#include "sg_rom.h"

// A piece of a check: of the pages so many bytes, else a node or a record. It may make a frame wait.
// A board may have no room for a trial: what is only for that is then left out.
enum { TRIAL = HAL_TRIAL_BYTES != 0, SLOTS = TRIAL ? 3 : 2, PIECE_BYTES = 8, PIECES_ROOMY = 6, PIECE_US = 60, CRC_FROM = 8 };

// A check under way, of slot `slot`, asked for by request `seq`.
struct check {
    uint32_t crc;
    uint16_t length;
    uint16_t at;                // 0: none under way
    uint16_t seq;
    uint8_t type;               // of the request
    uint8_t slot;
    int8_t parts;               // what has been found so far
};

static struct sg_model_view view[SLOTS];        // length 0: not a model
static int8_t verdict[SLOTS];
static uint8_t active = SG_SLOT_NONE;
static uint8_t stored = SG_SLOT_NONE;           // what TRIAL_USE 0 goes back to
static struct check check;
static uint8_t trial[TRIAL ? HAL_TRIAL_BYTES : 1];

SELDOM static const uint8_t *slot_image(uint8_t slot)
{
    return TRIAL && slot == SG_SLOT_RAM ? trial : hal_slot(slot);
}

static uint16_t slot_room(uint8_t slot)
{
    return TRIAL && slot == SG_SLOT_RAM ? (uint16_t)HAL_TRIAL_BYTES : app.slot_bytes;
}

static uint8_t slot_space(uint8_t slot)
{
    return TRIAL && slot == SG_SLOT_RAM ? (uint8_t)SG_ROM_MEMORY : (uint8_t)HAL_SLOT_SPACE;
}

// No trial, or one not checked since it was written.
static void forget_trial(int8_t why)
{
    if (!TRIAL)
        return;
    memset(&view[SG_SLOT_RAM], 0, sizeof view[SG_SLOT_RAM]);
    verdict[SG_SLOT_RAM] = why;
}

// Another model takes another time.
SELDOM static void use(uint8_t slot)
{
    if (active == slot)
        return;
    active = slot;
    app_rate_renew();
}

// The next piece of the check. The nodes and records count once all of it is known.
static void step(void)
{
    const uint8_t *image = slot_image(check.slot);
    const uint8_t space = slot_space(check.slot);
    uint16_t next = check.at + PIECE_BYTES;
    if (check.at >= SG_MODEL_HEAD_BYTES) {
        next = sg_model_part(image, check.at, space);
        if (check.parts == SG_OK)
            check.parts = (int8_t)sg_model_check_part(image, check.at, space);
    }
    check.crc = sg_model_crc32_at(check.crc, image + check.at, next - check.at, space);
    check.at = next;
}

SELDOM static int8_t judge(struct sg_model_view *found)
{
    memset(found, 0, sizeof *found);
    return (int8_t)sg_model_open_checked(found, slot_image(check.slot), slot_room(check.slot),
                                         slot_space(check.slot), check.crc, check.parts);
}

// The header alone decides how far to read; one that is wrong is answered for at once, with CRC 0.
SELDOM static int8_t begin(uint8_t type, uint8_t slot, uint16_t seq)
{
    const uint8_t *image = slot_image(slot);
    if (!image)
        return SG_E_BOUNDS;
    if (check.at)
        return SG_E_BUSY;
    const int length = sg_model_length(image, slot_room(slot), slot_space(slot));
    check = (struct check){ .at = CRC_FROM, .seq = seq, .type = type, .slot = slot };
    check.length = length < 0 ? 0 : (uint16_t)length;
    return SG_OK;
}

SELDOM void app_models_start(void)
{
    struct sg_model_view *found = view;
    const struct sg_model_view *newest = NULL;
    for (uint8_t slot = SG_SLOT_A; slot <= SG_SLOT_B; slot++, found++) {
        int8_t result = SG_E_MAGIC;
        if (begin(0, slot, 0) == SG_OK) {
            while (check.at < check.length)
                step();
            result = judge(found);
            check.at = 0;
            if (result == SG_OK && (!newest || (int32_t)(found->generation - newest->generation) > 0)) {
                newest = found;
                stored = slot;
            }
        }
        verdict[slot] = result;
    }
    forget_trial(SG_E_MAGIC);
    active = stored;
}

const struct sg_model_view *app_model(void)
{
    return active == SG_SLOT_NONE ? NULL : &view[active];
}

uint8_t app_model_slot(void)
{
    return active;
}

SELDOM void app_model_info(struct sg_model_info *info)
{
    memset(info, 0, sizeof *info);
    for (uint8_t slot = 0; slot < SLOTS; slot++) {
        info->crc[slot] = view[slot].crc;
        info->generation[slot] = view[slot].generation;
        info->vectors[slot] = view[slot].vectors;
        info->channels[slot] = view[slot].channels;
        info->verdict[slot] = verdict[slot];
    }
    if (!TRIAL)
        info->verdict[SG_SLOT_RAM] = SG_E_MAGIC;
    info->active = active;
}

SELDOM int8_t app_model_read(const struct sg_model_at *at, struct sg_model_data *data)
{
    if (at->slot > SG_SLOT_RAM || at->length < 1 || at->length > SG_WIRE_DATA_MAX)
        return SG_E_ARG;
    const uint8_t *image = slot_image(at->slot);
    const uint16_t room = slot_room(at->slot);
    if (!image || at->length > room || at->offset > room - at->length)
        return SG_E_BOUNDS;
    data->offset = at->offset;
    data->slot = at->slot;
    data->length = at->length;
    for (uint8_t i = 0; i < at->length; i++)
        data->data[i] = sg_rom_byte(image + at->offset + i, slot_space(at->slot));
    return SG_OK;
}

SELDOM static void answer(int8_t result)
{
    struct sg_model_verdict body = { .crc = check.crc, .verdict = result, .slot = check.slot };
    // Not queued only while the line is full of answers: ask again in the next turn.
    if (!app_send(check.type | SG_REPLY, check.seq, &body, sizeof body, 0))
        return;
    check.at = 0;
    if (TRIAL && check.type == SG_MSG_TRIAL_USE && result == SG_OK)
        use(SG_SLOT_RAM);
}

SELDOM int8_t app_model_verify(uint8_t slot, uint16_t seq)
{
    if (slot > SG_SLOT_RAM)
        return SG_E_ARG;
    return begin(SG_MSG_MODEL_VERIFY, slot, seq);
}

SELDOM int8_t app_trial_use(uint16_t seq)
{
    return TRIAL ? begin(SG_MSG_TRIAL_USE, SG_SLOT_RAM, seq) : (int8_t)SG_E_BOUNDS;
}

SELDOM int8_t app_trial_leave(struct sg_model_verdict *body)
{
    if (TRIAL && check.at && check.type == SG_MSG_TRIAL_USE)
        return SG_E_BUSY;
    if (TRIAL)
        use(stored);
    memset(body, 0, sizeof *body);
    const struct sg_model_view *model = app_model();
    body->slot = active;
    body->verdict = SG_E_STATE;
    if (model) {
        body->crc = model->crc;
        body->verdict = SG_OK;
    }
    return SG_OK;
}

SELDOM int8_t app_trial_write(const struct sg_model_data *data)
{
    if (data->slot != SG_SLOT_RAM || data->length < 1 || data->length > SG_WIRE_DATA_MAX)
        return SG_E_ARG;
    if (!TRIAL || data->offset > (uint16_t)HAL_TRIAL_BYTES || data->length > (uint16_t)HAL_TRIAL_BYTES - data->offset)
        return SG_E_BOUNDS;
    if (check.at && check.slot == SG_SLOT_RAM)
        return SG_E_BUSY;
    if (active == SG_SLOT_RAM)
        use(stored);            // a model in use never changes
    memcpy(trial + data->offset, data->data, data->length);
    forget_trial(SG_E_STATE);
    return SG_OK;
}

SELDOM uint8_t app_models_finish(void)
{
    if (!check.at || check.at < check.length)
        return 0;
    struct sg_model_view found;
    const int8_t result = judge(&found);
    // Flash cannot have changed since boot; what a verification finds there is only told.
    if (TRIAL && check.slot == SG_SLOT_RAM && active != SG_SLOT_RAM) {
        view[SG_SLOT_RAM] = found;
        verdict[SG_SLOT_RAM] = result;
    }
    answer(result);
    return 1;
}

void app_models_step(void)
{
    if (!check.at || check.at >= check.length || !app_time_for(PIECE_US))
        return;
    uint8_t pieces = app.roomy ? PIECES_ROOMY : 1;
    do {
        step();
    } while (check.at < check.length && --pieces);
}
