// SPDX-License-Identifier: GPL-3.0-or-later
// The board: libsimavr's ATmega328P at 16 MHz with our peripherals, the LEDs, the person before them, power
// and reset. Time is avr->cycle: it starts at 0 with the program, never goes back, and passes while the power
// is off too.
#ifndef NANO_H
#define NANO_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "adc.h"
#include "bridge.h"
#include "config.h"
#include "eeprom.h"
#include "leds.h"
#include "markers.h"
#include "person.h"
#include "pins.h"
#include "schedule.h"
#include "selfprog.h"
#include "timer1.h"
#include "uart.h"
#include "watchdog.h"

// Bits of MCUSR.
enum nano_reset { NANO_RESET_POWER = 1, NANO_RESET_EXTERNAL = 2, NANO_RESET_WATCHDOG = 8 };

struct nano {
    avr_t *avr;
    struct config config;
    struct bridge *bridge;
    struct sim_map *map;         // NULL: no emitter reaches a sensor
    struct timer1 timer1;
    struct adc adc;
    struct uart uart;
    struct eeprom eeprom;
    struct selfprog selfprog;
    struct watchdog watchdog;
    struct leds leds;
    struct pins pins;
    struct person person;
    struct markers markers;
    struct schedule schedule;
    double cycles_per_true_second;
    bool powered;
    uint64_t session;            // times the power was switched on before, ever: kept in the state folder
    uint64_t noise_seed;         // of this session
    uint8_t reset_flags;         // MCUSR, which a reset keeps
    uint64_t cut_cycle;          // power fails there; UINT64_MAX = not planned
    uint64_t asleep_cycles;      // spent sleeping since the counters were cleared
    uint64_t resets, watchdog_resets, power_ons, crashes;
};

// Load everything the configuration names and switch the power on at cycle 0. bridge must be open.
// Returns 0, or -1 with a one-line reason in error.
int nano_open(struct nano *nano, const struct config *config, struct bridge *bridge, char *error,
              size_t error_bytes);
void nano_close(struct nano *nano);

// Let time pass up to a cycle (overshooting by less than one instruction while the CPU runs).
void nano_run_until(struct nano *nano, uint64_t cycle);
// Start the tally of lamps and sleep anew.
void nano_clear_counters(struct nano *nano);
// Press the reset button. No effect without power.
void nano_press_reset(struct nano *nano);
// Returns 0, or -1 with errno set when the images could not be saved.
int nano_power(struct nano *nano, bool on);
// Save the images that changed since they were last saved. Returns 0, or -1 with errno set.
int nano_save(struct nano *nano);

#endif
