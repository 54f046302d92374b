// SPDX-License-Identifier: Apache-2.0
//
// Which parts of the eye's outside may mirror one site into another, to within a reach: a cover by cells of
// polar angle and azimuth, from bounds that hold all over a cell. Nothing is inferred from the ends of a
// cell, nor from how many azimuths of a ring come near: what cannot be excluded is divided, or kept.
#ifndef SIM_COVER_H
#define SIM_COVER_H

#include "sim_mirror.h"

enum { SIM_COVER_CELLS = 1024 };

struct sim_cell {
    double from, to;  // theta
    double lo, hi;    // azimuth in turns, 0..1; dyadic, so that neighbours share their edges exactly
    double bend;      // about the most that the half vector turns per way along the surface, radian/mm
    double steep;     // and against the normal, per radian of theta
    int piece;        // of the profile
    int edge;         // whether a site may set behind the eye's horizon in it
};

// Cells, sorted by `from`, that together hold every point that sees both sites and whose slope
// (sim_mirror.h) is below the reach. Returns their number.
int sim_cover(const struct sim_profile *profile, const struct sim_eye *eye, const double a[3],
              const double b[3], double reach, struct sim_cell out[SIM_COVER_CELLS]);

#endif
