// SPDX-License-Identifier: Apache-2.0
#include "sg_light.h"

#include "sg_light_loop.h"
#include "sg_light_table.h"
#include "sg_rom.h"

enum {
    // Mean square of what six channels depart together: noise alone is 256.
    MOVING_FROM = 768,
    MOVING_SHIFT = 2,           // interpolation is believed in full 256 << 2 above
    MOVING_MOST = 4096,
    DEPARTURE_MOST = 63,
};

// Pairs in the order of sampling, by wiring: six LEDs, or six photodiodes.
static const uint8_t order[2][6] SG_ROM = { { 5, 0, 1, 4, 2, 3 }, { 0, 3, 1, 4, 2, 5 } };

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

void sg_light_curve(struct sg_light *light, const int8_t curve_q10[6])
{
    for (uint8_t i = 0; i < SG_LIGHT_CHANNELS; i++)
        light->channel[i].slope_q16 = (int16_t)(SG_LIGHT_SLOPE_Q16 + 128 * curve_q10[i]);
}

void sg_light_gap(struct sg_light *light)
{
    light->gap = 1;
}

void sg_light_add(struct sg_light *light, const struct sg_reading *reading)
{
    if (light->gap) {
        light->gap = 0;
        for (uint8_t i = 0; i < SG_LIGHT_CHANNELS; i++)
            light->channel[i].unlit_q5[0] = light->channel[i].unlit_q5[1] = sg_light_q5(reading->unlit_code[i]);
    }
    struct sg_light_pass pass = { .brought_q5 = (int16_t)sg_light_q5(reading->held_code),
                                  .lit_code = reading->held_code };
    if (light->moving > MOVING_FROM)
        pass.moving_q8 = (uint16_t)(light->moving - MOVING_FROM) >> MOVING_SHIFT;
    sg_light_loop(light, reading, order[light->wiring], &pass);
    // Six channels depart together, noise does not.
    uint8_t size = DEPARTURE_MOST;
    if (pass.departure >= -DEPARTURE_MOST && pass.departure <= DEPARTURE_MOST)
        size = (uint8_t)(pass.departure < 0 ? -pass.departure : pass.departure);
    const uint16_t moving = (uint16_t)(light->moving - (light->moving >> 4) + (uint16_t)(size * size));
    light->moving = moving > MOVING_MOST ? MOVING_MOST : moving;
}

uint8_t sg_light_features(struct sg_light *light, uint16_t feature[6])
{
    uint8_t flags = 0;
    for (uint8_t i = 0; i < SG_LIGHT_CHANNELS; i++, feature++) {
        struct sg_light_channel *channel = &light->channel[i];
        const uint8_t n = channel->cycles;
        if (n != 0) {
            int32_t sum = channel->sum_q5;
            const uint16_t least = (uint16_t)(SG_LIGHT_STARVED_CODES * SG_LIGHT_UNIT * n);
            if (sum < (int32_t)least) {
                sum = (int32_t)least;
                channel->flags |= SG_LIGHT_STARVED;
            }
            int32_t value = channel->unit_q12;
            if (n != 1) {
                value -= sg_light_log2_q12(n);
                for (; sum > UINT16_MAX; sum >>= 1)
                    value += 4096;
            }
            value += sg_light_log2_q12((uint16_t)sum);
            *feature = value < 0 ? 0 : value > UINT16_MAX ? UINT16_MAX : (uint16_t)value;
            channel->cycles = 0;
        }
        flags |= channel->flags;
    }
    return flags;
}
