// SPDX-License-Identifier: Apache-2.0
// The rings of the serial line, and how a byte gets into the receiver's: by its interrupt (serial.c), which
// has to be short. The receiver itself holds two bytes, 20 us at 1 Mbaud.
#ifndef PORT_SERIAL_H
#define PORT_SERIAL_H

#include <avr/io.h>
#include <stdint.h>

enum {
    RX_RING = 128,                              // power of two
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

// With interrupts off, and only when a byte has arrived. 27 cycles, 34 for a 0x00. In assembler because the
// compiler's prologue would cost the interrupt as much again, and a release waits for it.
static inline __attribute__((always_inline)) void serial_receive(void)
{
    __asm__ volatile(
        "lds r24, %[status]" "\n\t"
        "lds r25, %[data]" "\n\t"
        "sbrs r24, %[overrun]" "\n\t"
        "rjmp 1f" "\n\t"
        "lds r30, %[overruns]" "\n\t"
        "lds r31, %[overruns]+1" "\n\t"
        "adiw r30, 1" "\n\t"
        "sts %[overruns]+1, r31" "\n\t"
        "sts %[overruns], r30" "\n"
        "1:" "\t" "lds r30, %[head]" "\n\t"
        "mov r24, r30" "\n\t"
        "inc r24" "\n\t"
        "andi r24, %[mask]" "\n\t"
        "lds r31, %[tail]" "\n\t"
        "cp r24, r31" "\n\t"
        "brne 2f" "\n\t"
        "lds r30, %[overruns]" "\n\t"           // no room: the byte is lost
        "lds r31, %[overruns]+1" "\n\t"
        "adiw r30, 1" "\n\t"
        "sts %[overruns]+1, r31" "\n\t"
        "sts %[overruns], r30" "\n\t"
        "rjmp 3f" "\n"
        "2:" "\t" "ldi r31, 0" "\n\t"
        "subi r30, lo8(-(%[ring]))" "\n\t"
        "sbci r31, hi8(-(%[ring]))" "\n\t"
        "st Z, r25" "\n\t"
        "sts %[head], r24" "\n"
        "3:" "\t" "cpi r25, 0" "\n\t"
        "brne 4f" "\n\t"
        "lds r24, %[ticks]" "\n\t"
        "lds r25, %[ticks]+1" "\n\t"
        "sts %[zero]+1, r25" "\n\t"
        "sts %[zero], r24" "\n"
        "4:"
        :
        : [status] "i"(_SFR_MEM_ADDR(UCSR0A)), [data] "i"(_SFR_MEM_ADDR(UDR0)), [overrun] "i"(DOR0),
          [overruns] "i"(&rx_overruns), [head] "i"(&rx_head), [tail] "i"(&rx_tail), [mask] "i"(RX_RING - 1),
          [ring] "i"(rx_ring), [ticks] "i"(_SFR_MEM_ADDR(TCNT1L)), [zero] "i"(&zero_ticks)
        : "r24", "r25", "r30", "r31", "memory");
}

#endif
