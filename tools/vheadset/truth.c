// SPDX-License-Identifier: GPL-3.0-or-later
#include "truth.h"

#include <inttypes.h>

#include "person.h"

enum { CYCLES_PER_MS = 16000 };

int truth_open(struct truth *t, const char *path, uint64_t cycle)
{
    if (t->file)
        fclose(t->file);
    t->file = NULL;
    if (!path)
        return 0;
    t->file = fopen(path, "w");
    if (!t->file)
        return -1;
    fprintf(t->file, "us,az_deg,el_deg,pupil_mm,lid_opening,target_az_deg,target_el_deg\n");
    t->next_ms = (cycle + CYCLES_PER_MS - 1) / CYCLES_PER_MS;
    fflush(t->file);
    return 0;
}

void truth_write(struct truth *t, struct person *person, uint64_t cycle)
{
    if (!t->file || t->next_ms * CYCLES_PER_MS > cycle)
        return;
    for (; t->next_ms * CYCLES_PER_MS <= cycle; t->next_ms++) {
        struct person_view v;
        person_view_at(person, (double)t->next_ms * 1e3, &v);
        fprintf(t->file, "%" PRIu64 ",%.5f,%.5f,%.4f,%.4f,%.5f,%.5f\n", t->next_ms * 1000,
                v.state.azimuth_deg, v.state.elevation_deg, v.state.pupil_mm, v.state.lid_opening,
                v.target_azimuth_deg, v.target_elevation_deg);
    }
    fflush(t->file);
}
