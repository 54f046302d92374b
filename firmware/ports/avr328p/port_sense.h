// SPDX-License-Identifier: Apache-2.0
// What the planner (plan.c) writes, what the sensing interrupt (sense_isr.c) reads and fills, and what the
// main loop takes from it (sense.c).
#ifndef PORT_SENSE_H
#define PORT_SENSE_H

#include "port.h"

// A plan is three lists of events, one for each pair of sensors, run twice each: lit and unlit. An event is a
// little-endian word, kind in the four bits on top and cycles to the next event's compare match below, and
// what the kind needs. A compare match comes some cycles before what it is for.
enum event {                        // of the word's high byte
    EVENT_CYCLES = 0x0F,
    // Service of a slot, one byte: ADMUX of the next slot. Reads the result of the slot before, arms the
    // next.
    EVENT_SERVICE = 0x00,
    EVENT_STORE = 0x10,             // and keeps the result
    EVENT_COMPLETE = 0x20,          // and keeps it; if lit, the cycle before is complete
    EVENT_DARK_STORE = 0x30,        // and keeps it, after lights are out and all nodes held
    // No event; one byte: length of the list, which is run again unlit if it was lit.
    EVENT_AGAIN = 0x40,
    EVENT_LAST = 0x50,              // the same, but then `list_next` follows
    EVENT_WAIT = 0x60,              // the pause between frames
    // One byte: DDRC, exactly RELEASE_LEAD_CYCLES after the match. A service follows at once, with its kind
    // and its byte, or none.
    EVENT_RELEASE = 0x80,
    EVENT_ALONE = 0x30,
    // The same with four bytes: PORTC and PORTD at once, if lit; lead less LEAD_LESS_CYCLES; DDRC exactly
    // lead after the match.
    EVENT_SET_RELEASE = 0xC0,
};

enum sense_cycles {
    SERVICE_AT = 40,                // compare match of a service after its slot's trigger, at the earliest
    SERVICE_LATEST = 388,           // from its slot's trigger to the first release it follows, at most
    // Of the first event after a half's samples; it acts 43 cycles later at the earliest.
    HOLD_AT = SAMPLE_CYCLES - 40,
    RELEASE_LEAD_CYCLES = 98,       // 76 when nothing is in the way
    LIGHT_LEAD_CYCLES = 113,
    SHORT_CYCLES = 300,             // exposures of a second below are not late for a serial byte
    SHORT_LEAD_CYCLES = RELEASE_LEAD_CYCLES + 80,
    // From the first event's match, a service, to a release's, so that that is not late.
    HOLD_CYCLES = 166,
    SPACING_CYCLES = 200,           // the same of the others: the one that completes a cycle takes longer
    // From SERVICE_AT to a release that the service can follow without an interrupt.
    WITH_RELEASE_CYCLES = 20,
    AFTER_RELEASE_CYCLES = 4,       // from a release to the next event's match
    EXPOSURES_APART_CYCLES = 96,    // two releases: this far apart, or one
    // Of the wait, from the TCNT1 it looks at to the end of OUT, without the wait itself; and what a list's
    // lead is stated less, so that it fits into a byte.
    RELEASE_FIXED_CYCLES = 27,
    LEAD_LESS_CYCLES = 24,
};

enum plan_limits {
    PLAN_BYTES = 3 * (3 * 3 + 6 + 6 + 3),
    GAP_BYTES = 8,
    GAP_WAIT_AT = 6,
    CODES = 14,                     // of the first pair's GND slots, and of twelve samples
    ADMUX_GROUND = (1 << REFS1) | (1 << REFS0) | 15,
    ADMUX_SUPPLY = (1 << REFS1) | (1 << REFS0) | 7,
    ADMUX_CHANNEL_0 = (1 << REFS1) | (1 << REFS0),
    PORTC_ALL = 0x3F,
    PORTD_DARK = 1 << PD0,          // pull-up on the UART's input
    FIRST_EMITTER = PD2,            // of photodiodes' wiring
};

struct plan {
    uint16_t exposure_cycles[HAL_CHANNELS];
    uint16_t slot_cycles;
    uint8_t first_mux;              // ADMUX of slot 0, in `event`
    uint8_t begin[4];               // of each list, in `event`, and their end; the first's is 0
    uint8_t event[PLAN_BYTES];
};

// One cycle as the interrupt leaves it. Codes in the order of slots: of the first pair GND, lit a, b, GND,
// unlit a, b; of the others lit a, b, unlit a, b.
struct taken {
    uint16_t code[CODES];
    uint16_t end;                   // TCNT1 at the trigger after the last slot
    uint8_t wraps;                  // low byte of sense_wraps there
    uint8_t plan;                   // index of the plan that it followed
    uint8_t turn;                   // sense_turn of the next
    uint8_t left;                   // cycles of its frame still to come
    uint16_t seq;                   // of its frame
    struct taken *other;
};

// Releases that came too late, by how many cycles: in the cycle that runs, or the one before.
struct late {
    uint8_t cycles[2][HAL_CHANNELS];    // lit, unlit
    uint8_t any;
};

extern struct late sense_late[2];
extern uint8_t sense_turn;                      // the running cycle's: 0 or sizeof(struct late)
extern struct plan sense_plan[2];
extern uint8_t sense_gap[GAP_BYTES];                    // the list of a pause: two services and EVENT_WAIT
extern const uint8_t *volatile sense_list_next; // list that follows the running one
extern uint16_t *sense_out;                     // where the next code goes
extern uint16_t sense_slot;                     // cycles from trigger to trigger
// TCNT1 at the latest known instant, and how often it wrapped.
extern volatile uint16_t sense_base;
extern volatile uint32_t sense_wraps;           // until then
extern uint8_t sense_left, sense_last;          // of the frame: cycles still to come, and at its beginning
extern uint16_t sense_seq;
extern uint8_t sense_drop;                      // there is no cycle before this one: nothing is complete
extern uint8_t sense_pause;                     // frames end with a pause
extern volatile uint8_t sense_current;                   // index of the running cycle's plan
extern uint8_t *sense_first;                    // ADMUX of slot 0 to be set back to GND; NULL: it is
extern volatile uint8_t sense_pauses;           // changes when sense_base does without sense_done
extern volatile uint8_t sense_done;             // cycles complete, low byte
extern uint8_t sense_took;                      // cycles taken, low byte

// Called by the interrupt, seldom. OCR1A is the match it was called at.
const uint8_t *sense_wait(void);                // the pause goes on or ends; the list to go on with
const uint8_t *sense_give_up(void);             // a trigger was missed: lights are out, the cycle is lost

// plan.c
extern const uint8_t plan_place[2][HAL_CHANNELS];        // in flash
// Of the sensor at a place: 2 * pair, + 1 for its second.
uint8_t plan_channel(uint8_t wiring, uint8_t place);
// Limits, and two releases not too near each other.
void plan_clip(uint16_t exposure_cycles[HAL_CHANNELS], uint8_t wiring, uint16_t slot_cycles);
// One list, from plan->exposure_cycles, which are clipped, and plan->slot_cycles; in order 0, 1, 2. If its exposures
// are those of `from`, a plan that differs in exposures alone, or NULL, it is copied.
void plan_write(struct plan *plan, const struct plan *from, const struct hal_timing *timing, uint8_t lights,
                uint8_t phase);

#endif
