// SPDX-License-Identifier: Apache-2.0
#include "sg_expose.h"

#define ONCE __attribute__((noinline))   // in flash

enum {
    CHANNELS = 6,
    GOAL_Q2 = SG_EXPOSE_GOAL_CODES >> 2,    // codes / 4
    BRIGHT_Q2 = SG_EXPOSE_BRIGHT_CODE >> 2,
    RISEN_Q2 = 12,              // less than that fits above the goal
    FREED_Q2 = 58,              // a quarter of the range: worth a longer exposure
    WORTH_Q2 = 150,             // a load below it is, if it lasts
    DIM_Q2 = 40,                // and one below this, a sixth of the goal, soon
    FALL_CYCLES = 3,            // the dark of a lamp that flickers to nothing at 100 Hz is shorter
    LOAD_LEAST = 8,
    FALL_LEAST_Q2 = 8,          // of a peak, below which a fall says nothing
    CAUTION_MOST = 6,
    DROWNED_LEAST = 255,        // a channel that is full for ever is as short as it can be
    LEAST_MOST = 1024,          // a port that takes more instead has other reasons
    WATCH_LOOKS = 5,            // 30 ms: five phases of a period of 10 ms
};

// Is a larger than b by more than this?
static uint8_t above(uint8_t a, uint8_t b, uint8_t by)
{
    return a > b && (uint8_t)(a - b) > by;
}

static uint16_t clipped(uint16_t cycles, uint16_t most)
{
    if (cycles > most)
        cycles = most;
    return cycles < SG_EXPOSE_MIN_CYCLES ? SG_EXPOSE_MIN_CYCLES : cycles;
}

uint16_t sg_expose_from_us_q4(uint16_t exposure_us_q4)
{
    return clipped(exposure_us_q4, SG_EXPOSE_MAX_CYCLES);
}

void sg_expose_start(struct sg_expose *expose, const uint16_t exposure_cycles[6],
                     const uint16_t most_cycles[6])
{
    *expose = (struct sg_expose) { .acquiring = 1 };
    for (uint8_t i = 0; i < CHANNELS; i++) {
        struct sg_expose_led *led = &expose->led[i];
        led->most_cycles = clipped(most_cycles[i], SG_EXPOSE_MAX_CYCLES);
        led->exposure_cycles = clipped(exposure_cycles[i], led->most_cycles);
    }
}

void sg_expose_taken(struct sg_expose *expose, const uint16_t exposure_cycles[6])
{
    for (uint8_t i = 0; i < CHANNELS; i++) {
        struct sg_expose_led *led = &expose->led[i];
        const uint16_t asked = led->exposure_cycles, taken = exposure_cycles[i];
        if (taken > asked + (asked >> 2) && taken <= LEAST_MOST)
            led->least_q3 = (uint8_t)(taken >> 3);
        led->exposure_cycles = taken;
    }
}

ONCE static uint16_t within(const struct sg_expose_led *led, uint16_t cycles)
{
    const uint16_t least = (uint16_t)(led->least_q3 << 3);
    return clipped(cycles < least ? least : cycles, led->most_cycles);
}

// 64 * SG_EXPOSE_GOAL_CODES / load, rounded down; a load of LOAD_LEAST or more.
static uint16_t stretch_q6(uint16_t load)
{
    // The first three bits are 0.
    uint16_t rest = SG_EXPOSE_GOAL_CODES * 64U >> 13, quotient = (uint16_t)(SG_EXPOSE_GOAL_CODES * 512UL);
    for (uint8_t bit = 0; bit < 13; bit++) {
        rest = (uint16_t)((uint16_t)(rest << 1) | (quotient >> 15));
        quotient = (uint16_t)(quotient << 1);
        if (rest >= load) {
            rest = (uint16_t)(rest - load);
            quotient |= 1U;
        }
    }
    return quotient;
}

// Exposure that would have met the goal with this much unlit and this much of ours, collected in then_cycles.
static uint16_t wanted(const struct sg_expose_led *led, uint16_t then_cycles, uint16_t unlit, int16_t signal)
{
    const int16_t load = (int16_t)(unlit + 2 * signal);
    const uint16_t stretch = stretch_q6(load < LOAD_LEAST ? LOAD_LEAST : (uint16_t)load);
    const uint32_t cycles = ((uint32_t)then_cycles * stretch) >> 6;
    const uint16_t whole = cycles > UINT16_MAX >> 3 ? UINT16_MAX >> 3 : (uint16_t)cycles;
    return within(led, (uint16_t)(whole - ((uint16_t)(whole * led->caution) >> 3)));
}

// Take an exposure. Returns 1 if it is another one.
ONCE static uint8_t change(struct sg_expose_led *led, uint16_t exposure_cycles, uint8_t stage)
{
    led->stage = stage;
    led->streak = 0;
    if (exposure_cycles == led->exposure_cycles)
        return 0;
    led->exposure_cycles = exposure_cycles;
    led->unlit_peak = 0;
    led->signal_peak = UINT8_MAX;       // what was the brightest is not known: wait for the next patience
    return 1;
}

// A full sample gives a direction, mostly no measure.
static uint8_t full(struct sg_expose_led *led, uint16_t lit, uint16_t unlit)
{
    const uint8_t settled = led->stage == SG_EXPOSE_TRACK;
    // Gaze or lids: no more than is needed.
    const uint8_t ours = settled && !above((uint8_t)(unlit >> 2), led->unlit_then, RISEN_Q2);
    const uint8_t shift = unlit >= SG_EXPOSE_SATURATED_CODE ? 4 : ours ? 1 : 3;
    uint16_t now = within(led, led->exposure_cycles >> shift);
    if (now >= led->exposure_cycles)
        return 0;
    uint8_t stage = ours ? SG_EXPOSE_VERIFY : SG_EXPOSE_ACQUIRE;
    if (!settled && led->stage != SG_EXPOSE_ACQUIRE) {
        if (led->caution)
            stage = SG_EXPOSE_WATCH;
        if (led->caution < CAUTION_MOST)
            led->caution++;
        // A crest on its way up: what its unlit code says and half more, so that the next ones fit. To start
        // over would choose in a trough again.
        if (unlit < SG_EXPOSE_SATURATED_CODE) {
            now = wanted(led, led->exposure_cycles, (uint16_t)(unlit + (unlit >> 1)), (int16_t)(lit - unlit));
            stage = SG_EXPOSE_VERIFY;
        }
    }
    return change(led, now, stage);
}

// A sample that decides at once. Returns 1 if the exposure changed.
static uint8_t acquire(struct sg_expose_led *led, uint16_t lit, uint16_t unlit, uint8_t late_cycles)
{
    // Twice, as the goal has the lit code, which may be less than the unlit one for it.
    const uint16_t then = (uint16_t)(led->exposure_cycles - 2U * late_cycles);
    if (late_cycles > led->exposure_cycles >> 2)
        return 0;
    const uint16_t now = wanted(led, then, unlit, (int16_t)(lit - unlit));
    if (now < led->exposure_cycles - (led->exposure_cycles >> 4)
        || now > led->exposure_cycles + (led->exposure_cycles >> 2))
        return change(led, now, (uint8_t)(led->stage + 1U));
    led->stage = SG_EXPOSE_VERIFY;
    return 0;
}

// An exposure for the ambient light of late and this signal, / 4.
static uint8_t choose(struct sg_expose_led *led, uint8_t signal_q2)
{
    const uint16_t now = wanted(led, led->exposure_cycles, (uint16_t)(led->unlit_peak << 2),
                                (int16_t)(signal_q2 << 2));
    return change(led, now, SG_EXPOSE_VERIFY);
}

// The exposure in force, looked at once a round. Returns 1 if it changed.
static uint8_t look(const struct sg_expose *expose, struct sg_expose_led *led, uint8_t bright, uint16_t lit,
                    uint16_t unlit)
{
    const uint8_t unlit_q2 = (uint8_t)(unlit >> 2);
    const uint8_t signal_q2 = lit > unlit ? (uint8_t)((uint16_t)(lit - unlit) >> 2) : 0;
    if (unlit_q2 >= led->unlit_peak)
        led->unlit_peak = unlit_q2;
    else
        led->unlit_peak = (uint8_t)(led->unlit_peak - ((uint8_t)(led->unlit_peak - unlit_q2 + 15U) >> 4));
    if (signal_q2 > led->signal_peak)
        led->signal_peak = signal_q2;
    if (led->stage == SG_EXPOSE_WATCH) {
        if (++led->streak < WATCH_LOOKS)
            return 0;
        return choose(led, signal_q2);
    }
    if (led->stage == SG_EXPOSE_VERIFY) {
        // What fits once may be the brightest there is.
        const uint8_t room = led->unlit_peak < GOAL_Q2 ? (uint8_t)(GOAL_Q2 - led->unlit_peak) >> 1 : 0;
        led->unlit_then = led->unlit_peak;
        led->signal_then = signal_q2 > room ? room : signal_q2;
    }
    if (led->stage < SG_EXPOSE_TRACK)
        led->stage++;
    const uint16_t load_then_q2 = (uint16_t)(led->unlit_peak + 2U * led->signal_then);
    const uint8_t longer = led->exposure_cycles < led->most_cycles;
    // What ambient light did, with the signal as it was when the exposure was chosen: gaze has no part in it.
    const uint8_t risen = load_then_q2 > BRIGHT_Q2 && above(led->unlit_peak, led->unlit_then, RISEN_Q2);
    const uint8_t freed = longer && above(led->unlit_then, led->unlit_peak, FREED_Q2);
    if (risen)
        return choose(led, led->signal_then);
    if (freed) {
        // The peak is still on its way down, and says too much.
        led->stage = SG_EXPOSE_WATCH;
        led->streak = 0;
        led->unlit_peak = 0;
        return 0;
    }
    // What our own light did must last.
    if (bright)
        led->streak = (int8_t)(led->streak > 0 ? led->streak + 1 : 1);
    else if (longer && (uint16_t)(led->unlit_peak + 2U * signal_q2) < DIM_Q2)
        led->streak = (int8_t)(led->streak < 0 ? led->streak - 1 : -1);
    else
        led->streak = 0;
    if (led->streak >= SG_EXPOSE_PATIENCE_BRIGHT)
        return change(led, within(led, (uint16_t)(led->exposure_cycles - (led->exposure_cycles >> 2))),
                      SG_EXPOSE_VERIFY);
    if (led->streak <= -SG_EXPOSE_PATIENCE_DIM)
        return choose(led, signal_q2);
    if (expose->rounds | expose->times)
        return 0;
    const uint8_t peak = led->signal_peak;
    led->signal_peak = signal_q2;
    if (longer && (uint16_t)(led->unlit_peak + 2U * peak) < WORTH_Q2)
        return choose(led, peak);
    return 0;
}

// Has the light around fallen away? Looks in consecutive cycles, each at another sensor, say so. Then all
// exposures are too short, and wait for no patience.
static void watch_ambient(struct sg_expose *expose, const struct sg_expose_led *led, uint16_t unlit)
{
    if (led->unlit_peak < FALL_LEAST_Q2 || unlit >> 2 >= led->unlit_peak >> 4) {
        expose->fallen = 0;
        return;
    }
    if (++expose->fallen < FALL_CYCLES)
        return;
    expose->fallen = 0;
    expose->acquiring = 1;
    for (uint8_t i = 0; i < CHANNELS; i++) {
        expose->led[i].caution = 0;
        if (expose->led[i].exposure_cycles < expose->led[i].most_cycles)
            expose->led[i].stage = SG_EXPOSE_ACQUIRE;
    }
}

// The channel sampled right before, whose code the sample capacitor brings along (sg_light.h); itself: none.
static uint8_t before(uint8_t i, uint8_t wiring)
{
    if (wiring)
        return i < 3 ? i : i - 3;
    return i == 0 || i == 3 || i == 4 ? 5 - i : i;
}

// A code without its share of the one before, s = 14 / 46, over the rest, for which the goal leaves room:
// (code - s before) / (1 - s).
ONCE static uint16_t own(uint16_t code, uint16_t code_before)
{
    const int16_t more = (int16_t)(code - code_before) >> 1;
    const int16_t alone = (int16_t)(code + more - (more >> 3));
    return alone < 0 ? 0 : (uint16_t)alone;
}

// A reading whose [0] are those of channel i: all of its arrays of words at once, by one address.
static const struct sg_reading *from_channel(const struct sg_reading *reading, uint8_t i)
{
    return (const struct sg_reading *)(const void *)((const uint16_t *)(const void *)reading + i);
}

// A channel in this cycle; what waits for its turn only if it is that. Returns 1 if its exposure changed.
static uint8_t visit(struct sg_expose *expose, const struct sg_reading *reading, uint8_t wiring, uint8_t i)
{
    struct sg_expose_led *led = &expose->led[i];
    const struct sg_reading *const own_reading = from_channel(reading, i);
    if (own_reading->exposure_cycles[0] != led->exposure_cycles)
        return 0;
    uint16_t lit = own_reading->lit_code[0], unlit = own_reading->unlit_code[0];
    // So much light came that the others will be full too: all change at once, for a change takes cycles.
    if (expose->drowned && led->stage == SG_EXPOSE_TRACK)
        unlit = SG_EXPOSE_SATURATED_CODE;
    if (lit >= SG_EXPOSE_SATURATED_CODE || unlit >= SG_EXPOSE_SATURATED_CODE)
        return full(led, lit, unlit);
    const uint8_t bright = lit > SG_EXPOSE_BRIGHT_CODE;
    const struct sg_reading *const first = from_channel(reading, before(i, wiring));
    lit = own(lit, first->lit_code[0]);
    unlit = own(unlit, first->unlit_code[0]);
    if (i == expose->next && led->stage > SG_EXPOSE_REFINE)
        watch_ambient(expose, led, unlit);
    if (led->stage <= SG_EXPOSE_REFINE)
        return acquire(led, lit, unlit, reading->late_lit_cycles[i]);
    return i == expose->next ? look(expose, led, bright, lit, unlit) : 0;
}

static void count_round(struct sg_expose *expose)
{
    if (++expose->rounds)
        return;
    if (++expose->times == SG_EXPOSE_PATIENCE_TIMES)
        expose->times = 0;
    for (uint8_t i = 0; i < CHANNELS; i++) {
        struct sg_expose_led *led = &expose->led[i];
        led->caution = (uint8_t)(led->caution - (led->caution != 0));
    }
}

// Bit 10 is set from SG_EXPOSE_SATURATED_CODE on.
static inline uint8_t raised(uint16_t code)
{
    return (uint8_t)((uint16_t)(code + (1024U - SG_EXPOSE_SATURATED_CODE)) >> 8);
}

uint8_t sg_expose_cycle(struct sg_expose *expose, const struct sg_reading *reading, uint8_t wiring)
{
    const uint16_t *code = reading->lit_code;
    const uint8_t any = raised(code[0]) | raised(code[1]) | raised(code[2])
                      | raised(code[3]) | raised(code[4]) | raised(code[5]);
    if (expose->next == 0) {
        expose->next = CHANNELS;
        count_round(expose);
    }
    expose->next--;
    expose->drowned = 0;
    uint8_t changed = 0;
    if (!(any & 4U) && !expose->acquiring) {
        changed = visit(expose, reading, wiring, expose->next);
        if (!changed && !expose->acquiring)
            return 0;
    }
    expose->acquiring = 0;
    uint8_t drowned = 0;
    for (uint8_t i = 0; i < CHANNELS; i++) {
        if (reading->unlit_code[i] >= SG_EXPOSE_SATURATED_CODE && reading->exposure_cycles[i] > DROWNED_LEAST)
            drowned = 1;
    }
    expose->drowned = drowned;
    for (uint8_t i = 0; i < CHANNELS; i++, code++) {
        const struct sg_expose_led *const led = &expose->led[i];
        // Most fit, and wait for their turn; while a change is on its way nothing says anything.
        if ((led->stage <= SG_EXPOSE_REFINE || *code >= SG_EXPOSE_SATURATED_CODE || drowned
             || i == expose->next)
            && reading->exposure_cycles[i] == led->exposure_cycles)
            changed |= visit(expose, reading, wiring, i);
        expose->acquiring |= led->stage <= SG_EXPOSE_REFINE;
    }
    return changed;
}
