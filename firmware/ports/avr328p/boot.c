// SPDX-License-Identifier: Apache-2.0
// What happens before main: why the chip was reset, the watchdog off, the stack painted.
#include "port.h"

#include <avr/pgmspace.h>
#include <avr/wdt.h>

enum {
    PAINT = 0xC5,
    STRIDE = 8,
    BOOTLOADER_VERSION_AT = 0x7FFE,     // Optiboot leaves minor, major here; other bootloaders leave FF FF
    OPTIBOOT_KEEPS_CAUSE = 0x0406,      // from 4.6 on MCUSR is handed over in r2
};
#define ALIVE_SIGNATURE 0x5A47315AUL    // survives every reset but loss of power

static uint32_t alive __attribute__((section(".noinit")));
static uint8_t left_mcusr __attribute__((section(".noinit")));
static struct {                         // registers as they were found; a reset leaves them alone
    uint8_t r2, r10, r11, r12, r13, r14, r15;
} left __attribute__((section(".noinit")));
static uint8_t cause;

extern uint8_t __heap_start;    // first byte after all static data
static const uint8_t *looked_at = &__heap_start;
static uint16_t stack_free;             // by the latest look that came to its end

// Before anything else uses registers or stack. A watchdog reset leaves the watchdog running at 16 ms: off at
// once. Who comes here by a stray jump finds interrupts on and maybe LEDs lit: off as well, boot takes long.
void boot_first(void) __attribute__((naked, used, section(".init3")));
void boot_first(void)
{
    __asm__ volatile("sts %0, r2" "\n\t"
                     "sts %0+1, r10" "\n\t"
                     "sts %0+2, r11" "\n\t"
                     "sts %0+3, r12" "\n\t"
                     "sts %0+4, r13" "\n\t"
                     "sts %0+5, r14" "\n\t"
                     "sts %0+6, r15" "\n\t"
                     "clr r10" "\n\t"         // seen: they shall not be taken for the bootloader's again
                     "clr r11" "\n\t"
                     "clr r12" "\n\t"
                     "clr r13" "\n\t"
                     "clr r14" "\n\t"
                     "clr r15" : : "i"(&left));
    cli();
    DDRC = 0;
    DDRD = 0;
    TIMSK1 = 0;
    left_mcusr = MCUSR;
    MCUSR = 0;
    __asm__ volatile("wdr");
    WDTCSR = (1 << WDCE) | (1 << WDE);
    WDTCSR = 0;
    for (uint8_t *p = &__heap_start; p <= (uint8_t *)RAMEND; p++)
        *p = PAINT;
}

// Optiboot 4 keeps these constants in registers from the moment it begins to listen, which it does after an
// external reset only: in one set of registers as boards carry it, in another when gcc 7 builds its source.
// It leaves through its watchdog; a watchdog reset while the application runs finds the application's
// registers instead.
static uint8_t bootloader_listened(void)
{
    return left.r14 == 0x01
           && ((left.r10 == 0x11 && left.r11 == 0x05 && left.r15 == 0x08)
               || (left.r12 == 0x11 && left.r13 == 0x05 && left.r15 == 0x03));
}

// MCUSR says it when the bootloader left it alone; later versions of Optiboot hand it over in r2. Optiboot
// before 4.6 clears it: then a lost signature means that power was off.
static uint8_t find_cause(void)
{
    const uint8_t known = SG_RESET_POWER | SG_RESET_EXTERNAL | SG_RESET_BROWNOUT | SG_RESET_WATCHDOG;
    const uint16_t version = pgm_read_word(BOOTLOADER_VERSION_AT);
    if (left_mcusr & known)
        return left_mcusr & known;
    if (version >= OPTIBOOT_KEEPS_CAUSE && version != 0xFFFF && (left.r2 & known))
        return left.r2 & known;
    if (bootloader_listened())
        return SG_RESET_EXTERNAL;
    return alive != ALIVE_SIGNATURE ? SG_RESET_POWER : SG_RESET_WATCHDOG;
}

void hal_boot(void)
{
    cli();
    // The bits of MCUSR are those of enum sg_reset.
    _Static_assert((1 << PORF) == SG_RESET_POWER && (1 << EXTRF) == SG_RESET_EXTERNAL
                   && (1 << BORF) == SG_RESET_BROWNOUT && (1 << WDRF) == SG_RESET_WATCHDOG, "reset bits");
    cause = find_cause();
    alive = ALIVE_SIGNATURE;
    // Boot loaders blink an LED on D13 (PB5): back to an input.
    PORTB = 0;
    DDRB = 0;
}

uint8_t boot_reset_cause(void)
{
    return cause;
}

// In strides, because a frame waits meanwhile: what is deepest on a stack is addresses and registers in a
// row.
uint8_t boot_look_at_stack(void)
{
    const uint8_t *p = looked_at;
    if (p[STRIDE - 1] == PAINT) {
        looked_at = p + STRIDE;
        return 0;
    }
    while (*p == PAINT)
        p++;
    stack_free = (uint16_t)(p - &__heap_start);
    looked_at = &__heap_start;
    return 1;
}

uint16_t boot_stack_free(void)
{
    return stack_free;
}

void boot_watchdog_on(void)
{
    wdt_enable(WDTO_120MS);
}

_Noreturn void boot_restart(void)
{
    cli();
    DDRC = 0;
    DDRD = 0;
    PORTC = 0;
    PORTD = 0;
    if (pgm_read_word(BOOTLOADER_VERSION_AT) == 0xFFFF) {
        // The older bootloader never switches the watchdog off and would be reset by it for ever: start the
        // application afresh instead. find_cause() takes that for the watchdog.
        wdt_disable();
        UCSR0B = 0;
        TIMSK1 = 0;
        ADCSRA = 0;
        TCCR1B = 0;
        __asm__ volatile("jmp 0");
    }
    wdt_enable(WDTO_15MS);
    for (;;) {
    }
}
