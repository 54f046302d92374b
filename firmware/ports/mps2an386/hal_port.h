// SPDX-License-Identifier: Apache-2.0
// Sizes and markers of the mps2-an386 port (Cortex-M4 in QEMU). Included by hal.h only.
#ifndef HAL_PORT_H
#define HAL_PORT_H

#include <stdint.h>

enum {
    HAL_TRIAL_BYTES = 3072,     // a whole slot
    HAL_SLOT_SPACE = 0,         // slots are ordinary memory
    HAL_RECORD_MAX = 56,        // live state
};

// Sections for instruction counts. Each end is reported on the second UART (port.h, struct scope_record).
enum hal_section {
    HAL_SECTION_INFER = 0,      // sg_track_infer
    HAL_SECTION_FEATURE = 1,
    HAL_SECTION_OUTPUT = 2,
    HAL_SECTION_SENSE = 3,
    HAL_SECTION_SERIAL = 4,
    HAL_SECTION_FRAME = 5,
    HAL_SECTION_REQUEST = 6,    // sg_track_infer for SG_MSG_INFER
    HAL_SECTION_EMPTY = 15,     // what the marking itself costs
    HAL_SECTIONS = 16,
};

// scope.c. Out of line and never inlined, so that every section pays the same for being marked.
void scope_begin(uint8_t section);
void scope_end(uint8_t section);

#define HAL_BEGIN(section) scope_begin(section)
#define HAL_END(section) scope_end(section)

#endif
