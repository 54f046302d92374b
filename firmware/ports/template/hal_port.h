// SPDX-License-Identifier: Apache-2.0
// Sizes and markers of a port. Copy this directory to begin one.
#ifndef HAL_PORT_H
#define HAL_PORT_H

enum {
    HAL_TRIAL_BYTES = 640,      // RAM for a trial model, bytes
    HAL_SLOT_SPACE = 0,         // memory of hal_slot()'s images: 0 ordinary, 1 flash with its own load
    HAL_RECORD_MAX = 56,        // largest record hal_save() must take, bytes
};

// Sections whose begin and end a port may mark for cycle counts, at no cost if it does not.
enum hal_section {
    HAL_SECTION_INFER = 0,
    HAL_SECTION_FEATURE = 1,
    HAL_SECTION_OUTPUT = 2,
    HAL_SECTION_SENSE = 3,
    HAL_SECTION_SERIAL = 4,
    HAL_SECTION_FRAME = 5,
    HAL_SECTION_REQUEST = 6,
};

#define HAL_BEGIN(section) ((void)(section))
#define HAL_END(section) ((void)(section))

#endif
