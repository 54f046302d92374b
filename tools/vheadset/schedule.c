// SPDX-License-Identifier: GPL-3.0-or-later
#include "schedule.h"

#include <string.h>

int schedule_add(struct schedule *s, uint64_t cycle, const struct setting *setting)
{
    unsigned at = s->entries;
    if (s->entries == SCHEDULE_MOST)
        return -1;
    while (at && s->entry[at - 1].cycle > cycle)
        at--;
    memmove(&s->entry[at + 1], &s->entry[at], (s->entries - at) * sizeof *s->entry);
    s->entry[at].cycle = cycle;
    s->entry[at].setting = *setting;
    s->entries++;
    return 0;
}

void schedule_clear(struct schedule *s)
{
    s->entries = 0;
}

void schedule_run(struct schedule *s, struct nano *nano, uint64_t cycle)
{
    if (s->applying)        // applying one brings the board forward, which asks again
        return;
    s->applying = true;
    while (s->entries && s->entry[0].cycle <= cycle) {
        setting_apply(nano, &s->entry[0].setting, s->entry[0].cycle);
        memmove(s->entry, s->entry + 1, --s->entries * sizeof *s->entry);
    }
    s->applying = false;
}

uint64_t schedule_next(const struct schedule *s)
{
    return s->entries ? s->entry[0].cycle : UINT64_MAX;
}
