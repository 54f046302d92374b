// SPDX-License-Identifier: Apache-2.0
// How fast: from the settings, the model and the streams to the timing of sensing, so that the work of every
// frame is done before the next one's readings are complete.
#include "app.h"

#include <string.h>

// Cycles of a 16 MHz AVR, measured (tests/budget.csv; tests/target/test_settings.py holds them to it).
enum app_rate_cost {
    COST_SENSE = 3000,          // interrupts of one sensing cycle
    COST_CYCLE = 1700,          // taking a cycle's readings, exposure and health of one channel, the loop
    COST_FRAME = 2500,          // features, flags, and what a frame needs besides
    COST_MODEL = 2770,          // inference: with any model, and per vector
    COST_VECTOR = 150,
    COST_PACKET = 700,          // a stream's packet: encoding and the UART's interrupts, and per byte
    COST_BYTE = 105,
    COST_REQUEST = 500,         // what a request may take of a frame
    COST_ROOMY = 8000,          // the costliest of them
    BIT_CYCLES = 16,            // on the line at 1 Mbaud
    PACKET_BYTES = SG_WIRE_FRAME_MAX - SG_WIRE_BODY_MAX,
};

#define CYCLES_PER_S (1000000UL * SG_EXPOSE_CYCLES_PER_US)

// Of one sensing cycle: its 18 conversions, each as soon as the converter can and as late as the timer reaches.
enum { CONVERSIONS = 18, PERIOD_LEAST = CONVERSIONS * 888, PERIOD_MOST = CONVERSIONS * 1777 };

// By subtraction: this chip does not divide, and nobody waits.
SELDOM static uint32_t divided(uint32_t n, uint32_t by)
{
    uint32_t quotient = 0, rest = 0;
    for (uint8_t i = 0; i < 32; i++) {
        rest = (rest << 1) | (n >> 31);
        n <<= 1;
        quotient <<= 1;
        if (rest >= by) {
            rest -= by;
            quotient |= 1;
        }
    }
    return quotient;
}

// Down to a multiple of 18; exact below 32768.
SELDOM static uint16_t whole_slots(uint16_t cycles)
{
    return (uint16_t)(((uint32_t)cycles * 3641U) >> 16) * CONVERSIONS;
}

SELDOM static uint8_t stream_bytes(void)
{
    uint8_t n = 0;
    if (app.stream & SG_STREAM_GAZE)
        n += sizeof(struct sg_gaze) + PACKET_BYTES;
    if (app.stream & SG_STREAM_RAW)
        n += sizeof(struct sg_raw) + PACKET_BYTES;
    if (app.stream & SG_STREAM_COUNTS)
        n += sizeof(struct sg_counts) + PACKET_BYTES;
    return n;
}

SELDOM static uint16_t infer_cycles(void)
{
    const struct sg_model_view *model = app_model();
    return model ? COST_MODEL + (uint16_t)COST_VECTOR * model->vectors : 0;
}

// Cycles between the last readings of a frame and the end of all work that this brings, interrupts included.
SELDOM static uint32_t work_cycles(void)
{
    uint32_t cycles = (uint32_t)(COST_SENSE + COST_CYCLE + COST_FRAME + COST_REQUEST) + infer_cycles();
    for (uint8_t bit = SG_STREAM_RAW; bit <= SG_STREAM_COUNTS; bit <<= 1) {
        if (app.stream & bit)
            cycles += COST_PACKET;
    }
    return cycles + (uint16_t)stream_bytes() * (uint16_t)COST_BYTE;
}

SELDOM static uint8_t repeats_shift(void)
{
    uint8_t shift = 0;
    while (app_live.repeats >> 1 >> shift)
        shift++;
    return shift;
}

// Frame after frame at least this far apart, cycles; *period is then one sensing cycle.
SELDOM static uint32_t shortest(uint16_t *period)
{
    const uint8_t shift = repeats_shift();
    const uint32_t work = work_cycles();
    // A cycle must last as long as the work of the frame before; what is above its longest is a gap.
    uint32_t last = work < PERIOD_LEAST ? PERIOD_LEAST : work;
    *period = PERIOD_LEAST;
    if (app_live.power == SG_POWER_NORMAL && shift)
        *period = last > PERIOD_MOST ? PERIOD_MOST : whole_slots((uint16_t)last + CONVERSIONS - 1);
    if (last < *period)
        last = *period;
    uint32_t frame = ((uint32_t)*period << shift) - *period + last;
    // The line needs its time as well, and answers an eighth of it.
    const uint32_t line = (uint32_t)stream_bytes() * (app.slow_line ? 2 * 10 * BIT_CYCLES : 10 * BIT_CYCLES);
    if (frame < line + (line >> 3))
        frame = line + (line >> 3);
    return frame;
}

// The timing wanted.
SELDOM void app_rate_start(struct hal_timing *timing)
{
    const uint8_t shift = repeats_shift();
    memset(timing, 0, sizeof *timing);
    uint32_t frame = shortest(&timing->period_cycles);
    if (app_live.rate_hz) {
        const uint32_t wanted = divided(CYCLES_PER_S, app_live.rate_hz);
        if (frame < wanted)
            frame = wanted;
    }
    // Longer exposures instead of darkness.
    if (app_live.power == SG_POWER_NORMAL) {
        const uint32_t each = frame >> shift;
        timing->period_cycles = each > PERIOD_MOST ? PERIOD_MOST : whole_slots((uint16_t)each);
    }
    timing->frame_cycles = frame;
    timing->repeats = app_live.repeats;
    timing->wiring = app_live.wiring;
    timing->lights = app_live.lights;
    timing->probe = app.probe;
    timing->sleep = app_live.power == SG_POWER_LOW;
    // What is left of the time until the next frame's first cycle is complete.
    const uint32_t dark = frame - ((uint32_t)timing->period_cycles << shift);
    const uint32_t spare = dark + timing->period_cycles - work_cycles();
    app.pause = dark > PERIOD_LEAST / 64;
    app.infer_fits = !app.sensed || spare >= infer_cycles();
    app.roomy = !app.sensed || spare >= COST_ROOMY;
}

SELDOM void app_rate_renew(void)
{
    struct hal_timing timing;
    app_rate_start(&timing);
    app_sense_timing(&timing);
}

SELDOM int8_t app_settings(struct sg_settings *io)
{
    if (io->op > SG_SETTINGS_SET)
        return SG_E_ARG;
    if (io->op == SG_SETTINGS_SET) {
        // Frames of more than 65 ms do not fit their field; a gaze after every pair does not fit its time.
        if ((io->rate_hz && io->rate_hz < SG_WIRE_RATE_LEAST_HZ) || io->wiring > SG_WIRING_PHOTODIODES
            || io->power > SG_POWER_LOW || io->rolling || io->lights > 1 || !io->repeats
            || io->repeats > SG_LIGHT_REPEATS_MAX || (io->repeats & (io->repeats - 1)))
            return SG_E_ARG;
        app_live.rate_hz = io->rate_hz;
        app_live.repeats = io->repeats;
        app_live.wiring = io->wiring;
        app_live.power = io->power;
        app_live.lights = io->lights;
        app_live_changed();
        app_rate_renew();
    }
    const struct hal_timing *timing = app_timing();
    uint16_t period;
    uint32_t frame = timing->frame_cycles;
    if (!frame)
        frame = (uint32_t)timing->period_cycles << repeats_shift();
    io->rate_hz = (uint16_t)divided(CYCLES_PER_S, frame);
    io->rate_limit_hz = (uint16_t)divided(CYCLES_PER_S, shortest(&period));
    io->period_us = timing->period_cycles / SG_EXPOSE_CYCLES_PER_US;
    io->frame_period_us = (uint16_t)(frame / SG_EXPOSE_CYCLES_PER_US);
    io->repeats = app_live.repeats;
    io->wiring = app_live.wiring;
    io->power = app_live.power;
    io->rolling = 0;
    io->lights = app_live.lights;
    return SG_OK;
}
