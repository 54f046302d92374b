// SPDX-License-Identifier: Apache-2.0
// From exposures to lists of events for the sensing interrupt: one for each pair of sensors, run through lit
// and again unlit, three slots each: GND, a, b. What happens before a half's samples begins right after the
// sample before them, in the slot before its first.
//
// Samples are fixed, releases follow from the exposures, services have most of a slot to choose from: where a
// release is near, it comes first and the service after it. Only two releases of one half can be in each
// other's way; plan_clip() moves the second sensor's exposure then.
#include "port_sense.h"

#include <avr/pgmspace.h>
#include <string.h>

#define ONCE __attribute__((noinline))   // in flash

#pragma GCC optimize("Os")          // runs when an exposure changes

const uint8_t plan_place[2][HAL_CHANNELS] PROGMEM = {
    [SG_WIRING_LEDS] = { 5, 0, 1, 4, 2, 3 },
    [SG_WIRING_PHOTODIODES] = { 0, 3, 1, 4, 2, 5 },
};

struct plan sense_plan[2];

__attribute__((noinline)) uint8_t plan_channel(uint8_t wiring, uint8_t place)
{
    return pgm_read_byte(&plan_place[wiring != SG_WIRING_LEDS][place]);
}

static inline uint16_t clipped(uint16_t cycles, uint8_t least, uint16_t most)
{
    return cycles > most ? most : cycles < least ? least : cycles;
}

void plan_clip(uint16_t exposure_cycles[HAL_CHANNELS], uint8_t wiring, uint16_t slot_cycles)
{
    const uint16_t first_most = 2 * slot_cycles - EXPOSURE_LESS_CYCLES, most = first_most + slot_cycles;
    for (uint8_t place = 0; place < HAL_CHANNELS; place += 2) {
        uint16_t *const a = &exposure_cycles[plan_channel(wiring, place)];
        uint16_t *const b = &exposure_cycles[plan_channel(wiring, place + 1)];
        *a = clipped(*a, EXPOSURE_MIN_CYCLES, first_most);
        uint16_t cycles = clipped(*b, EXPOSURE_SECOND_MIN_CYCLES, most);
        const uint16_t same = *a + slot_cycles;     // with the release of the pair's first
        const int16_t apart = cycles - same;
        if (apart > -EXPOSURES_APART_CYCLES && apart < EXPOSURES_APART_CYCLES) {
            cycles = same;
            if (apart <= -EXPOSURES_APART_CYCLES / 2)
                cycles -= EXPOSURES_APART_CYCLES;
            if (apart >= EXPOSURES_APART_CYCLES / 2)
                cycles += EXPOSURES_APART_CYCLES;
            if (cycles > most)
                cycles = same;
        }
        *b = cycles;
    }
}

// The list being written. Times are cycles until the sample of the pair's second.
static uint8_t *to;
static uint8_t *word;                   // of the event before
static uint16_t match;                  // its compare match

static ONCE void put(uint8_t byte)
{
    *to++ = byte;
}

static ONCE void event(uint8_t kind, uint16_t at)
{
    const uint16_t delta = match - at;
    uint8_t *const before = word;
    match = at;
    word = to;
    before[0] = (uint8_t)delta;
    before[1] |= (uint8_t)(delta >> 8);
    put(0);
    put(kind);
}

static ONCE uint8_t bit(uint8_t i)
{
    return 1 << i;
}

static void pair(struct plan *plan, const struct hal_timing *timing, uint8_t lights, uint8_t phase,
                 uint8_t a, uint8_t b)
{
    const uint16_t slot = plan->slot_cycles;
    uint8_t bits = bit(a), more = bit(b);
    uint8_t admux[3] = { ADMUX_GROUND, ADMUX_CHANNEL_0 + a, ADMUX_CHANNEL_0 + b };
    uint8_t portc = PORTC_ALL & (uint8_t)~(bits | more), portd = PORTD_DARK;

    if (timing->wiring != SG_WIRING_LEDS) {
        portc = 0;
        if (timing->probe == phase || timing->probe >= HAL_CHANNELS)
            portd |= bit(FIRST_EMITTER + phase);
    } else if (timing->probe < HAL_CHANNELS) {
        // The only emitter is at 5 V when its turn comes: the converter is not to see that.
        portc = bit(timing->probe);
        if (bits == portc) {
            bits = 0;
            admux[1] = ADMUX_GROUND;
        }
        if (more == portc) {
            more = 0;
            admux[2] = ADMUX_GROUND;
        }
    }
    if (!lights) {
        portc = 0;
        portd = PORTD_DARK;
    }

    uint16_t release = plan->exposure_cycles[a] + slot, later = plan->exposure_cycles[b];
    if (release == later) {
        bits |= more;
        later = 0;                      // none
    } else if (later > release) {
        const uint16_t r = release;
        const uint8_t m = bits;
        release = later;
        later = r;
        bits = more;
        more = m;
    }

    // Cycles from setting the lights to the release, if the next release is one that does.
    uint8_t set = LIGHT_LEAD_CYCLES;
    uint16_t trigger = 3 * slot + SAMPLE_CYCLES;    // of the slot that the service is in
    uint16_t service = trigger - HOLD_AT;
    for (uint8_t k = 0;; k++) {
        uint8_t released = 0;
        while (release) {
            // A short exposure of the second: the first's is over, so its node may be held once more.
            const uint8_t lead = release < SHORT_CYCLES ? SHORT_LEAD_CYCLES : set;
            uint16_t at = release + (lead ? lead : RELEASE_LEAD_CYCLES);
            // A service right after a release costs no interrupt of its own; but lights go out in time, and
            // the result is read before the next.
            if (k == 0) {
                if (at + HOLD_CYCLES <= service)
                    break;
                if (set)
                    at = service;       // no time for holding first
            } else if (k != 3 && at + SPACING_CYCLES <= service && release + SERVICE_LATEST < trigger) {
                break;
            }
            event((lead ? EVENT_SET_RELEASE : EVENT_RELEASE) | EVENT_ALONE, at);
            if (lead) {
                put(portc);
                put(portd);
                put((uint8_t)(at - release - LEAD_LESS_CYCLES));
                set = 0;
            }
            put(PORTC_ALL & (uint8_t)~bits);
            // With the release, if the last sample has been taken long enough.
            released = release + WITH_RELEASE_CYCLES <= service;
            if (service > release - AFTER_RELEASE_CYCLES)
                service = release - AFTER_RELEASE_CYCLES;
            bits |= more;
            release = later;
            later = 0;
        }
        if (k == 3)
            break;
        uint8_t kind = EVENT_STORE;
        if (k == 0 && set)
            kind = EVENT_DARK_STORE;
        if (k == (phase == 0 ? 1 : 2))
            kind = phase == 0 ? EVENT_COMPLETE : EVENT_SERVICE;
        if (released)
            word[1] ^= EVENT_ALONE ^ kind;
        else
            event(kind, service);
        if (k == 0 && phase == 0)
            plan->first_mux = (uint8_t)(to - plan->event);
        put(admux[k]);
        trigger -= slot;
        service = trigger - SERVICE_AT;
    }
    // Here every list begins as well: nothing of this one changes any more.
    event(phase == 2 ? EVENT_LAST : EVENT_AGAIN, SAMPLE_CYCLES - HOLD_AT);
    put((uint8_t)(to - plan->event) - plan->begin[phase]);
}

static ONCE uint8_t equal(const struct plan *plan, const struct plan *from, uint8_t channel)
{
    return plan->exposure_cycles[channel] == from->exposure_cycles[channel];
}

void plan_write(struct plan *plan, const struct plan *from, const struct hal_timing *timing, uint8_t lights,
                uint8_t phase)
{
    const uint8_t a = plan_channel(timing->wiring, 2 * phase), b = plan_channel(timing->wiring, 2 * phase + 1);
    uint8_t *const begin = &plan->begin[phase];
    to = plan->event + begin[0];
    word = to;                          // the first event has none before it
    if (from && equal(plan, from, a) && equal(plan, from, b)) {
        const uint8_t *const other = &from->begin[phase];
        const uint8_t *at = from->event + other[0];
        const uint8_t n = other[1] - other[0];
        memcpy(to, at, n);
        to += n;
        if (phase == 0) {
            plan->first_mux = from->first_mux;
            plan->event[plan->first_mux] = ADMUX_GROUND;    // the other may ask for the supply just now
        }
    } else {
        pair(plan, timing, lights, phase, a, b);
    }
    begin[1] = (uint8_t)(to - plan->event);
}
