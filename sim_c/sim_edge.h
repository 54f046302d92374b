// SPDX-License-Identifier: Apache-2.0
//
// The edge of what a site beside the eye lights of the iris' plane: where its rays graze the cornea, or fold.
#ifndef SIM_EDGE_H
#define SIM_EDGE_H

#include "sim_wide.h"

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
void sim_edge_find(const struct sim_eye *eye, const double site[3], struct sim_edge *edge);

// Where the edge crosses a row, (v along) * up + u * across: its v; and the u, within +-radius, of the rows
// that it touches without crossing them. Both return their number.
int sim_edge_crossings(const struct sim_edge *edge, const double across[2], double u,
                       double out[SIM_EDGE_MOST]);
int sim_edge_turns(const struct sim_edge *edge, const double across[2], double radius,
                   double out[SIM_EDGE_MOST]);

#endif
