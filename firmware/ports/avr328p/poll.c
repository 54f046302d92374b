// SPDX-License-Identifier: Apache-2.0
// The main loop's turn, and the descriptions that need more than one part of the port.
#include "port_sense.h"
#include "port_serial.h"

#include <avr/wdt.h>

static struct hal_cycle cycle;
static uint8_t alive;

void hal_describe(struct sg_hello *hello)
{
    hello->slot_bytes = SLOT_BYTES;
    hello->slot_base[0] = SLOT_A;
    hello->slot_base[1] = SLOT_B;
    hello->cpu_hz = F_CPU;
    hello->frame_period_us = SLOTS * SLOT_CYCLES_MIN / CYCLES_PER_US;
    hello->exposure_min_us = EXPOSURE_MIN_CYCLES / CYCLES_PER_US;
    hello->exposure_max_us = (3 * SLOT_CYCLES_MAX - EXPOSURE_LESS_CYCLES) / CYCLES_PER_US;
    hello->page_bytes = SPM_PAGESIZE;
    hello->board = SG_BOARD_NANO328P;
}

const uint8_t *hal_slot(uint8_t slot)
{
    if (slot > SG_SLOT_B)
        return 0;
    return (const uint8_t *)(slot == SG_SLOT_A ? (uint16_t)SLOT_A : (uint16_t)SLOT_B);
}

void hal_start(struct hal_timing *timing, uint16_t exposure_cycles[HAL_CHANNELS])
{
    while (!boot_look_at_stack()) {
    }
    sense_start(timing, exposure_cycles);
    boot_watchdog_on();
    serial_start();             // last: nobody takes its bytes before interrupts are on
    sei();
}

static void sleep_if_idle(void)
{
    if (!sense_idle() || !serial_idle())
        return;
    SMCR = 1 << SE;             // idle: timers, converter and serial line go on
    cli();                      // for as short as can be: a release may be waiting
    if (sense_done == sense_took && rx_head == rx_tail) {
        sei();                  // takes effect after the next instruction: no interrupt is slept through
        __asm__ volatile("sleep");
    }
    sei();
    SMCR = 0;
}

int hal_poll(void)
{
    sense_poll();               // first: an exposure chosen after the frame before waits for no other
    if (sense_take(&cycle)) {
        app_on_cycle(&cycle);
        sense_taken();
    }
    if (alive != sense_alive()) {
        alive = sense_alive();
        wdt_reset();            // the engine is alive, and being here proves the loop
    }
    serial_poll();
    store_poll();
    boot_look_at_stack();
    sleep_if_idle();
    return 1;
}

void hal_report(struct sg_status *status)
{
    sense_report(status);
    status->rx_overrun = serial_overruns();
    status->stack_free = boot_stack_free();
    status->reset_cause = boot_reset_cause();
    status->eeprom_writes = store_writes();
}
