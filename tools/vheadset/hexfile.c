// SPDX-License-Identifier: GPL-3.0-or-later
#include "hexfile.h"

#include <errno.h>
#include <fcntl.h>
#include <gelf.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

static int nibble(char c)
{
    return c >= '0' && c <= '9' ? c - '0' : c >= 'A' && c <= 'F' ? c - 'A' + 10
         : c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

// One record into bytes[]. Returns the number of bytes after the colon, or -1.
static int record(const char *line, uint8_t *bytes, int room)
{
    int n = 0, sum = 0;
    for (const char *p = line + 1; *p && *p != '\r' && *p != '\n'; p += 2) {
        int high = nibble(p[0]), low = high < 0 ? -1 : nibble(p[1]);
        if (low < 0 || n >= room)
            return -1;
        bytes[n] = (uint8_t)(high << 4 | low);
        sum += bytes[n++];
    }
    return n >= 5 && n == bytes[0] + 5 && (sum & 0xFF) == 0 ? n : -1;
}

static long load_ihex(FILE *file, uint8_t *image, uint32_t limit, const char **why)
{
    char line[600];
    uint8_t bytes[260];
    uint32_t base = 0;
    long total = 0;
    while (fgets(line, sizeof line, file)) {
        if (line[0] == '\r' || line[0] == '\n')
            continue;
        int n = line[0] == ':' ? record(line, bytes, (int)sizeof bytes) : -1;
        if (n < 0) {
            *why = "a record is damaged";
            return -1;
        }
        uint64_t at = (uint64_t)base + (uint64_t)(bytes[1] << 8 | bytes[2]);
        switch (bytes[3]) {
        case 0:
            if (at + bytes[0] > limit) {
                *why = "it does not fit the memory it is for";
                return -1;
            }
            memcpy(image + at, bytes + 4, bytes[0]);
            total += bytes[0];
            break;
        case 1:
            return total;
        case 2:
            base = (uint32_t)(bytes[4] << 8 | bytes[5]) << 4;
            break;
        case 4:
            base = (uint32_t)(bytes[4] << 8 | bytes[5]) << 16;
            break;
        default:  // start addresses: of no use on an AVR
            break;
        }
    }
    *why = "the end record is missing";
    return -1;
}

// Loadable segments whose physical address is in flash (below 0x800000, where avr-gcc puts RAM).
static long load_elf(int fd, uint8_t *image, uint32_t limit, const char **why)
{
    long total = 0;
    size_t count = 0;
    *why = "it is not a readable AVR ELF file";
    if (elf_version(EV_CURRENT) == EV_NONE)
        return -1;
    Elf *elf = elf_begin(fd, ELF_C_READ, NULL);
    GElf_Ehdr head;
    if (!elf || elf_kind(elf) != ELF_K_ELF || !gelf_getehdr(elf, &head) || head.e_machine != EM_AVR
        || elf_getphdrnum(elf, &count)) {
        elf_end(elf);
        return -1;
    }
    for (size_t i = 0; i < count; i++) {
        GElf_Phdr part;
        if (!gelf_getphdr(elf, (int)i, &part) || part.p_type != PT_LOAD || !part.p_filesz
            || part.p_paddr >= 0x800000)
            continue;
        if (part.p_paddr > limit || part.p_filesz > limit - part.p_paddr) {
            *why = "it does not fit the memory it is for";
            total = -1;
            break;
        }
        if (pread(fd, image + part.p_paddr, part.p_filesz, (off_t)part.p_offset) != (ssize_t)part.p_filesz) {
            total = -1;
            break;
        }
        total += (long)part.p_filesz;
    }
    elf_end(elf);
    return total;
}

long hexfile_load(const char *path, uint8_t *image, uint32_t limit, char *error, size_t error_bytes)
{
    const char *why = "it holds no program", *dot = strrchr(path, '.');
    long total;
    FILE *file = fopen(path, "rb");
    if (!file) {
        snprintf(error, error_bytes, "cannot read %s: %s", path, strerror(errno));
        return -1;
    }
    if (dot && !strcmp(dot, ".elf"))
        total = load_elf(fileno(file), image, limit, &why);
    else
        total = load_ihex(file, image, limit, &why);
    fclose(file);
    if (total <= 0) {
        snprintf(error, error_bytes, "cannot load %s: %s", path, why);
        return -1;
    }
    return total;
}
