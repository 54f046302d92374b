// SPDX-License-Identifier: Apache-2.0
// Live state in EEPROM: two copies, each  payload | sequence | CRC-16. A write goes to the older copy, one
// byte per 3.4 ms, started and left; if power fails in the middle its CRC does not fit and the other copy is
// still whole. Records of another size lie elsewhere, so that those of an older firmware outlive the first
// write of a newer one.
#include "port.h"

#include <avr/eeprom.h>

enum {
    TAIL_BYTES = 4,
    SIZE_V1 = 24,
    SIZE_V2 = 28,
    PLACE_V2 = 2 * (SIZE_V1 + TAIL_BYTES),
    PLACE_V3 = PLACE_V2 + 2 * (SIZE_V2 + TAIL_BYTES),
};

// Being written: the record where it lies, and its tail.
static const uint8_t *payload;
static struct { uint16_t sequence, crc; } tail;
_Static_assert(sizeof tail == TAIL_BYTES, "layout in EEPROM");
static uint8_t payload_bytes;           // 0: nothing under way
static uint8_t position;
static uint8_t copy;                    // where the next write goes
static uint16_t sequence;               // of the newest whole copy
static uint16_t writes;

static uint16_t place(uint8_t which, uint8_t n)
{
    const uint8_t copy_bytes = n + TAIL_BYTES;
    return (n == SIZE_V1 ? 0 : n == SIZE_V2 ? PLACE_V2 : PLACE_V3) + (which ? copy_bytes : 0);
}

// 1 if the copy is whole; *found is then its sequence number.
static uint8_t check_copy(uint16_t at, uint8_t n, uint16_t *found)
{
    uint16_t crc = 0xFFFF;
    for (uint8_t i = 0; i < n + 2; i++) {
        const uint8_t byte = eeprom_read_byte((const uint8_t *)(at + i));
        crc = sg_wire_crc16(crc, &byte, 1);
    }
    *found = eeprom_read_word((const uint16_t *)(at + n));
    return eeprom_read_word((const uint16_t *)(at + n + 2)) == crc;
}

uint8_t hal_load(void *record, uint8_t n)
{
    uint16_t found[2];
    const uint8_t whole_a = check_copy(place(0, n), n, &found[0]);
    const uint8_t whole_b = check_copy(place(1, n), n, &found[1]);
    uint8_t newest = 0;
    if (!whole_a && !whole_b)
        return 0;
    if (whole_b && (!whole_a || (int16_t)(found[1] - found[0]) > 0))
        newest = 1;
    sequence = found[newest];
    eeprom_read_block(record, (const uint8_t *)place(newest, n), n);
    copy = !newest;
    return 1;
}

uint8_t hal_save(const void *record, uint8_t n)
{
    tail.sequence = sequence + 1;
    tail.crc = sg_wire_crc16(sg_wire_crc16(0xFFFF, record, n), (const uint8_t *)&tail.sequence,
                             sizeof tail.sequence);
    payload = record;
    payload_bytes = n;
    position = 0;
    return 1;
}

uint8_t store_busy(void)
{
    return payload_bytes;
}

uint16_t store_writes(void)
{
    return writes;
}

void store_poll(void)
{
    if (!payload_bytes || (EECR & (1 << EEPE)))
        return;
    if (position == payload_bytes + TAIL_BYTES) {
        payload_bytes = 0;
        copy = !copy;
        sequence++;
        writes++;
        return;
    }
    EEAR = place(copy, payload_bytes) + position;
    EECR = 1 << EERE;
    const uint8_t wanted = position < payload_bytes ? payload[position]
                                                    : ((const uint8_t *)&tail)[position - payload_bytes];
    position++;
    if (EEDR == wanted)         // spare the cell, and 3.4 ms
        return;
    EEDR = wanted;
    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        EECR = 1 << EEMPE;      // erase and write; the write must follow within four cycles
        EECR |= 1 << EEPE;
    }
}
