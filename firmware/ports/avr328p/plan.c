// SPDX-License-Identifier: Apache-2.0
// From exposures to a list of events for the sensing interrupt. A cycle is six half phases of three slots: GND, a,
// b of each pair, lit and then unlit. What happens before a half phase's samples begins right after the sample
// before them, in the slot before its first.
//
// Samples are fixed, releases follow from the exposures, services have most of a slot to choose from: where a
// release is near, it comes first and the service after it. Only two releases of one half phase can be in each
// other's way; plan_clip() moves the second sensor's exposure then.
#include "port_sense.h"

enum { SECONDS_LEDS = 1 << 0 | 1 << 4 | 1 << 3, SECONDS_PHOTODIODES = 1 << 3 | 1 << 4 | 1 << 5 };

static const uint8_t pair[2][3][2] = {
    [SG_WIRING_LEDS] = { { 5, 0 }, { 1, 4 }, { 2, 3 } },
    [SG_WIRING_PHOTODIODES] = { { 0, 3 }, { 1, 4 }, { 2, 5 } },
};

struct plan sense_plan[2];

// The list being written.
static uint8_t *to;
static uint8_t *word;                   // of the event before
static int16_t match;                   // its compare match, from the trigger of the half phase's first slot

uint8_t plan_channel(uint8_t wiring, uint8_t phase, uint8_t second)
{
    return pair[wiring != SG_WIRING_LEDS][phase][second];
}

uint16_t plan_exposure_most(uint8_t channel, uint8_t wiring, uint16_t slot_cycles)
{
    const uint8_t seconds = wiring == SG_WIRING_LEDS ? SECONDS_LEDS : SECONDS_PHOTODIODES;
    return 2 * slot_cycles + (seconds >> channel & 1 ? slot_cycles : 0) - EXPOSURE_LESS_CYCLES;
}

void plan_clip(uint16_t exposure_cycles[HAL_CHANNELS], uint8_t wiring, uint16_t slot_cycles)
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        const uint16_t most = plan_exposure_most(i, wiring, slot_cycles);
        if (exposure_cycles[i] < EXPOSURE_MIN_CYCLES)
            exposure_cycles[i] = EXPOSURE_MIN_CYCLES;
        if (exposure_cycles[i] > most)
            exposure_cycles[i] = most;
    }
    for (uint8_t phase = 0; phase < 3; phase++) {
        // b is sampled a slot after a: the same release is a slot more.
        uint16_t *b = &exposure_cycles[plan_channel(wiring, phase, 1)];
        const uint16_t same = exposure_cycles[plan_channel(wiring, phase, 0)] + slot_cycles;
        const int16_t apart = *b - same;
        if (apart > -EXPOSURES_APART_CYCLES / 2 && apart < EXPOSURES_APART_CYCLES / 2)
            *b = same;
        else if (apart > 0 && apart < EXPOSURES_APART_CYCLES)
            *b = same + EXPOSURES_APART_CYCLES;
        else if (apart < 0 && apart > -EXPOSURES_APART_CYCLES)
            *b = same - EXPOSURES_APART_CYCLES;
    }
}

static void put(uint8_t byte)
{
    *to++ = byte;
}

static void event(uint16_t kind, int16_t at)
{
    const uint16_t delta = at - match;
    word[0] = (uint8_t)delta;
    word[1] |= (uint8_t)(delta >> 8);
    match = at;
    word = to;
    put(0);
    put(kind >> 8);
}

static void half_phase(struct plan *plan, const struct hal_timing *timing, uint8_t half)
{
    const uint8_t phase = half >> 1, lit = !(half & 1), wiring = timing->wiring;
    const int16_t slot = (int16_t)plan->slot_cycles;
    const uint8_t a = plan_channel(wiring, phase, 0), b = plan_channel(wiring, phase, 1);
    const int16_t hold_at = HOLD_AT - slot;
    uint8_t portc = 0, portd = PORTD_DARK, left = 2;
    uint8_t bits = 1 << a, more = 1 << b;
    int16_t release = slot + SAMPLE_CYCLES - (int16_t)plan->exposure_cycles[a];
    int16_t later = 2 * slot + SAMPLE_CYCLES - (int16_t)plan->exposure_cycles[b];

    if (wiring == SG_WIRING_LEDS) {
        uint8_t emitters = PORTC_ALL & (uint8_t)~(bits | more);
        if (timing->probe < HAL_CHANNELS) {
            emitters = 1 << timing->probe;
            bits &= (uint8_t)~emitters;
            more &= (uint8_t)~emitters;
        }
        if (lit && timing->lights)
            portc = emitters;
    } else if (lit && timing->lights && (timing->probe >= HAL_CHANNELS || timing->probe == phase)) {
        portd |= 1 << (FIRST_EMITTER + phase);
    }
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

    uint8_t set = lit;              // the next release is the one that lights go on with
    uint8_t begun = 0;
    for (uint8_t slot_of = 0; slot_of < 4; slot_of++) {
        int16_t service = slot_of == 0 ? hold_at : (slot_of - 1) * slot + SERVICE_AT;
        while (left) {
            const uint16_t kind = (set ? EVENT_SET_RELEASE : EVENT_RELEASE) | (lit ? 0 : EVENT_UNLIT);
            int16_t begin = release - (set ? LIGHT_LEAD_CYCLES : RELEASE_LEAD_CYCLES);
            if (slot_of < 3 && begin >= service + SPACING_CYCLES)
                break;
            if (!begun) {           // no time for holding first
                set = 1;
                begin = hold_at;
            }
            begun = 1;
            event(set ? kind | EVENT_SET_RELEASE : kind, begin);
            if (set) {
                put(portc);
                put(portd);
                put(release - begin);
            }
            put(PORTC_ALL & (uint8_t)~bits);
            if (service < release + AFTER_RELEASE_CYCLES)
                service = release + AFTER_RELEASE_CYCLES;
            release = later;
            bits |= more;
            set = 0;
            left--;
        }
        if (slot_of == 3)
            break;
        uint16_t kind = EVENT_SERVICE;
        if (slot_of == 0)
            kind = begun ? EVENT_STORE : EVENT_DARK_STORE;
        else if (slot_of == 1)
            kind = half == 0 ? EVENT_COMPLETE : EVENT_STORE;
        else if (half == 0)
            kind = EVENT_STORE;
        event(kind, service);
        if (half == 0 && slot_of == 0)
            plan->first_mux = to;
        put(slot_of == 0 ? ADMUX_GROUND : ADMUX_CHANNEL_0 + (slot_of == 1 ? a : b));
        begun = 1;
    }
}

void plan_write(struct plan *plan, const struct hal_timing *timing)
{
    const int16_t slot = (int16_t)plan->slot_cycles;
    to = plan->event;
    word = to;
    for (uint8_t half = 0; half < 6; half++) {
        half_phase(plan, timing, half);
        match -= 3 * slot;
    }
    event(EVENT_END, HOLD_AT - slot);
}
