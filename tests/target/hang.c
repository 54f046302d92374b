// SPDX-License-Identifier: Apache-2.0
// An application that hangs on purpose, on the real port: the watchdog's test. HANG_LIT: with interrupts off,
// at a moment when emitters are lit. Otherwise: the main loop stops while the sensing engine runs on.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <string.h>

#include "hal.h"

static uint8_t frames;

void app_on_frame(const struct hal_frame *frame)
{
    (void)frame;
    if (++frames < 100)
        return;
#ifdef HANG_LIT
    // Lit are five of the six anodes: look until one sees it, then stop the world.
    while (!(PORTD & 0xFC))
        ;
    cli();
#endif
    for (;;) {
    }
}

// Anything said to it is answered by a report: the reset cause is how the test sees the watchdog at work.
void app_on_byte(uint8_t byte, uint32_t zero_us)
{
    struct sg_status status;
    struct sg_head head = { .seq = 1, .type = SG_MSG_STATUS | SG_REPLY, .flags = 0 };
    uint8_t out[SG_WIRE_FRAME_MAX];
    (void)zero_us;
    if (byte != 0)
        return;
    memset(&status, 0, sizeof status);
    hal_report(&status);
    hal_send(out, (uint8_t)sg_wire_encode(&head, &status, sizeof status, out), 0);
}

int main(void)
{
    static const uint16_t exposure_cycles[HAL_CHANNELS] = { 4480, 4480, 4480, 4480, 4480, 4480 };
    hal_boot();
    hal_start(exposure_cycles);
    while (hal_poll())
        ;
    return 0;
}
