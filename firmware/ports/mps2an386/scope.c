// SPDX-License-Identifier: Apache-2.0
// How long marked sections take: two readings of the timer, and a record of their difference.
#include "port.h"

static uint32_t begun[HAL_SECTIONS];
static uint16_t number;

static void put(uint8_t byte)
{
    // A UART of QEMU has sent a byte before the next instruction, unless its reader is slow.
    while (UART_STATE(UART_SCOPE) & UART_STATE_TX_FULL)
        ;
    UART_DATA(UART_SCOPE) = byte;
}

uint32_t scope_now(void)
{
    return ~TIMER_VALUE;
}

__attribute__((noinline)) void scope_begin(uint8_t section)
{
    if (section < HAL_SECTIONS)
        begun[section] = scope_now();
}

__attribute__((noinline)) void scope_end(uint8_t section)
{
    const uint32_t end = scope_now();
    if (section >= HAL_SECTIONS)
        return;
    const struct scope_record record = { .mark = SCOPE_MARK, .section = section, .number = number++,
                                         .ticks = end - begun[section] };
    const uint8_t *byte = (const uint8_t *)&record;
    for (uint8_t i = 0; i < sizeof record; i++)
        put(byte[i]);
}

void scope_start(void)
{
    UART_DIVIDER(UART_SCOPE) = 16;
    UART_CTRL(UART_SCOPE) = UART_CTRL_TX;
    TIMER_RELOAD = UINT32_MAX;
    TIMER_VALUE = UINT32_MAX;
    TIMER_CTRL = 1;
    HAL_BEGIN(HAL_SECTION_EMPTY);
    HAL_END(HAL_SECTION_EMPTY);
}
