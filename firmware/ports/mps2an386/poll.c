// SPDX-License-Identifier: Apache-2.0
// The main loop's turn, and the rest of the contract: no sensors, so no cycle ever comes; no store, so the
// live state lasts until the next reset.
#include "port.h"

// Turns without a byte before the sleep: checks of models go on in them.
enum { IDLE_TURNS = 64 };

// Of a board that senses, in its cycles of 1/16 us; nothing here is exposed.
enum { EXPOSURE_MOST_CYCLES = 2544 };

static uint16_t idle;
static uint32_t now_us;
static uint32_t seen_ticks;

void hal_boot(void)
{
}

void hal_describe(struct sg_hello *hello)
{
    hello->slot_bytes = SLOT_BYTES;
    hello->slot_base[0] = SLOT_A;
    hello->slot_base[1] = SLOT_B;
    hello->cpu_hz = TICKS_PER_US * 1000000UL;
    hello->frame_period_us = 999;
    hello->exposure_min_us = 4;
    hello->exposure_max_us = EXPOSURE_MOST_CYCLES / 16;
    hello->page_bytes = 0;
    hello->board = SG_BOARD_MPS2AN386;
}

const uint8_t *hal_slot(uint8_t slot)
{
    if (slot > SG_SLOT_B)
        return 0;
    return (const uint8_t *)(slot == SG_SLOT_A ? (uintptr_t)SLOT_A : (uintptr_t)SLOT_B);
}

void hal_start(struct hal_timing *timing, uint16_t exposure_cycles[HAL_CHANNELS])
{
    (void)timing;
    (void)exposure_cycles;
    scope_start();
    serial_start();
}

uint32_t hal_now_us(void)
{
    while (scope_now() - seen_ticks >= TICKS_PER_US * 1000U) {
        seen_ticks += TICKS_PER_US * 1000U;
        now_us += 1000;
    }
    return now_us + (scope_now() - seen_ticks) / TICKS_PER_US;
}

uint16_t hal_now_us16(void)
{
    return (uint16_t)hal_now_us();
}

int hal_poll(void)
{
    if (serial_poll())
        idle = 0;
    else if (idle < IDLE_TURNS)
        idle++;
    else
        serial_sleep();
    return 1;
}

void hal_expose(uint16_t exposure_cycles[HAL_CHANNELS])
{
    (void)exposure_cycles;
}

void hal_set_timing(struct hal_timing *timing)
{
    (void)timing;
}

uint16_t hal_exposure_most(uint8_t channel)
{
    (void)channel;
    return EXPOSURE_MOST_CYCLES;
}

uint8_t hal_load(void *record, uint8_t n)
{
    (void)record;
    (void)n;
    return 0;
}

uint8_t hal_save(const void *record, uint8_t n)
{
    (void)record;
    (void)n;
    return 1;
}

uint8_t hal_alarm(void)
{
    return 0;
}

void hal_report(struct sg_status *status)
{
    status->rx_overrun = serial_overruns();
    status->stack_free = boot_stack_free();
    status->reset_cause = SG_RESET_POWER;
}
