// SPDX-License-Identifier: Apache-2.0
#include "sg_expose.h"

uint16_t sg_expose_from_us_q4(uint16_t c) { return c < 64 ? 64 : c > 5216 ? 5216 : c; }
void sg_expose_start(struct sg_expose *expose, const uint16_t exposure_cycles[6], const uint16_t most_cycles[6])
{
    *expose = (struct sg_expose) { .next = 0 };
    for (uint8_t i = 0; i < 6; i++) {
        expose->led[i].exposure_cycles = exposure_cycles[i];
        expose->led[i].most_cycles = most_cycles[i];
    }
}
void sg_expose_taken(struct sg_expose *expose, const uint16_t exposure_cycles[6]) { for (uint8_t i = 0; i < 6; i++) expose->led[i].exposure_cycles = exposure_cycles[i]; }
uint8_t sg_expose_cycle(struct sg_expose *expose, const uint16_t lit_code[6], const uint16_t unlit_code[6],
                        const uint16_t exposure_cycles[6]) { (void)expose; (void)lit_code; (void)unlit_code; (void)exposure_cycles; return 0; }
