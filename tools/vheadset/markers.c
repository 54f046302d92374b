// SPDX-License-Identifier: GPL-3.0-or-later
#include "markers.h"

#include <inttypes.h>
#include <string.h>

#include "access.h"

enum { GPIOR0 = 0x3E, GPIOR1 = 0x4A, OUT_AND_LDI = 2, ENTRY_CYCLES = 4, WAKE_CYCLES = 4, RETI_CYCLES = 4 };

static void count(struct marker_sum *sum, uint64_t cycles)
{
    if (!sum->count++ || cycles < sum->least)
        sum->least = cycles;
    if (cycles > sum->most)
        sum->most = cycles;
    sum->total += cycles;
}

static void write_section(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct markers *m = param;
    uint64_t now = access_write_cycle(avr);
    avr->data[at] = value;
    if (!value || (value - 1) / 2 >= MARKERS_SECTIONS)
        return;
    struct marker *s = &m->section[(value - 1) / 2];
    if (value & 1) {
        s->open = true;
        s->began = now;
        s->interrupted = 0;
        s->depth = m->depth;
    } else if (s->open) {
        uint64_t cycles = now - s->began;
        s->open = false;
        count(&s->gross, cycles < OUT_AND_LDI ? 0 : cycles - OUT_AND_LDI);
        count(&s->net, cycles < OUT_AND_LDI + s->interrupted ? 0 : cycles - OUT_AND_LDI - s->interrupted);
    }
}

void markers_log(struct markers *m, const char *what, uint64_t cycle)
{
    if (m->frames)
        fprintf(m->frames, "%s,%" PRIu64 "\n", what, cycle);
}

void markers_log_value(void *param, const char *what, int value, uint64_t cycle)
{
    struct markers *m = param;
    if (m->frames)
        fprintf(m->frames, "%s:%d,%" PRIu64 "\n", what, value, cycle);
}

static void write_frame(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    avr->data[at] = value;
    if (value == 1 || value == 2)
        markers_log(param, value == 1 ? "release" : "sample", access_write_cycle(avr));
}

// Raised with the vector on entry, and at RETI with the vector returned to (0: none).
static void on_running(avr_irq_t *irq, uint32_t vector, void *param)
{
    struct markers *m = param;
    avr_t *avr = m->avr;
    (void)irq;
    // On entry the simulator raises this before it pushes the vector on its own list, at RETI after taking it
    // off.
    bool entry = vector && avr->sreg[S_I] == 0;
    if (entry) {
        if (m->depth < MARKERS_NESTING)
            m->entered[m->depth] = avr->cycle;
        m->depth++;
        avr->cycle += ENTRY_CYCLES + (m->slept ? WAKE_CYCLES : 0);
        m->slept = false;
    } else if (m->depth > 0) {
        m->depth--;
        if (m->depth >= MARKERS_NESTING)
            return;
        uint64_t spent = avr->cycle + RETI_CYCLES - m->entered[m->depth];
        for (int i = 0; i < MARKERS_SECTIONS; i++)
            if (m->section[i].open && m->section[i].depth == m->depth)
                m->section[i].interrupted += spent;
    }
}

void markers_attach(struct markers *m, avr_t *avr)
{
    memset(m, 0, sizeof *m);
    m->avr = avr;
    access_take_write(avr, GPIOR0, write_section, m);
    access_take_write(avr, GPIOR1, write_frame, m);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, AVR_INT_ANY) + AVR_INT_IRQ_RUNNING, on_running, m);
}

void markers_reset(struct markers *m)
{
    m->depth = 0;
    m->slept = false;
    for (int i = 0; i < MARKERS_SECTIONS; i++)
        m->section[i].open = false;
}

void markers_clear(struct markers *m)
{
    for (int i = 0; i < MARKERS_SECTIONS; i++)
        m->section[i] = (struct marker){0};
}

static size_t print_sum(char *text, size_t bytes, int k, const char *suffix, const struct marker_sum *s)
{
    int n = snprintf(text, bytes, "%d%s:%" PRIu64 ":%" PRIu64 ":%.3f:%" PRIu64, k, suffix, s->count, s->least,
                     (double)s->total / (double)s->count, s->most);
    return n < 0 || (size_t)n >= bytes ? 0 : (size_t)n;
}

void markers_print(const struct markers *m, char *text, size_t bytes)
{
    size_t used = 0;
    text[0] = 0;
    for (int k = 0; k < MARKERS_SECTIONS; k++) {
        const struct marker *s = &m->section[k];
        for (int net = 0; net < 2 && s->gross.count; net++) {
            if (used && used + 1 < bytes)
                text[used++] = ';';
            used += print_sum(text + used, bytes - used, k, net ? "n" : "", net ? &s->net : &s->gross);
        }
    }
    text[used] = 0;
}
