// SPDX-License-Identifier: GPL-3.0-or-later
// How a peripheral of our own takes a register over from libsimavr 1.6, and at which cycle an access happens.
//
// The core calls register callbacks while an instruction executes, with avr->cycle = the cycle it began at.
// On the chip the access is in the last cycle of the instruction: a write takes effect when the instruction
// ends, a read sees the state one cycle earlier. IN, OUT, SBIC and SBIS take one cycle, the other accesses
// two.
#ifndef ACCESS_H
#define ACCESS_H

#include <stdbool.h>
#include <string.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>

static inline unsigned access_cycles(const avr_t *avr)
{
    uint16_t opcode = (uint16_t)(avr->flash[avr->pc] | avr->flash[avr->pc + 1] << 8);
    return (opcode & 0xF000) == 0xB000 || (opcode & 0xFD00) == 0x9900 ? 1 : 2;
}

static inline uint64_t access_write_cycle(const avr_t *avr)
{
    return avr->cycle + access_cycles(avr);
}

static inline uint64_t access_read_cycle(const avr_t *avr)
{
    return avr->cycle + access_cycles(avr) - 1;
}

// Value a register of write-one-to-clear flags receives: SBI on this chip touches its own bit only, while the
// simulator reads, modifies and writes.
static inline uint8_t access_flags_written(const avr_t *avr, uint8_t value)
{
    uint16_t opcode = (uint16_t)(avr->flash[avr->pc] | avr->flash[avr->pc + 1] << 8);
    return (opcode & 0xFF00) == 0x9A00 ? (uint8_t)(1 << (opcode & 7)) : value;
}

// Replace (not chain) the callbacks of a register. NULL leaves plain memory.
static inline void access_take_write(avr_t *avr, avr_io_addr_t at, avr_io_write_t call, void *param)
{
    avr->io[AVR_DATA_TO_IO(at)].w.c = call;
    avr->io[AVR_DATA_TO_IO(at)].w.param = param;
}

static inline void access_take_read(avr_t *avr, avr_io_addr_t at, avr_io_read_t call, void *param)
{
    avr->io[AVR_DATA_TO_IO(at)].r.c = call;
    avr->io[AVR_DATA_TO_IO(at)].r.param = param;
}

// One of libsimavr's modules by kind ("uart", "adc", ...), whose interrupt vectors we go on using.
static inline avr_io_t *access_module(avr_t *avr, const char *kind)
{
    for (avr_io_t *io = avr->io_port; io; io = io->next)
        if (!strcmp(io->kind, kind))
            return io;
    return NULL;
}

static inline bool access_enabled(const avr_t *avr, const avr_int_vector_t *vector)
{
    return avr->data[vector->enable.reg] >> vector->enable.bit & 1;
}

// An interrupt whose request is a level (RXC, UDRE, EEPROM ready, SPM ready): call whenever the level or its
// enable bit may have changed, and at RETI, because the level asks again.
static inline void access_level(avr_t *avr, avr_int_vector_t *vector, bool level)
{
    if (level && access_enabled(avr, vector)) {
        if (!vector->pending)
            avr_raise_interrupt(avr, vector);
    } else if (vector->pending) {
        avr_clear_interrupt(avr, vector);
    }
}

// An interrupt whose flag is an edge: the flag bit in data[] was set earlier while the enable bit was clear.
static inline void access_edge_enabled(avr_t *avr, avr_int_vector_t *vector)
{
    if (access_enabled(avr, vector) && (avr->data[vector->raised.reg] >> vector->raised.bit & 1)
        && !vector->pending)
        avr_raise_interrupt(avr, vector);
}

// Call `at` at an absolute cycle (not before the present one).
static inline void access_at(avr_t *avr, uint64_t cycle, avr_cycle_timer_t at, void *param)
{
    avr_cycle_timer_register(avr, cycle > avr->cycle ? cycle - avr->cycle : 0, at, param);
}

#endif
