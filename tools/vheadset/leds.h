// SPDX-License-Identifier: GPL-3.0-or-later
// The six sensors, electrically: anode of LED i on PC i through a resistor, all cathodes on a quiet rail.
//
// Wiring    leds: the same six LEDs emit when their pin is high. photodiodes: photodiodes on PC 0..5 with
//           their cathodes on the rail, three emitters from PD 2..4 to ground, lit when their pin is high.
// Node      the anode, with the junction's and the pin's capacitance. A driven pin sets it at once. Pin low:
//           0 V, the junction reverse-biased. With the pin an input without pull-up it floats: photocurrent,
//           ambient light and leakage raise it from there.
// Charge    q(V) of charge.h. The charge collected while floating is integrated exactly over stretches in
//           which nothing else changes, each with the response map at its middle; q is then inverted.
// Sampling  from the start of a conversion to its sample, the sample capacitor, still holding the last
//           converted voltage, hangs on the node: the sum of both charges is kept, and both are charged
//           together. A driven node is stiff and simply charges it.
// Ceiling   illuminated, the junction stops at a forward voltage: the node does not rise above
//           rail + 0.25 V.
// Rail      carries noise, drawn independently at every release and every sample, and rises by rail_ohm times
//           the current sent into it. A floating node follows by the share of its junction capacitance.
// Supply    lamps.h; nothing of a floating node depends on it.
// Faults    belong to a part, not to a pin: parts may be exchanged by leds_swap().
#ifndef LEDS_H
#define LEDS_H

#include <stdbool.h>
#include <stdint.h>

#include "charge.h"
#include "config.h"
#include "lamps.h"
#include "light.h"

struct adc;

// Parts 0..5 are the LEDs or photodiodes; 6..8 the emitters of the photodiode wiring.
enum { LEDS_COUNT = 6, LEDS_EMITTERS = 3, LEDS_PARTS = LEDS_COUNT + LEDS_EMITTERS };

enum led_drive { LED_LOW, LED_HIGH, LED_PULLUP, LED_FLOAT };

enum led_fault { FAULT_NONE, FAULT_OPEN, FAULT_SHORT, FAULT_SHORT_GROUND, FAULT_COVERED, FAULT_FINGER };

struct led_part {
    double sensor, emitter;    // spread, 1 = nominal
    double leakage_na;
    enum led_fault fault;
};

struct led {                   // a pin of port C
    enum led_drive drive;
    double charge_pc;          // of the floating node at `since`
    double volts;              // of the pulled-up node at `since`
    uint64_t since;
    uint64_t event;            // last change of drive, or sample while floating
    int part;
};

struct leds_pins { uint8_t port_c, ddr_c, port_d, ddr_d; bool pull_ups; };  // registers; pull-ups enabled

struct leds {
    const struct physics *physics;
    const struct board_wiring *wiring;
    struct adc *adc;
    struct light light;
    struct lamps lamps;
    uint64_t seed;
    double warmer_k;           // headset temperature above 25 C
    struct leds_pins pins;
    uint64_t releases, samples;                // count draws
    int joined;                                // pin whose node carries the sample capacitor, or -1
    // Told "drive0".."drive5" with the new enum led_drive and "lit" with the new mask; may be NULL.
    void (*log)(void *param, const char *what, int value, uint64_t cycle);
    void *log_param;
    struct led led[LEDS_COUNT];
    struct led_part part[LEDS_PARTS];
};

// All pins are inputs at first. adc must be attached before time passes.
void leds_attach(struct leds *leds, struct adc *adc, struct person *person, const struct sim_map *map,
                 const struct config *config, double cycles_per_true_second);
// The pins are driven like this from a cycle on.
void leds_drive(struct leds *leds, const struct leds_pins *pins, uint64_t cycle);
// The power was off: every node is empty.
void leds_empty(struct leds *leds, uint64_t cycle);
// What PINC reads at a cycle.
uint8_t leds_digital(struct leds *leds, uint64_t cycle);

// Draw noise from here on: the seed of a session.
void leds_seed(struct leds *leds, uint64_t seed);

// Bring all nodes and samples forward to a cycle: call before anything changes that they depend on, such as
// leds->light, warmer_k or lamps.
void leds_settle(struct leds *leds, uint64_t cycle);
// Change the state of a part from a cycle on.
void leds_set_fault(struct leds *leds, int part, enum led_fault fault, uint64_t cycle);
// Exchange the parts on two pins from a cycle on.
void leds_swap(struct leds *leds, int a, int b, uint64_t cycle);

// Join the sample capacitor, which holds held_volts, to the node of a pin at a cycle.
void leds_join(struct leds *leds, int pin, uint64_t cycle, double held_volts);
// Separate it again. Returns the voltage it now holds.
double leds_sample(struct leds *leds, int pin, uint64_t cycle);
// Separate it at a conversion that was called off.
void leds_part(struct leds *leds, uint64_t cycle);
// What the supply divider shows at a sample, with ripple.
double leds_divider(struct leds *leds, uint64_t cycle);

// Voltage of a node at a cycle (not before the last event), looked at without disturbing anything.
double leds_peek(struct leds *leds, int pin, uint64_t cycle);

#endif
