// SPDX-License-Identifier: Apache-2.0
// From exposures to lists of events for the sensing interrupt: one for each pair of sensors, run through lit and
// again unlit, three slots each: GND, a, b. What happens before a half's samples begins right after the sample
// before them, in the slot before its first.
//
// Samples are fixed, releases follow from the exposures, services have most of a slot to choose from: where a
// release is near, it comes first and the service after it. Only two releases of one half can be in each other's
// way; plan_clip() moves the second sensor's exposure then.
#include "port_sense.h"

#include <avr/pgmspace.h>

#pragma GCC optimize("Os")          // runs when an exposure changes

const uint8_t plan_place[2][HAL_CHANNELS] PROGMEM = {
    [SG_WIRING_LEDS] = { 5, 0, 1, 4, 2, 3 },
    [SG_WIRING_PHOTODIODES] = { 0, 3, 1, 4, 2, 5 },
};

struct plan sense_plan[2];

// The list being written.
static uint8_t *to;
static uint8_t *word;                   // of the event before
static int16_t match;                   // its compare match, from the trigger of the half's first slot

uint8_t plan_channel(uint8_t wiring, uint8_t place)
{
    return pgm_read_byte(&plan_place[wiring != SG_WIRING_LEDS][place]);
}

void plan_clip(uint16_t exposure_cycles[HAL_CHANNELS], uint8_t wiring, uint16_t slot_cycles)
{
    uint16_t same = 0;                  // exposure with the release of the pair's first
    for (uint8_t place = 0; place < HAL_CHANNELS; place++) {
        const uint8_t second = place & 1;
        uint16_t *cycles = &exposure_cycles[plan_channel(wiring, place)];
        const uint16_t most = (second ? 3 : 2) * slot_cycles - EXPOSURE_LESS_CYCLES;
        if (*cycles < EXPOSURE_MIN_CYCLES)
            *cycles = EXPOSURE_MIN_CYCLES;
        if (*cycles > most)
            *cycles = most;
        const int16_t apart = *cycles - same;
        if (second && apart > -EXPOSURES_APART_CYCLES && apart < EXPOSURES_APART_CYCLES) {
            *cycles = same;
            if (apart <= -EXPOSURES_APART_CYCLES / 2)
                *cycles -= EXPOSURES_APART_CYCLES;
            if (apart >= EXPOSURES_APART_CYCLES / 2)
                *cycles += EXPOSURES_APART_CYCLES;
            if (*cycles > most)
                *cycles = same;
        }
        same = *cycles + slot_cycles;
    }
}

static void event(uint8_t kind, int16_t at)
{
    const uint16_t delta = at - match;
    word[0] = (uint8_t)delta;
    word[1] |= (uint8_t)(delta >> 8);
    match = at;
    word = to;
    to[0] = 0;
    to[1] = kind;
    to += 2;
}

static void pair(struct plan *plan, const struct hal_timing *timing, uint8_t lights, uint8_t phase)
{
    const int16_t slot = (int16_t)plan->slot_cycles;
    uint8_t *const begin = to;
    uint8_t portc = 0, portd = PORTD_DARK, left = 2, set = 1, bits[2], admux[3];
    int16_t release[2], service = HOLD_AT - slot;

    admux[0] = ADMUX_GROUND;
    for (uint8_t k = 0; k < 2; k++) {
        const uint8_t i = plan_channel(timing->wiring, 2 * phase + k);
        admux[1 + k] = ADMUX_CHANNEL_0 + i;
        bits[k] = 1 << i;
        release[k] = (k + 1) * slot + SAMPLE_CYCLES - (int16_t)plan->exposure_cycles[i];
    }
    uint8_t emitters = PORTC_ALL & (uint8_t)~(bits[0] | bits[1]);
    if (timing->probe < HAL_CHANNELS)
        emitters = 1 << timing->probe;
    if (timing->wiring != SG_WIRING_LEDS) {
        if (timing->probe == phase || timing->probe >= HAL_CHANNELS)
            portd |= 1 << (FIRST_EMITTER + phase);
    } else {
        // The only emitter is at 5 V when its turn comes: the converter is not to see that.
        for (uint8_t k = 0; k < 2; k++)
            if (bits[k] == emitters) {
                bits[k] = 0;
                admux[1 + k] = ADMUX_GROUND;
            }
        portc = emitters;
    }
    if (!lights) {
        portc = 0;
        portd = PORTD_DARK;
    }
    uint8_t next = release[1] < release[0];
    uint8_t held = PORTC_ALL & (uint8_t)~bits[next];
    if (release[0] == release[1]) {
        held &= (uint8_t)~bits[1];
        left = 1;
    }

    for (uint8_t k = 0; k < 4; k++) {
        uint8_t released = 0;
        while (left) {
            int16_t at = release[next] - (set ? LIGHT_LEAD_CYCLES : RELEASE_LEAD_CYCLES);
            // A service right after a release costs no interrupt of its own; but lights go out in time.
            if (k < 3 && at >= service + (k == 0 ? HOLD_CYCLES : SPACING_CYCLES)
                && (k == 0 || release[next] > (int16_t)(k * slot) - SERVICE_BEFORE_CYCLES))
                break;
            if (k == 0 && set)
                at = service;           // no time for holding first
            event((set ? EVENT_SET_RELEASE : EVENT_RELEASE) | EVENT_ALONE, at);
            if (set) {
                *to++ = portc;
                *to++ = portd;
                *to++ = (uint8_t)(release[next] - at - LEAD_LESS_CYCLES);
            }
            *to++ = held;
            // With the release, if the last sample has been taken long enough.
            released = release[next] >= service + WITH_RELEASE_CYCLES;
            if (service < release[next] + AFTER_RELEASE_CYCLES)
                service = release[next] + AFTER_RELEASE_CYCLES;
            next = !next;
            held &= (uint8_t)~bits[next];
            set = 0;
            left--;
        }
        if (k == 3)
            break;
        uint8_t kind = EVENT_STORE;
        if (k == 0 && set)
            kind = EVENT_DARK_STORE;
        else if (k == 1 && phase == 0)
            kind = EVENT_COMPLETE;
        else if (k == 2 && phase != 0)
            kind = EVENT_SERVICE;
        if (released)
            word[1] ^= EVENT_ALONE ^ kind;
        else
            event(kind, service);
        if (k == 0 && phase == 0)
            plan->first_mux = to;
        *to++ = admux[k];
        service = k * slot + SERVICE_AT;
    }
    event(phase == 2 ? EVENT_LAST : EVENT_AGAIN, 2 * slot + HOLD_AT);
    *to = (uint8_t)(to - begin);
    to++;
    match -= 3 * slot;
}

void plan_write(struct plan *plan, const struct hal_timing *timing, uint8_t lights, uint8_t phase)
{
    if (phase == 0) {
        to = plan->event;
        word = to;
    }
    pair(plan, timing, lights, phase);
}
