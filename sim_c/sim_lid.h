// SPDX-License-Identifier: Apache-2.0
//
// The two lid margins, as curves around the centre of rotation: elevation beta over azimuth alpha of a
// direction in the head frame (radians; e_r = (sin a cos b, sin b, -cos a cos b)). Inside both, the eye;
// outside, skin. Edges are soft (C2), so that nothing that lids cut has a staircase; closed lids hide
// everything exactly.
#ifndef SIM_LID_H
#define SIM_LID_H

#include "sim_eye.h"

struct sim_lid {
    double upper, lower;  // elevation of the margins at alpha = 0
    double half, tilt;    // canthi at +-half; both curves rise by tilt * alpha
    double thickness, softness;
    double lash_length, lash_opacity;
};

// A point as the lids see it.
struct sim_lid_point {
    double above, below;      // mm from the upper and lower margin, positive inside the opening
    double radial[3], up[3];  // unit vectors of the direction and of growing elevation, head frame
};

void sim_lid_pose(struct sim_lid *lid, const struct sim_person *person, double elevation_deg, double opening);

// Both margins at one azimuth.
void sim_lid_margins(const struct sim_lid *lid, double alpha, double *upper, double *lower);

// Unit vectors of a point given in the head frame relative to the centre of rotation; no margin distances
// yet. Returns its distance from the centre.
double sim_lid_locate(const double head[3], struct sim_lid_point *point, double *alpha, double *beta);

// Distances to the margins of one pose.
void sim_lid_measure(const struct sim_lid *lid, double alpha, double beta, double rho,
                     struct sim_lid_point *point);

// How open the lids are at the point, 0..1, seen straight on.
double sim_lid_open(const struct sim_lid *lid, const struct sim_lid_point *point);

// The same seen along a unit vector (from the point): a margin stands lid_thickness_mm off the eye, and the
// upper lashes dim, by lash_opacity, what a margin of lash_length_mm instead would hide. Closed lids hide
// all.
double sim_lid_open_toward(const struct sim_lid *lid, const struct sim_lid_point *point,
                           const double toward[3]);

#endif
