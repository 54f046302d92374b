// SPDX-License-Identifier: Apache-2.0
// How the compiler calls sg_wire_avr.S, which saves no register: what it leaves changed is said here. Included
// by sg_wire.h alone.
#ifndef SG_WIRE_AVR_H
#define SG_WIRE_AVR_H

extern inline __attribute__((gnu_inline, always_inline))
uint16_t sg_wire_encode_ring(const struct sg_head *head, const void *body, uint8_t body_bytes, uint8_t *ring,
                             uint16_t size, uint16_t at)
{
    register uint8_t *next __asm__("r26") = ring + at;
    register const struct sg_head *first __asm__("r30") = head;
    register const void *then __asm__("r18") = body;
    register uint8_t bytes __asm__("r20") = body_bytes;
    register const uint8_t *begin __asm__("r22") = ring;
    register const uint8_t *end __asm__("r14") = ring + size;
    __asm__ volatile("call sg_wire_encode_at" : "+r"(next), "+r"(first), "+r"(then), "+r"(bytes)
                     : "r"(begin), "r"(end)
                     : "r0", "r10", "r11", "r12", "r13", "r16", "r17", "r21", "r24", "r25", "cc", "memory");
    return (uint16_t)(next - ring);
}

#endif
