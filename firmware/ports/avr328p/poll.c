// SPDX-License-Identifier: Apache-2.0
// The main loop's turn, and the descriptions that need more than one part of the port.
#include "port.h"

#include <avr/wdt.h>

static struct hal_frame frame;

void hal_describe(struct sg_hello *hello)
{
    hello->slot_bytes = SLOT_B - SLOT_A;
    hello->slot_base[0] = SLOT_A;
    hello->slot_base[1] = SLOT_B;
    hello->cpu_hz = F_CPU;
    hello->frame_period_us = HAL_CHANNELS * (SLOT_CYCLES / CYCLES_PER_US);
    hello->exposure_min_us = EXPOSURE_MIN_CYCLES / CYCLES_PER_US;
    hello->exposure_max_us = EXPOSURE_MAX_CYCLES / CYCLES_PER_US;
    hello->page_bytes = SPM_PAGESIZE;
    hello->board = SG_BOARD_NANO328P;
}

const uint8_t *hal_slot(uint8_t slot)
{
    if (slot > SG_SLOT_B)
        return 0;
    return (const uint8_t *)(slot == SG_SLOT_A ? (uint16_t)SLOT_A : (uint16_t)SLOT_B);
}

void hal_start(const uint16_t exposure_cycles[HAL_CHANNELS])
{
    serial_start();
    sense_start(exposure_cycles);
    boot_watchdog_on();
    sei();
}

int hal_poll(void)
{
    if (sense_take(&frame)) {
        wdt_reset();        // a frame proves the engine, and being here proves the loop
        app_on_frame(&frame);
        sense_taken();
    }
    serial_poll();
    store_poll();
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
