// SPDX-License-Identifier: GPL-3.0-or-later
// USART0 in asynchronous mode and the line to the USB bridge, replacing libsimavr's.
//
// Device    10 bits per byte (8N1; other frames by their own length) at exactly the programmed rate.
//           Transmitter: data register and shift register (UDRE returns when the byte moves to the shifter,
//           TXC after the last stop bit). Receiver: two-byte FIFO and the shift register behind it; a start
//           bit while all three are full loses the byte in the shift register and sets DOR.
// Line      the bridge sends at the host's speed, one byte after the other, whether the chip listens or not.
//           When the speeds (clock error included) differ by more than 4 %, or the frame is not 8N1, what
//           arrives on either side is garbage.
#ifndef UART_H
#define UART_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_interrupts.h>

struct bridge;

struct uart_byte { uint8_t data; bool framing_error; uint64_t came; };

struct uart {
    avr_t *avr;
    struct bridge *bridge;
    avr_int_vector_t *rxc, *udre, *txc;
    uint64_t seed;                // of a session
    double cycles_per_true_second;
    // transmitter
    uint8_t tx_data, tx_shift;
    bool tx_waiting, tx_shifting;
    uint64_t tx_end;
    // receiver
    struct uart_byte fifo[2], shift;
    int held;
    bool shift_full, overrun;
    // line towards the chip
    bool line_busy, line_heard;   // a byte is under way; the receiver was on when it began
    uint8_t line_byte;
    double line_free;             // cycle at which its stop bit ends
    uint64_t heard, garbled;      // count draws
    uint64_t overruns, rx_garbage, tx_garbage, tx_bytes, rx_bytes;
    uint64_t longest_rx;          // cycles from a byte's stop bit until it was read
    // told about every byte that leaves, at the end of its stop bit; may be NULL
    void (*on_sent)(void *param, uint8_t byte, uint64_t cycle);
    void *on_sent_param;
};

void uart_attach(struct uart *uart, avr_t *avr, struct bridge *bridge,
                 double cycles_per_true_second);
void uart_reset(struct uart *uart);
// The bridge has bytes for the chip: begin with the first if the line is idle.
void uart_line_wake(struct uart *uart);

#endif
