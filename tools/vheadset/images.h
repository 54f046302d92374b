// SPDX-License-Identifier: GPL-3.0-or-later
// Memory images on disk: flash.bin and eeprom.bin in the state directory, replaced as a whole (temporary file
// and rename), so that a killed program leaves the old image or the new one.
#ifndef IMAGES_H
#define IMAGES_H

#include <stddef.h>
#include <stdint.h>

// Fill data from directory/name; a missing file leaves data as it is. Returns 0, or -1 with a reason (a file
// of another size is an error).
int images_load(const char *directory, const char *name, uint8_t *data, size_t bytes, char *error,
                size_t error_bytes);
// Returns 0, or -1 with errno set.
int images_save(const char *directory, const char *name, const uint8_t *data, size_t bytes);

#endif
