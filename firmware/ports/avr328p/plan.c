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

// In registers while a list is written.
struct writer {
    uint8_t *to;
    uint8_t *word;                      // of the event before
    int16_t match;                      // its compare match, from the trigger of the half's first slot
};

// The list being written.
static struct writer writer;

static inline __attribute__((always_inline)) void event(struct writer *w, uint8_t kind, int16_t at)
{
    const uint16_t delta = at - w->match;
    w->word[0] = (uint8_t)delta;
    w->word[1] |= (uint8_t)(delta >> 8);
    w->match = at;
    w->word = w->to;
    w->to[0] = 0;
    w->to[1] = kind;
    w->to += 2;
}

static __attribute__((noinline)) uint8_t bit(uint8_t i)
{
    return 1 << i;
}

static inline __attribute__((always_inline)) void put(struct writer *w, uint8_t byte)
{
    *w->to++ = byte;
}

static void pair(struct plan *plan, const struct hal_timing *timing, uint8_t lights, uint8_t phase)
{
    const int16_t slot = (int16_t)plan->slot_cycles;
    struct writer w = writer;
    uint8_t *const begin = w.to;
    const uint8_t a = plan_channel(timing->wiring, 2 * phase);
    const uint8_t b = plan_channel(timing->wiring, 2 * phase + 1);
    uint8_t bits = bit(a), more = bit(b);
    uint8_t admux_a = ADMUX_CHANNEL_0 + a, admux_b = ADMUX_CHANNEL_0 + b;
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
            admux_a = ADMUX_GROUND;
        }
        if (more == portc) {
            more = 0;
            admux_b = ADMUX_GROUND;
        }
    }
    if (!lights) {
        portc = 0;
        portd = PORTD_DARK;
    }

    int16_t release = slot + SAMPLE_CYCLES - (int16_t)plan->exposure_cycles[a];
    int16_t later = 2 * slot + SAMPLE_CYCLES - (int16_t)plan->exposure_cycles[b];
    uint8_t left = 2;
    if (release == later) {
        bits |= more;
        left = 1;
    } else if (later < release) {
        const int16_t r = release;
        const uint8_t m = bits;
        release = later;
        later = r;
        bits = more;
        more = m;
    }

    // Cycles from setting the lights to the release, if the next release is one that does.
    uint8_t set = LIGHT_LEAD_CYCLES, admux = ADMUX_GROUND;
    int16_t trigger = -slot;            // of the slot that the service is in
    int16_t service = HOLD_AT - slot;
    for (uint8_t k = 0;; k++) {
        uint8_t released = 0;
        while (left) {
            // A short exposure of the second: the first's is over, so its node may be held once more.
            uint8_t lead = set;
            if (release > 2 * slot + SAMPLE_CYCLES - SHORT_CYCLES)
                lead = SHORT_LEAD_CYCLES;
            int16_t at = release - (lead ? lead : RELEASE_LEAD_CYCLES);
            // A service right after a release costs no interrupt of its own; but lights go out in time, and
            // the result is read before the next.
            if (k == 0) {
                if (at >= service + HOLD_CYCLES)
                    break;
                if (set)
                    at = service;       // no time for holding first
            } else if (k != 3 && at >= service + SPACING_CYCLES && release > trigger + SERVICE_LATEST) {
                break;
            }
            event(&w, (lead ? EVENT_SET_RELEASE : EVENT_RELEASE) | EVENT_ALONE, at);
            if (lead) {
                put(&w, portc);
                put(&w, portd);
                put(&w, (uint8_t)(release - at - LEAD_LESS_CYCLES));
                set = 0;
            }
            put(&w, PORTC_ALL & (uint8_t)~bits);
            // With the release, if the last sample has been taken long enough.
            released = release >= service + WITH_RELEASE_CYCLES;
            if (service < release + AFTER_RELEASE_CYCLES)
                service = release + AFTER_RELEASE_CYCLES;
            bits |= more;
            release = later;
            left--;
        }
        if (k == 3)
            break;
        uint8_t kind = EVENT_STORE;
        if (k == 0 && set)
            kind = EVENT_DARK_STORE;
        if (k == 1 && phase == 0)
            kind = EVENT_COMPLETE;
        if (k == 2 && phase != 0)
            kind = EVENT_SERVICE;
        if (released)
            w.word[1] ^= EVENT_ALONE ^ kind;
        else
            event(&w, kind, service);
        if (k == 0 && phase == 0)
            plan->first_mux = w.to;
        put(&w, admux);
        admux = k == 0 ? admux_a : admux_b;
        trigger += slot;
        service = trigger + SERVICE_AT;
    }
    event(&w, phase == 2 ? EVENT_LAST : EVENT_AGAIN, 2 * slot + HOLD_AT);
    put(&w, (uint8_t)(w.to - begin));
    plan->end[phase] = (uint8_t)(w.to - plan->event);
    w.match -= 3 * slot;
    writer = w;
}

static void begin_list(struct plan *plan, uint8_t phase)
{
    if (phase == 0) {
        writer.to = plan->event;
        writer.word = plan->event;
    }
}

void plan_write(struct plan *plan, const struct hal_timing *timing, uint8_t lights, uint8_t phase)
{
    begin_list(plan, phase);
    pair(plan, timing, lights, phase);
}

void plan_copy(struct plan *plan, const struct plan *from, uint8_t phase)
{
    begin_list(plan, phase);
    const uint8_t begin = phase ? from->end[phase - 1] : 0;
    const uint8_t n = from->end[phase] - begin;
    memcpy(writer.to, from->event + begin, n);
    writer.to += n;
    plan->end[phase] = (uint8_t)(writer.to - plan->event);
    if (phase == 0) {
        plan->first_mux = plan->event + (from->first_mux - from->event);
        *plan->first_mux = ADMUX_GROUND;            // the other may ask for the supply just now
    }
    // Where every list begins and ends.
    writer.word = writer.to - 3;
    writer.match = HOLD_AT - (int16_t)plan->slot_cycles;
}
