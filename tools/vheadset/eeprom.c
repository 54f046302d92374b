// SPDX-License-Identifier: GPL-3.0-or-later
#include "eeprom.h"

#include <simavr/avr_eeprom.h>

#include "access.h"
#include "noise.h"

enum { EECR = 0x3F, EEDR = 0x40, EEARL = 0x41, EEARH = 0x42 };
enum { EERE = 1, EEPE = 2, EEMPE = 4, EERIE = 8, EEPM = 0x30 };
enum { BOTH_CYCLES = 54400, ONE_CYCLES = 28800 };  // 3.4 ms and 1.8 ms at 16 MHz

static avr_cycle_count_t done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct eeprom *e = param;
    (void)when;
    e->data[e->address] = e->target;
    e->busy = false;
    e->dirty = true;
    e->writes++;
    avr->data[EECR] &= (uint8_t)~EEPE;
    access_level(avr, e->ready, true);
    return 0;
}

static avr_cycle_count_t master_over(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)when, (void)param;
    avr->data[EECR] &= (uint8_t)~EEMPE;
    return 0;
}

static void write_control(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct eeprom *e = param;
    uint64_t now = access_write_cycle(avr);
    uint16_t address = (uint16_t)((avr->data[EEARH] << 8 | avr->data[EEARL]) % EEPROM_BYTES);
    bool armed = (avr->data[at] & EEMPE) && now <= e->master_until;
    uint8_t keep = e->busy ? avr->data[at] & (EEPM | EEPE) : value & EEPM;
    avr->data[at] = (uint8_t)((value & (EERIE | EEMPE)) | keep);
    if ((value & EEMPE) && !armed) {
        e->master_until = now + 4;
        access_at(avr, e->master_until, master_over, e);
    }
    if ((value & EEPE) && armed && !e->busy) {
        e->mode = (uint8_t)(value & EEPM);
        uint8_t old = e->data[address], new = avr->data[EEDR];
        e->target = e->mode == 0x10 ? 0xFF : e->mode == 0x20 ? old & new : new;
        e->address = address;
        e->busy = true;
        e->began = now;
        e->end = now + (e->mode ? ONE_CYCLES : BOTH_CYCLES);
        avr->data[at] = (uint8_t)((avr->data[at] | EEPE) & ~EEMPE);
        access_at(avr, e->end, done, e);
        avr->cycle += 2;  // the CPU stands still for two cycles
    } else if ((value & EERE) && !e->busy) {
        avr->data[EEDR] = e->data[address];
        avr->cycle += 4;
    }
    access_level(avr, e->ready, !e->busy);
}

static void on_return(avr_irq_t *irq, uint32_t running, void *param)
{
    struct eeprom *e = param;
    (void)irq;
    if (!running)
        access_level(e->avr, e->ready, !e->busy);
}

void eeprom_attach(struct eeprom *e, avr_t *avr)
{
    memset(e, 0, sizeof *e);
    memset(e->data, 0xFF, sizeof e->data);
    e->avr = avr;
    e->ready = &((avr_eeprom_t *)access_module(avr, "eeprom"))->ready;
    access_take_write(avr, EECR, write_control, e);
    avr_irq_register_notify(&e->ready->irq[AVR_INT_IRQ_RUNNING], on_return, e);
}

// A write goes on through a reset.
void eeprom_reset(struct eeprom *e)
{
    if (!e->busy)
        return;
    e->avr->data[EECR] |= EEPE;
    access_at(e->avr, e->end, done, e);
}

void eeprom_cut(struct eeprom *e, uint64_t seed)
{
    if (!e->busy)
        return;
    uint8_t old = e->data[e->address], random = (uint8_t)noise_bits(seed, NOISE_CORRUPT, e->avr->cycle);
    bool erasing = e->mode == 0x10 || (!e->mode && e->avr->cycle < e->began + (e->end - e->began) / 2);
    // Half erased: some zeros have become ones. Half written: some zeros are not there yet.
    e->data[e->address] = erasing ? old | random : e->target | (random & (e->mode == 0x20 ? old : 0xFF));
    e->busy = false;
    e->dirty = true;
}
