// SPDX-License-Identifier: Apache-2.0
// Byte stream to packets: a receiver that takes one byte at a time and finds its way back at the next
// delimiter after anything.
#ifndef SG_LINK_H
#define SG_LINK_H

#include <stddef.h>
#include <stdint.h>

#include "sg_wire.h"

// cdef begin
// Owned by the caller; all zeros is the initial state.
struct sg_link_rx {
    uint16_t bad_crc;       // frames dropped for a wrong CRC; counters stay at 65535
    uint16_t bad_length;    // frames dropped as too long, too short or wrongly coded
    uint8_t fill;           // bytes of the present frame so far, at most 72: longer frames are not kept
    uint8_t frame[71];      // without the delimiter
};

// Take one byte.
//
//   head, body   written when a packet is complete; body holds SG_WIRE_BODY_MAX bytes
//
// Returns the body's length (0..64) when this byte ended a good packet; SG_E_BUSY when more bytes are needed
// (also for the delimiter of an empty frame, which is not an error: senders may lead with one); SG_E_SHORT,
// SG_E_BOUNDS or SG_E_CRC when it ended a frame that was dropped and counted.
int sg_link_receive(struct sg_link_rx *rx, uint8_t byte, struct sg_head *head, void *body);

// Take bytes up to the end of the first frame that is good or bad. *used says how many were taken.
// Returns as sg_link_receive does; SG_E_BUSY only when all n bytes were taken.
int sg_link_feed(struct sg_link_rx *rx, const uint8_t *data, size_t n, size_t *used, struct sg_head *head,
                 void *body);
// cdef end

// The same in two: any byte but a delimiter, and a delimiter. The body may stay where it is decoded, in the frame behind
// the head, until the next byte comes.
void sg_link_put(struct sg_link_rx *rx, uint8_t byte);
int sg_link_end(struct sg_link_rx *rx, struct sg_head *head, void *body);

#endif
