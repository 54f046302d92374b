// SPDX-License-Identifier: GPL-3.0-or-later
// Ports C and D as the LEDs feel them: what the registers say goes to leds.h at the cycle of the access, and
// PINC reads the nodes' digital level, because libsimavr has no notion of a floating pin.
#ifndef PINS_H
#define PINS_H

#include <simavr/sim_avr.h>

#include "leds.h"

struct pins {
    avr_t *avr;
    struct leds *leds;
    struct leds_pins state;
};

void pins_attach(struct pins *pins, avr_t *avr, struct leds *leds);
// After every reset of the chip: all pins are inputs.
void pins_reset(struct pins *pins);

#endif
