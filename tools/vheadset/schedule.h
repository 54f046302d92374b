// SPDX-License-Identifier: GPL-3.0-or-later
// Settings that take effect at exact cycles, whatever the program does there: due ones are applied before
// anything else happens that is later.
#ifndef SCHEDULE_H
#define SCHEDULE_H

#include <stdbool.h>
#include <stdint.h>

#include "setting.h"

struct nano;

enum { SCHEDULE_MOST = 1024 };

struct schedule {
    struct { uint64_t cycle; struct setting setting; } entry[SCHEDULE_MOST];   // in order of cycles
    unsigned entries;
    bool applying;
};

// Returns 0, or -1 when it is full. Of one cycle, the later given comes later.
int schedule_add(struct schedule *schedule, uint64_t cycle, const struct setting *setting);
void schedule_clear(struct schedule *schedule);
// Apply what is due by a cycle.
void schedule_run(struct schedule *schedule, struct nano *nano, uint64_t cycle);
// Cycle of the next one, UINT64_MAX when there is none.
uint64_t schedule_next(const struct schedule *schedule);

#endif
