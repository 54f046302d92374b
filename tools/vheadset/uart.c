// SPDX-License-Identifier: GPL-3.0-or-later
#include "uart.h"

#include <math.h>
#include <simavr/avr_uart.h>

#include "access.h"
#include "bridge.h"
#include "noise.h"

enum { UCSR0A = 0xC0, UCSR0B, UCSR0C, UBRR0L = 0xC4, UBRR0H, UDR0 };
enum { RXC = 0x80, TXC = 0x40, UDRE = 0x20, FE = 0x10, DOR = 0x08, UPE = 0x04, U2X = 0x02 };
enum { RXEN = 0x10, TXEN = 0x08, UCSZ2 = 0x04 };
static const double BAUD_TOLERANCE = 0.04;

static unsigned bit_cycles(const struct uart *u)
{
    const uint8_t *data = u->avr->data;
    unsigned divisor = (unsigned)((data[UBRR0H] & 15) << 8 | data[UBRR0L]) + 1;
    return divisor * (data[UCSR0A] & U2X ? 8 : 16);
}

static unsigned frame_bits(const struct uart *u)
{
    uint8_t c = u->avr->data[UCSR0C];
    unsigned data_bits = u->avr->data[UCSR0B] & UCSZ2 ? 9 : 5 + (c >> 1 & 3);
    return 2 + data_bits + (c & 0x20 ? 1 : 0) + (c & 0x08 ? 1 : 0);
}

// Whether both ends understand each other.
static bool matched(const struct uart *u)
{
    double host = bridge_baud(u->bridge), device = u->cycles_per_true_second / bit_cycles(u);
    bool plain = (u->avr->data[UCSR0C] & 0xF6) == 6 && !(u->avr->data[UCSR0B] & UCSZ2);
    return plain && host > 0 && fabs(device / host - 1) <= BAUD_TOLERANCE;
}

static void show_receiver(struct uart *u)
{
    uint8_t a = u->avr->data[UCSR0A] & (uint8_t)~(RXC | FE | DOR | UPE);
    if (u->held)
        a |= RXC | (u->fifo[0].framing_error ? FE : 0);
    if (u->overrun)
        a |= DOR;
    u->avr->data[UCSR0A] = a;
    access_level(u->avr, u->rxc, u->held > 0);
}

static void settle_shift(struct uart *u)
{
    if (u->shift_full && u->held < 2) {
        u->fifo[u->held++] = u->shift;
        u->shift_full = false;
    }
}

static avr_cycle_count_t line_stop(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct uart *u = param;
    (void)when;
    u->line_busy = false;
    u->rx_bytes++;
    if (u->line_heard && (avr->data[UCSR0B] & RXEN)) {
        struct uart_byte byte = {u->line_byte, false, avr->cycle};
        if (!matched(u)) {
            uint64_t draw = noise_bits(u->seed, NOISE_LINE_RX, u->heard++);
            byte = (struct uart_byte){(uint8_t)draw, draw >> 8 & 1, avr->cycle};
            u->rx_garbage++;
        }
        u->shift = byte;
        u->shift_full = true;
        settle_shift(u);
        show_receiver(u);
    }
    uart_line_wake(u);
    return 0;
}

static avr_cycle_count_t line_start(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct uart *u = param;
    double bit = u->cycles_per_true_second / fmax(bridge_baud(u->bridge), 50);
    u->line_heard = avr->data[UCSR0B] & RXEN;
    if (u->line_heard && u->shift_full) {
        u->shift_full = false;
        u->overrun = true;
        u->overruns++;
        show_receiver(u);
    }
    double began = fmax(u->line_free, (double)when - 1);  // keeps the fraction of a cycle from byte to byte
    u->line_free = began + 10 * bit;
    access_at(avr, (uint64_t)ceil(began + 9.5 * bit), line_stop, u);
    return 0;
}

void uart_line_wake(struct uart *u)
{
    if (u->line_busy || !bridge_take(u->bridge, &u->line_byte))
        return;
    u->line_busy = true;
    double start = fmax(u->line_free, (double)u->avr->cycle);
    access_at(u->avr, (uint64_t)ceil(start), line_start, u);
}

static avr_cycle_count_t tx_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct uart *u = param;
    uint8_t byte = u->tx_shift;
    if (!matched(u)) {
        byte = (uint8_t)noise_bits(u->seed, NOISE_LINE_TX, u->garbled++);
        u->tx_garbage++;
    }
    u->tx_bytes++;
    bridge_give(u->bridge, byte);
    if (u->on_sent)
        u->on_sent(u->on_sent_param, u->tx_shift, when);
    u->tx_shifting = u->tx_waiting;
    if (!u->tx_waiting) {
        avr_raise_interrupt(avr, u->txc);
        return 0;
    }
    u->tx_shift = u->tx_data;
    u->tx_waiting = false;
    avr->data[UCSR0A] |= UDRE;
    access_level(avr, u->udre, true);
    u->tx_end = when + (uint64_t)bit_cycles(u) * frame_bits(u);
    return u->tx_end;
}

static void write_data(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct uart *u = param;
    (void)at;
    if (!(avr->data[UCSR0B] & TXEN))
        return;
    if (!u->tx_shifting) {
        u->tx_shift = value;
        u->tx_shifting = true;
        u->tx_end = access_write_cycle(avr) + (uint64_t)bit_cycles(u) * frame_bits(u);
        access_at(avr, u->tx_end, tx_done, u);
        return;
    }
    if (u->tx_waiting)  // the data register is full: the chip ignores the write
        return;
    u->tx_data = value;
    u->tx_waiting = true;
    avr->data[UCSR0A] &= (uint8_t)~UDRE;
    access_level(avr, u->udre, false);
}

static uint8_t read_data(avr_t *avr, avr_io_addr_t at, void *param)
{
    struct uart *u = param;
    if (u->held) {
        avr->data[at] = u->fifo[0].data;
        if (avr->cycle - u->fifo[0].came > u->longest_rx)
            u->longest_rx = avr->cycle - u->fifo[0].came;
        u->fifo[0] = u->fifo[1];
        u->held--;
        u->overrun = false;
        settle_shift(u);
        show_receiver(u);
    }
    return avr->data[at];
}

// TXC is cleared by writing a one; U2X and MPCM are the only bits that can be set.
static void write_status(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct uart *u = param;
    avr->data[at] = (uint8_t)((avr->data[at] & ~3) | (value & 3));
    if (value & TXC)
        avr_clear_interrupt(avr, u->txc);
}

static void write_control(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct uart *u = param;
    avr->data[at] = value;
    if (!(value & RXEN)) {
        u->held = 0;
        u->shift_full = u->overrun = false;
    }
    show_receiver(u);
    access_level(avr, u->udre, avr->data[UCSR0A] & UDRE);
    access_edge_enabled(avr, u->txc);
}

static void on_return(avr_irq_t *irq, uint32_t running, void *param)
{
    struct uart *u = param;
    (void)irq;
    if (running)
        return;
    access_level(u->avr, u->rxc, u->held > 0);
    access_level(u->avr, u->udre, u->avr->data[UCSR0A] & UDRE);
}

void uart_attach(struct uart *u, avr_t *avr, struct bridge *bridge,
                 double cycles_per_true_second)
{
    avr_uart_t *stock = (avr_uart_t *)access_module(avr, "uart");
    memset(u, 0, sizeof *u);
    u->avr = avr;
    u->bridge = bridge;
    u->cycles_per_true_second = cycles_per_true_second;
    u->rxc = &stock->rxc;
    u->udre = &stock->udrc;
    u->txc = &stock->txc;
    access_take_write(avr, UCSR0A, write_status, u);
    access_take_read(avr, UCSR0A, NULL, NULL);
    access_take_write(avr, UCSR0B, write_control, u);
    access_take_write(avr, UCSR0C, NULL, NULL);
    access_take_write(avr, UBRR0L, NULL, NULL);
    access_take_write(avr, UBRR0H, NULL, NULL);
    access_take_write(avr, UDR0, write_data, u);
    access_take_read(avr, UDR0, read_data, u);
    avr_irq_register_notify(&u->rxc->irq[AVR_INT_IRQ_RUNNING], on_return, u);
    avr_irq_register_notify(&u->udre->irq[AVR_INT_IRQ_RUNNING], on_return, u);
    uart_reset(u);
}

void uart_reset(struct uart *u)
{
    uint8_t *data = u->avr->data;
    data[UCSR0A] = UDRE;
    data[UCSR0B] = 0;
    data[UCSR0C] = 6;
    data[UBRR0L] = data[UBRR0H] = 0;
    u->tx_waiting = u->tx_shifting = false;
    u->held = 0;
    u->shift_full = u->overrun = false;
    u->line_busy = false;  // its timers are gone; what was on the line is lost
    u->line_free = fmax(u->line_free, (double)u->avr->cycle);
    uart_line_wake(u);
}
