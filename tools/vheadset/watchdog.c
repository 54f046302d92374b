// SPDX-License-Identifier: GPL-3.0-or-later
#include "watchdog.h"

#include <simavr/avr_watchdog.h>

#include "access.h"

enum { MCUSR = 0x54, WDRF = 8, WDTCSR = 0x60 };
enum { WDIF = 0x80, WDIE = 0x40, WDP3 = 0x20, WDCE = 0x10, WDE = 0x08, WDP = 0x27 };
enum { CYCLES_PER_TICK = 125, SHORTEST_TICKS = 2048 };  // of 128 kHz at 16 MHz

static uint64_t period(const struct watchdog *w)
{
    uint8_t v = w->avr->data[WDTCSR];
    unsigned shift = (v & 7u) | (v & WDP3 ? 8u : 0u);
    return (uint64_t)CYCLES_PER_TICK * SHORTEST_TICKS << (shift > 9 ? 9 : shift);
}

static avr_cycle_count_t due(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct watchdog *w = param;
    uint64_t end = w->fed + period(w);
    if (end > when)
        return end;
    if (avr->data[WDTCSR] & WDIE) {
        avr_raise_interrupt(avr, w->vector);
        w->fed = end;
        return end + period(w);
    }
    w->expired = true;
    return 0;
}

static void start_or_stop(struct watchdog *w, bool was_on)
{
    bool on = w->avr->data[WDTCSR] & (WDE | WDIE);
    if (on && !was_on)
        w->fed = w->avr->cycle;
    if (on)
        access_at(w->avr, w->fed + period(w), due, w);
    else
        avr_cycle_timer_cancel(w->avr, due, w);
}

static void write_control(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct watchdog *w = param;
    uint8_t was = avr->data[at], now = was;
    uint64_t cycle = access_write_cycle(avr);
    if (value & WDIF)
        avr_clear_interrupt(avr, w->vector);
    now = (uint8_t)((avr->data[at] & ~(WDIE | WDCE)) | (value & WDIE));
    if ((was & WDCE) && cycle <= w->change_until)
        now = (uint8_t)((now & ~(WDE | WDP)) | (value & (WDE | WDP)));
    now |= value & WDE;
    if (avr->data[MCUSR] & WDRF)
        now |= WDE;
    if ((value & (WDCE | WDE)) == (WDCE | WDE)) {
        now |= WDCE;
        w->change_until = cycle + 4;
    }
    avr->data[at] = now;
    access_edge_enabled(avr, w->vector);
    start_or_stop(w, was & (WDE | WDIE));
}

static uint8_t read_control(avr_t *avr, avr_io_addr_t at, void *param)
{
    struct watchdog *w = param;
    if (access_read_cycle(avr) > w->change_until)
        avr->data[at] &= (uint8_t)~WDCE;
    return avr->data[at];
}

static int on_ioctl(avr_io_t *io, uint32_t control, void *param)
{
    (void)param;
    if (control != AVR_IOCTL_WATCHDOG_RESET)
        return -1;
    ((struct watchdog *)io)->fed = ((struct watchdog *)io)->avr->cycle;
    return 0;
}

void watchdog_attach(struct watchdog *w, avr_t *avr)
{
    memset(w, 0, sizeof *w);
    w->avr = avr;
    w->vector = &((avr_watchdog_t *)access_module(avr, "watchdog"))->watchdog;
    w->io.kind = "own watchdog";
    w->io.ioctl = on_ioctl;
    avr_register_io(avr, &w->io);
    access_take_write(avr, WDTCSR, write_control, w);
    access_take_read(avr, WDTCSR, read_control, w);
}

void watchdog_reset(struct watchdog *w, bool held)
{
    w->expired = false;
    w->change_until = 0;
    w->avr->data[WDTCSR] = held ? WDE : 0;
    start_or_stop(w, false);
}
