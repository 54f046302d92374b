// SPDX-License-Identifier: Apache-2.0
// Made by make_tables.py; edit that.
#ifndef SG_CRC32_TABLE_H
#define SG_CRC32_TABLE_H

#include <stdint.h>

#include "sg_rom.h"

static const uint32_t crc32_table[16] SG_ROM = {
    0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
    0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C,
};

#endif
