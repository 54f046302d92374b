// SPDX-License-Identifier: Apache-2.0
//
// Face and closed lids as one height field w(x, y) = -z over the frontal plane (mm, head frame, origin at the
// centre of rotation): the lids' bulge, orbit, brow, nose and cheek, smooth everywhere and defined for all x
// and y. Its skin is the rectangle SIM_SKIN_*; what an open eye cuts out of it is a soft mask that depends on
// the lids' pose, of skin on the lids only: what stands before them in the opening's directions, as the side
// of the nose does, stays. What the face hides is soft as well, because a site is a lens and not a point:
// shadows' edges are as wide as the lens makes them, so that integrals over the face are smooth in the site's
// position.
//
// Horizon   H (mm) of a point P for a lens centre Q: how high the centre stands above the horizon that the
//           face makes along the ray, inf over 0 < u <= 1 of gap(u) / u, gap(u) = the ray's height over w at
//           the fraction u of the way. H < 0: the centre is hidden; the lens is wholly seen from H = +R on
//           and wholly hidden from H = -R on.
#ifndef SIM_FACE_H
#define SIM_FACE_H

#include <stddef.h>

#include "sim_lid.h"

#define SIM_SKIN_X_FROM (-34.0)
#define SIM_SKIN_X_TO 30.0
#define SIM_SKIN_Y_FROM (-32.0)
#define SIM_SKIN_Y_TO 32.0

// The least lens radius that shadows are softened by: a point's shadow would have a hard edge.
#define SIM_LEAST_LENS_MM 0.25

// The height field's numbers, from a person.
struct sim_relief {
    double radius, edge, edge_height, edge_slope;  // the lids' bulge: a sphere up to `edge`, a cone beyond
    double brow, cheek, nose;
};

// Which part of the face hides: all of it, or (from the eye, which lies behind the closed lids) all but the
// lids' bulge.
enum sim_part { SIM_PART_ALL, SIM_PART_RELIEF };

enum { SIM_VIEW_ALPHAS = 68, SIM_VIEW_BETAS = 56 };  // cells of 2.5 degrees, alpha within 85, beta within 70

struct sim_face {
    struct sim_relief relief;
    int n_sites;
    double (*sites)[3], *lens;  // [n_sites] places and lens radii, at least SIM_LEAST_LENS_MM
    unsigned char *view;  // [n_sites][SIM_VIEW_BETAS][SIM_VIEW_ALPHAS] 0 hidden, 1 seen, 2 to be computed
    int *eye_clear;       // [n_sites] 1 = hides nothing of what open lids show at gazes within 30 degrees
};

void sim_relief_init(struct sim_relief *relief, const struct sim_person *person);

// w, and its derivatives by x and y.
double sim_relief_height(const struct sim_relief *relief, double x, double y);
double sim_relief_slope(const struct sim_relief *relief, double x, double y, double slope[2]);
double sim_face_height(const struct sim_person *person, double x, double y);

// Share of skin at a distance from the centre of rotation that is the lids', for open lids to take away: 1 up
// to 1 mm before their sphere, 0 from 2.5 mm on.
double sim_relief_on_lids(const struct sim_relief *relief, double rho);

// H of a point for a place.
//   at_zero   the limit of gap(u) / u for u -> 0: sim_relief_tangent() of a point of the skin, INFINITY of a
//             point above the part.
//   lens      H is needed where it is within +-lens only; beyond, any number on the same side is returned.
//             INFINITY: always H.
// Accuracy    1e-6 mm. Cost about 0.3 us where the face's own height decides, 1 us in a penumbra.
double sim_relief_horizon(const struct sim_relief *relief, enum sim_part part, const double from[3],
                          const double to[3], double at_zero, double lens);

// Height (mm, along -z) of a place above the tangent plane of the skin at a point of it.
double sim_relief_tangent(const double skin[3], const double slope[2], const double to[3]);

// Share of a lens (radius >= SIM_LEAST_LENS_MM) that the face leaves to a point of its skin, 0..1, relative
// to what the point's own horizon leaves (which its cosine of incidence accounts for): S(1/2 + H / 2R) /
// S(1/2 + H0 / 2R), S = sim_step(); 1 where H0 <= -R.
double sim_relief_share(const struct sim_relief *relief, const double skin[3], const double slope[2],
                        const double to[3], double lens);

// Copies the sites and looks at the eye from each. Returns 0, or -1 for lack of memory. sim_face_close() in
// either case.
int sim_face_open(struct sim_face *face, const struct sim_person *person, const double (*sites)[3],
                  const double *radius_mm, int n_sites);
void sim_face_close(struct sim_face *face);

// Share of a site's lens that the relief leaves to the eye's point in direction (alpha, beta), taken on the
// lids' sphere: S(1/2 + H / 2R), 0 inside the relief. At once where the lens is wholly seen or hidden.
double sim_face_eye_reach(const struct sim_face *face, int site, double alpha, double beta);

#endif
