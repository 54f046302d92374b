// SPDX-License-Identifier: GPL-3.0-or-later
// EEPROM of the ATmega328P with its times: a byte takes 3.4 ms (erase and write) or 1.8 ms (either alone,
// EEPM), EEPE stays set meanwhile, EEMPE falls after four cycles, the ready interrupt is a level. A byte
// under way when the power fails is left corrupt.
#ifndef EEPROM_H
#define EEPROM_H

#include <stdbool.h>
#include <stdint.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>

enum { EEPROM_BYTES = 1024 };

struct eeprom {
    avr_t *avr;
    avr_int_vector_t *ready;
    uint8_t data[EEPROM_BYTES];
    bool busy, dirty;              // dirty: differs from what was saved
    uint16_t address;              // of the byte under way
    uint8_t target, mode;          // value it ends with; EEPM
    uint64_t master_until, began, end;
    uint64_t writes;
};

void eeprom_attach(struct eeprom *eeprom, avr_t *avr);
void eeprom_reset(struct eeprom *eeprom);
// The power fails now.
void eeprom_cut(struct eeprom *eeprom, uint64_t seed);

#endif
