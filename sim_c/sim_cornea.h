// SPDX-License-Identifier: Apache-2.0
//
// Paths of light through the cornea to spots of the iris, for a batch at once: as sim_eye_refract().
#ifndef SIM_CORNEA_H
#define SIM_CORNEA_H

#include "sim_wide.h"

// Spots on the iris' plane (eye frame), where their paths cross the cornea, and how far these have settled.
struct sim_spots {
    int n;
    double x[SIM_BATCH], y[SIM_BATCH], weight[SIM_BATCH];
    double exit[3][SIM_BATCH];
    double least[SIM_BATCH];   // lower eigenvalue of the length's second derivatives
    double step[SIM_BATCH];    // the next step of Newton's, mm
    double facing[SIM_BATCH];  // <= 0 where the crossing is not on the visible side
};

// A fixed number of Newton's steps from a first guess; transfer (veil included) is what sim_eye_refract() has
// where that suffices.
void sim_cornea_refract(const struct sim_eye *eye, const double site[3], int steps, struct sim_spots *spots,
                        double *transfer);

// Whether rays from a site through the clear cornea fold on the iris (2): beside the lit part's edge a spot
// then has two paths, and the light rises to the edge like an inverse square root. Elsewhere it fades out
// there (0), steeply where they nearly fold (1).
int sim_cornea_folds(const struct sim_eye *eye, const double site[3]);

// The paths that have not settled, one by one, but for those known to be dark (dark may be NULL). A spot
// without a path keeps a crossing, and no light.
void sim_cornea_mend(const struct sim_eye *eye, const double site[3], int folds, const unsigned char *dark,
                     struct sim_spots *spots, double *transfer);

#endif
