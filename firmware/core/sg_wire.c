// SPDX-License-Identifier: Apache-2.0
#include "sg_wire.h"

#include "sg_err.h"

// What runs for every byte of a frame, in its place whatever the rest is compiled for.
#define HOT static inline __attribute__((always_inline))

// CRC-16, its bytes apart because that is how an AVR shifts.
struct crc { uint8_t high, low; };

// x^16 + x^12 + x^5 + 1 divides a byte at once: its quotient is the byte xor its own high nibble.
HOT void crc16_byte(struct crc *crc, uint8_t byte)
{
    uint8_t q = (uint8_t)(crc->high ^ byte);
    q = (uint8_t)(q ^ (q >> 4));
    crc->high = (uint8_t)(crc->low ^ (uint8_t)(q << 4) ^ (q >> 3));
    crc->low = (uint8_t)(q ^ (uint8_t)(q << 5));
}

uint16_t sg_wire_crc16(uint16_t crc, const uint8_t *data, size_t n)
{
    struct crc now = { .high = (uint8_t)(crc >> 8), .low = (uint8_t)crc };
    for (const uint8_t *end = data + n; data != end;)
        crc16_byte(&now, *data++);
    return (uint16_t)(((uint16_t)now.high << 8) | now.low);
}

#ifndef SG_WIRE_ASSEMBLY
// COBS into a ring. A packet has at most 70 bytes, so no group reaches the 254 bytes at which COBS needs a second
// rule.
struct out {
    uint8_t *next;
    uint8_t *code;              // where the length of the group under way will stand
    uint8_t *ring;
    uint8_t *end;
    uint8_t group;
};

HOT void out_byte(struct out *out, uint8_t byte)
{
    *out->next = byte;
    // A zero holds the place of the next group's length.
    if (byte == 0) {
        *out->code = out->group;
        out->code = out->next;
        out->group = 0;
    }
    out->group++;
    if (++out->next == out->end)
        out->next = out->ring;
}

uint16_t sg_wire_encode_ring(const struct sg_head *head, const void *body, uint8_t body_bytes, uint8_t *ring,
                             uint16_t size, uint16_t at)
{
    struct out out = { .next = ring + at, .code = ring + at, .ring = ring, .end = ring + size, .group = 0 };
    struct crc crc = { .high = 0xFF, .low = 0xFF };
    // All that is sent lies in memory as on the wire.
    const uint8_t *from = (const uint8_t *)head;
    uint8_t left = SG_WIRE_HEAD_BYTES;
    out_byte(&out, 1);
    for (uint8_t part = 0; part < 2; part++) {
        for (; left; left--) {
            const uint8_t byte = *from++;
            crc16_byte(&crc, byte);
            out_byte(&out, byte);
        }
        from = body;
        left = body_bytes;
    }
    out_byte(&out, crc.low);
    out_byte(&out, crc.high);
    *out.code = out.group;
    *out.next = 0;
    return (uint16_t)((++out.next == out.end ? ring : out.next) - ring);
}
#endif

int sg_wire_encode(const struct sg_head *head, const void *body, size_t body_bytes, uint8_t *out)
{
    if (body_bytes > SG_WIRE_BODY_MAX)
        return SG_E_BOUNDS;
    return sg_wire_encode_ring(head, body, (uint8_t)body_bytes, out, SG_WIRE_FRAME_MAX + 1, 0);
}

int sg_wire_decode(uint8_t *frame, size_t n, struct sg_head *head, void *body)
{
    const uint8_t *at = frame, *const end = frame + n;
    uint8_t *packet = frame;    // never gets ahead: a group has one byte more than what it stands for
    uint8_t *const full = packet + SG_WIRE_PACKET_MAX;
    uint8_t *to = packet;
    while (at != end) {
        uint8_t code = *at++;
        if (code == 0)
            return SG_E_BOUNDS;
        if ((size_t)(code - 1U) > (size_t)(end - at))
            return SG_E_SHORT;
        while (--code != 0) {
            const uint8_t byte = *at++;
            if (byte == 0 || to == full)
                return SG_E_BOUNDS;
            *to++ = byte;
        }
        if (at != end) {  // between two groups stands a zero
            if (to == full)
                return SG_E_BOUNDS;
            *to++ = 0;
        }
    }
    const uint8_t fill = (uint8_t)(to - packet);
    if (fill < SG_WIRE_HEAD_BYTES + 2)
        return SG_E_SHORT;
    const uint8_t body_bytes = (uint8_t)(fill - SG_WIRE_HEAD_BYTES - 2);
    const uint16_t crc = sg_wire_crc16(0xFFFF, packet, (size_t)(fill - 2U));
    if (packet[fill - 2] != (uint8_t)crc || packet[fill - 1] != (uint8_t)(crc >> 8))
        return SG_E_CRC;
    head->seq = (uint16_t)(packet[0] | (uint16_t)((uint16_t)packet[1] << 8));
    head->type = packet[2];
    head->flags = packet[3];
    uint8_t *out = body;
    for (uint8_t i = 0; i < body_bytes; i++)
        out[i] = packet[SG_WIRE_HEAD_BYTES + i];
    return body_bytes;
}
