// SPDX-License-Identifier: Apache-2.0
// How fast: from the settings, the model and the streams to the timing of sensing, so that the work of every
// frame is done before the next one's readings are complete.
#include "app.h"

#include <string.h>

// The host foretells rates from the same numbers (choose.py): cut out like the core's declarations.
// cdef begin
// Cycles of a 16 MHz AVR, measured (tests/budget.csv; tests/target/test_settings.py holds them to it).
enum app_rate_cost {
    COST_SENSE = 4250,          // interrupts of one sensing cycle; they send the gaze as well
    COST_FRAME = 3950,          // readings, features, exposure and health of one channel, the loop
    COST_MODEL = 2780,          // inference: with any model, and per vector
    COST_VECTOR = 168,
    COST_RECENTRE = 640,        // a correction, if there is one
    COST_GAZE = 1030,           // its packet
    COST_RAW = 6500,            // and sending it
    COST_COUNTS = 8500,
    COST_REQUEST = 1400,         // a look at the line; a request makes a frame wait
};

// All of the following is in device microseconds, of 16 cycles, rounded so that nothing gets too short. A frame
// lasts 62500 us at most: 16 bits hold everything.
enum app_rate_us {
    CYCLES_PER_US = SG_EXPOSE_CYCLES_PER_US,
    PERIOD_LEAST_US = 999,      // 18 conversions as close as the converter can, 888 cycles,
    PERIOD_MOST_US = 1998,      // and as far apart as the port's timer reaches
    PAUSE_US = 4,               // dark for longer than this is a pause; shorter is not worth shorter exposures
    PAUSE_LEAST_US = 167,       // the port makes none shorter (3 slots), but by slots shorter than a conversion
    ROOMY_US = 500,             // the costliest request
    BYTE_US = 10,               // on the line at 1 Mbaud
    PACKET_BYTES = SG_WIRE_FRAME_MAX - SG_WIRE_BODY_MAX,
};
// cdef end

// Whole microseconds of so many cycles. One place, because a shift is a loop.
SELDOM static uint16_t us_of(uint16_t cycles)
{
    return cycles / CYCLES_PER_US;
}

// 10^6 / n, by subtraction: this chip does not divide, and nobody waits. n at least 16.
SELDOM static uint16_t million_over(uint16_t n)
{
    uint32_t rest = 1000000UL, part = (uint32_t)n << 16;
    uint16_t quotient = 0;
    for (uint8_t bit = 16; bit != 0; bit--) {
        part >>= 1;
        quotient <<= 1;
        if (rest >= part) {
            rest -= part;
            quotient |= 1;
        }
    }
    return quotient;
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

SELDOM static uint16_t infer_us(void)
{
    const struct sg_model_view *model = app_model();
    return model ? us_of((uint16_t)COST_MODEL + (uint16_t)COST_VECTOR * model->vectors) + 1 : 0;
}

// Between the last readings of a frame and the end of all work that this brings, interrupts included.
SELDOM static uint16_t work_us(void)
{
    uint16_t cycles = COST_SENSE + COST_FRAME + COST_REQUEST;
    if (app_recentre())
        cycles += COST_RECENTRE;
    if (app.stream & SG_STREAM_GAZE)
        cycles += COST_GAZE;
    if (app.stream & SG_STREAM_RAW)
        cycles += COST_RAW;
    if (app.stream & SG_STREAM_COUNTS)
        cycles += COST_COUNTS;
    return us_of(cycles) + 1 + infer_us();
}

// n * by; at most 16 * 1998 and no frame's time more.
SELDOM static uint16_t times(uint16_t n, uint8_t by)
{
    return n * by;
}

// Frame after frame at least this far apart; *period_us is then one sensing cycle.
SELDOM static uint16_t shortest(uint16_t *period_us)
{
    uint16_t period = PERIOD_LEAST_US, last = work_us();
    if (last < period)
        last = period;
    // Cycles as long as the work of the frame before; what is above the longest is a gap.
    if (app_live.power == SG_POWER_NORMAL)
        period = last < PERIOD_MOST_US ? last : PERIOD_MOST_US;
    *period_us = period;
    const uint16_t frame = times(period, app_live.repeats - 1) + last;
    // The line needs its time as well, and answers an eighth of it.
    uint16_t line = stream_bytes() * BYTE_US;
    if (app.slow_line)
        line <<= 1;
    line += line >> 3;
    return frame < line ? line : frame;
}

// The timing wanted.
SELDOM void app_rate_start(struct hal_timing *timing)
{
    uint16_t period, frame = shortest(&period);
    uint8_t repeats = app_live.repeats;
    if (app_live.rate_hz) {
        const uint16_t wanted = million_over(app_live.rate_hz);
        if (frame < wanted)
            frame = wanted;
    }
    // Cycles without a gap follow ambient light that flickers: as many as there is time for, then longer ones.
    uint16_t sensing = times(period, repeats);
    if (app_live.power == SG_POWER_NORMAL) {
        for (; repeats < SG_LIGHT_REPEATS_MAX && sensing + period <= frame; sensing += period)
            repeats++;
    }
    if (app_live.power == SG_POWER_NORMAL || (uint16_t)(frame - sensing) < PAUSE_LEAST_US) {
        for (; period < PERIOD_MOST_US && sensing + repeats <= frame; sensing += repeats)
            period++;
    }
    uint16_t dark = frame - sensing;
    app.pause = dark > (uint16_t)(PAUSE_US + repeats);
    if (!app.pause) {
        frame = sensing;
        dark = 0;
    }
    memset(timing, 0, sizeof *timing);
    timing->period_cycles = period * CYCLES_PER_US;
    timing->frame_cycles = (uint32_t)frame * CYCLES_PER_US;
    timing->repeats = repeats;
    timing->wiring = app_live.wiring;
    timing->lights = app_live.lights;
    timing->probe = app.probe;
    timing->sleep = app_live.power;     // enum sg_power: 1 is low
    // What is left of the time until the next frame's first cycle is complete.
    dark += period;
    const uint16_t work = work_us();        // in low power maybe a little more than there is
    const uint16_t spare = !app.sensed ? UINT16_MAX : dark > work ? dark - work : 0;
    // The last sample takes a slot of 18 to arrive: a period / 16 - 6, within 1 us of it for the shortest.
    app.busy_us = dark + us_of(period) - 6 + COST_REQUEST / CYCLES_PER_US;
    app.infer_fits = spare >= infer_us();
    app.roomy = spare >= ROOMY_US;
}

SELDOM void app_rate_renew(void)
{
    struct hal_timing timing;
    app_rate_start(&timing);
    app_sense_timing(&timing);
}

uint16_t app_frame_us(void)
{
    const struct hal_timing *timing = app_timing();
    if (!timing->frame_cycles)
        return (uint16_t)((uint32_t)timing->period_cycles * timing->repeats / CYCLES_PER_US);
    return (uint16_t)(timing->frame_cycles / CYCLES_PER_US);
}

SELDOM __attribute__((noclone)) int8_t app_settings(struct sg_settings *io)
{
    if (io->op > SG_SETTINGS_SET)
        return SG_E_ARG;
    if (io->op == SG_SETTINGS_SET) {
        const uint8_t less = (uint8_t)(io->repeats - 1);    // 255: none
        // Frames of more than 65 ms do not fit their field; a gaze after every pair does not fit its time.
        if ((io->rate_hz && io->rate_hz < SG_WIRE_RATE_LEAST_HZ) || io->wiring > SG_WIRING_PHOTODIODES
            || io->power > SG_POWER_LOW || io->rolling || io->lights > 1 || less >= SG_LIGHT_REPEATS_MAX
            || (io->repeats & less))
            return SG_E_ARG;
        app_live.rate_hz = io->rate_hz;
        app_live.repeats = io->repeats;
        app_live.wiring = io->wiring;
        app_live.power = io->power;
        app_live.lights = io->lights;
        app_live_changed();
        app_rate_renew();
    }
    io->frame_period_us = app_frame_us();
    io->rate_hz = app_live.rate_hz;
    io->rate_limit_hz = million_over(shortest(&io->period_us));
    io->period_us = us_of(app_timing()->period_cycles);
    io->repeats = app_live.repeats;
    io->wiring = app_live.wiring;
    io->power = app_live.power;
    io->rolling = 0;
    io->lights = app_live.lights;
    return SG_OK;
}
