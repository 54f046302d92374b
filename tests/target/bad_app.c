// SPDX-License-Identifier: Apache-2.0
// An application that misbehaves on purpose, on the real port; BAD says how:
//   HANG_LOOP    from the 100th frame on the main loop stands, the sensing engine runs on
//   HANG_LIT     the same, with interrupts off at a moment when emitters are lit
//   BLOCK        interrupts are off for 250 us in every frame, later and later in it
//   SLOW         5 ms of work for frames that come every 3.84 ms
#include <avr/interrupt.h>
#include <avr/io.h>
#include <string.h>
#include <util/delay.h>

#include "hal.h"

enum { HANG_LOOP, HANG_LIT, BLOCK, SLOW };

static uint8_t frames;

void app_on_frame(const struct hal_frame *frame)
{
    (void)frame;
    frames++;
    if (BAD == SLOW)
        _delay_ms(5);
    if (BAD == BLOCK) {
        for (uint8_t i = frames & 31; i != 0; i--)
            _delay_us(50);
        cli();
        _delay_us(250);
        sei();
    }
    if (frames < 100 || BAD == SLOW || BAD == BLOCK)
        return;
    if (BAD == HANG_LIT) {
        // Lit are five of the six anodes: look until one sees it, then stop the world.
        while (!(PORTD & 0xFC))
            ;
        cli();
    }
    for (;;) {
    }
}

// Anything said to it is answered by a report: the reset cause is how the test sees the watchdog at work.
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
    static const uint16_t exposure_cycles[HAL_CHANNELS] = { 1600, 1600, 1600, 1600, 1600, 1600 };
    hal_boot();
    hal_start(exposure_cycles);
    while (hal_poll())
        ;
    return 0;
}
