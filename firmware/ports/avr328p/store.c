// SPDX-License-Identifier: Apache-2.0
// Live state in EEPROM: two copies, each  payload | sequence | CRC-16. A write goes to the older copy, one
// byte per 3.4 ms, started and left; if power fails in the middle its CRC does not fit and the other copy is
// still whole. Records of another size lie elsewhere, so that those of an older firmware outlive the first
// write of a newer one. What the newer copy holds already is not written again: sequence and CRC wear, too.
#include "port.h"

#include <avr/eeprom.h>
#include <string.h>

enum {
    TAIL_BYTES = 4,
    SIZE_V1 = 24,
    SIZE_V2 = 28,
    PLACE_V2 = 2 * (SIZE_V1 + TAIL_BYTES),
    PLACE_V3 = PLACE_V2 + 2 * (SIZE_V2 + TAIL_BYTES),
};

// Being written: the record where it lies, then its tail.
static const uint8_t *from;
static uint16_t to;                     // in EEPROM
static struct { uint16_t sequence, crc; } tail;
_Static_assert(sizeof tail == TAIL_BYTES, "layout in EEPROM");
static uint8_t left;                    // bytes, and one for the end; 0: nothing under way
static uint8_t copy;                    // where the next write goes
static uint16_t sequence;               // of the newest whole copy
static uint16_t writes;

static uint16_t place(uint8_t which, uint8_t n)
{
    const uint8_t copy_bytes = n + TAIL_BYTES;
    return (n == SIZE_V1 ? 0 : n == SIZE_V2 ? PLACE_V2 : PLACE_V3) + (which ? copy_bytes : 0);
}

// Of a record and of the sequence number in `tail`.
static __attribute__((noinline)) uint16_t record_crc(const uint8_t *record, uint8_t n)
{
    return sg_wire_crc16(sg_wire_crc16(0xFFFF, record, n), (const uint8_t *)&tail.sequence,
                         sizeof tail.sequence);
}

uint8_t hal_load(void *record, uint8_t n)
{
    uint8_t any = 0;
    for (uint8_t which = 0; which < 2; which++) {
        uint8_t bytes[HAL_RECORD_MAX];
        const uint16_t at = place(which, n);
        eeprom_read_block(bytes, (const uint8_t *)at, n);
        eeprom_read_block(&tail, (const uint8_t *)(at + n), TAIL_BYTES);
        if (record_crc(bytes, n) != tail.crc)
            continue;
        if (any && (int16_t)(tail.sequence - sequence) <= 0)
            continue;
        any = 1;
        sequence = tail.sequence;
        copy = !which;
        memcpy(record, bytes, n);
    }
    return any;
}

// Nothing can be read while a byte is being written: then it is not known, and is written.
static uint8_t stored(const uint8_t *record, uint8_t n)
{
    if (EECR & (1 << EEPE))
        return 0;
    uint16_t at = place(!copy, n);
    do {
        EEAR = at++;
        EECR = 1 << EERE;
        if (EEDR != *record++)
            return 0;
    } while (--n);
    return 1;
}

uint8_t hal_save(const void *record, uint8_t n)
{
    left = 0;
    if (stored(record, n))
        return 1;
    tail.sequence = sequence + 1;
    tail.crc = record_crc(record, n);
    from = record;
    left = n + TAIL_BYTES + 1;
    to = place(copy, n);
    return 1;
}

uint8_t store_busy(void)
{
    return left;
}

uint16_t store_writes(void)
{
    return writes;
}

void store_poll(void)
{
    if (!left || (EECR & (1 << EEPE)))
        return;
    if (--left == 0) {
        copy ^= 1;
        sequence++;
        writes++;
        return;
    }
    if (left == TAIL_BYTES)
        from = (const uint8_t *)&tail;
    EEAR = to++;
    EECR = 1 << EERE;
    const uint8_t wanted = *from++;
    if (EEDR == wanted)         // spare the cell, and 3.4 ms
        return;
    EEDR = wanted;
    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        EECR = 1 << EEMPE;      // erase and write; the write must follow within four cycles
        EECR |= 1 << EEPE;
    }
}
