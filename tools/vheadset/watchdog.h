// SPDX-License-Identifier: GPL-3.0-or-later
// Watchdog of the ATmega328P, replacing libsimavr's: timed sequence, interrupt and reset modes, WDE held by
// WDRF. The 128 kHz oscillator is taken as exact. Feeding it costs nothing here, while the stock module files
// a timer for every WDR, which halves the speed of a program that feeds it in its idle loop.
#ifndef WATCHDOG_H
#define WATCHDOG_H

#include <stdbool.h>
#include <stdint.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>

struct watchdog {
    avr_io_t io;               // first: registered to be asked for WDR before the stock module
    avr_t *avr;
    avr_int_vector_t *vector;
    uint64_t fed, change_until;
    bool expired;              // wants a reset
};

void watchdog_attach(struct watchdog *watchdog, avr_t *avr);
// After every reset. held: WDRF is set in MCUSR.
void watchdog_reset(struct watchdog *watchdog, bool held);

#endif
