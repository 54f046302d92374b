// SPDX-License-Identifier: Apache-2.0
#include "sg_wire.h"

#include "sg_err.h"

static uint16_t crc16_byte(uint16_t crc, uint8_t byte)
{
    // x^16 + x^12 + x^5 + 1 divides a byte at once: its quotient is the byte xor its own high nibble.
    uint8_t t = (uint8_t)((crc >> 8) ^ byte);
    t = (uint8_t)(t ^ (t >> 4));
    crc = (uint16_t)(crc << 8);
    return (uint16_t)(crc ^ (uint16_t)((uint16_t)t << 12) ^ (uint16_t)((uint16_t)t << 5) ^ t);
}

uint16_t sg_wire_crc16(uint16_t crc, const uint8_t *data, size_t n)
{
    for (size_t i = 0; i < n; i++)
        crc = crc16_byte(crc, data[i]);
    return crc;
}

uint16_t sg_wire_encode_ring(const struct sg_head *head, const void *body, uint8_t body_bytes, uint8_t *ring,
                             uint16_t size, uint16_t at)
{
    // A packet has at most 70 bytes, so no group reaches the 254 bytes at which COBS needs a second rule.
    const uint8_t head_byte[SG_WIRE_HEAD_BYTES] = {
        (uint8_t)head->seq, (uint8_t)(head->seq >> 8), head->type, head->flags,
    };
    const uint8_t *from = head_byte;
    uint8_t left = SG_WIRE_HEAD_BYTES, part = 0;    // head, body, CRC
    uint8_t tail[2];
    uint16_t crc = 0xFFFF;
    uint8_t *out = ring + at, *code = out;          // where the length of the group under way will stand
    uint8_t group = 0, byte = 0;
    for (;;) {
        // A zero, and the frame's first byte, hold the place of the next group's length.
        if (byte == 0) {
            *code = group;
            code = out;
            group = 0;
        }
        group++;
        *out++ = byte;
        if (out == ring + size)
            out = ring;
        while (left == 0) {
            if (++part == 1) {
                from = body;
                left = body_bytes;
            } else if (part == 2) {
                tail[0] = (uint8_t)crc;
                tail[1] = (uint8_t)(crc >> 8);
                from = tail;
                left = sizeof tail;
            } else {
                *code = group;
                *out++ = 0;
                return (uint16_t)((out == ring + size ? ring : out) - ring);
            }
        }
        byte = *from++;
        left--;
        crc = crc16_byte(crc, byte);
    }
}

int sg_wire_encode(const struct sg_head *head, const void *body, size_t body_bytes, uint8_t *out)
{
    if (body_bytes > SG_WIRE_BODY_MAX)
        return SG_E_BOUNDS;
    return sg_wire_encode_ring(head, body, (uint8_t)body_bytes, out, SG_WIRE_FRAME_MAX + 1, 0);
}

int sg_wire_decode(uint8_t *frame, size_t n, struct sg_head *head, void *body)
{
    uint8_t *packet = frame;    // never gets ahead: a group has one byte more than what it stands for
    uint8_t fill = 0;
    size_t at = 0;
    while (at < n) {
        const uint8_t code = frame[at++];
        if (code == 0)
            return SG_E_BOUNDS;
        if ((size_t)(code - 1U) > n - at)
            return SG_E_SHORT;
        for (uint8_t i = 1; i < code; i++) {
            if (frame[at] == 0 || fill == SG_WIRE_PACKET_MAX)
                return SG_E_BOUNDS;
            packet[fill++] = frame[at++];
        }
        if (at < n) {  // between two groups stands a zero
            if (fill == SG_WIRE_PACKET_MAX)
                return SG_E_BOUNDS;
            packet[fill++] = 0;
        }
    }
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
