// SPDX-License-Identifier: Apache-2.0
// How the compiler calls sg_light_add() of sg_light_avr.S, which saves no register but r28 and r29: its
// caller keeps next to nothing in the others, once a cycle. Included by sg_light.h alone.
#ifndef SG_LIGHT_AVR_H
#define SG_LIGHT_AVR_H

extern inline __attribute__((gnu_inline, always_inline))
void sg_light_add(struct sg_light *light, const struct sg_reading *reading)
{
    register struct sg_light *first __asm__("r24") = light;
    register const struct sg_reading *second __asm__("r22") = reading;
    __asm__ volatile("call sg_light_add" : "+r"(first), "+r"(second)
                     : : SG_LOST, "r16", "r17", "r18", "r19", "r20", "r21");
}

#endif
