// SPDX-License-Identifier: Apache-2.0
// Codes and charges are counted in 1/32 (q5): 1023 codes are 32736, differences fit 16 bits signed and sums
// 16 bits unsigned.
#include "sg_light_loop.h"

#include "sg_light_table.h"
#include "sg_rom.h"

enum { LATE_UNKNOWN = 255, LATE_SLOPE_Q16 = 14800, CURVED_Q16 = 7314 };

const uint8_t sg_light_order[2][6] SG_ROM = { { 5, 0, 1, 4, 2, 3 }, { 0, 3, 1, 4, 2, 5 } };

// Upper half of a product.
static int16_t high(int16_t x, int16_t y)
{
    return (int16_t)(((int32_t)x * y) >> 16);
}

// Q0.8 of a difference, rounded down.
static int16_t by_q8(int16_t x, uint8_t weight_q8)
{
    return (int16_t)(((int32_t)x * weight_q8) >> 8);
}

static uint16_t size_of(int16_t x)
{
    return (uint16_t)(x < 0 ? -x : x);
}

// What is known of a channel's ambient light is this code and no more.
static void settle(struct sg_light_channel *channel, uint16_t unlit_q5)
{
    channel->unlit_q5[0] = channel->unlit_q5[1] = channel->mean_q5 = unlit_q5;
    channel->settled = 1;
}

// late / rest, Q0.16, rounded down; late < rest.
static uint16_t ratio_q16(uint16_t late, uint16_t rest)
{
    uint16_t quotient = 0;
    for (uint8_t bit = 0; bit < 16; bit++) {
        late = (uint16_t)(late << 1);
        quotient = (uint16_t)(quotient << 1);
        if (late >= rest) {
            late = (uint16_t)(late - rest);
            quotient++;
        }
    }
    return quotient;
}

// Charge that a late release missed: what was collected in the rest of the exposure goes on as it came.
//   code read, before: that of the sample capacitor before it
// More than half missed: 0, and STARVED.
static int16_t missed_q5(struct sg_light_channel *channel, uint16_t code, uint16_t before,
                         uint8_t late_cycles)
{
    if (late_cycles == LATE_UNKNOWN || late_cycles >= channel->exposure_cycles >> 1) {
        channel->flags |= SG_LIGHT_STARVED;
        return 0;
    }
    const uint16_t ratio = ratio_q16(late_cycles, (uint16_t)(channel->exposure_cycles - late_cycles));
    const uint16_t code_q5 = sg_light_q5(code);
    // of the curve, 0.056 x is enough here
    const int16_t bracket = high((int16_t)code_q5, CURVED_Q16);
    const int32_t came = (int32_t)code_q5 + high((int16_t)code_q5, bracket)
                       - high((int16_t)sg_light_q5(before), SHARE_Q16);
    // less than 2^16; half of it at most is missed. A negative one is noise.
    return came <= 0 ? 0 : (int16_t)(((uint32_t)came * ratio) >> 16);
}

// A little charge as a difference of codes: over the curve's slope, about 1 - 0.113 x.
static int16_t as_code(int16_t charge_q5, uint16_t code_q5)
{
    return (int16_t)(charge_q5 - high(charge_q5, high((int16_t)code_q5, LATE_SLOPE_Q16)));
}

// What the mean would be if codes could be negative, down to the code of 0 V.
static int16_t unclipped_q5(uint16_t mean_q5, int8_t zero_q5)
{
    const int8_t level = (int8_t)(sg_rom_byte(&sg_light_clipped_table[mean_q5], SG_ROM_FLASH) - 128);
    return level < zero_q5 ? zero_q5 : level;
}

// One unlit code into what is known of the ambient light. Returns the unlit code meant at the lit moment.
static int16_t ambient_q5(const struct sg_light *light, struct sg_light_channel *channel, uint16_t unlit_q5,
                          struct sg_light_pass *pass)
{
    const uint8_t moves = light->state & SG_LIGHT_MOVES;
    const int16_t off = (int16_t)(unlit_q5 - channel->mean_q5);
    const uint8_t dither = moves ? 8 : light->dither;
    int16_t step = (int16_t)((off + dither) >> 4);
    pass->departure = (int16_t)(pass->departure + step);
    if (channel->settled < SG_LIGHT_SETTLED) {
        step = (int16_t)((off + 2) >> 2);
        channel->settled++;
    }
    const uint16_t mean = (uint16_t)(channel->mean_q5 + step);
    channel->mean_q5 = mean;
    if (!moves) {
        if (size_of(off) < SG_LIGHT_STEP_Q5)
            return mean < SG_LIGHT_CLIPPED_Q5 ? unclipped_q5(mean, light->zero_q5) : (int16_t)mean;
        settle(channel, unlit_q5);      // nobody knows whether the lit exposure saw it
        channel->flags |= SG_LIGHT_STARVED;
        return (int16_t)unlit_q5;
    }
    const uint16_t before = channel->unlit_q5[0], earlier = channel->unlit_q5[1];
    channel->unlit_q5[1] = before;
    channel->unlit_q5[0] = unlit_q5;
    const int16_t past = (int16_t)(before - unlit_q5), long_past = (int16_t)(earlier - unlit_q5);
    const uint16_t size = size_of(past);
    // No flicker falls or rises by all but a sixteenth in a cycle, but near its least.
    if (size >= SG_LIGHT_LEAP_Q5 && size >= mean >> 1) {
        const uint16_t most = past < 0 ? unlit_q5 : before;
        if (size >= most - (most >> 4)) {
            settle(channel, unlit_q5);
            channel->flags |= SG_LIGHT_STARVED;
            return (int16_t)unlit_q5;
        }
    }
    const int32_t meant = (int32_t)unlit_q5 + by_q8(past, light->before_q8)
                        - by_q8(long_past, light->earlier_q8);
    return meant < 0 ? 0 : meant > INT16_MAX ? INT16_MAX : (int16_t)meant;
}

void sg_light_begin(struct sg_light_channel *channel, uint16_t exposure_cycles, uint16_t unlit_code)
{
    channel->exposure_cycles = exposure_cycles;
    channel->unit_q12 = (int16_t)(UNIT_Q12 - sg_light_log2_q12(exposure_cycles == 0 ? 1 : exposure_cycles));
    channel->cycles = 0;
    settle(channel, sg_light_q5(unlit_code));
}

int16_t sg_light_meant(struct sg_light *light, const struct sg_reading *reading, uint8_t i,
                       struct sg_light_pass *pass)
{
    struct sg_light_channel *channel = &light->channel[i];
    const uint16_t lit = reading->lit_code[i], unlit = reading->unlit_code[i];
    uint16_t unlit_q5 = sg_light_q5(unlit);
    if (channel->exposure_cycles != reading->exposure_cycles[i])
        sg_light_begin(channel, reading->exposure_cycles[i], unlit);
    if (channel->cycles == 0)
        channel->flags = 0;
    // Full itself, or nobody knows what the sample capacitor brought.
    if (lit >= SG_LIGHT_SATURATED_CODE || unlit >= SG_LIGHT_SATURATED_CODE
        || pass->lit_code >= SG_LIGHT_SATURATED_CODE || pass->unlit_code >= SG_LIGHT_SATURATED_CODE)
        channel->flags |= SG_LIGHT_SATURATED;
    const uint8_t late_lit = reading->late_lit_cycles[i], late_unlit = reading->late_unlit_cycles[i];
    // A neighbour released late brought less than usual.
    if (pass->unlit_more_q5)
        unlit_q5 = (uint16_t)(unlit_q5 + as_code(high(pass->unlit_more_q5, SHARE_Q16), unlit_q5));
    int16_t missed = 0, more = 0;
    if (pass->missed_q5)
        missed = (int16_t)-high(pass->missed_q5, SHARE_Q16);
    if (late_lit)
        missed = (int16_t)(missed + missed_q5(channel, lit, pass->lit_code, late_lit));
    if (late_unlit) {
        more = missed_q5(channel, unlit, pass->unlit_code, late_unlit);
        more = as_code(more, unlit_q5);
        unlit_q5 = (uint16_t)(unlit_q5 + more);
    }
    pass->missed_q5 = missed;
    pass->unlit_more_q5 = more;
    pass->lit_code = lit;
    pass->unlit_code = unlit;
    return ambient_q5(light, channel, unlit_q5, pass);
}

uint16_t sg_light_log2_q12(uint16_t x)
{
    uint8_t octave = 15;
    if (!(x & 0xFF00U)) {
        x = (uint16_t)(x << 8);
        octave = 7;
    }
    for (; !(x & 0x8000U); octave--)
        x = (uint16_t)(x << 1);
    // 1.xxxxxx|yyyyyyyyy: six bits choose the entry, eight more interpolate. Neighbours differ by at most 92.
    const uint16_t *entry = &sg_light_log2_table[(uint8_t)(x >> 9) & 63U];
    const uint8_t fraction = (uint8_t)(x >> 1);
    const uint16_t here = sg_rom_word(entry);
    const uint8_t rise = (uint8_t)(sg_rom_word(entry + 1) - here);
    return (uint16_t)(((uint16_t)octave << 12) + here + (uint8_t)((uint16_t)(rise * fraction + 128U) >> 8));
}

uint16_t sg_light_feature(struct sg_light_channel *channel)
{
    const uint8_t n = channel->cycles;
    const int32_t least = (int32_t)(uint16_t)(SG_LIGHT_STARVED_CODES * SG_LIGHT_UNIT * n);
    int32_t sum = channel->sum_q5, value = channel->unit_q12;
    if (sum < least) {
        sum = least;
        channel->flags |= SG_LIGHT_STARVED;
    }
    for (; sum > UINT16_MAX; sum >>= 1)
        value += 4096;
    value += (int32_t)sg_light_log2_q12((uint16_t)sum) - sg_light_log2_q12(n);
    return value < 0 ? 0 : value > UINT16_MAX ? UINT16_MAX : (uint16_t)value;
}

// What is rare at the start of a cycle: earlier codes that are none.
void sg_light_prepare(struct sg_light *light, const struct sg_reading *reading)
{
    for (uint8_t i = 0; i < SG_LIGHT_CHANNELS; i++) {
        struct sg_light_channel *channel = &light->channel[i];
        channel->unlit_q5[0] = channel->mean_q5;
        if (light->state & SG_LIGHT_GAP)
            channel->unlit_q5[0] = sg_light_q5(reading->unlit_code[i]);
        channel->unlit_q5[1] = channel->unlit_q5[0];
    }
    light->state &= SG_LIGHT_MOVES;
}

#ifndef SG_LIGHT_ASSEMBLY
// Charge between an unlit and a lit code, less their difference D. With X the mean of both over 1024 and d
// half their difference:  D (2 k1 X + 3 k2 (X^2 + d^2 / 3) + curve X / 512).
//   slope_q16   2 k1 + curve / 512
// 65536 X is the sum of both codes. In the small term its upper byte does, which is half a step of 1/256 too
// small on average: SG_LIGHT_SLOPE_Q16 makes that up. d^2 is the
// upper byte of (256 d)^2 over 256.
// Overflow   the bracket is within -0.25 .. 0.44 in Q0.16.
static int16_t bend_q5(uint16_t lit_q5, uint16_t unlit_q5, int16_t slope_q16)
{
    const int16_t difference = (int16_t)(lit_q5 - unlit_q5);
    const uint16_t sum = (uint16_t)(lit_q5 + unlit_q5);
    const uint8_t x = (uint8_t)(sum >> 8);
    const int8_t d = (int8_t)(difference >> 8);
    const int16_t slope = (int16_t)(slope_q16 + (int16_t)(x * SG_LIGHT_CUBIC));
    const int16_t square = (int16_t)(((uint16_t)(d * d) >> 8) << SG_LIGHT_SQUARE_SHIFT);
    const int16_t bracket = (int16_t)((int16_t)(((int32_t)slope * sum) >> 16) + square);
    return high(difference, bracket);
}

void sg_light_add(struct sg_light *light, const struct sg_reading *reading)
{
    struct sg_light_pass pass = { .missed_q5 = (int16_t)sg_light_q5(reading->held_code),
                                  .lit_code = reading->held_code };
    if (light->state & (SG_LIGHT_GAP | SG_LIGHT_BEGINS))
        sg_light_prepare(light, reading);
    const uint8_t *order = sg_light_order[light->wiring];
    int16_t brought_q5 = 0;
    for (uint8_t k = 0; k < SG_LIGHT_CHANNELS; k++) {
        const uint8_t i = sg_rom_byte(order + k, SG_ROM_FLASH);
        struct sg_light_channel *channel = &light->channel[i];
        const uint16_t meant_q5 = (uint16_t)sg_light_meant(light, reading, i, &pass);
        // Lit emitters lift the rail by 24 mV (0.3 ohm, 4 emitters of 20 mA), and a junction biased more
        // holds less: 0.21 to 0.24 % of the code, here 2^-9 + 2^-12. Emitters of photodiodes do not flow
        // through it.
        const uint16_t lit_q5 = sg_light_q5(reading->lit_code[i]);
        const uint8_t lit_high = (uint8_t)(lit_q5 >> 8);
        const uint16_t rail = light->wiring ? 0 : (uint16_t)((lit_high >> 1) + (lit_high >> 4));
        const int16_t difference = (int16_t)(lit_q5 - rail - meant_q5);
        const int16_t bend = bend_q5((uint16_t)(lit_q5 - rail), meant_q5, channel->slope_q16);
        const int16_t brought = high(brought_q5, SHARE_Q16);
        if (channel->cycles != UINT8_MAX) {
            const int32_t signal = (int32_t)difference + (int16_t)(bend + pass.missed_q5 - brought);
            channel->sum_q5 = channel->cycles == 0 ? signal : channel->sum_q5 + signal;
            channel->cycles++;
        }
        pass.missed_q5 = 0;
        brought_q5 = (int16_t)(difference + (int16_t)rail);
        if (k & 1U) {
            brought_q5 = pass.unlit_more_q5 = 0;
            pass.lit_code = pass.unlit_code = 0;
        }
    }
    // Six channels depart together, noise does not.
    uint8_t size = SG_LIGHT_DEPARTURE_MOST;
    if (pass.departure > -SG_LIGHT_DEPARTURE_MOST && pass.departure < SG_LIGHT_DEPARTURE_MOST)
        size = (uint8_t)(pass.departure < 0 ? -pass.departure : pass.departure);
    uint16_t moving = (uint16_t)(light->moving - (light->moving >> 4) + (uint16_t)(size * size));
    if (moving > SG_LIGHT_MOVING_MOST)
        moving = SG_LIGHT_MOVING_MOST;
    light->moving = moving;
    if (moving < SG_LIGHT_RESTING_BELOW)
        light->state &= (uint8_t)~SG_LIGHT_MOVES;
    else if (moving >= SG_LIGHT_MOVING_FROM && !(light->state & SG_LIGHT_MOVES))
        light->state |= SG_LIGHT_MOVES | SG_LIGHT_BEGINS;
    light->dither = (light->dither + 7U) & 15U;
}

uint8_t sg_light_features(struct sg_light *light, uint16_t feature[6])
{
    uint8_t flags = 0;
    for (uint8_t i = 0; i < SG_LIGHT_CHANNELS; i++) {
        struct sg_light_channel *channel = &light->channel[i];
        if (channel->cycles != 0) {
            feature[i] = sg_light_feature(channel);
            channel->cycles = 0;
        }
        flags |= channel->flags;
    }
    return flags;
}
#endif
