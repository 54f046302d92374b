// SPDX-License-Identifier: Apache-2.0
// A small application on the real port. It answers anything said to it, and misbehaves on purpose if BAD says so:
//   NOTHING      it is well behaved
//   HANG_LOOP    from the 400th cycle on the main loop stands, the sensing engine runs on
//   HANG_LIT     the same, with interrupts off at a moment when emitters are lit
//   BLOCK        interrupts are off for 250 us in every 16th cycle, later and later in it
//   SLOW         5 ms of work for cycles that come every millisecond
// What it is asked for is a command and its arguments, little endian, without any frame around (run_app() in
// sensing_app.py).
#include <avr/interrupt.h>
#include <avr/io.h>
#include <string.h>
#include <util/delay.h>

#include "hal.h"

enum { NOTHING, HANG_LOOP, HANG_LIT, BLOCK, SLOW };

static uint16_t cycles;
static struct hal_cycle last;

void app_on_cycle(const struct hal_cycle *cycle)
{
    cycles++;
    last = *cycle;
    if (BAD == SLOW)
        _delay_ms(5);
    if (BAD == BLOCK && cycles % 16 == 0) {
        for (uint8_t i = cycles / 16 & 31; i != 0; i--)
            _delay_us(30);
        cli();
        _delay_us(250);
        sei();
    }
    if (cycles < 400 || BAD == SLOW || BAD == BLOCK || BAD == NOTHING)
        return;
    if (BAD == HANG_LIT) {
        // Lit are four of the six pins: look until one sees it, then stop the world.
        while (!PORTC)
            ;
        cli();
    }
    for (;;) {
    }
}

void app_on_byte(uint8_t byte, uint32_t zero_us)
{
    struct sg_status status;
    struct sg_head head = { .seq = 1, .type = SG_MSG_STATUS | SG_REPLY, .flags = 0 };
    (void)zero_us;
    if (byte != 0)
        return;
    memset(&status, 0, sizeof status);
    hal_report(&status);
    hal_send(&head, &status, sizeof status, 0);
}

int main(void)
{
    uint16_t exposure_cycles[HAL_CHANNELS] = { 1600, 1600, 1600, 1600, 1600, 1600 };
    struct hal_timing timing = { .period_cycles = 15984, .repeats = 1, .lights = 1, .probe = 255 };
    hal_boot();
    hal_start(&timing, exposure_cycles);
    while (hal_poll())
        ;
    return 0;
}
