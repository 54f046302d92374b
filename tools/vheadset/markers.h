// SPDX-License-Identifier: GPL-3.0-or-later
// Exact cycle counts by GPIOR0, frame moments by GPIOR1, and the four cycles an interrupt takes to begin
// (eight out of sleep), which libsimavr 1.6 counts as none.
//
// Writing 2k+1 to GPIOR0 begins section k, 2k+2 ends it. A section is counted from the end of the first OUT
// to the LDI before the second: two cycles are taken off the distance between the two. "Net" leaves out
// interrupts that began and ended inside the section, their entry included.
#ifndef MARKERS_H
#define MARKERS_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include <simavr/sim_avr.h>

enum { MARKERS_SECTIONS = 16, MARKERS_NESTING = 16 };

struct marker_sum { uint64_t count, total, least, most; };

struct marker {
    bool open;
    uint64_t began, interrupted;   // cycles of interrupts since it began
    int depth;                     // interrupt nesting where it began
    struct marker_sum gross, net;
};

struct markers {
    avr_t *avr;
    struct marker section[MARKERS_SECTIONS];
    uint64_t entered[MARKERS_NESTING];
    int depth;
    bool slept;                    // the CPU was asleep when the pending interrupt came
    FILE *frames;
};

void markers_attach(struct markers *markers, avr_t *avr);
void markers_reset(struct markers *markers);  // of the chip: nothing is running any more
void markers_clear(struct markers *markers);
// "k:count:min:mean:max;...;kn:..." into text.
void markers_print(const struct markers *markers, char *text, size_t bytes);
// A row of the frame log, if there is one.
void markers_log(struct markers *markers, const char *what, uint64_t cycle);
// The same with a number: "what:value". param: struct markers.
void markers_log_value(void *param, const char *what, int value, uint64_t cycle);

#endif
