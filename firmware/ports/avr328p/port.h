// SPDX-License-Identifier: Apache-2.0
// Between the source files of this port. One noun each: boot, plan, sense, serial, store, and poll, which
// joins them.
#ifndef PORT_H
#define PORT_H

#include <avr/interrupt.h>
#include <avr/io.h>
#include <stdint.h>
#include <util/atomic.h>

#include "hal.h"

enum port_limits {
    CYCLES_PER_US = 16,
    // A sensing cycle is 18 slots, a conversion each: three phases of GND, a lit, b lit, GND, a unlit, b
    // unlit.
    SLOTS = 18,
    SLOT_CYCLES_MIN = 888,          // a conversion takes 868 of them
    SLOT_CYCLES_MAX = 1777,
    // TCNT1 = OCR1B to the closing of sample-and-hold: the flag rises one cycle after the match, three cycles
    // go into synchronisation (datasheet, ADC auto triggering), then two ADC clocks of 64 cycles.
    SAMPLE_CYCLES = 1 + 3 + 2 * 64,
    EXPOSURE_MIN_CYCLES = 64,
    // Of a pair's second: let go, late as it may be, before the sample capacitor comes with what the first
    // left on it.
    EXPOSURE_SECOND_MIN_CYCLES = 136,
    // The eye-safety cap: the first sensor of a pair is exposed at most 2 slots less this, the second 3 slots
    // less this, and lights are on from at most LIGHTS_AHEAD_CYCLES before the first release until just after
    // the second sample: 3 of the 6 slots of a phase. No command and no caller gets past plan_clip().
    EXPOSURE_LESS_CYCLES = 120,
    LIGHTS_AHEAD_CYCLES = 120,
    LOCKOUT_MS = 1000,              // lights stay off that long after a reset by the watchdog
    SLOT_A = 0x6C00,
    SLOT_B = 0x7200,
    SLOT_BYTES = 1536,
};

// boot.c
uint8_t boot_reset_cause(void);         // bits of enum sg_reset
uint8_t boot_look_at_stack(void);       // goes on looking for its deepest byte; 1 when that is found
uint16_t boot_stack_free(void);         // bytes between the static data and the deepest found last
void boot_watchdog_on(void);            // 120 ms
_Noreturn void boot_restart(void);      // through the watchdog, lights out first

// sense.c
void sense_start(struct hal_timing *timing, uint16_t exposure_cycles[HAL_CHANNELS]);
uint8_t sense_alive(void);              // changes with every cycle, and during a pause
uint8_t sense_take(struct hal_cycle *cycle);    // 1 if a new cycle was there
void sense_taken(void);                 // the cycle is dealt with; late if the next already waits
void sense_poll(void);                  // plans what was asked for
uint8_t sense_idle(void);               // call with interrupts off: 1 if no cycle waits and sleep is wanted
void sense_report(struct sg_status *status);

// serial.c
void serial_start(void);
uint8_t serial_poll(void);              // delivers received bytes; acts once the line has drained
uint8_t serial_idle(void);              // nothing to deliver and nothing to do once the line has drained
uint16_t serial_overruns(void);

// store.c
uint8_t store_busy(void);
void store_poll(void);                  // at most one byte per call, never waits
uint16_t store_writes(void);

#endif
