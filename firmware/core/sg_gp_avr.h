// SPDX-License-Identifier: Apache-2.0
// How the compiler calls sg_gp_avr.S, which saves no register but r28 and r29: its one caller, sg_gp_predict(),
// keeps next to nothing in the others, and 94 pushes and pops a frame would save that. Included by sg_gp_loop.h
// alone.
#ifndef SG_GP_AVR_H
#define SG_GP_AVR_H

static inline uint8_t sg_gp_scale(struct sg_gp_sum *sum, const uint16_t feature[6], const uint8_t *offset,
                                  uint8_t space)
{
    register struct sg_gp_sum *first __asm__("r24") = sum;
    register const uint16_t *second __asm__("r22") = feature;
    register const uint8_t *third __asm__("r20") = offset;
    register uint8_t fourth __asm__("r18") = space;
    __asm__ volatile("call sg_gp_scale" : "+r"(first), "+r"(second), "+r"(third), "+r"(fourth)
                     : : SG_LOST, "r16", "r17", "r19");
    return (uint8_t)(uint16_t)first;
}

static inline void sg_gp_trend(struct sg_gp_sum *sum, const uint8_t *bias, uint8_t space)
{
    register struct sg_gp_sum *first __asm__("r24") = sum;
    register const uint8_t *second __asm__("r22") = bias;
    register uint8_t third __asm__("r20") = space;
    __asm__ volatile("call sg_gp_trend" : "+r"(first), "+r"(second), "+r"(third)
                     : : SG_LOST, "r16", "r17", "r18", "r19", "r21");
}

static inline void sg_gp_loop(struct sg_gp_sum *sum, const uint8_t *record, uint8_t n, uint8_t space)
{
    register struct sg_gp_sum *first __asm__("r24") = sum;
    register const uint8_t *second __asm__("r22") = record;
    register uint8_t third __asm__("r20") = n;
    register uint8_t fourth __asm__("r18") = space;
    __asm__ volatile("call sg_gp_loop" : "+r"(first), "+r"(second), "+r"(third), "+r"(fourth)
                     : : SG_LOST, "r16", "r17", "r19", "r21");
}

static inline void sg_gp_find(const int16_t deg_q7[2], const uint8_t *origin, uint8_t space,
                              struct sg_gp_place *place)
{
    register const int16_t *first __asm__("r24") = deg_q7;
    register const uint8_t *second __asm__("r22") = origin;
    register uint8_t third __asm__("r20") = space;
    register struct sg_gp_place *fourth __asm__("r18") = place;
    __asm__ volatile("call sg_gp_find" : "+r"(first), "+r"(second), "+r"(third), "+r"(fourth)
                     : : SG_LOST, "r16", "r17", "r21");
}

static inline void sg_gp_judge(const struct sg_gp_sum *sum, const struct sg_gp_place *place, const uint8_t *guard,
                               uint8_t space, struct sg_gp_opinion *opinion)
{
    register const struct sg_gp_sum *first __asm__("r24") = sum;
    register const struct sg_gp_place *second __asm__("r22") = place;
    register const uint8_t *third __asm__("r20") = guard;
    register uint8_t fourth __asm__("r18") = space;
    register struct sg_gp_opinion *fifth __asm__("r16") = opinion;
    __asm__ volatile("call sg_gp_judge" : "+r"(first), "+r"(second), "+r"(third), "+r"(fourth), "+r"(fifth)
                     : : SG_LOST, "r19");
}

#endif
