// SPDX-License-Identifier: Apache-2.0
// The serial line with a send ring. QEMU hands a byte over when the last one was read: nothing is overrun.
#include "port.h"

enum { TX_RING = 256, AROUND_BODY = SG_WIRE_FRAME_MAX - SG_WIRE_BODY_MAX, BYTES_PER_POLL = 64 };

static uint8_t tx_ring[TX_RING];
static uint8_t tx_head;
static uint8_t tx_tail;
static uint32_t zero_us;
static uint8_t after_pending;
static uint8_t after;
static uint16_t quiet;

static uint16_t used(void)
{
    return (uint8_t)(tx_head - tx_tail);
}

static uint8_t room(void)
{
    return (uint8_t)(TX_RING - 1 - used());
}

void serial_start(void)
{
    UART_DIVIDER(UART_LINE) = 25;
    UART_CTRL(UART_LINE) = UART_CTRL_TX | UART_CTRL_RX | UART_CTRL_RX_INT;
    NVIC_ENABLE = 1;                    // the line's receiver; masked, it only ends a sleep
    SYSTICK_RELOAD = 0x00FFFFFF;
    SYSTICK_VALUE = 0;
    SYSTICK_CTRL = 7;
}

uint8_t hal_send(const struct sg_head *head, const void *body, uint8_t n, uint8_t keep_free)
{
    if (after_pending || room() < n + AROUND_BODY + keep_free)
        return 0;
    if (head)
        tx_head = (uint8_t)sg_wire_encode_ring(head, body, n, tx_ring, TX_RING, tx_head);
    return 1;
}

void hal_after_sending(uint8_t action)
{
    after = action;
    after_pending = 1;
}

uint8_t serial_poll(void)
{
    uint8_t moved = 0;
    while (used() && !(UART_STATE(UART_LINE) & UART_STATE_TX_FULL)) {
        UART_DATA(UART_LINE) = tx_ring[tx_tail++];
        moved = 1;
    }
    if (after_pending && !used()) {
        after_pending = 0;
        if (after == HAL_AFTER_REBOOT)
            boot_restart();             // a change of speed changes nothing here: no bit takes any time
    }
    for (uint8_t i = 0; i < BYTES_PER_POLL && app_listens(0); i++) {
        if (!(UART_STATE(UART_LINE) & UART_STATE_RX_FULL))
            break;
        const uint8_t byte = (uint8_t)UART_DATA(UART_LINE);
        if (byte == 0)
            zero_us = hal_now_us();
        app_on_byte(byte, zero_us);
        quiet = 0;
        moved = 1;
    }
    return moved || used();
}

void serial_sleep(void)
{
    UART_INT(UART_LINE) = UART_INT_RX;
    NVIC_UNPEND = 1;
    // A byte that came before this line is seen here, one that comes after it ends the sleep.
    if (!(UART_STATE(UART_LINE) & UART_STATE_RX_FULL))
        __asm__ volatile("wfi" ::: "memory");
    if (SCB_ICSR & 1UL << 26) {         // SysTick is pending
        SCB_ICSR = 1UL << 25;
        if (++quiet > QUIET_LIMIT)
            boot_restart();
    }
}

uint16_t serial_overruns(void)
{
    return 0;
}
