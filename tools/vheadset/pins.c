// SPDX-License-Identifier: GPL-3.0-or-later
#include "pins.h"

#include <simavr/avr_ioport.h>

#include "access.h"

enum { PINC = 0x26, MCUCR = 0x55, PUD = 0x10 };

static void changed(struct pins *p)
{
    p->state.pull_ups = !(p->avr->data[MCUCR] & PUD);
    leds_drive(p->leds, &p->state, access_write_cycle(p->avr));
}

static void port_c(avr_irq_t *irq, uint32_t value, void *param)
{
    struct pins *p = param;
    (void)irq;
    p->state.port_c = (uint8_t)value;
    changed(p);
}

static void ddr_c(avr_irq_t *irq, uint32_t value, void *param)
{
    struct pins *p = param;
    (void)irq;
    p->state.ddr_c = (uint8_t)value;
    changed(p);
}

static void port_d(avr_irq_t *irq, uint32_t value, void *param)
{
    struct pins *p = param;
    (void)irq;
    p->state.port_d = (uint8_t)value;
    changed(p);
}

static void ddr_d(avr_irq_t *irq, uint32_t value, void *param)
{
    struct pins *p = param;
    (void)irq;
    p->state.ddr_d = (uint8_t)value;
    changed(p);
}

static uint8_t read_pins(avr_t *avr, avr_io_addr_t at, void *param)
{
    return avr->data[at] = leds_digital(((struct pins *)param)->leds, access_read_cycle(avr));
}

void pins_attach(struct pins *p, avr_t *avr, struct leds *leds)
{
    static const struct { char port; int irq; avr_irq_notify_t call; } hooks[] = {
        {'C', IOPORT_IRQ_REG_PORT, port_c}, {'C', IOPORT_IRQ_DIRECTION_ALL, ddr_c},
        {'D', IOPORT_IRQ_REG_PORT, port_d}, {'D', IOPORT_IRQ_DIRECTION_ALL, ddr_d},
    };
    p->avr = avr;
    p->leds = leds;
    for (size_t i = 0; i < sizeof hooks / sizeof *hooks; i++) {
        avr_irq_t *irq = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(hooks[i].port), hooks[i].irq);
        irq->flags &= (uint8_t)~IRQ_FLAG_FILTERED;  // a reset changes pins behind its back
        avr_irq_register_notify(irq, hooks[i].call, p);
    }
    access_take_read(avr, PINC, read_pins, p);
    pins_reset(p);
}

void pins_reset(struct pins *p)
{
    p->state = (struct leds_pins){.pull_ups = true};
    leds_drive(p->leds, &p->state, p->avr->cycle);
}
