// SPDX-License-Identifier: Apache-2.0
// The rings of the serial line, and how a byte gets into the receiver's: by its interrupt (serial.c), which
// has to be short. The receiver itself holds two bytes, 20 us at 1 Mbaud.
#ifndef PORT_SERIAL_H
#define PORT_SERIAL_H

#include <avr/io.h>
#include <stdint.h>

enum {
    RX_RING = 128,                              // power of two
    SERIAL_OWN = 1 << TXB80,                    // in UCSR0B, a ninth bit unused: the interrupt alone sends
    TX_RING = 252,                              // frames of all three streams (108), and two answers (72)
};

extern uint8_t rx_ring[RX_RING];
extern volatile uint8_t rx_head;                // written with interrupts off
extern uint8_t rx_tail;                         // written by the main loop
extern volatile uint16_t rx_overruns;
extern uint8_t tx_ring[TX_RING];
extern volatile uint8_t tx_head;                // written by the main loop
extern volatile uint8_t tx_tail;                // written with interrupts off
extern volatile uint16_t zero_ticks;            // TCNT1 when the latest 0x00 arrived

// Subroutine of the assembler: keeps the byte that has arrived. With interrupts off; some 40 cycles. Uses
// r24, r25, r30, r31 and the flags.
void serial_byte(void);

#endif
