// SPDX-License-Identifier: Apache-2.0
// UART0 with a ring each way. At 1 Mbaud a byte takes 160 cycles. The receiver bridges two, so it has its
// interrupt. A gaze frame is sent without one: by the main loop while it has nothing else to do, and by the
// sensing interrupt before it returns, up to two bytes each of the 18 times a cycle. That saves some 40
// cycles a byte, and no release waits: one that is late costs its reading a correction of 700 cycles. Only
// when more waits than they can carry do its first bytes go by their own interrupt.
#include "port.h"
#include "port_serial.h"

enum {
    AROUND_BODY = SG_WIRE_FRAME_MAX - SG_WIRE_BODY_MAX,
    POLLED = (1 << RXCIE0) | (1 << RXEN0) | (1 << TXEN0),       // UCSR0B
    OWN = SERIAL_OWN,
    // As many as wait are left to the polling: an answer and a gaze; after a long frame of a stream fewer,
    // the next gaze would be late.
    POLLED_BYTES = 96,
    POLLED_LONG = 24,
    LONG_BODY = 16,
    SENT_MEANWHILE = 8,                 // by the sensing interrupt
    BYTES_PER_POLL = 32,                // so that a flood of bytes cannot keep a frame waiting
    DRAIN_CYCLES = 4 * 10 * 2 * 16,     // the last two bytes leave the shift register, at the lower speed
};

uint8_t rx_ring[RX_RING];
volatile uint8_t rx_head;
uint8_t rx_tail;
volatile uint16_t rx_overruns;
volatile uint16_t zero_ticks;

uint8_t tx_ring[TX_RING];
volatile uint8_t tx_head;
volatile uint8_t tx_tail;
static volatile uint8_t tx_until;       // where the interrupt stops

static uint8_t after_pending;
static uint8_t after;
static uint16_t drained_ticks;
static uint8_t drained;
static uint32_t zero_us;                // the same as device time
static volatile uint8_t zero_new;       // not yet

// Takes the byte and a place in the ring, then lets other interrupts in: a release waits for half of this,
// not for all. What they receive comes behind it, and nobody looks at the ring before this has ended. In
// assembler because the compiler's prologue would cost as much again.
#define TAKE_BYTE                                                                                       \
    "lds r30, %[head]" "\n\t" "mov r24, r30" "\n\t" "inc r24" "\n\t" "andi r24, %[mask]" "\n\t"         \
    "lds r25, %[tail]" "\n\t" "cpse r24, r25" "\n\t" "sts %[head], r24" "\n\t"                        \
    "lds r24, %[status]" "\n\t" "lds r25, %[data]" "\n\t"

ISR(USART_RX_vect, ISR_NAKED)
{
    __asm__ volatile("push r24" "\n\t"
                     "in r24, __SREG__" "\n\t"
                     "push r24" "\n\t"
                     "push r25" "\n\t"
                     "push r30" "\n\t"
                     TAKE_BYTE
                     "sei" "\n\t"
                     "push r31" "\n\t"
                     "ldi r31, %[begin]" "\n\t"
                     "out %[mark], r31" "\n\t"
                     "rcall serial_keep" "\n\t"
                     "ldi r24, %[end]" "\n\t"
                     "out %[mark], r24" "\n\t"
                     "pop r31" "\n\t"
                     "pop r30" "\n\t"
                     "pop r25" "\n\t"
                     "pop r24" "\n\t"
                     "out __SREG__, r24" "\n\t"
                     "pop r24" "\n\t"
                     "reti" "\n"
                     ".global serial_byte" "\n"
                     "serial_byte:" "\t"
                     TAKE_BYTE "\n"
                     "serial_keep:" "\t"
                     "sbrc r24, %[overrun]" "\n\t"
                     "rcall 3f" "\n\t"
                     "mov r24, r30" "\n\t"
                     "inc r24" "\n\t"
                     "andi r24, %[mask]" "\n\t"
                     "lds r31, %[tail]" "\n\t"
                     "cp r24, r31" "\n\t"
                     "breq 3f" "\n\t"               // no room: the byte is lost
                     "ldi r31, 0" "\n\t"
                     "subi r30, lo8(-(%[ring]))" "\n\t"
                     "sbci r31, hi8(-(%[ring]))" "\n\t"
                     "st Z, r25" "\n\t"
                     "tst r25" "\n\t"
                     "brne 4f" "\n\t"
                     "in r31, __SREG__" "\n\t"
                     "cli" "\n\t"
                     "lds r24, %[ticks]" "\n\t"
                     "lds r25, %[ticks]+1" "\n\t"
                     "sts %[zero]+1, r25" "\n\t"
                     "sts %[zero], r24" "\n\t"
                     "sts %[new], r31" "\n\t"        // not 0, by the flag of the comparison
                     "out __SREG__, r31" "\n"
                     "4:" "\t" "ret" "\n"
                     "3:" "\t"
                     "lds r24, %[overruns]" "\n\t"
                     "lds r31, %[overruns]+1" "\n\t"
                     "subi r24, 0xFF" "\n\t"
                     "sbci r31, 0xFF" "\n\t"
                     "sts %[overruns]+1, r31" "\n\t"
                     "sts %[overruns], r24" "\n\t"
                     "ret"
                     : : [begin] "M"(2 * HAL_SECTION_SERIAL + 1), [end] "M"(2 * HAL_SECTION_SERIAL + 2),
                     [mark] "I"(_SFR_IO_ADDR(GPIOR0)), [status] "i"(_SFR_MEM_ADDR(UCSR0A)),
                     [data] "i"(_SFR_MEM_ADDR(UDR0)), [overrun] "i"(DOR0), [overruns] "i"(&rx_overruns),
                     [head] "i"(&rx_head), [tail] "i"(&rx_tail), [mask] "i"(RX_RING - 1),
                     [ring] "i"(rx_ring), [ticks] "i"(_SFR_MEM_ADDR(TCNT1L)), [zero] "i"(&zero_ticks),
                     [new] "i"(&zero_new)
                     : "memory");
}

// Sends up to tx_until, then leaves the rest to the polling. After 14 cycles it is off and others may come, so
// that no release waits; OWN keeps the polling away meanwhile. In assembler for the same reason.
ISR(USART_UDRE_vect, ISR_NAKED)
{
    __asm__ volatile("push r24" "\n\t"
                     "ldi r24, %[off]" "\n\t"
                     "sts %[control], r24" "\n\t"
                     "sei" "\n\t"
                     "in r24, __SREG__" "\n\t"
                     "push r24" "\n\t"
                     "push r30" "\n\t"
                     "push r31" "\n\t"
                     "ldi r24, %[begin]" "\n\t"
                     "out %[mark], r24" "\n\t"
                     "lds r30, %[tail]" "\n\t"
                     "mov r24, r30" "\n\t"
                     "ldi r31, 0" "\n\t"
                     "subi r30, lo8(-(%[ring]))" "\n\t"
                     "sbci r31, hi8(-(%[ring]))" "\n\t"
                     "ld r30, Z" "\n\t"
                     "sts %[data], r30" "\n\t"
                     "inc r24" "\n\t"
                     "cpi r24, %[size]" "\n\t"
                     "brne 1f" "\n\t"
                     "ldi r24, 0" "\n"
                     "1:" "\t" "sts %[tail], r24" "\n\t"
                     "lds r30, %[until]" "\n\t"
                     "ldi r31, %[polled]" "\n\t"
                     "cpse r24, r30" "\n\t"
                     "ldi r31, %[on]" "\n\t"
                     "ldi r24, %[end]" "\n\t"
                     "out %[mark], r24" "\n\t"
                     "cli" "\n\t"
                     "sts %[control], r31" "\n\t"
                     "pop r31" "\n\t"
                     "pop r30" "\n\t"
                     "pop r24" "\n\t"
                     "out __SREG__, r24" "\n\t"
                     "pop r24" "\n\t"
                     "reti"
                     : : [begin] "M"(2 * HAL_SECTION_SERIAL + 1), [end] "M"(2 * HAL_SECTION_SERIAL + 2),
                     [mark] "I"(_SFR_IO_ADDR(GPIOR0)), [tail] "i"(&tx_tail), [until] "i"(&tx_until),
                     [ring] "i"(tx_ring), [data] "i"(_SFR_MEM_ADDR(UDR0)), [size] "M"(TX_RING),
                     [control] "i"(_SFR_MEM_ADDR(UCSR0B)), [polled] "M"(POLLED),
                     [off] "M"(POLLED | OWN), [on] "M"(POLLED | OWN | 1 << UDRIE0)
                     : "memory");
}

void serial_start(void)
{
    UCSR0B = 0;
    UCSR0A = 1 << U2X0;
    UCSR0C = (1 << UCSZ01) | (1 << UCSZ00);
    UBRR0 = 1;                          // 1 Mbaud
    UCSR0B = POLLED;
}

static uint8_t room(void)
{
    const uint8_t tail = tx_tail, head = tx_head;
    return (tail > head ? tail : tail + TX_RING) - head - 1;
}

uint8_t hal_send(const struct sg_head *head, const void *body, uint8_t n, uint8_t keep_free)
{
    if (after_pending || (uint16_t)n + AROUND_BODY + keep_free > room())
        return 0;
    if (!head)
        return 1;
    const uint8_t end = (uint8_t)sg_wire_encode_ring(head, body, n, tx_ring, TX_RING, tx_head);
    __asm__ volatile("" : : : "memory");      // the bytes are there before they are sent
    tx_head = end;
    const uint8_t polled = keep_free && n > LONG_BODY ? POLLED_LONG : POLLED_BYTES;
    const uint8_t waiting = TX_RING - 1 - room();
    if (waiting > polled + SENT_MEANWHILE) {
        // Not much more by the interrupt than this packet has: the polling works off an answer, bit by bit.
        uint8_t sent = waiting - polled;
        if (sent > n + AROUND_BODY)
            sent = n + AROUND_BODY;
        if (waiting - sent > POLLED_BYTES)
            sent = waiting - POLLED_BYTES;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
            const uint8_t tail = tx_tail;
            UCSR0B = POLLED | OWN | 1 << UDRIE0;
            tx_until = tail >= TX_RING - sent ? tail - (TX_RING - sent) : tail + sent;
        }
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

// The sensing interrupt does the same whenever it ends.
static void send_on(void)
{
    const uint8_t tail = tx_tail;
    if (tail == tx_head || (UCSR0B & OWN))
        return;
    const uint8_t byte = tx_ring[tail], next = tail + 1 == TX_RING ? 0 : tail + 1;
    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        if (tail == tx_tail && (UCSR0A & (1 << UDRE0))) {
            UDR0 = byte;
            tx_tail = next;
        }
    }
}

uint8_t serial_poll(void)
{
    uint8_t left = BYTES_PER_POLL;
    send_on();
    if (after_pending)
        carry_out();
    if (zero_new) {                     // at once: in 4 ms the timer comes round
        zero_new = 0;
        uint16_t zero;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
            zero = zero_ticks;
        }
        const uint32_t now_us = hal_now_us();
        zero_us = now_us - ((uint16_t)((uint16_t)(now_us << 4) - zero) >> 4);
    }
    if (rx_tail == rx_head)
        return 0;
    while (left-- && rx_tail != rx_head && !after_pending) {
        const uint8_t byte = rx_ring[rx_tail];
        if (byte == 0) {
            if (!app_listens(0))
                break;
            left = 0;                   // what follows may have to wait for it
        } else if (left == BYTES_PER_POLL - 1 && !app_listens(byte)) {
            break;
        }
        rx_tail = (rx_tail + 1) & (RX_RING - 1);
        app_on_byte(byte, zero_us);
    }
    return 1;
}

uint8_t serial_idle(void)
{
    return rx_tail == rx_head && tx_tail == tx_head && !after_pending;
}

uint16_t serial_overruns(void)
{
    uint16_t n;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        n = rx_overruns;
    }
    return n;
}
