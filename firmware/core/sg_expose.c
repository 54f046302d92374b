// SPDX-License-Identifier: Apache-2.0
#include "sg_expose.h"

#include "sg_expose_table.h"
#include "sg_rom.h"

// Value between an entry of a rising table and the next, Q4.12, rounded half up. fraction < 2^bits <= 512 and
// neighbours differ by at most 92: the product fits 16 bits unsigned.
static inline uint16_t interpolated_q12(const uint16_t *entry, uint16_t fraction, uint8_t bits)
{
    const uint16_t here = sg_rom_word(entry);
    const uint16_t rise = (uint16_t)(sg_rom_word(entry + 1) - here);
    return (uint16_t)(here + ((uint16_t)((uint16_t)(rise * fraction) + (1U << (bits - 1U))) >> bits));
}

// 4096 * log2(x), x in 1..32767.
static uint16_t log2_q12(uint16_t x)
{
    uint8_t octave = 15;
    while (!(x & 0x8000U)) {
        x = (uint16_t)(x << 1);
        octave--;
    }
    // 1.xxxxxx|yyyyyyyyy: six bits choose the entry, nine interpolate
    const uint16_t fraction = interpolated_q12(&log2_mantissa_q12[(x >> 9) & 63U], x & 511U, 9);
    return (uint16_t)((uint16_t)(octave << 12) + fraction);
}

// log2 of the collected charge, Q4.12, on the scale of GOAL_Q12; minus log2 of the cycles it is the feature.
static int32_t log2_charge_q12(uint16_t drop_q2)
{
    const uint16_t *entry = &log2_capacitance_q12[drop_q2 >> 6];
    uint16_t capacitance_q12;
    if (drop_q2 < 4096U)
        capacitance_q12 = interpolated_q12(entry, drop_q2 & 63U, 6);
    else
        capacitance_q12 = sg_rom_word(entry);   // reached exactly: nothing follows it
    return (int32_t)capacitance_q12 + log2_q12(drop_q2);
}

static uint16_t drop_of(uint16_t code_q2)
{
    return code_q2 > 4092U ? 4U : (uint16_t)(4096U - code_q2);
}

uint8_t sg_expose_feature(uint16_t code_q2, uint16_t exposure_cycles, uint16_t *feature)
{
    const uint16_t drop_q2 = drop_of(code_q2);
    if (exposure_cycles < 1U)
        exposure_cycles = 1U;
    if (exposure_cycles > 32767U)
        exposure_cycles = 32767U;
    int32_t value = log2_charge_q12(drop_q2) - log2_q12(exposure_cycles);
    if (value < 0)
        value = 0;
    if (value > UINT16_MAX)
        value = UINT16_MAX;
    *feature = (uint16_t)value;
    if (code_q2 <= SG_EXPOSE_SATURATED_Q2)
        return SG_EXPOSE_SATURATED;
    return drop_q2 < SG_EXPOSE_STARVED_Q2 ? SG_EXPOSE_STARVED : 0;
}

static uint16_t clipped(uint32_t exposure_cycles)
{
    if (exposure_cycles < SG_EXPOSE_MIN_CYCLES)
        return SG_EXPOSE_MIN_CYCLES;
    if (exposure_cycles > SG_EXPOSE_MAX_CYCLES)
        return SG_EXPOSE_MAX_CYCLES;
    return (uint16_t)exposure_cycles;
}

uint16_t sg_expose_from_us_q2(uint16_t exposure_us_q2)
{
    return clipped((uint32_t)exposure_us_q2 * ((uint16_t)SG_EXPOSE_CYCLES_PER_US >> 2));
}

uint16_t sg_expose_to_us_q2(uint16_t exposure_cycles)
{
    return (uint16_t)(exposure_cycles >> 2);
}

void sg_expose_start(struct sg_expose_led *led, uint16_t exposure_cycles)
{
    led->exposure_cycles = clipped(exposure_cycles);
    led->tracking = 0;
    led->streak = 0;
}

// exposure * 2^(octaves_q12 / 4096), clipped. 2^f = 1 + f (0.66 + 0.34 f) is within 0.3 % for f in 0..1.
static uint16_t stretched(uint16_t exposure_cycles, int32_t octaves_q12)
{
    const int8_t whole = (int8_t)(octaves_q12 >> 12);
    const uint32_t f = (uint32_t)octaves_q12 & 4095U;
    const uint32_t factor_q12 = 4096U + ((f * (2703U + ((1393U * f) >> 12))) >> 12);
    const uint32_t base = (exposure_cycles * factor_q12) >> 12;  // 13 bits by 13 bits, clipped exposures only
    if (whole < 0)
        return whole < -14 ? clipped(0) : clipped(base >> -whole);
    return whole > 13 ? clipped(SG_EXPOSE_MAX_CYCLES) : clipped(base << whole);
}

// The exposure that would have met the goal, from one sample.
static uint16_t corrected(uint16_t code_q2, uint16_t exposure_cycles)
{
    if (code_q2 <= SG_EXPOSE_SATURATED_Q2)
        return clipped(exposure_cycles >> 2);
    const uint16_t drop_q2 = drop_of(code_q2);
    if (drop_q2 < SG_EXPOSE_STARVED_Q2)
        return clipped((uint32_t)exposure_cycles << 2);
    return stretched(exposure_cycles, GOAL_Q12 - log2_charge_q12(drop_q2));
}

// Has the sample, or the row of samples it belongs to, waited long enough to act?
static uint8_t lasting(struct sg_expose_led *led, uint16_t code_q2)
{
    if (code_q2 <= SG_EXPOSE_SATURATED_Q2)
        return 1;
    if (code_q2 < BRIGHT_CODE_Q2)
        led->streak = (int8_t)(led->streak > 0 ? led->streak + 1 : 1);
    else if (code_q2 > DIM_CODE_Q2)
        led->streak = (int8_t)(led->streak < 0 ? led->streak - 1 : -1);
    else
        led->streak = 0;
    return led->streak >= SG_EXPOSE_PATIENCE_BRIGHT || led->streak <= -SG_EXPOSE_PATIENCE_DIM;
}

uint8_t sg_expose_step(struct sg_expose_led *led, uint16_t code_q2, uint16_t exposure_cycles)
{
    if (led->tracking && !lasting(led, code_q2))
        return 0;
    led->streak = 0;

    const uint16_t old = led->exposure_cycles;
    const uint16_t then = clipped(exposure_cycles);
    const uint16_t now = corrected(code_q2, then);
    const uint8_t saturated = code_q2 <= SG_EXPOSE_SATURATED_Q2;
    const uint8_t starved = drop_of(code_q2) < SG_EXPOSE_STARVED_Q2;
    // A saturated or starved sample gives a direction, no measure: it may be older than a better correction.
    if ((saturated && now >= old) || (starved && now <= old)) {
        if (now == then)        // taken at the limit itself: there is no better
            led->tracking = 1;
        return 0;
    }
    const uint16_t change = now > old ? (uint16_t)(now - old) : (uint16_t)(old - now);
    led->tracking = !saturated && !starved && change <= (old >> 4);
    if (change <= (old >> 4))
        return 0;
    led->exposure_cycles = now;
    return 1;
}
