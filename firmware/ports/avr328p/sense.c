// SPDX-License-Identifier: Apache-2.0
// The sensing engine as the main loop sees it: what to sense next (exposures, timing, lights), what was sensed, and
// the pauses between frames. The cycles themselves run in sense_isr.c after the plans of plan.c.
#include "port_sense.h"

#include <string.h>

enum {
    WAIT_AT = 120,                  // compare match of EVENT_WAIT after that of the service before it
    PAUSE_LEAST_SLOTS = 3,
    RESTART_CYCLES = 600,           // before a frame that begins out of turn
    PAUSE_CHUNK_CYCLES = 0x8000,    // waited for at once
    PAUSE_WHOLE_CYCLES = 0xC000,
    LOCKOUT_WRAPS = LOCKOUT_MS * (F_CPU / 1000) / 65536 + 1,
    HELD_LEAST = 9,                 // code: what is below is an offset of the converter, not a voltage
    SUPPLY_CYCLES_LOG2 = 10,        // looked at once in so many cycles
    SUPPLY_FIRST = 16,
    SUPPLY_TRIES = 8,
    SUPPLY_CODE_LEAST = 130,        // 4.2 V at a bandgap of 1.2 V,
    SUPPLY_CODE_MOST = 235,         // 5.7 V at 1.0 V: beyond, nothing or something else is on the pin
    SUPPLY_MV_PER_CODE_Q8 = 6875,   // 1.1 V / 1024 / 0.04
};

static struct taken ring[2] = { { .other = &ring[1] }, { .other = &ring[0] } };

uint8_t sense_gap[GAP_BYTES];
const uint8_t *volatile sense_list_next;
uint16_t *sense_out;
uint16_t sense_slot;
uint16_t sense_base;
volatile uint32_t sense_wraps;
uint8_t sense_left, sense_last;
uint16_t sense_seq;
uint8_t sense_drop;
uint8_t sense_pause;
volatile uint8_t sense_current;
volatile uint8_t sense_done;

static volatile uint8_t alive;
static volatile uint8_t plan_next;          // index of the plan to begin with, or to go on with
static volatile uint8_t restart;            // timing changed: begin a frame with it
static uint8_t pausing;
static uint32_t pause_left;
static uint32_t pause_cycles;               // between frames; 0: none
static volatile uint16_t late_slots;

static struct hal_timing timing;            // asked for
static uint16_t exposure[HAL_CHANNELS];     // asked for, clipped
static uint16_t slot;                       // of `timing`
static uint8_t timing_new, plan_new;        // asked for and not in a plan yet
static uint8_t locked_out;
static uint8_t took;                        // cycles taken, low byte
static uint16_t late_frames;
static uint32_t frames;
static uint32_t taken_ticks;
static uint16_t cycles_max;
static uint16_t cycles;                     // taken, low half
static uint8_t supply_tries;                // left of this look at the supply
static uint8_t supply_code, supply_boot;    // 0: unknown

// Call with interrupts off.
static uint32_t wraps_at(uint16_t ticks)
{
    return sense_wraps + (ticks < sense_base);
}

static void base_at(uint16_t ticks)
{
    sense_wraps = wraps_at(ticks);
    sense_base = ticks;
}

static uint32_t ticks_now(void)
{
    uint32_t high;
    uint16_t ticks;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        ticks = TCNT1;
        high = wraps_at(ticks);
    }
    return high << 16 | ticks;
}

uint32_t hal_now_us(void)
{
    uint32_t high;
    uint16_t ticks;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        ticks = TCNT1;
        high = wraps_at(ticks);
    }
    return high << 12 | ticks >> 4;
}

static struct taken *filling(void)
{
    return sense_out < ring[1].code ? &ring[0] : &ring[1];
}

// A frame whose first cycle's hold is at `hold`, by TCNT1.
static const uint8_t *begin_at(uint16_t hold)
{
    const struct plan *plan = &sense_plan[plan_next];
    pausing = 0;
    if (restart) {
        restart = 0;
        if (sense_left != sense_last)
            sense_seq++;            // the one under way is cut short
        sense_last = timing.repeats - 1;
        sense_left = sense_last;
        sense_slot = plan->slot_cycles;
        sense_pause = pause_cycles != 0;
        const uint16_t second = sense_slot - HOLD_AT + SERVICE_AT;
        sense_gap[0] = (uint8_t)second;
        sense_gap[1] = EVENT_DARK_STORE >> 8 | second >> 8;
        sense_gap[2] = ADMUX_GROUND;
        sense_gap[3] = WAIT_AT;
        sense_gap[4] = EVENT_COMPLETE >> 8;
        sense_gap[5] = ADMUX_GROUND;
    }
    // As if another cycle had gone before: a conversion of GND, the next trigger a slot later, nothing of it kept.
    OCR1B = hold - HOLD_AT;
    TIFR1 = 1 << OCF1B;
    ADMUX = ADMUX_GROUND;
    OCR1A = hold;
    sense_drop = 1;
    sense_out = &filling()->code[CODES - 2];
    sense_list_next = sense_pause && sense_left == 0 ? sense_gap : plan->event;
    return plan->event;
}

const uint8_t *sense_wait(void)
{
    const uint16_t match = OCR1A;
    base_at(match);
    alive++;
    if (!pausing) {
        pausing = 1;
        pause_left = pause_cycles - (sense_slot - HOLD_AT + SERVICE_AT + WAIT_AT);
    }
    if (restart)
        pause_left = RESTART_CYCLES;
    if (pause_left > PAUSE_WHOLE_CYCLES) {
        pause_left -= PAUSE_CHUNK_CYCLES;
        OCR1A = match + PAUSE_CHUNK_CYCLES;
        return &sense_gap[GAP_WAIT_AT];
    }
    return begin_at(match + (uint16_t)pause_left);
}

const uint8_t *sense_give_up(void)
{
    const uint16_t now = TCNT1;
    base_at(now);
    late_slots++;
    if (sense_left != sense_last) {
        sense_seq++;
        sense_left = sense_last;
    }
    const uint8_t *list = begin_at(now + RESTART_CYCLES);
    TIFR1 = 1 << OCF1A;
    return list;
}

void sense_late(uint8_t channels, uint8_t cycles, uint8_t kind)
{
    const uint8_t unlit = (kind & EVENT_UNLIT >> 8) != 0;
    struct taken *into = filling();
    // The first lit releases of a cycle may come before the last codes of the one before.
    const uint8_t early = sense_out > &into->code[CODES - 3] && !unlit;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++, channels >>= 1) {
        if (!(channels & 1))
            continue;
        const uint8_t first = i == plan_channel(timing.wiring, 0, 0) || i == plan_channel(timing.wiring, 0, 1);
        (early && first ? into->other : into)->late[unlit][i] = cycles;
    }
}

// ------------------------------------------------------------------------------------------------------

uint16_t hal_exposure_most(uint8_t channel)
{
    return plan_exposure_most(channel, timing.wiring, slot);
}

void hal_expose(uint16_t exposure_cycles[HAL_CHANNELS])
{
    plan_clip(exposure_cycles, timing.wiring, slot);
    memcpy(exposure, exposure_cycles, sizeof exposure);
    plan_new = 1;
}

// Cycles per slot that make frames of `frame` cycles without a pause, to the nearest, without a division.
static uint16_t slot_for(uint32_t frame, uint8_t repeats)
{
    const uint16_t step = SLOTS * repeats;
    uint16_t n = SLOT_CYCLES_MIN;
    for (uint32_t at = (uint32_t)step * SLOT_CYCLES_MIN + step / 2; at <= frame && n < SLOT_CYCLES_MAX; at += step)
        n++;
    return n;
}

static uint32_t pause_of(const struct hal_timing *t, uint16_t slot_cycles)
{
    const uint32_t sensing = (uint32_t)(SLOTS * t->repeats) * slot_cycles;
    return t->frame_cycles > sensing ? t->frame_cycles - sensing : 0;
}

void hal_set_timing(struct hal_timing *t)
{
    if (t->repeats < 1)
        t->repeats = 1;
    if (t->repeats > SG_LIGHT_REPEATS_MAX)
        t->repeats = SG_LIGHT_REPEATS_MAX;
    uint16_t n = slot_for(t->period_cycles, 1);
    uint32_t pause = pause_of(t, n);
    if (pause < PAUSE_LEAST_SLOTS * n) {
        if (t->frame_cycles)
            n = slot_for(t->frame_cycles, t->repeats);
        while ((pause = pause_of(t, n)) >= SLOTS * (uint16_t)t->repeats && pause < PAUSE_LEAST_SLOTS * n)
            n--;                    // cycles cannot be that long: shorter ones, and a pause
        if (pause < PAUSE_LEAST_SLOTS * n)
            pause = 0;
    }
    t->period_cycles = SLOTS * n;
    if (t->frame_cycles || pause)
        t->frame_cycles = (uint32_t)t->repeats * t->period_cycles + pause;
    timing = *t;
    slot = n;
    plan_clip(exposure, t->wiring, n);
    timing_new = 1;
    plan_new = 1;
}

static void write_plan(uint8_t index)
{
    struct hal_timing lit = timing;
    struct plan *plan = &sense_plan[index];
    if (locked_out)
        lit.lights = 0;
    memcpy(plan->exposure_cycles, exposure, sizeof exposure);
    plan->slot_cycles = slot;
    plan_write(plan, &lit);
    if (supply_tries)
        *plan->first_mux = ADMUX_SUPPLY;
}

void sense_poll(void)
{
    if (locked_out && sense_wraps >= LOCKOUT_WRAPS) {
        locked_out = 0;
        plan_new = 1;
    }
    // The other plan is free once a cycle that follows this one is complete up to the last that did not.
    if (!plan_new || sense_current != plan_next || sense_done != took)
        return;
    const uint8_t index = !plan_next;
    write_plan(index);
    plan_new = 0;
    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        plan_next = index;
        if (timing_new) {
            timing_new = 0;
            pause_cycles = pause_of(&timing, slot);
            restart = 1;
            sense_list_next = sense_gap;
        } else if (sense_list_next != sense_gap) {
            sense_list_next = sense_plan[index].event;
        }
    }
}

void sense_start(struct hal_timing *t, uint16_t exposure_cycles[HAL_CHANNELS])
{
    locked_out = (boot_reset_cause() & SG_RESET_WATCHDOG) != 0;
    memcpy(exposure, exposure_cycles, sizeof exposure);
    hal_set_timing(t);
    memcpy(exposure_cycles, exposure, sizeof exposure);
    write_plan(0);
    plan_new = 0;
    timing_new = 0;
    pause_cycles = pause_of(&timing, slot);
    restart = 1;
    sense_gap[GAP_WAIT_AT + 1] = EVENT_WAIT >> 8;
    sense_out = ring[0].code;

    PORTC = 0;
    PORTD = PORTD_DARK;
    DDRC = PORTC_ALL;
    if (timing.wiring == SG_WIRING_PHOTODIODES)
        DDRD = 7 << FIRST_EMITTER;
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
    TIFR1 = 1 << OCF1A;
    TIMSK1 = 1 << OCIE1A;
    TCCR1B = 1 << CS10;
}

// ------------------------------------------------------------------------------------------------------

static void convert_first(uint8_t admux)
{
    for (uint8_t i = 0; i < 2; i++)
        if (sense_plan[i].first_mux)
            *sense_plan[i].first_mux = admux;
}

// Once a second the first GND slot converts the divider at A7 instead, until a code of it has come or too many have
// not.
static void look_at_supply(uint16_t held_code)
{
    if ((++cycles & ((1 << SUPPLY_CYCLES_LOG2) - 1)) == SUPPLY_FIRST) {
        supply_tries = SUPPLY_TRIES;
        convert_first(ADMUX_SUPPLY);
    } else if (supply_tries) {
        if (held_code == 0 && --supply_tries)
            return;
        supply_tries = 0;
        convert_first(ADMUX_GROUND);
        supply_code = 0;
        if (held_code >= SUPPLY_CODE_LEAST && held_code <= SUPPLY_CODE_MOST)
            supply_code = (uint8_t)held_code;
        if (!supply_boot)
            supply_boot = supply_code;
    }
}

uint8_t sense_alive(void)
{
    return sense_done + alive;
}

uint8_t sense_take(struct hal_cycle *cycle)
{
    struct taken *from;
    uint8_t done;
    uint32_t wraps;
    uint16_t half_sum = 0;
    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        done = sense_done;
        from = filling()->other;
        wraps = sense_wraps;
    }
    if (done == took)
        return 0;
    HAL_BEGIN(HAL_SECTION_FRAME);
    taken_ticks = ticks_now();
    late_frames += (uint8_t)(done - took - 1);
    took = done;

    // Read without a lock: the interrupt comes back to this one when the other is complete.
    const struct plan *plan = &sense_plan[from->plan];
    struct sg_reading *reading = &cycle->reading;
    const uint16_t *code = &from->code[1];
    for (uint8_t phase = 0; phase < 3; phase++, code += 4)
        for (uint8_t k = 0; k < 2; k++) {
            const uint8_t i = plan_channel(timing.wiring, phase, k);
            reading->lit_code[i] = code[k];
            reading->unlit_code[i] = code[2 + k];
        }
    memcpy(reading->exposure_cycles, plan->exposure_cycles, sizeof reading->exposure_cycles);
    memcpy(reading->late_lit_cycles, from->late[0], sizeof from->late[0]);
    memcpy(reading->late_unlit_cycles, from->late[1], sizeof from->late[1]);
    memset(from->late, 0, sizeof from->late);
    reading->held_code = from->code[0] < HELD_LEAST ? 0 : from->code[0];
    look_at_supply(reading->held_code);

    // Mean of the mid-exposures: slots 1, 2, 7, 8, 13, 14 are 7.5 on average; sum / 12 as sum * 5461 / 2^16.
    for (uint8_t i = 0; i < HAL_CHANNELS; i++)
        half_sum += plan->exposure_cycles[i];
    half_sum = (uint16_t)((uint32_t)half_sum * 5461U >> 16);
    const uint16_t n = plan->slot_cycles;
    const uint16_t from_end = (uint16_t)(10 * n + (n >> 1)) - SAMPLE_CYCLES + half_sum;
    wraps -= (uint8_t)((uint8_t)wraps - from->wraps);
    const uint32_t end_us = wraps << 12 | from->end >> 4;
    cycle->t_us = end_us - ((from_end - (from->end & 15U) + 8U) >> 4);
    cycle->span_us = (uint16_t)(9 * n + (n >> 1) + half_sum + 8U) >> 4;
    cycle->seq = from->seq;
    cycle->left = from->left;
    frames += (uint16_t)(from->seq - (uint16_t)frames);
    return 1;
}

void sense_taken(void)
{
    const uint32_t spent = ticks_now() - taken_ticks;
    if (spent > cycles_max)
        cycles_max = spent > UINT16_MAX ? UINT16_MAX : (uint16_t)spent;
    late_frames += sense_done != took;
    HAL_END(HAL_SECTION_FRAME);
}

uint8_t sense_idle(void)
{
    return timing.sleep && sense_done == took;
}

uint8_t hal_alarm(void)
{
    uint8_t alarm = locked_out ? SG_ALARM_LOCKOUT : 0;
    const uint8_t moved = supply_code > supply_boot ? supply_code - supply_boot : supply_boot - supply_code;
    if (supply_code && 25 * (uint16_t)moved > supply_boot)
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
