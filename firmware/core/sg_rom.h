// SPDX-License-Identifier: Apache-2.0
// Read-only data that may live in program flash. The only file of the core that asks for the architecture.
//
// On AVR a pointer does not say which memory it points into, so data that can be in either carries a `space`,
// and tables of the core are marked SG_ROM and read through sg_rom_word. Elsewhere both are plain loads.
#ifndef SG_ROM_H
#define SG_ROM_H

#include <stdint.h>

enum sg_rom_space { SG_ROM_MEMORY = 0, SG_ROM_FLASH = 1 };

// sg_gp has an assembly twin of its inner loop for AVR; SG_GP_PORTABLE asks for the C one there too.
#if defined(__AVR__) && !defined(SG_GP_PORTABLE)
#define SG_GP_ASSEMBLY
#endif

// The same of sg_mlp.
#if defined(__AVR__) && !defined(SG_MLP_PORTABLE)
#define SG_MLP_ASSEMBLY
#endif

// The same of sg_light.
#if defined(__AVR__) && !defined(SG_LIGHT_PORTABLE)
#define SG_LIGHT_ASSEMBLY
#endif

// The same of sg_wire's encoder.
#if defined(__AVR__) && !defined(SG_WIRE_PORTABLE)
#define SG_WIRE_ASSEMBLY
#endif

#ifdef __AVR__
#include <avr/pgmspace.h>
#define SG_ROM PROGMEM

// What a part of the core in assembly may leave changed: all but r28 and r29, and the registers that bring its
// arguments, which have to be operands. It is called where next to nothing is kept in registers.
#define SG_LOST "r0", "r2", "r3", "r4", "r5", "r6", "r7", "r8", "r9", "r10", "r11", "r12", "r13", "r14", "r15", \
                "r26", "r27", "r30", "r31", "cc", "memory"

// Does it lie in flash? A build that has no model anywhere else need not ask.
static inline uint8_t sg_rom_flash(uint8_t space)
{
#ifdef SG_GP_FLASH_ONLY
    (void)space;
    return 1;
#else
    return space == SG_ROM_FLASH;
#endif
}

static inline uint8_t sg_rom_byte(const uint8_t *p, uint8_t space)
{
    return sg_rom_flash(space) ? pgm_read_byte(p) : *p;
}

// Little-endian fields at any alignment.
static inline uint16_t sg_rom_u16(const uint8_t *p, uint8_t space)
{
    return sg_rom_flash(space) ? pgm_read_word(p) : *(const uint16_t *)p;
}

static inline uint32_t sg_rom_u32(const uint8_t *p, uint8_t space)
{
    return sg_rom_flash(space) ? pgm_read_dword(p) : *(const uint32_t *)p;
}

// An entry of a table of the core.
static inline uint16_t sg_rom_word(const uint16_t *entry)
{
    return pgm_read_word(entry);
}

static inline uint32_t sg_rom_dword(const uint32_t *entry)
{
    return pgm_read_dword(entry);
}
#else
#define SG_ROM

static inline uint8_t sg_rom_byte(const uint8_t *p, uint8_t space)
{
    (void)space;
    return *p;
}

static inline uint16_t sg_rom_u16(const uint8_t *p, uint8_t space)
{
    (void)space;
    return (uint16_t)(p[0] | (uint16_t)((uint16_t)p[1] << 8));
}

static inline uint32_t sg_rom_u32(const uint8_t *p, uint8_t space)
{
    return sg_rom_u16(p, space) | ((uint32_t)sg_rom_u16(p + 2, space) << 16);
}

static inline uint16_t sg_rom_word(const uint16_t *entry)
{
    return *entry;
}

static inline uint32_t sg_rom_dword(const uint32_t *entry)
{
    return *entry;
}
#endif

#endif
