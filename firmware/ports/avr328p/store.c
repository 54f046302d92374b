// SPDX-License-Identifier: Apache-2.0
// Live state in EEPROM: two copies, each  payload | sequence | CRC-16. A write goes to the older copy, one
// byte per 3.4 ms, started and left; if power fails in the middle its CRC does not fit and the other copy is
// still whole.
#include "port.h"

#include <avr/eeprom.h>
#include <string.h>

enum { COPY_BYTES = HAL_RECORD_MAX + 4 };

static uint8_t image[COPY_BYTES];       // being written; payload_bytes of payload, sequence, CRC
static uint8_t image_bytes;             // 0: nothing under way
static uint8_t position;
static uint8_t copy;                    // where the next write goes
static uint16_t sequence;               // of the newest whole copy
static uint16_t writes;

static uint8_t read_copy(uint8_t which, uint8_t payload_bytes, uint16_t *found)
{
    const uint8_t n = payload_bytes + 4;
    uint16_t crc;
    eeprom_read_block(image, (const uint8_t *)(uint16_t)(which * COPY_BYTES), n);
    memcpy(found, image + payload_bytes, sizeof *found);
    memcpy(&crc, image + payload_bytes + 2, sizeof crc);
    return sg_wire_crc16(0xFFFF, image, n - 2U) == crc;
}

uint8_t hal_load(void *record, uint8_t n)
{
    uint16_t found[2];
    const uint8_t whole_a = read_copy(0, n, &found[0]);
    const uint8_t whole_b = read_copy(1, n, &found[1]);
    uint8_t newest = 0;
    if (!whole_a && !whole_b)
        return 0;
    if (whole_b && (!whole_a || (int16_t)(found[1] - found[0]) > 0))
        newest = 1;
    read_copy(newest, n, &sequence);
    memcpy(record, image, n);
    copy = !newest;
    return 1;
}

uint8_t hal_save(const void *record, uint8_t n)
{
    if (image_bytes)
        return 0;
    const uint16_t next = sequence + 1;
    memcpy(image, record, n);
    memcpy(image + n, &next, sizeof next);
    const uint16_t crc = sg_wire_crc16(0xFFFF, image, n + 2U);
    memcpy(image + n + 2, &crc, sizeof crc);
    image_bytes = n + 4;
    position = 0;
    return 1;
}

uint8_t store_busy(void)
{
    return image_bytes;
}

uint16_t store_writes(void)
{
    return writes;
}

void store_poll(void)
{
    if (!image_bytes || (EECR & (1 << EEPE)))
        return;
    if (position == image_bytes) {
        image_bytes = 0;
        copy = !copy;
        sequence++;
        writes++;
        return;
    }
    EEAR = (uint16_t)(copy * COPY_BYTES + position);
    EECR = 1 << EERE;
    const uint8_t wanted = image[position++];
    if (EEDR == wanted)         // spare the cell, and 3.4 ms
        return;
    EEDR = wanted;
    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        EECR = 1 << EEMPE;      // erase and write; the write must follow within four cycles
        EECR |= 1 << EEPE;
    }
}
