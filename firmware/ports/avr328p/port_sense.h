// SPDX-License-Identifier: Apache-2.0
// What the planner (plan.c) writes, what the sensing interrupt (sense_isr.c) reads and fills, and what the main
// loop takes from it (sense.c).
#ifndef PORT_SENSE_H
#define PORT_SENSE_H

#include "port.h"

// A plan is a list of events, each a little-endian word  kind | cycles to the next event's compare match, and what
// the kind needs. A compare match comes some cycles before what it is for.
enum event {
    EVENT_CYCLES = 0x0FFF,
    // Service of a slot, one byte: ADMUX of the next slot. Reads the result of the slot before, arms the next.
    EVENT_SERVICE = 0x0000,
    EVENT_STORE = 0x1000,           // and keeps the result
    EVENT_COMPLETE = 0x2000,        // and keeps it: the cycle before is complete
    EVENT_DARK_STORE = 0x3000,      // after lights are out and all nodes held
    EVENT_END = 0x4000,             // no event: goes on in the list `list_next`
    EVENT_WAIT = 0x5000,            // the pause between frames
    EVENT_RELEASE = 0x8000,         // one byte: DDRC, exactly RELEASE_LEAD_CYCLES after the match
    EVENT_SET_RELEASE = 0xC000,     // four bytes: PORTC and PORTD at once, lead, DDRC exactly lead after the match
    EVENT_UNLIT = 0x2000,           // with the last two: of the unlit exposure
};

enum sense_cycles {
    SERVICE_AT = 40,                // compare match of a service after its slot's trigger, at the earliest
    HOLD_AT = SAMPLE_CYCLES - 8,    // of the first event after the unlit, or lit, samples: lights out, nodes held
    RELEASE_LEAD_CYCLES = 112,      // other interrupts may take 75 of them
    LIGHT_LEAD_CYCLES = 128,
    SPACING_CYCLES = 84,            // from a service's match to a release's, so that neither is late
    AFTER_RELEASE_CYCLES = 24,      // from a release to the next event's match
    EXPOSURES_APART_CYCLES = 64,    // two releases: this far apart, or one
    // Of the wait, from the TCNT1 it looks at to the end of OUT, without the wait itself.
    RELEASE_FIXED_CYCLES = 27,
};

enum plan_limits {
    PLAN_BYTES = 6 * (3 * 3 + 6 + 3) + 1 + 2,
    GAP_BYTES = 8,
    GAP_WAIT_AT = 6,
    CODES = 13,                     // of the first GND slot, and of twelve samples
    ADMUX_GROUND = (1 << REFS1) | (1 << REFS0) | 15,
    ADMUX_SUPPLY = (1 << REFS1) | (1 << REFS0) | 7,
    ADMUX_CHANNEL_0 = (1 << REFS1) | (1 << REFS0),
    PORTC_ALL = 0x3F,
    PORTD_DARK = 1 << PD0,          // pull-up on the UART's input
    FIRST_EMITTER = PD2,            // of photodiodes' wiring
};

struct plan {
    uint8_t event[PLAN_BYTES];
    uint16_t exposure_cycles[HAL_CHANNELS];
    uint16_t slot_cycles;
    uint8_t *first_mux;             // ADMUX of slot 0
};

// One cycle as the interrupt leaves it. Codes in the order of slots: of slot 0, then lit a, b, unlit a, b of each
// pair.
struct taken {
    uint16_t code[CODES];
    uint16_t end;                   // TCNT1 at the trigger after the last slot
    uint8_t wraps;                  // low byte of sense_wraps there
    uint8_t plan;                   // index of the plan that it followed
    uint8_t left;                   // cycles of its frame still to come
    uint16_t seq;                   // of its frame
    struct taken *other;
    uint8_t late[2][HAL_CHANNELS];  // lit, unlit
};

extern struct plan sense_plan[2];
extern uint8_t sense_gap[GAP_BYTES];                    // the list of a pause: two services and EVENT_WAIT
extern const uint8_t *volatile sense_list_next; // list that follows the running one
extern uint16_t *sense_out;                     // where the next code goes
extern uint16_t sense_slot;                     // cycles from trigger to trigger
extern uint16_t sense_base;                     // TCNT1 at the latest known instant, and how often it wrapped
extern volatile uint32_t sense_wraps;           // until then
extern uint8_t sense_left, sense_last;          // of the frame: cycles still to come, and at its beginning
extern uint16_t sense_seq;
extern uint8_t sense_drop;                      // there is no cycle before this one: nothing is complete
extern uint8_t sense_pause;                     // frames end with a pause
extern volatile uint8_t sense_current;                   // index of the running cycle's plan
extern volatile uint8_t sense_done;             // cycles complete, low byte

// Called by the interrupt, seldom. OCR1A is the match it was called at.
const uint8_t *sense_wait(void);                // the pause goes on or ends; the list to go on with
const uint8_t *sense_give_up(void);             // a trigger was missed: lights are out, the cycle is lost
void sense_late(uint8_t channels, uint8_t cycles, uint8_t kind);  // bits of channels; high byte of their event

// plan.c
uint8_t plan_channel(uint8_t wiring, uint8_t phase, uint8_t second);
uint16_t plan_exposure_most(uint8_t channel, uint8_t wiring, uint16_t slot_cycles);
// Limits, and two releases not too near each other.
void plan_clip(uint16_t exposure_cycles[HAL_CHANNELS], uint8_t wiring, uint16_t slot_cycles);
// From plan->exposure_cycles, which are clipped, and plan->slot_cycles.
void plan_write(struct plan *plan, const struct hal_timing *timing);

#endif
