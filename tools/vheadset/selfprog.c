// SPDX-License-Identifier: GPL-3.0-or-later
#include "selfprog.h"

#include <simavr/avr_flash.h>

#include "access.h"
#include "noise.h"

enum { SPMCSR = 0x57, R0 = 0, R1 = 1, ZL = 30, ZH = 31 };
enum { SPMEN = 1, PGERS = 2, PGWRT = 4, BLBSET = 8, RWWSRE = 0x10, RWWSB = 0x40, SPMIE = 0x80 };
enum { PAGE_CYCLES = 64000 };  // 4 ms at 16 MHz

void selfprog_show(struct selfprog *s)
{
    memcpy(s->avr->flash, s->flash, FLASH_BYTES);
    if (s->hidden)
        memset(s->avr->flash, 0xFF, FLASH_RWW_BYTES);
}

static void empty_buffer(struct selfprog *s)
{
    memset(s->buffer, 0xFF, sizeof s->buffer);
    memset(s->filled, 0, sizeof s->filled);
}

static void finish(struct selfprog *s)
{
    uint8_t *page = s->flash + s->page;
    for (int i = 0; i < FLASH_PAGE_BYTES; i++)
        page[i] = s->erasing ? 0xFF : page[i] & s->buffer[i];
    if (!s->erasing) {
        empty_buffer(s);
        s->page_writes++;
    }
    s->busy = false;
    s->dirty = true;
    selfprog_show(s);
}

static avr_cycle_count_t done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct selfprog *s = param;
    (void)when;
    finish(s);
    avr->data[SPMCSR] &= (uint8_t)~(SPMEN | PGERS | PGWRT);
    access_level(avr, s->ready, true);
    return 0;
}

static avr_cycle_count_t disarm(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct selfprog *s = param;
    (void)when;
    if (!s->busy) {
        avr->data[SPMCSR] &= (uint8_t)~(SPMEN | PGERS | PGWRT | BLBSET | RWWSRE);
        access_level(avr, s->ready, true);
    }
    return 0;
}

static void write_control(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct selfprog *s = param;
    if (s->busy) {
        avr->data[at] = (uint8_t)((avr->data[at] & ~SPMIE) | (value & SPMIE));
        access_level(avr, s->ready, false);
        return;
    }
    avr->data[at] = (uint8_t)((value & ~RWWSB) | (s->hidden ? RWWSB : 0));
    access_level(avr, s->ready, !(value & SPMEN));
    if (value & SPMEN) {
        s->armed_until = access_write_cycle(avr) + 4;
        access_at(avr, s->armed_until, disarm, s);
    }
}

static void begin_page(struct selfprog *s, uint16_t z, bool erasing)
{
    avr_t *avr = s->avr;
    s->page = (uint16_t)(z & (FLASH_BYTES - FLASH_PAGE_BYTES));
    if (s->page >= s->boot_start) {
        s->denied++;
        avr->data[SPMCSR] &= (uint8_t)~(SPMEN | PGERS | PGWRT);
        return;
    }
    s->erasing = erasing;
    s->busy = true;
    s->began = avr->cycle;
    s->end = avr->cycle + PAGE_CYCLES;
    if (s->page < FLASH_RWW_BYTES) {
        s->hidden = true;
        avr->data[SPMCSR] |= RWWSB;
        selfprog_show(s);
    } else {
        avr->cycle += PAGE_CYCLES;
    }
    access_at(avr, s->end, done, s);
}

static int on_ioctl(avr_io_t *io, uint32_t control, void *param)
{
    struct selfprog *s = (struct selfprog *)io;
    avr_t *avr = s->avr;
    (void)param;
    if (control != AVR_IOCTL_FLASH_SPM)
        return -1;
    uint16_t z = (uint16_t)(avr->data[ZH] << 8 | avr->data[ZL]);
    uint8_t what = avr->data[SPMCSR];
    if (!(what & SPMEN) || s->busy)
        return 0;
    avr_cycle_timer_cancel(avr, disarm, s);
    if (avr->pc < s->boot_start) {
        s->denied++;
        avr->data[SPMCSR] &= (uint8_t)~(SPMEN | PGERS | PGWRT | BLBSET | RWWSRE);
        return 0;
    }
    if (what & (PGERS | PGWRT)) {
        begin_page(s, z, what & PGERS);
        return 0;
    }
    if (what & RWWSRE) {
        s->hidden = false;
        empty_buffer(s);
        selfprog_show(s);
        avr->data[SPMCSR] &= (uint8_t)~RWWSB;
    } else if (!(what & BLBSET)) {  // lock bits are not modelled: setting them does nothing
        int word = z % FLASH_PAGE_BYTES / 2;
        if (!s->filled[word]) {     // a word of the buffer can be written once
            s->filled[word] = true;
            s->buffer[2 * word] = avr->data[R0];
            s->buffer[2 * word + 1] = avr->data[R1];
        }
    }
    avr->data[SPMCSR] &= (uint8_t)~(SPMEN | BLBSET | RWWSRE);
    access_level(avr, s->ready, true);
    return 0;
}

static void on_return(avr_irq_t *irq, uint32_t running, void *param)
{
    struct selfprog *s = param;
    (void)irq;
    if (!running)
        access_level(s->avr, s->ready, !(s->avr->data[SPMCSR] & SPMEN));
}

void selfprog_attach(struct selfprog *s, avr_t *avr, uint32_t boot_start)
{
    avr_flash_t *stock = (avr_flash_t *)access_module(avr, "flash");
    memset(s, 0, sizeof *s);
    memset(s->flash, 0xFF, sizeof s->flash);
    empty_buffer(s);
    s->avr = avr;
    s->boot_start = boot_start;
    s->ready = &stock->flash;
    s->io.kind = "selfprog";
    s->io.ioctl = on_ioctl;
    avr_register_io(avr, &s->io);
    access_take_write(avr, SPMCSR, write_control, s);
    avr_irq_register_notify(&s->ready->irq[AVR_INT_IRQ_RUNNING], on_return, s);
}

// A reset does not stop the charge pump at once, but what it leaves is as undefined as after a cut;
// bootloaders are not reset while they program. The page under way is finished.
void selfprog_reset(struct selfprog *s)
{
    if (s->busy)
        finish(s);
    s->hidden = false;
    empty_buffer(s);
    selfprog_show(s);
}

void selfprog_cut(struct selfprog *s, uint64_t seed)
{
    if (!s->busy)
        return;
    uint8_t *page = s->flash + s->page;
    for (int i = 0; i < FLASH_PAGE_BYTES; i++) {
        uint64_t draw = s->avr->cycle * FLASH_PAGE_BYTES + (uint64_t)i;
        uint8_t random = (uint8_t)noise_bits(seed, NOISE_CORRUPT, draw);
        page[i] = s->erasing ? page[i] | random : page[i] & (s->buffer[i] | random);
    }
    s->busy = false;
    s->dirty = true;
}
