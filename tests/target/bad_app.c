// SPDX-License-Identifier: Apache-2.0
// A small application on the real port. It does what it is told and misbehaves on purpose if BAD says so:
//   NOTHING      it does not
//   HANG_LOOP    from the 400th cycle on the main loop stands, the sensing engine runs on
//   HANG_LIT     the same, with interrupts off at a moment when emitters are lit
//   STRAY        there a jump to address 0, as a smashed stack makes: no reset, but a start from the top
//   BLOCK        interrupts are off for 250 us in every 16th cycle, later and later in it
//   SHORT_BLOCK  the same for 6 us, in every second
//   SLOW         5 ms of work for cycles that come every millisecond
// It is told by bytes without any frame around them: a letter and structs as they lie in memory
// (port_app.py).
// It answers in packets of PROTOCOL.md's coding whose bodies are structs as they lie in memory.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <string.h>
#include <util/delay.h>

#include "hal.h"

enum { NOTHING, HANG_LOOP, HANG_LIT, STRAY, BLOCK, SHORT_BLOCK, SLOW };
enum { TYPE_CYCLE = 0x50, TYPE_EXPOSURE = 0x51, TYPE_TIMING = 0x52, TYPE_NOISE = 0x53 };

static uint16_t cycles;
static uint8_t cycles_wanted;           // cycles are sent
static uint8_t noise;                   // the line is kept full
static uint16_t exposure_cycles[HAL_CHANNELS] = { 1600, 1600, 1600, 1600, 1600, 1600 };
static struct hal_timing timing = { .period_cycles = 15984, .repeats = 1, .lights = 1, .probe = 255 };
static uint8_t told[16];
static uint8_t told_bytes;

static void answer(uint8_t type, const void *body, uint8_t n)
{
    struct sg_head head = { .seq = cycles, .type = type, .flags = 0 };
    hal_send(&head, body, n, 0);
}

void app_on_cycle(const struct hal_cycle *cycle)
{
    cycles++;
    if (cycles_wanted)
        answer(TYPE_CYCLE, cycle, sizeof *cycle);
    if (BAD == SLOW)
        _delay_ms(5);
    const uint8_t every = BAD == BLOCK ? 16 : 2;
    if ((BAD == BLOCK || BAD == SHORT_BLOCK) && cycles % every == 0) {
        for (uint8_t i = cycles / every & 63; i != 0; i--)
            _delay_us(13);
        cli();
        _delay_us(BAD == BLOCK ? 250 : 6);
        sei();
    }
    if (cycles < 400 || (BAD != HANG_LIT && BAD != HANG_LOOP && BAD != STRAY))
        return;
    if (BAD == HANG_LIT || BAD == STRAY) {
        // Lit are four of the six pins: look until one sees it, then stop the world.
        while (!PORTC)
            ;
        cli();
    }
    if (BAD == STRAY)
        __asm__ volatile("jmp 0");
    for (;;) {
    }
}

static void report(void)
{
    struct sg_status status;
    memset(&status, 0, sizeof status);
    hal_report(&status);
    answer(SG_MSG_STATUS | SG_REPLY, &status, sizeof status);
}

uint8_t app_listens(uint8_t byte)
{
    (void)byte;
    return 1;
}

void app_on_byte(uint8_t byte, uint32_t zero_us)
{
    (void)zero_us;
    if (told_bytes < sizeof told)
        told[told_bytes++] = byte;
    uint8_t n = 1;
    switch (told[0]) {
    case 'e':
        n = 1 + sizeof exposure_cycles;
        break;
    case 't':
        n = 1 + sizeof timing;
        break;
    case 'c':
    case 'n':
        n = 2;
        break;
    }
    if (told_bytes < n)
        return;
    told_bytes = 0;
    switch (told[0]) {
    case 'e':
        memcpy(exposure_cycles, told + 1, sizeof exposure_cycles);
        hal_expose(exposure_cycles);
        answer(TYPE_EXPOSURE, exposure_cycles, sizeof exposure_cycles);
        break;
    case 't':
        memcpy(&timing, told + 1, sizeof timing);
        hal_set_timing(&timing);
        answer(TYPE_TIMING, &timing, sizeof timing);
        break;
    case 'c':
        cycles_wanted = told[1];
        break;
    case 'n':
        noise = told[1];
        break;
    case 's':
        report();
        break;
    }
}

int main(void)
{
    hal_boot();
    hal_start(&timing, exposure_cycles);
    while (hal_poll())
        if (noise)
            answer(TYPE_NOISE, &timing, sizeof timing);
    return 0;
}
