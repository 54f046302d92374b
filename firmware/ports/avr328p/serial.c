// SPDX-License-Identifier: Apache-2.0
// UART0 with a ring each way. At 1 Mbaud a byte takes 160 cycles and the receiver bridges two: the interrupts
// are short.
#include "port.h"

enum {
    RX_RING = 128,                      // power of two
    TX_RING = 192,                      // a frame of all three streams (92), an answer (72), and some
    BYTES_PER_POLL = 32,                // so that a flood of bytes cannot keep a frame waiting
    DRAIN_CYCLES = 4 * 10 * 2 * 16,     // the last two bytes leave the shift register, at the lower speed
};

static uint8_t rx_ring[RX_RING];
static volatile uint8_t rx_head;        // written by the interrupt
static uint8_t rx_tail;
static volatile uint16_t rx_overruns;
static volatile uint16_t zero_ticks;    // TCNT1 when the latest 0x00 arrived

static uint8_t tx_ring[TX_RING];
static uint8_t tx_head;
static volatile uint8_t tx_tail;        // written by the interrupt

static uint8_t after_pending;
static uint8_t after;
static uint16_t drained_ticks;
static uint8_t drained;

ISR(USART_RX_vect)
{
    HAL_BEGIN(HAL_SECTION_SERIAL);
    const uint8_t status = UCSR0A;
    const uint8_t byte = UDR0;
    const uint8_t head = rx_head;
    const uint8_t next = (head + 1) & (RX_RING - 1);
    if (status & (1 << DOR0))
        rx_overruns++;
    if (next != rx_tail) {
        rx_ring[head] = byte;
        rx_head = next;
    } else {
        rx_overruns++;
    }
    if (byte == 0)
        zero_ticks = TCNT1;
    HAL_END(HAL_SECTION_SERIAL);
}

ISR(USART_UDRE_vect)
{
    HAL_BEGIN(HAL_SECTION_SERIAL);
    uint8_t tail = tx_tail;
    UDR0 = tx_ring[tail];
    if (++tail == TX_RING)
        tail = 0;
    tx_tail = tail;
    if (tail == tx_head)
        UCSR0B = (1 << RXCIE0) | (1 << RXEN0) | (1 << TXEN0);
    HAL_END(HAL_SECTION_SERIAL);
}

void serial_start(void)
{
    UCSR0B = 0;
    UCSR0A = 1 << U2X0;
    UCSR0C = (1 << UCSZ01) | (1 << UCSZ00);
    UBRR0 = 1;                          // 1 Mbaud
    UCSR0B = (1 << RXCIE0) | (1 << RXEN0) | (1 << TXEN0);
}

uint8_t serial_room(void)
{
    const uint8_t tail = tx_tail, head = tx_head;
    return (tail > head ? tail : tail + TX_RING) - head - 1;
}

uint8_t hal_send(const uint8_t *bytes, uint8_t n, uint8_t keep_free)
{
    uint8_t head = tx_head;
    if (after_pending || (uint16_t)n + keep_free > serial_room())
        return 0;
    while (n--) {
        tx_ring[head] = *bytes++;
        if (++head == TX_RING)
            head = 0;
    }
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        tx_head = head;
        UCSR0B = (1 << RXCIE0) | (1 << RXEN0) | (1 << TXEN0) | (1 << UDRIE0);
    }
    return 1;
}

void hal_after_sending(uint8_t action)
{
    after = action;
    after_pending = 1;
    drained = 0;
}

static uint16_t ticks_now(void)
{
    uint16_t ticks;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        ticks = TCNT1;
    }
    return ticks;
}

static void carry_out(void)
{
    if (tx_tail != tx_head)
        return;
    if (!drained) {
        drained = 1;
        drained_ticks = ticks_now();
        return;
    }
    if ((uint16_t)(ticks_now() - drained_ticks) < DRAIN_CYCLES)
        return;
    if (after == HAL_AFTER_REBOOT) {
        if (store_busy())
            return;
        boot_restart();
    }
    UBRR0 = after == HAL_AFTER_BAUD_500K ? 3 : 1;
    after_pending = 0;
}

uint8_t serial_poll(void)
{
    uint8_t left = BYTES_PER_POLL;
    if (after_pending)
        carry_out();
    if (rx_tail == rx_head)
        return 0;
    while (left-- && rx_tail != rx_head && serial_room() >= SG_WIRE_FRAME_MAX && !after_pending) {
        uint16_t zero;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
            zero = zero_ticks;
        }
        const uint8_t byte = rx_ring[rx_tail];
        rx_tail = (rx_tail + 1) & (RX_RING - 1);
        // Only a frame's end asks for the time; it is less than one turn of the timer ago.
        uint32_t zero_us = 0;
        if (byte == 0) {
            const uint32_t now_us = hal_now_us();
            zero_us = now_us - ((uint16_t)((uint16_t)(now_us << 4) - zero) >> 4);
        }
        app_on_byte(byte, zero_us);
    }
    return 1;
}

uint16_t serial_overruns(void)
{
    uint16_t n;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        n = rx_overruns;
    }
    return n;
}
