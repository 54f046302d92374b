// SPDX-License-Identifier: GPL-3.0-or-later
// The six LEDs, electrically. LED i has its cathode on PC i and its anode, through a resistor, on PD (2 + i).
//
// Node      the cathode with the junction's and the pin's capacitance. Driven pins set it at once. With the
//           anode low and the cathode an input without pull-up it floats: photocurrent, ambient light and
//           leakage discharge it.
// Charge    F(V) = Qj(V) + pin_pf V, Qj(V) = integral of C0 / (1 + v/0.7)^0.4 from 0 to V. Integrated
//           exactly: the charge collected while floating is a sum over stretches of constant emitters, each
//           with the response map at its middle; F is then inverted by Newton's method (to 1e-12 V).
// Sampling  from the start of a conversion to its sample, the sample capacitor, still holding the last
//           converted voltage, hangs on the node: the sum of both charges is kept, and both are discharged
//           together. A driven node is stiff and simply charges it.
// Floor     illuminated, the junction stops at a forward voltage: the node does not fall below -0.25 V. The
//           charged capacitor joins late, so a channel that ran into the floor reads 1.1 V or less, not zero.
// Supply    each lit emitter draws 20 mA through source_ohm; ripple is drawn anew for every release of a
//           node, every sample of a driven node and every conversion's reference.
#ifndef LEDS_H
#define LEDS_H

#include <stdbool.h>
#include <stdint.h>

#include <simavr/sim_avr.h>

#include "config.h"

struct adc;
struct person;
struct sim_map;

enum { LEDS_COUNT = 6, LEDS_STRETCHES = 24, LEDS_HISTORY = 32 };

enum led_drive {
    LED_OFF,      // node held low, or the LED biased in a way that neither lights nor senses
    LED_EMIT,     // anode high, cathode low: lit
    LED_REVERSE,  // cathode driven high
    LED_PULLUP,   // cathode an input with its pull-up on
    LED_FLOAT,    // cathode an input, anode low: sensing
    LED_OPEN,     // cathode an input, anode an input: nothing to discharge through
};

struct led_stretch { uint64_t since; uint8_t lit; };  // from a cycle on, these emitters were lit

struct led {
    enum led_drive drive;
    double volts;              // of the node at `since`
    uint64_t since;
    struct led_stretch stretch[LEDS_STRETCHES];
    int stretches;
    double sensor, emitter;    // part spread, 1 = nominal
    double leakage_na;
};

struct leds {
    avr_t *avr;
    const struct physics *physics;
    const struct sim_map *map; // NULL: no emitter reaches a sensor
    struct person *person;
    struct adc *adc;
    uint64_t seed;
    double cycles_per_true_second;
    double map_reference;      // mean of the map that gives nominal_na; 0 = this map's own
    double scale_na;           // photocurrent per map unit
    double sensitivity;        // of this light level, relative to nominal
    double ambient_na, ambient_flicker, flicker_hz, flicker_phase;
    double warmer_k;           // headset temperature above 25 C
    uint8_t port_c, ddr_c, port_d, ddr_d;
    uint8_t lit;
    struct led_stretch history[LEDS_HISTORY];  // ring of changes of `lit`, for the supply
    unsigned history_next;
    uint64_t releases, samples;                // count draws
    int joined;                                // LED whose node carries the sample capacitor, or -1
    uint64_t response_cycle;
    bool response_known;
    double response[LEDS_COUNT * LEDS_COUNT];
    struct led led[LEDS_COUNT];
};

void leds_attach(struct leds *leds, avr_t *avr, struct adc *adc, struct person *person,
                 const struct sim_map *map, const struct config *config, double cycles_per_true_second);
// After every reset of the chip: all pins are inputs. fresh: power was off, every node is empty.
void leds_reset(struct leds *leds, bool fresh);

// Draw noise from here on: the seed of a session.
void leds_seed(struct leds *leds, uint64_t seed);
void leds_set_ambient(struct leds *leds, enum ambient ambient);
void leds_set_light(struct leds *leds, enum light light);

// Join the sample capacitor, which holds held_volts, to the node of a channel at a cycle.
void leds_join(struct leds *leds, int channel, uint64_t cycle, double held_volts);
// Separate it again. Returns the voltage it now holds.
double leds_sample(struct leds *leds, int channel, uint64_t cycle);
// Separate it at a conversion that was called off.
void leds_part(struct leds *leds, uint64_t cycle);
// Supply at a recent cycle, without ripple.
double leds_supply_volts(const struct leds *leds, uint64_t cycle);
double leds_temperature_k(const struct leds *leds);  // above 25 C

// Voltage of a node at a cycle (not before the last event), looked at without disturbing anything.
double leds_peek(struct leds *leds, int index, uint64_t cycle);

// Junction and pin charge in pC (volts times pF), and its inverse.
double leds_charge_pc(const struct physics *physics, double volts, double extra_pf);
double leds_volts(const struct physics *physics, double charge_pc, double extra_pf);

#endif
