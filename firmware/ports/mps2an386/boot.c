// SPDX-License-Identifier: Apache-2.0
// From reset to main(), and back.
#include "port.h"

#include <string.h>

enum { PAINT = 0xC5, AIRCR_RESET = 0x05FA0004 };

// From port.ld.
extern uint32_t port_data_source[], port_data[], port_data_end[], port_bss[], port_bss_end[];
extern uint32_t port_stack[], port_stack_end[];

int main(void);

_Noreturn void boot_restart(void)
{
    for (;;)
        SCB_AIRCR = AIRCR_RESET;        // QEMU ends instead, when it was started with -no-reboot
}

_Noreturn void boot_reset(void)
{
    // Nothing of this port runs in an interrupt: they end sleeps, no more.
    __asm__ volatile("cpsid i" ::: "memory");
    memcpy(port_data, port_data_source, (size_t)((uint8_t *)port_data_end - (uint8_t *)port_data));
    memset(port_bss, 0, (size_t)((uint8_t *)port_bss_end - (uint8_t *)port_bss));
    uint8_t *deepest;
    __asm__ volatile("mov %0, sp" : "=r"(deepest));
    for (volatile uint8_t *p = (uint8_t *)port_stack; p < deepest; p++)
        *p = PAINT;
    main();
    boot_restart();
}

// A fault is an error of this program: whoever started it sees it end.
static void boot_fault(void)
{
    boot_restart();
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))port_stack_end, boot_reset, boot_fault, boot_fault, boot_fault, boot_fault, boot_fault,
};

uint16_t boot_stack_free(void)
{
    const uint8_t *p = (const uint8_t *)port_stack;
    while (p < (const uint8_t *)port_stack_end && *p == PAINT)
        p++;
    return (uint16_t)(p - (const uint8_t *)port_stack);
}
