// SPDX-License-Identifier: Apache-2.0
#include "sg_expose.h"

enum {
    CHANNELS = 6,
    BRIGHT_Q2 = SG_EXPOSE_BRIGHT_CODE >> 2, // codes / 4
    RISEN_Q2 = 12,              // less than that fits above the goal
    FREED_Q2 = 58,              // a quarter of the range: worth a longer exposure
    WORTH_Q2 = 160,             // a load below it is
    FALL_CYCLES = 3,            // the dark of a lamp that flickers to nothing at 100 Hz is shorter
    FALL_LEAST_Q2 = 8,          // of a peak, below which a fall says nothing
    CAUTION_MOST = 6,
    ACQUIRED_A_CYCLE = 2,
    LEAST_MOST = 1024,          // a port that takes more instead has other reasons
    SETTLED_LOOKS = 4,
    SOON_LOOKS = 5,             // 30 ms: a crest comes within 10 ms
    WATCH_LOOKS = 5,            // 30 ms: five phases of a period of 10 ms
    SLOW_ROUNDS = 170,          // 1 s at 6 ms a round
};

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
            led->least_q4 = (uint8_t)(taken >> 4);
        led->exposure_cycles = taken;
    }
}

static uint16_t within(const struct sg_expose_led *led, uint16_t cycles)
{
    const uint16_t least = (uint16_t)(led->least_q4 << 4);
    return clipped(cycles < least ? least : cycles, led->most_cycles);
}

// 64 * SG_EXPOSE_GOAL_CODES / load, rounded down; a load of 8 codes or more.
static uint16_t stretch_q6(uint16_t load)
{
    uint16_t rest = 0, quotient = (uint16_t)(SG_EXPOSE_GOAL_CODES << 6);
    if (load < 8)
        load = 8;
    for (uint8_t bit = 0; bit < 16; bit++) {
        rest = (uint16_t)((uint16_t)(rest << 1) | (quotient >> 15));
        quotient = (uint16_t)(quotient << 1);
        if (rest >= load) {
            rest = (uint16_t)(rest - load);
            quotient |= 1U;
        }
    }
    return quotient;
}

// Exposure that would have met the goal with this much unlit and this much of ours.
static uint16_t wanted(const struct sg_expose_led *led, uint16_t unlit, uint16_t signal)
{
    const uint16_t stretch = stretch_q6((uint16_t)(unlit + 2U * signal));
    const uint32_t cycles = ((uint32_t)led->exposure_cycles * stretch) >> 6;
    const uint16_t whole = cycles > UINT16_MAX >> 3 ? UINT16_MAX >> 3 : (uint16_t)cycles;
    return within(led, (uint16_t)(whole - ((uint16_t)(whole * led->caution) >> 3)));
}

// Take an exposure. Returns 1 if it is another one.
static uint8_t change(struct sg_expose_led *led, uint16_t exposure_cycles, uint8_t stage)
{
    led->stage = stage;
    led->streak = 0;
    led->age = 0;
    if (exposure_cycles == led->exposure_cycles)
        return 0;
    led->exposure_cycles = exposure_cycles;
    led->unlit_peak = 0;
    return 1;
}

// A full sample gives a direction, no measure: it may be older than a better correction.
static uint8_t full(struct sg_expose_led *led, uint16_t unlit, uint16_t then_cycles)
{
    const uint8_t shift = unlit >= SG_EXPOSE_SATURATED_CODE ? 4 : 3;
    const uint16_t now = within(led, then_cycles >> shift);
    if (now >= led->exposure_cycles)
        return 0;
    if (led->stage == SG_EXPOSE_ACQUIRE || led->age >= SOON_LOOKS)
        return change(led, now, SG_EXPOSE_ACQUIRE);
    const uint8_t again = led->caution != 0;
    if (led->caution < CAUTION_MOST)
        led->caution++;
    return change(led, now, again ? SG_EXPOSE_WATCH : SG_EXPOSE_ACQUIRE);
}

// A sample that decides at once. Returns 1 if the exposure changed.
static uint8_t acquire(struct sg_expose_led *led, uint16_t lit, uint16_t unlit)
{
    const uint16_t now = wanted(led, unlit, lit > unlit ? (uint16_t)(lit - unlit) : 0);
    if (now < led->exposure_cycles - (led->exposure_cycles >> 4)
        || now > led->exposure_cycles + (led->exposure_cycles >> 2))
        return change(led, now, (uint8_t)(led->stage + 1U));
    led->stage = SG_EXPOSE_VERIFY;
    return 0;
}

// An exposure for the ambient light of late and this signal, / 4.
static uint8_t choose(struct sg_expose_led *led, uint8_t signal_q2)
{
    const uint16_t now = wanted(led, (uint16_t)(led->unlit_peak << 2), (uint16_t)(signal_q2 << 2));
    return change(led, now, SG_EXPOSE_VERIFY);
}

// The exposure in force, looked at once a round. Returns 1 if it changed.
static uint8_t look(struct sg_expose_led *led, uint16_t lit, uint16_t unlit)
{
    const uint8_t unlit_q2 = (uint8_t)(unlit >> 2);
    const uint8_t signal_q2 = lit > unlit ? (uint8_t)((uint16_t)(lit - unlit) >> 2) : 0;
    if (unlit_q2 >= led->unlit_peak)
        led->unlit_peak = unlit_q2;
    else
        led->unlit_peak = (uint8_t)(led->unlit_peak - ((uint8_t)(led->unlit_peak - unlit_q2 + 15U) >> 4));
    if (led->age != UINT8_MAX)
        led->age++;
    if (led->stage == SG_EXPOSE_WATCH) {
        if (++led->streak < WATCH_LOOKS)
            return 0;
        return choose(led, signal_q2);
    }
    if (led->stage == SG_EXPOSE_VERIFY) {
        led->unlit_then = led->unlit_peak;
        led->signal_then = signal_q2;
        led->stage = SG_EXPOSE_TRACK;
    }
    const uint16_t load_then_q2 = (uint16_t)(led->unlit_peak + 2U * led->signal_then);
    const uint8_t longer = led->exposure_cycles < led->most_cycles;
    // What ambient light did, with the signal as it was when the exposure was chosen: gaze has no part in it.
    const uint8_t risen = load_then_q2 > BRIGHT_Q2 && led->unlit_peak > led->unlit_then + RISEN_Q2;
    const uint8_t freed = longer && led->unlit_then > led->unlit_peak + FREED_Q2;
    if (risen || freed)
        return choose(led, led->signal_then);
    // What our own light did must last.
    if (lit > SG_EXPOSE_BRIGHT_CODE)
        led->streak = (int8_t)(led->streak > 0 ? led->streak + 1 : 1);
    else if (longer && (uint16_t)(2U * signal_q2 + (signal_q2 >> 3)) < led->signal_then
             && (uint16_t)(led->unlit_peak + 2U * signal_q2) < WORTH_Q2)
        led->streak = (int8_t)(led->streak < 0 ? led->streak - 1 : -1);
    else
        led->streak = 0;
    if (led->streak < SG_EXPOSE_PATIENCE_BRIGHT && led->streak > -SG_EXPOSE_PATIENCE_DIM)
        return 0;
    return choose(led, signal_q2);
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

static uint8_t is_full(uint16_t lit, uint16_t unlit)
{
    return lit >= SG_EXPOSE_SATURATED_CODE || unlit >= SG_EXPOSE_SATURATED_CODE;
}

// What does not wait for its turn. Returns 1 if an exposure changed.
static uint8_t at_once(struct sg_expose *expose, const uint16_t lit_code[6], const uint16_t unlit_code[6],
                       const uint16_t exposure_cycles[6])
{
    uint8_t changed = 0, acquired = 0, left = 0, drowned = 0;
    for (uint8_t i = 0; i < CHANNELS; i++)
        drowned = (uint8_t)(drowned + (unlit_code[i] >= SG_EXPOSE_SATURATED_CODE));
    struct sg_expose_led *led = expose->led;
    for (uint8_t i = 0; i < CHANNELS; i++, led++) {
        const uint16_t lit = lit_code[i], unlit = unlit_code[i];
        // Two full without our light: so much of it came that the others will be, and all change at once.
        if (drowned >= 2 && exposure_cycles[i] == led->exposure_cycles && led->stage == SG_EXPOSE_TRACK
            && led->age >= SETTLED_LOOKS) {
            changed |= full(led, SG_EXPOSE_SATURATED_CODE, exposure_cycles[i]);
        } else if (is_full(lit, unlit)) {
            changed |= full(led, unlit, exposure_cycles[i]);
        } else if (led->stage <= SG_EXPOSE_REFINE && acquired < ACQUIRED_A_CYCLE
                   && exposure_cycles[i] == led->exposure_cycles) {
            changed |= acquire(led, lit, unlit);
            acquired++;
        }
        left |= led->stage <= SG_EXPOSE_REFINE;
    }
    expose->acquiring = left;
    return changed;
}

static void forget_caution(struct sg_expose *expose)
{
    expose->rounds = 0;
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

uint8_t sg_expose_cycle(struct sg_expose *expose, const uint16_t lit_code[6], const uint16_t unlit_code[6],
                        const uint16_t exposure_cycles[6])
{
    const uint8_t any = raised(lit_code[0]) | raised(lit_code[1]) | raised(lit_code[2]) | raised(lit_code[3])
                      | raised(lit_code[4]) | raised(lit_code[5]);
    uint8_t changed = 0;
    if ((any & 4U) || expose->acquiring)
        changed = at_once(expose, lit_code, unlit_code, exposure_cycles);

    uint8_t next = expose->next;
    if (next == 0) {
        next = CHANNELS;
        if (++expose->rounds >= SLOW_ROUNDS)
            forget_caution(expose);
    }
    next--;
    expose->next = next;
    struct sg_expose_led *led = &expose->led[next];
    const uint16_t lit = lit_code[next], unlit = unlit_code[next];
    if (led->stage < SG_EXPOSE_VERIFY || exposure_cycles[next] != led->exposure_cycles || is_full(lit, unlit))
        return changed;
    watch_ambient(expose, led, unlit);
    return changed | look(led, lit, unlit);
}
