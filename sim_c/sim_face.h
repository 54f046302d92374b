// SPDX-License-Identifier: Apache-2.0
//
// Face and closed lids as one height field w(x, y) = -z over the frontal plane (mm, head frame, origin at the
// centre of rotation): the lids' bulge, orbit, brow, nose and cheek, smooth everywhere. What an open eye cuts
// out of it is a soft mask that depends on the lids' pose; which of it each lamp or sensor reaches does not,
// and is found once, with Embree.
#ifndef SIM_FACE_H
#define SIM_FACE_H

#include <stddef.h>

#include "sim_lid.h"

struct sim_spot {
    double position[3], area[3];  // outward normal times area, mm^2
    double alpha, beta, rho;      // as the lids see it
    int lid;                      // whether an open eye may take its place
};

enum { SIM_VIEW_NODES = 28 };

struct sim_face {
    struct sim_spot *spots;
    int n_spots, n_sites;
    float *reach;      // [n_spots][n_sites] 0 or 1: can light pass between spot and site
    float *eye_reach;  // [n_sites][SIM_VIEW_NODES][SIM_VIEW_NODES] B-spline coefficients over (beta, alpha)
    int *eye_clear;    // [n_sites] 1 = the face hides nothing of the eye from that site
};

double sim_face_height(const struct sim_person *person, double x, double y);

// Build the mesh and cast all rays. step_mm: spacing of the quadrature. radius_mm: of each site's lens, for
// soft edges. Returns 0, or -1 with a reason. sim_face_close() in either case.
int sim_face_open(struct sim_face *face, const struct sim_person *person, const double (*sites)[3],
                  const double *radius_mm, int n_sites, double step_mm, char *error, size_t error_bytes);
void sim_face_close(struct sim_face *face);

// Part of a site's lens that a point of the eye in that direction sees past the face, 0..1, C2.
double sim_face_eye_reach(const struct sim_face *face, int site, double alpha, double beta);

#endif
