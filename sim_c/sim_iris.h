// SPDX-License-Identifier: Apache-2.0
//
// What the iris' rows (sim_iris_row.c) and the disc that they make (sim_iris.c) share.
#ifndef SIM_IRIS_H
#define SIM_IRIS_H

#include "sim_cornea.h"
#include "sim_edge.h"

enum { SIM_PROBE_STEPS = 3, SIM_SHADOW_STEPS = 5, SIM_ROW_EDGES = 32 };

// One call's work. Rows are chords of a disc about the axis, along the head's up.
struct sim_iris {
    const struct sim_scene *scene;
    struct sim_light *light;
    const double *axes, (*sites)[3];  // sites: eye frame
    const struct sim_lid *lids;
    int n_lids, folds[2 * SIM_MAX_PORTS];  // sim_cornea_folds() of the sites
    int uneven;  // whether any is not 0, or the face hides some of the eye
    struct sim_edge *edges, *edge_of[2 * SIM_MAX_PORTS];  // of the sites whose rays fold; which is a site's
    int n_edges;
    struct {
        int site;
        double from, to;
    } unlit[SIM_ROW_EDGES];  // stretches of the row that folded rays do not reach
    int n_unlit;
    unsigned char dark[2 * SIM_MAX_PORTS][SIM_BATCH];  // spots that they do not
    double *ring, across[2], up[2];
    struct sim_spots at, probe;
};

// The batch's light goes into `ring`.
void sim_iris_flush(struct sim_iris *iris);

// Where the paths from site k cross the cornea, as the lids see it.
void sim_iris_locate(const double axes[9], const double place[3], const struct sim_spots *s, int k,
                     struct sim_light *light);

// Spots along the row at a distance u from the axis, from end to end, as site k sees them.
void sim_iris_probe(struct sim_iris *iris, int k, double radius, double u);

// How far the probe's spots lie inside what either margin hides from site k, as in the sclera's rows.
void sim_iris_look(const struct sim_lid *lid, const struct sim_light *light, int k, double *lower,
                   double *upper, double *full_lower, double *full_upper);

// Shares of site k's lens that the face leaves to the probe's spots; -1 where there is no light.
void sim_iris_past_face(const struct sim_iris *iris, int k, double share[SIM_SAMPLES]);

// One row of the disc within a radius: u across, v upward, both in the iris' plane.
void sim_iris_add_row(struct sim_iris *iris, double radius, double u, double weight, double step_mm);

#endif
