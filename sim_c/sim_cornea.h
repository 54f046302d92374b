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

// The edge of what a site beside the eye lights of the iris' plane: where its rays graze the cornea, or fold.
// Two curves, over the crossing's distance y from the plane of site and axis: where the light begins, coming
// from the horizon, and where it ends for another fold.
enum { SIM_EDGE_PLACES = 33, SIM_EDGE_MOST = 8 };
struct sim_edge {
    const struct sim_eye *eye;
    double site[3], azimuth[2];  // (distance from the axis, 0, z), the frame of x and y; direction of its x
    double widest;               // |y|
    struct sim_edge_place {
        int there;
        double at[2];  // eye frame, on the iris' plane
    } place[2][SIM_EDGE_PLACES];
};
void sim_cornea_edge(const struct sim_eye *eye, const double site[3], struct sim_edge *edge);

// Where the edge crosses a row, (v along) * up + u * across: its v; and the u, within +-radius, of the rows
// that it touches without crossing them. Both return their number.
int sim_edge_crossings(const struct sim_edge *edge, const double across[2], double u,
                       double out[SIM_EDGE_MOST]);
int sim_edge_turns(const struct sim_edge *edge, const double across[2], double radius,
                   double out[SIM_EDGE_MOST]);

// The paths that have not settled, one by one, but for those known to be dark (dark may be NULL). A spot
// without a path keeps a crossing, and no light.
void sim_cornea_mend(const struct sim_eye *eye, const double site[3], int folds, const unsigned char *dark,
                     struct sim_spots *spots, double *transfer);

#endif
