// SPDX-License-Identifier: Apache-2.0
// A port that has no hardware: it builds with any C11 compiler, senses nothing, says nothing and ends at
// once. What each function owes is in hal.h; this is the shape to fill in.
#include "hal.h"

#include <stddef.h>

enum { EXPOSURE_MOST_CYCLES = 2544 };

void hal_boot(void)
{
}

void hal_describe(struct sg_hello *hello)
{
    hello->slot_bytes = 0;
    hello->slot_base[0] = 0;
    hello->slot_base[1] = 0;
    hello->cpu_hz = 16000000;
    hello->frame_period_us = 999;
    hello->exposure_min_us = 4;
    hello->exposure_max_us = EXPOSURE_MOST_CYCLES / 16;
    hello->page_bytes = 0;
    hello->board = SG_BOARD_TEMPLATE;
}

void hal_start(struct hal_timing *timing, uint16_t exposure_cycles[HAL_CHANNELS])
{
    (void)timing;
    (void)exposure_cycles;
}

int hal_poll(void)
{
    return 0;
}

uint32_t hal_now_us(void)
{
    return 0;
}

uint16_t hal_now_us16(void)
{
    return 0;
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

uint8_t hal_send(const struct sg_head *head, const void *body, uint8_t n, uint8_t keep_free)
{
    (void)head;
    (void)body;
    (void)n;
    (void)keep_free;
    return 0;
}

void hal_after_sending(uint8_t action)
{
    (void)action;
}

const uint8_t *hal_slot(uint8_t slot)
{
    (void)slot;
    return NULL;
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
    return 0;
}

uint8_t hal_alarm(void)
{
    return 0;
}

void hal_report(struct sg_status *status)
{
    (void)status;
}
