// SPDX-License-Identifier: Apache-2.0
#include "sg_light.h"

#include "sg_light_loop.h"
#include "sg_light_table.h"
#include "sg_rom.h"

static const uint8_t before_q8[PERIOD_NODES] SG_ROM = BEFORE_Q8;
static const uint8_t earlier_minus_q8[PERIOD_NODES] SG_ROM = EARLIER_MINUS_Q8;

void sg_light_start(struct sg_light *light, uint8_t wiring, uint16_t period_cycles)
{
    *light = (struct sg_light) { .wiring = wiring ? 1 : 0 };
    uint8_t node = 0;
    if (period_cycles > PERIOD_FROM)
        node = (uint8_t)((uint16_t)(period_cycles - PERIOD_FROM + (1U << (PERIOD_BITS - 1))) >> PERIOD_BITS);
    if (node >= PERIOD_NODES)
        node = PERIOD_NODES - 1;
    light->before_q8 = sg_rom_byte(&before_q8[node], SG_ROM_FLASH);
    light->earlier_q8 = sg_rom_byte(&earlier_minus_q8[node], SG_ROM_FLASH);
    for (uint8_t i = 0; i < SG_LIGHT_CHANNELS; i++)
        light->channel[i].slope_q16 = SG_LIGHT_SLOPE_Q16;
}

void sg_light_curve(struct sg_light *light, const int8_t curve_q10[6], int8_t zero_q2)
{
    light->zero_q5 = zero_q2 > 0 ? 0 : zero_q2 < -16 ? -128 : (int8_t)(zero_q2 * 8);
    for (uint8_t i = 0; i < SG_LIGHT_CHANNELS; i++)
        light->channel[i].slope_q16 = (int16_t)(SG_LIGHT_SLOPE_Q16 + 128 * curve_q10[i]);
}

void sg_light_gap(struct sg_light *light)
{
    light->state |= SG_LIGHT_GAP;
}
