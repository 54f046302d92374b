// SPDX-License-Identifier: Apache-2.0
#include "sg_link.h"

#include "sg_err.h"

_Static_assert(sizeof(((struct sg_link_rx *)0)->frame) == SG_WIRE_FRAME_MAX - 1, "all but the delimiter");

static void count(uint16_t *counter)
{
    if (*counter != UINT16_MAX)
        ++*counter;
}

void sg_link_put(struct sg_link_rx *rx, uint8_t byte)
{
    const uint8_t fill = rx->fill;
    if (fill < sizeof rx->frame)
        rx->frame[fill] = byte;
    if (fill <= sizeof rx->frame)      // one past the end marks a frame that is too long
        rx->fill = (uint8_t)(fill + 1U);
}

int sg_link_end(struct sg_link_rx *rx, struct sg_head *head, void *body)
{
    const uint8_t fill = rx->fill;
    rx->fill = 0;
    if (fill == 0)
        return SG_E_BUSY;
    int result = SG_E_BOUNDS;
    if (fill <= sizeof rx->frame)
        result = sg_wire_decode(rx->frame, fill, head, body);
    if (result < 0)
        count(result == SG_E_CRC ? &rx->bad_crc : &rx->bad_length);
    return result;
}

int sg_link_receive(struct sg_link_rx *rx, uint8_t byte, struct sg_head *head, void *body)
{
    if (byte == 0)
        return sg_link_end(rx, head, body);
    sg_link_put(rx, byte);
    return SG_E_BUSY;
}

int sg_link_feed(struct sg_link_rx *rx, const uint8_t *data, size_t n, size_t *used, struct sg_head *head,
                 void *body)
{
    int result = SG_E_BUSY;
    size_t i = 0;
    while (i < n && result == SG_E_BUSY)
        result = sg_link_receive(rx, data[i++], head, body);
    *used = i;
    return result;
}
