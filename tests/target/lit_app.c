// SPDX-License-Identifier: Apache-2.0
// The port asked for as much light as it will give: timing and exposures by -D, nothing done with what is
// sensed.
// ASK_HANG: after 400 cycles with light it stops with interrupts off, at a moment when emitters are lit.
#include <avr/interrupt.h>
#include <avr/io.h>

#include "hal.h"

static uint16_t cycles;

void app_on_cycle(const struct hal_cycle *cycle)
{
    (void)cycle;
#ifdef ASK_HANG
    if (hal_alarm() || ++cycles < 400)
        return;
    while (!(PORTC & 0x3F) && !(PORTD & 0x1C))
        ;
    cli();
    for (;;) {
    }
#else
    cycles++;
#endif
}

uint8_t app_listens(uint8_t byte)
{
    (void)byte;
    return 1;
}

void app_on_byte(uint8_t byte, uint32_t zero_us)
{
    const struct sg_head head = { .seq = cycles, .type = SG_MSG_RAW, .flags = byte };
    const struct sg_raw raw = { .t_us = zero_us };
    hal_send(&head, &raw, sizeof raw, 0);
}

int main(void)
{
    uint16_t first = ASK_FIRST, second = ASK_SECOND;
    uint16_t exposure_cycles[HAL_CHANNELS] = { second, first, first, second, second, first };
    struct hal_timing timing = {
        .frame_cycles = ASK_FRAME, .period_cycles = ASK_PERIOD, .repeats = ASK_REPEATS, .wiring = ASK_WIRING,
        .lights = 1, .probe = ASK_PROBE, .sleep = ASK_SLEEP,
    };
    if (timing.wiring == SG_WIRING_PHOTODIODES) {
        exposure_cycles[0] = exposure_cycles[1] = exposure_cycles[2] = first;
        exposure_cycles[3] = exposure_cycles[4] = exposure_cycles[5] = second;
    }
    hal_boot();
    hal_start(&timing, exposure_cycles);
    while (hal_poll())
        ;
    return 0;
}
