// SPDX-License-Identifier: GPL-3.0-or-later
// Run a bench ELF in simavr to its final sleep. Prints one line per marked section, "section k: count min
// max" in net cycles (an empty pair of marks is 0), one line "untouched n", the longest stretch of SRAM that
// nothing wrote to (between static data and stack), and the bytes it wrote to GPIOR1 as one line of hex.
//
//   runner FILE.elf [CHIP [INPUT]]     CHIP: simavr's name, atmega328p; INPUT: a file whose bytes the program
//                                      reads one by one from GPIOR2 (0 behind its end)
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

enum { SECTIONS = 16, OUTPUT_MAX = 1 << 20, MARK_CYCLES = 2, PAINT = 0xC5 };

static struct {
    avr_cycle_count_t begin, min, max;
    unsigned long count;
} section[SECTIONS];
static unsigned char output[OUTPUT_MAX];
static size_t output_fill;

static void on_mark(struct avr_t *avr, avr_io_addr_t addr, uint8_t v, void *param)
{
    (void)param;
    avr->data[addr] = v;
    const unsigned k = (v - 1u) / 2;
    if (v == 0 || k >= SECTIONS)
        return;
    if (v & 1) {
        section[k].begin = avr->cycle;
        return;
    }
    const avr_cycle_count_t cycles = avr->cycle - section[k].begin - MARK_CYCLES;
    if (section[k].count == 0 || cycles < section[k].min)
        section[k].min = cycles;
    if (cycles > section[k].max)
        section[k].max = cycles;
    section[k].count++;
}

static void on_output(struct avr_t *avr, avr_io_addr_t addr, uint8_t v, void *param)
{
    (void)param;
    avr->data[addr] = v;
    if (output_fill < OUTPUT_MAX)
        output[output_fill++] = v;
}

static uint8_t on_input(struct avr_t *avr, avr_io_addr_t addr, void *param)
{
    const int byte = param == NULL ? EOF : fgetc(param);
    avr->data[addr] = byte == EOF ? 0 : (uint8_t)byte;
    return avr->data[addr];
}

static unsigned longest_untouched(const avr_t *avr)
{
    unsigned longest = 0, run = 0;
    for (unsigned a = avr->ioend + 1; a <= avr->ramend; a++) {
        run = avr->data[a] == PAINT ? run + 1 : 0;
        longest = run > longest ? run : longest;
    }
    return longest;
}

int main(int argc, char **argv)
{
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    FILE *input = argc > 3 ? fopen(argv[3], "rb") : NULL;
    if (argc < 2 || argc > 4 || (argc > 3 && input == NULL) || elf_read_firmware(argv[1], &firmware) != 0) {
        fprintf(stderr, "usage: runner FILE.elf [CHIP [INPUT]]\n");
        return 2;
    }
    avr_t *avr = avr_make_mcu_by_name(argc > 2 ? argv[2] : "atmega328p");
    if (avr == NULL || avr_init(avr) != 0)
        return 2;
    memset(avr->data + avr->ioend + 1, PAINT, avr->ramend - avr->ioend);
    firmware.frequency = 16000000;
    avr_load_firmware(avr, &firmware);
    avr_register_io_write(avr, 0x3E, on_mark, NULL);
    avr_register_io_write(avr, 0x4A, on_output, NULL);
    avr_register_io_read(avr, 0x4B, on_input, input);
    avr->log = LOG_NONE;
    int state = cpu_Running;
    while (state != cpu_Done && state != cpu_Crashed && avr->cycle < 2000000000ull) {
        avr->run_cycle_limit = 16000;
        state = avr_run(avr);
    }
    if (state != cpu_Done) {
        fprintf(stderr, "the bench did not come to its end: state %d at pc 0x%x\n", state, avr->pc);
        return 1;
    }
    for (unsigned k = 0; k < SECTIONS; k++)
        if (section[k].count)
            printf("section %u: %lu %llu %llu\n", k, section[k].count, (unsigned long long)section[k].min,
                   (unsigned long long)section[k].max);
    printf("untouched %u\n", longest_untouched(avr));
    for (size_t i = 0; i < output_fill; i++)
        printf("%02x", output[i]);
    printf("\n");
    return 0;
}
