// SPDX-License-Identifier: GPL-3.0-or-later
// Self-programming of the ATmega328P, replacing libsimavr's SPM.
//
// Page erase and page write take 4 ms each. In the read-while-write section (below 0x7000) they run while the
// CPU goes on; until RWWSRE that section reads as 0xFF. Above, the CPU stands still. A write only clears
// bits; words not filled keep their value. Only code at or above the boot section's start may program, and
// (lock bits 0xCF, as shipped) not the boot section itself. A page under way when the power fails is left
// corrupt.
#ifndef SELFPROG_H
#define SELFPROG_H

#include <stdbool.h>
#include <stdint.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>

enum { FLASH_BYTES = 32768, FLASH_PAGE_BYTES = 128, FLASH_RWW_BYTES = 0x7000 };

struct selfprog {
    avr_io_t io;                     // first: registered with the simulator to be asked before its own module
    avr_t *avr;
    avr_int_vector_t *ready;
    uint8_t flash[FLASH_BYTES];      // what is programmed; avr->flash is what can be read now
    uint8_t buffer[FLASH_PAGE_BYTES];
    bool filled[FLASH_PAGE_BYTES / 2];
    uint32_t boot_start;             // first byte of the boot section
    bool busy, hidden, erasing, dirty;
    uint16_t page;                   // address of the page under way
    uint64_t armed_until, began, end;
    uint64_t denied, page_writes;
};

void selfprog_attach(struct selfprog *selfprog, avr_t *avr, uint32_t boot_start);
void selfprog_reset(struct selfprog *selfprog);
// The programmed contents were changed from outside: make them readable.
void selfprog_show(struct selfprog *selfprog);
void selfprog_cut(struct selfprog *selfprog, uint64_t seed);

#endif
