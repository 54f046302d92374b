// SPDX-License-Identifier: Apache-2.0
// Between the source files of this port: a board of QEMU (mps2-an386: Cortex-M4, two UARTs, a timer) that has
// no sensors and computes what it is asked. One noun each: boot, scope, serial, memory, and poll, which joins
// them.
//
// QEMU runs it with -icount shift=10: its clock is the number of instructions, 1024 ns each, and nothing
// else.
#ifndef PORT_H
#define PORT_H

#include <stdint.h>

#include "hal.h"

enum port_limits {
    TICKS_PER_US = 25,              // of the timer, of SysTick and of the processor
    SLOT_A = 0x00300000,            // where QEMU's loader puts a model (port.ld keeps the program below)
    SLOT_B = 0x00301000,
    SLOT_BYTES = SLOT_B - SLOT_A,
    QUIET_LIMIT = 180,              // SysTick rounds of 0.67 s without a byte: nobody is there any more
};

#define REGISTER(address) (*(volatile uint32_t *)(address))

// One UART, CMSDK APB.
#define UART_DATA(base) REGISTER((base) + 0x0U)
#define UART_STATE(base) REGISTER((base) + 0x4U)
#define UART_CTRL(base) REGISTER((base) + 0x8U)
#define UART_INT(base) REGISTER((base) + 0xCU)
#define UART_DIVIDER(base) REGISTER((base) + 0x10U)
enum uart {
    UART_LINE = 0x40004000,         // the serial line
    UART_SCOPE = 0x40005000,        // records of the scope
    UART_STATE_TX_FULL = 1,
    UART_STATE_RX_FULL = 2,
    UART_CTRL_TX = 1,
    UART_CTRL_RX = 2,
    UART_CTRL_RX_INT = 8,
    UART_INT_RX = 2,
};

#define TIMER_CTRL REGISTER(0x40000000U)    // CMSDK timer: counts down, 32 bits
#define TIMER_VALUE REGISTER(0x40000004U)
#define TIMER_RELOAD REGISTER(0x40000008U)

#define SYSTICK_CTRL REGISTER(0xE000E010U)
#define SYSTICK_RELOAD REGISTER(0xE000E014U)
#define SYSTICK_VALUE REGISTER(0xE000E018U)
#define NVIC_ENABLE REGISTER(0xE000E100U)
#define NVIC_UNPEND REGISTER(0xE000E280U)
#define SCB_ICSR REGISTER(0xE000ED04U)
#define SCB_AIRCR REGISTER(0xE000ED0CU)

// boot.c
uint16_t boot_stack_free(void);     // bytes of the stack never touched
_Noreturn void boot_reset(void);    // where the processor begins
_Noreturn void boot_restart(void);

// scope.c. What the second UART carries, little endian; ticks include the marking (HAL_SECTION_EMPTY).
struct scope_record {
    uint8_t mark;                   // SCOPE_MARK
    uint8_t section;                // enum hal_section
    uint16_t number;                // of the record, from 0, wrapping: none is missing
    uint32_t ticks;                 // of 40 ns; an instruction takes 25.6
};
enum { SCOPE_MARK = 0xA5 };
void scope_start(void);
uint32_t scope_now(void);           // ticks since boot

// serial.c
void serial_start(void);
uint8_t serial_poll(void);          // moves bytes both ways, acts once the line has drained; 0: idle
void serial_sleep(void);            // until a byte or the end of a SysTick round; acts on QUIET_LIMIT
uint16_t serial_overruns(void);

#endif
