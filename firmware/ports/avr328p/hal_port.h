// SPDX-License-Identifier: Apache-2.0
// Sizes and markers of the ATmega328P port (Arduino Nano). Included by hal.h only.
#ifndef HAL_PORT_H
#define HAL_PORT_H

#include <avr/io.h>

enum {
    HAL_TRIAL_BYTES = 0,        // none: RAM is short
    HAL_SLOT_SPACE = 1,         // SG_ROM_FLASH: slots are read through LPM
    HAL_RECORD_MAX = 56,        // live state
};

// Sections for exact cycle counts (tests/budget.csv): GPIOR0 = 2k+1 begins, 2k+2 ends section k. Two cycles
// each, on silicon as in the virtual Nano, so the shipped binary is the measured one.
enum hal_section {
    HAL_SECTION_INFER = 0,      // sg_track_infer
    HAL_SECTION_FEATURE = 1,    // codes and exposures to features
    HAL_SECTION_OUTPUT = 2,     // encode and queue
    HAL_SECTION_SENSE = 3,      // sensing interrupts
    HAL_SECTION_SERIAL = 4,     // UART interrupts
    HAL_SECTION_FRAME = 5,      // all of a frame in the main loop, from taking its samples on
    HAL_SECTION_REQUEST = 6,    // sg_track_infer for SG_MSG_INFER, apart from the live frames'
};

#define HAL_BEGIN(section) (GPIOR0 = (uint8_t)(2 * (section) + 1))
#define HAL_END(section) (GPIOR0 = (uint8_t)(2 * (section) + 2))

#endif
