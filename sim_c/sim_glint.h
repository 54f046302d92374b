// SPDX-License-Identifier: Apache-2.0
//
// One gaze, one pair of sites, and the glint's integrand between them; not for callers.
#ifndef SIM_GLINT_H
#define SIM_GLINT_H

#include "sim_cover.h"
#include "sim_inside.h"

// Of one gaze: all in the eye frame but the lids.
struct sim_gaze {
    const struct sim_scene *scene;
    double axes[9], sites[2 * SIM_MAX_PORTS][3], widen[2 * SIM_MAX_PORTS];
    double sensor_aim[SIM_MAX_PORTS][3], emitter_aim[SIM_MAX_PORTS][3];
    struct sim_lid lids[SIM_MAX_LIDS];
    int n_lids;
    double *out;
    long long counts[3];  // as sim_scene_glint_counts()
};

// Of one pair of sites.
struct sim_lobe {
    struct sim_gaze *gaze;
    const double *a, *b;
    int site_a, site_b;
    double alpha, alpha2, cut;  // cut: slope^2 / alpha^2 beyond which nothing is taken
    const struct sim_cell *cells;  // the cover; first..last is the part in hand
    int first, last;
    double *apart;              // [pairs of this lobe][n_lids]: where to add, instead of gaze->out; or NULL
    struct sim_facing start;
};

// Fills everything but `out` and the counts. Returns 0, or -1 for bad arguments.
int sim_gaze_open(struct sim_gaze *gaze, const struct sim_scene *scene, double azimuth_deg,
                  double elevation_deg, const double *lid_opening, int n_lids);

// The lids' and the face's share of a point: open[lid]. l, v: unit vectors to both sites. Returns whether
// anything is left.
int sim_lobe_open(const struct sim_lobe *lobe, const double point[3], const double l[3], const double v[3],
                  double *open);

// Adds the integrand times a weight at an azimuth (cosine, sine) of a ring. Returns slope^2 / alpha^2 there,
// large behind a horizon.
double sim_lobe_point(const struct sim_lobe *lobe, const struct sim_ring *ring, double c, double s,
                      double weight);

double sim_gaze_window(const double aim[3], double per_tan2, const double away[3]);

// The lobe from its mirror points and their neighbours, when quality.tolerance allows: adds it and returns 1,
// or adds nothing and returns 0. stretches: where the lobe is.
int sim_lobe_by_mirror(struct sim_lobe *lobe, const struct sim_stretch *stretches, int n);

#endif
