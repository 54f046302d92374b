// SPDX-License-Identifier: Apache-2.0
// The sensing engine as the main loop sees it: what to sense next (exposures, timing, lights), what was
// sensed, and the pauses between frames. The cycles themselves run in sense_isr.c after the plans of plan.c.
#include "port_sense.h"

#include <avr/pgmspace.h>
#include <stddef.h>
#include <string.h>

#define SELDOM __attribute__((noinline, cold))
#define HOT __attribute__((optimize("O2")))

enum {
    NONE = 255,
    WAIT_AT = 120,                  // compare match of EVENT_WAIT after that of the service before it
    PLAN_PATIENCE = 2,              // cycles
    PAUSE_LEAST_SLOTS = 3,
    RESTART_CYCLES = 1500,          // before a frame that begins with another timing
    PAUSE_MOST = 16000000,          // a frame a second, at least
    PAUSE_CHUNK_CYCLES = 0x8000,    // waited for at once
    PAUSE_WHOLE_CYCLES = 0xC000,
    LOCKOUT_WRAPS = LOCKOUT_MS * (F_CPU / 1000) / 65536 + 1,
    HELD_LEAST = 9,                 // code: what is below is an offset of the converter, not a voltage
    SUPPLY_EVERY_WRAPS = 244,       // a second
    SUPPLY_CODE_LEAST = 130,        // 3.8 V at a bandgap of 1.2 V,
    SUPPLY_CODE_MOST = 235,         // 5.7 V at 1.0 V: beyond, nothing or something else is on the pin
    SUPPLY_MV_PER_CODE_Q8 = 6875,   // 1.1 V / 1024 / 0.04
    UNLIT_AFTER = offsetof(struct sg_reading, unlit_code) / sizeof(uint16_t),   // behind the lit code of a channel
};

static struct taken ring[2];

uint8_t sense_gap[GAP_BYTES];
const uint8_t *volatile sense_list_next;
uint16_t *sense_out;
uint16_t sense_slot;
volatile uint16_t sense_base;
volatile uint32_t sense_wraps;
uint8_t sense_left, sense_last;
uint16_t sense_seq;
uint8_t sense_drop;
uint8_t sense_pause;
uint8_t *sense_first;
struct late sense_late[2];
uint8_t sense_turn;
volatile uint8_t sense_current;
volatile uint8_t sense_done;

volatile uint8_t sense_pauses;
static volatile uint8_t plan_next;          // index of the plan to begin with, or to go on with
static volatile uint8_t restart;            // timing changed: begin a frame with it
static uint8_t pausing;
static __uint24 pause_left;
static __uint24 pause_cycles;               // between frames; 0: none
static volatile uint16_t late_slots;

static struct hal_timing timing;            // asked for
static uint16_t exposure[HAL_CHANNELS];     // asked for, clipped
static uint16_t slot;                       // of `timing`
static __uint24 pause_new;
static uint8_t timing_new, plan_new;        // asked for and not in a plan yet
static uint8_t plan_hurry;              // bits of enum hurry: all lists at once, nothing waits for time
// An exposure halves or doubles: the light is another. No list is that of the plan in use.
enum hurry { HURRY_LIGHT = 1, HURRY_WHOLE = 2 };
static uint8_t plan_since;              // sense_done when exposures were asked for, or a list was written
static uint8_t written;                     // lists of the next plan
static uint8_t locked_out;
uint8_t sense_took;                         // cycles taken, low byte
static uint16_t late_frames;
static uint32_t frames;
static uint32_t took_at;                    // by now()
static uint8_t shown_plan = NONE;           // what the reading's exposures and these are of
static uint16_t mean_to_end;                // and half a microsecond
static uint8_t late_shown;
static uint16_t cycles_max;
static uint8_t supply_wraps = 16;           // of TCNT1, when the supply was last asked for: soon at first
static volatile uint8_t supply;             // enum supply
enum supply { SUPPLY_RESTS, SUPPLY_WANTED, SUPPLY_ASKED };
static uint8_t supply_of;                   // the cycle that has it makes sense_done this
static uint8_t supply_code, supply_boot;    // 0: unknown

static void base_at(uint16_t ticks)
{
    if (ticks < sense_base)
        sense_wraps++;
    sense_base = ticks;
}

uint8_t sense_alive(void)
{
    return sense_done + sense_pauses;
}

static uint16_t ticks_now(void)
{
    uint16_t ticks;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        ticks = TCNT1;
    }
    return ticks;
}

// 32 bits of two halves; by `<< 16 |` they would go through eight registers.
static inline uint32_t joined(uint16_t high, uint16_t low)
{
    const union { uint16_t half[2]; uint32_t whole; } both = { .half = { low, high } };
    return both.whole;
}

// Device time in cycles, 32 bits: TCNT1, and how often it wrapped. Read again if the interrupt went on meanwhile,
// which is off as little as can be: a release may be waiting.
HOT __attribute__((noinline)) static uint32_t now(void)
{
    uint16_t ticks, wraps;
    uint8_t before;
    do {
        before = sense_alive();
        ticks = ticks_now();
        wraps = (uint16_t)sense_wraps + (ticks < sense_base);
    } while (before != sense_alive());
    return joined(wraps, ticks);
}

// Of 16-bit pieces, because a shift of 32 bits is a loop.
static inline uint32_t us_of(uint32_t wraps, uint16_t ticks)
{
    const uint16_t low = (uint16_t)wraps << 12 | ticks >> 4;
    const uint16_t high = (uint16_t)(wraps >> 16) << 12 | (uint16_t)wraps >> 4;
    return joined(high, low);
}

uint32_t hal_now_us(void)
{
    uint32_t wraps;
    do
        wraps = sense_wraps;
    while (wraps != sense_wraps);
    const uint32_t cycles = now();      // may have wrapped since
    wraps += (uint16_t)((uint16_t)(cycles >> 16) - (uint16_t)wraps);
    return us_of(wraps, (uint16_t)cycles);
}

static struct taken *filling(void)
{
    const uint16_t *out;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        out = sense_out;
    }
    return out < ring[1].code ? &ring[0] : &ring[1];
}

// The first GND slot of the cycle that makes sense_done `of` converts the divider at A7 instead; the
// interrupt sets it back when that is under way.
SELDOM static void ask_supply(struct plan *plan, uint8_t of)
{
    if (supply != SUPPLY_WANTED)
        return;
    supply = SUPPLY_ASKED;
    supply_of = of;
    sense_first = plan->event + plan->first_mux;
    *sense_first = ADMUX_SUPPLY;
}

// Its other GND slot must be over, and the same plan go on. Interrupts stay on: what is left of the cycle is
// long.
SELDOM static void try_supply(void)
{
    if (supply != SUPPLY_WANTED || sense_current != plan_next
        || sense_list_next != sense_plan[plan_next].event)
        return;
    const uint8_t done = sense_done;
    const uint16_t since = ticks_now() - sense_base;
    if (since > 3 * sense_slot && since < 15 * sense_slot && done == sense_done)
        ask_supply(&sense_plan[plan_next], done + 2);
}

HOT uint16_t hal_now_us16(void)
{
    // Under full load the main loop comes by here alone while a cycle is half over.
    if (supply == SUPPLY_WANTED)
        try_supply();
    const uint32_t cycles = now();
    return (uint16_t)((uint16_t)(cycles >> 16) << 12) | (uint16_t)cycles >> 4;
}

// A frame whose first cycle's hold is at `hold`, by TCNT1. Called with interrupts off.
SELDOM static const uint8_t *begin_at(uint16_t hold)
{
    struct plan *plan = &sense_plan[plan_next];
    pausing = 0;
    ask_supply(plan, sense_done + 1);
    sense_drop = 1;
    sense_out = &filling()->code[CODES - 2];
    sense_list_next = sense_pause && sense_left == 0 ? sense_gap : plan->event;
    // As if another cycle had gone before: a conversion of GND, the next trigger a slot later, nothing of it
    // kept.
    ADMUX = ADMUX_GROUND;
    OCR1B = hold - HOLD_AT;
    OCR1A = hold;
    TIFR1 = (1 << OCF1A) | (1 << OCF1B);
    GPIOR2 = 0xFF;
    return plan->event;
}

// A frame begins out of turn, or with another timing.
SELDOM static void begin_frame(void)
{
    if (sense_left != sense_last)
        sense_seq++;                // the one under way is cut short
    if (restart) {
        restart = 0;
        sense_last = timing.repeats - 1;
        sense_slot = sense_plan[plan_next].slot_cycles;
        sense_pause = pause_cycles != 0;
        DDRD = timing.wiring == SG_WIRING_LEDS ? 0 : 7 << FIRST_EMITTER;
        const uint16_t second = sense_slot - HOLD_AT + SERVICE_AT;
        sense_gap[0] = (uint8_t)second;
        sense_gap[1] = EVENT_DARK_STORE | second >> 8;
        sense_gap[2] = ADMUX_GROUND;
        sense_gap[3] = WAIT_AT;
        sense_gap[4] = EVENT_COMPLETE;
        sense_gap[5] = ADMUX_GROUND;
    }
    sense_left = sense_last;
}

// The next event comes long after this: other interrupts may.
const uint8_t *sense_wait(void)
{
    const uint16_t match = OCR1A;
    base_at(match);
    sense_pauses++;
    sei();
    if (!pausing) {
        pausing = 1;
        pause_left = pause_cycles - (sense_slot - HOLD_AT + SERVICE_AT + WAIT_AT);
    }
    uint16_t chunk = PAUSE_CHUNK_CYCLES;
    if (restart) {
        begin_frame();
        pause_left = RESTART_CYCLES;
    }
    const uint8_t go_on = pause_left > PAUSE_WHOLE_CYCLES;
    if (go_on)
        pause_left -= PAUSE_CHUNK_CYCLES;
    else
        chunk = (uint16_t)pause_left;
    cli();
    if (!go_on)
        return begin_at(match + chunk);
    OCR1A = match + chunk;
    return &sense_gap[GAP_WAIT_AT];
}

const uint8_t *sense_give_up(void)
{
    const uint16_t given_up = TCNT1;
    base_at(given_up);
    sense_pauses++;
    TIFR1 = 1 << OCF1A;
    sei();
    late_slots++;
    begin_frame();
    memset(&sense_late[sense_turn != 0], 0, sizeof sense_late[0]);
    cli();
    // A whole cycle in the dark: what was lit just now is not lit again before its turn.
    return begin_at(given_up + SLOTS * sense_slot);
}

// ------------------------------------------------------------------------------------------------------

uint16_t hal_exposure_most(uint8_t channel)
{
    uint8_t second = 0;
    for (uint8_t place = 1; place < HAL_CHANNELS; place += 2)
        second |= plan_channel(timing.wiring, place) == channel;
    return (second ? 3 : 2) * slot - EXPOSURE_LESS_CYCLES;
}

void hal_expose(uint16_t exposure_cycles[HAL_CHANNELS])
{
    plan_clip(exposure_cycles, timing.wiring, slot);
    for (uint8_t i = 0; i < HAL_CHANNELS; i++)
        if (exposure_cycles[i] < exposure[i] >> 1 || exposure_cycles[i] >> 1 > exposure[i])
            plan_hurry |= HURRY_LIGHT;
    memcpy(exposure, exposure_cycles, sizeof exposure);
    plan_new = 1;
    plan_since = sense_done;
}

// All lists anew, at once.
SELDOM static void write_whole(void)
{
    plan_new = 1;
    plan_hurry = HURRY_WHOLE;
    written = 0;
}

SELDOM __attribute__((noclone))
void hal_set_timing(struct hal_timing *t)
{
    if (t->repeats < 1)
        t->repeats = 1;
    if (t->repeats > SG_LIGHT_REPEATS_MAX)
        t->repeats = SG_LIGHT_REPEATS_MAX;
    uint16_t n = SLOT_CYCLES_MIN;
    for (uint16_t left = t->period_cycles; left >= SLOTS * (SLOT_CYCLES_MIN + 1) && n < SLOT_CYCLES_MAX; n++)
        left -= SLOTS;
    if (t->frame_cycles > PAUSE_MOST)
        t->frame_cycles = PAUSE_MOST;
    const uint16_t step = SLOTS * t->repeats;
    int32_t pause = (int32_t)(t->frame_cycles - (uint32_t)n * step);
    if (pause < (int16_t)step) {
        pause = 0;
        t->frame_cycles = 0;
    } else {
        // A pause too short to make: shorter cycles, a longer pause.
        for (; pause < (int16_t)(PAUSE_LEAST_SLOTS * n); pause += step)
            n--;
    }
    t->period_cycles = SLOTS * n;
    timing = *t;
    slot = n;
    pause_new = (__uint24)pause;
    plan_clip(exposure, t->wiring, n);
    timing_new = 1;
    write_whole();
}

// One list of the plan that is not in use, and when all are written it is the next.
SELDOM static void write_plan(void)
{
    const uint8_t index = !plan_next;
    struct plan *plan = &sense_plan[index];
    if (written == 0) {
        plan_new = 0;
        memcpy(plan->exposure_cycles, exposure, sizeof exposure);
        plan->slot_cycles = slot;
    }
    plan_write(plan, plan_hurry & HURRY_WHOLE ? NULL : &sense_plan[plan_next], &timing,
               timing.lights && !locked_out, written);
    plan_since = sense_done;
    if (++written != 3)
        return;
    written = 0;
    plan_hurry = 0;
    if (shown_plan == index)
        shown_plan = NONE;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        plan_next = index;
        if (timing_new) {
            timing_new = 0;
            pause_cycles = pause_new;
            restart = 1;
            sense_list_next = sense_gap;
        } else if (sense_list_next != sense_gap) {
            sense_list_next = plan->event;
        }
    }
}

// A list takes about two slots, and may make the next frame wait a little, but not be late. After some cycles it
// no longer waits for that.
static uint8_t time_for_list(void)
{
    const uint16_t since = ticks_now() - sense_base;
    return plan_hurry || (uint8_t)(sense_done - plan_since) > PLAN_PATIENCE
        || (sense_done == sense_took && since < (SLOTS - 1) * sense_slot);
}

void sense_poll(void)
{
    if (locked_out && sense_wraps >= LOCKOUT_WRAPS) {
        locked_out = 0;
        write_whole();
    }
    // The other plan is free when neither the running cycle nor the newest complete one follows it. A cycle that
    // has been asked for the supply keeps its plan.
    if ((plan_new || written) && supply != SUPPLY_ASKED && sense_current == plan_next
        && filling()->other->plan == plan_next && time_for_list())
        do
            write_plan();
        while (plan_hurry && written);
    try_supply();
}

SELDOM void sense_start(struct hal_timing *t, uint16_t exposure_cycles[HAL_CHANNELS])
{
    locked_out = (boot_reset_cause() & SG_RESET_WATCHDOG) != 0;
    memcpy(exposure, exposure_cycles, sizeof exposure);
    hal_set_timing(t);
    memcpy(exposure_cycles, exposure, sizeof exposure);
    plan_next = 1;
    do {
        write_plan();
    } while (written);
    begin_frame();
    ring[0].other = &ring[1];
    ring[1].other = &ring[0];
    sense_gap[GAP_WAIT_AT + 1] = EVENT_WAIT;
    sense_out = ring[0].code;

    PORTC = 0;
    PORTD = PORTD_DARK;
    DDRC = PORTC_ALL;
    DIDR0 = PORTC_ALL;
    ADCSRB = (1 << ADTS2) | (1 << ADTS0);           // Timer1 compare B
    ADCSRA = (1 << ADEN) | (1 << ADATE) | (1 << ADPS2) | (1 << ADPS1);      // 250 kHz
    TCCR0B = 0;
    TCCR1A = 0;
    TCCR1B = 0;
    TCNT1 = 0;
    const uint8_t *list = begin_at(4 * slot);       // the converter's first result takes 25 of its clocks
    OCR0A = (uint8_t)(uint16_t)list;
    OCR0B = (uint16_t)list >> 8;
    TIMSK1 = 1 << OCIE1A;
    TCCR1B = 1 << CS10;
}

// ------------------------------------------------------------------------------------------------------

// Where the cycle's last channel is full, the sample capacitor brings its volts along: that reading says nothing.
static void look_at_supply(uint8_t done, uint16_t held_code, uint16_t last_code)
{
    const uint8_t now_wraps = (uint8_t)sense_wraps;
    if ((uint8_t)(now_wraps - supply_wraps) >= SUPPLY_EVERY_WRAPS) {
        supply_wraps = now_wraps;
        supply = SUPPLY_WANTED;
    }
    if (supply != SUPPLY_ASKED || done != supply_of)
        return;
    supply = SUPPLY_RESTS;
    if (last_code >= SG_LIGHT_SATURATED_CODE)
        return;
    supply_code = 0;
    if (held_code >= SUPPLY_CODE_LEAST && held_code <= SUPPLY_CODE_MOST)
        supply_code = (uint8_t)held_code;
    if (!supply_boot)
        supply_boot = supply_code;
}

// What follows from the plan, once for each.
SELDOM static void show_plan(struct hal_cycle *cycle, uint8_t index)
{
    const struct plan *plan = &sense_plan[index];
    uint16_t sum = 0;
    memcpy(cycle->reading.exposure_cycles, plan->exposure_cycles, sizeof plan->exposure_cycles);
    for (uint8_t i = 0; i < HAL_CHANNELS; i++)
        sum += plan->exposure_cycles[i];
    // Mean of the mid-exposures: lit are slots 1, 2, 7, 8, 13 and 14, 7.5 on average; sum / 12 as sum * 5461
    // / 2^16.
    sum = (uint16_t)((uint32_t)sum * 5461U >> 16);
    const uint16_t n = plan->slot_cycles;
    const uint16_t mean_to_last = 9 * n + (n >> 1) + sum + 8;
    cycle->span_us = mean_to_last >> 4;
    mean_to_end = mean_to_last + n - SAMPLE_CYCLES;
    shown_plan = index;
}

SELDOM static void show_late(struct sg_reading *reading, struct late *late)
{
    late_shown = late->any;
    memcpy(reading->late_lit_cycles, late->cycles, sizeof late->cycles);
    memset(late, 0, sizeof *late);
}

uint8_t sense_take(struct hal_cycle *cycle)
{
    struct sg_reading *reading = &cycle->reading;
    const struct taken *from;
    uint8_t done;
    uint32_t wraps;
    if (sense_done == sense_took)
        return 0;
    HAL_BEGIN(HAL_SECTION_FRAME);
    do {
        done = sense_done;
        from = filling()->other;
        took_at = now();
        wraps = sense_wraps;
    } while (done != sense_done);
    late_frames += (uint8_t)(done - sense_took - 1);
    sense_took = done;

    // Read without a lock: the interrupt comes back to this one when the other is complete.
    if (from->plan != shown_plan)
        show_plan(cycle, from->plan);
    struct late *late = (struct late *)((uint8_t *)&sense_late[1] - from->turn);    // those of the turn before
    if (late->any || late_shown)
        show_late(reading, late);
    const uint8_t *place = timing.wiring == SG_WIRING_LEDS ? plan_place[0] : plan_place[1];
    const uint16_t *code = &from->code[1];
    for (uint8_t phase = 0; phase < 3; phase++) {
        const uint8_t a = pgm_read_byte(place++), b = pgm_read_byte(place++);
        uint16_t *const to_a = &reading->lit_code[a], *const to_b = &reading->lit_code[b];
        *to_a = *code++;
        *to_b = *code++;
        if (phase == 0)
            code++;
        to_a[UNLIT_AFTER] = *code++;
        to_b[UNLIT_AFTER] = *code++;
    }
    reading->held_code = from->code[0] < HELD_LEAST ? 0 : from->code[0];
    look_at_supply(done, reading->held_code, code[-1]);

    wraps -= (uint8_t)((uint8_t)wraps - from->wraps);
    const uint16_t low = from->end & 15;
    cycle->t_us = us_of(wraps, from->end) - ((uint16_t)(mean_to_end - low) >> 4);
    cycle->seq = from->seq;
    cycle->left = from->left;
    frames += (uint16_t)(from->seq - (uint16_t)frames);
    return 1;
}

void sense_taken(void)
{
    const uint32_t spent = now() - took_at;
    if (cycles_max < spent)
        cycles_max = spent > UINT16_MAX ? UINT16_MAX : (uint16_t)spent;
    late_frames += sense_done != sense_took;
    HAL_END(HAL_SECTION_FRAME);
}

uint8_t sense_idle(void)
{
    return timing.sleep && sense_done == sense_took;
}

uint8_t hal_alarm(void)
{
    uint8_t alarm = locked_out ? SG_ALARM_LOCKOUT : 0;
    const uint8_t moved = supply_code > supply_boot ? supply_code - supply_boot : supply_boot - supply_code;
    // Far out of the window, code 0, is an alarm too, but for boards that never had one within.
    if (25 * (uint16_t)moved > supply_boot)
        alarm |= SG_ALARM_SUPPLY;
    return alarm;
}

void sense_report(struct sg_status *status)
{
    status->frames = frames;
    status->late_frames = late_frames;
    status->cycles_max = cycles_max;
    status->supply_mv = (uint16_t)((uint32_t)supply_code * SUPPLY_MV_PER_CODE_Q8 >> 8);
    status->alarm |= hal_alarm();
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        status->late_slots = late_slots;
    }
}
