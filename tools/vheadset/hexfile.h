// SPDX-License-Identifier: GPL-3.0-or-later
// Program files: Intel HEX and ELF.
#ifndef HEXFILE_H
#define HEXFILE_H

#include <stddef.h>
#include <stdint.h>

// Lay a program over an image; bytes the file does not mention stay. A path ending in .elf is read as ELF,
// anything else as Intel HEX (every checksum and address is checked).
//   limit   first address that may not be written
// Returns the number of bytes laid, or -1 with a one-line reason in error (the image may then be partly
// written).
long hexfile_load(const char *path, uint8_t *image, uint32_t limit, char *error, size_t error_bytes);

#endif
