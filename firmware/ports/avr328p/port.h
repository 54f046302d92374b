// SPDX-License-Identifier: Apache-2.0
// Between the source files of this port. One noun each: boot, sense, serial, store, and poll, which joins
// them.
#ifndef PORT_H
#define PORT_H

#include <avr/interrupt.h>
#include <avr/io.h>
#include <stdint.h>
#include <util/atomic.h>

#include "hal.h"

enum port_limits {
    CYCLES_PER_US = 16,
    SLOT_CYCLES = 640 * CYCLES_PER_US,
    EXPOSURE_MIN_CYCLES = 16 * CYCLES_PER_US,
    // The eye-safety cap. Lit are 5 us of settling, the exposure and the few us until the interrupt after the
    // sample: below 320 of every 640 us. No command and no caller gets past hal_expose().
    EXPOSURE_MAX_CYCLES = 304 * CYCLES_PER_US,
    SLOT_A = 0x6000,
    SLOT_B = 0x6C00,
};

// boot.c
uint8_t boot_reset_cause(void);         // bits of enum sg_reset
uint16_t boot_stack_free(void);         // bytes between the static data and the deepest stack since boot
void boot_watchdog_on(void);            // 120 ms
_Noreturn void boot_restart(void);      // through the watchdog, lights out first

// sense.c
void sense_start(const uint16_t exposure_cycles[HAL_CHANNELS]);
uint8_t sense_take(struct hal_frame *frame);    // 1 if a new frame was there
void sense_taken(void);                 // the frame is dealt with; late if the next already waits
void sense_report(struct sg_status *status);

// serial.c
void serial_start(void);
uint8_t serial_room(void);              // bytes free in the send queue
uint8_t serial_poll(void);              // delivers received bytes; acts once the line has drained
uint16_t serial_overruns(void);

// store.c
uint8_t store_busy(void);
void store_poll(void);                  // at most one byte per call, never waits
uint16_t store_writes(void);

#endif
