// SPDX-License-Identifier: Apache-2.0
//
// What the parts of the simulator share about a scene; not for callers.
#ifndef SIM_INSIDE_H
#define SIM_INSIDE_H

#include "sim_face.h"
#include "sim_mirror.h"
#include "sim_scene.h"

#define SIM_RADIANS (3.14159265358979323846 / 180)

// A place where at least one sensor or emitter is, head frame. Everything but the window depends on the place
// only.
struct sim_site {
    double position[3], radius;
};

struct sim_window {
    int site;
    double aim[3], per_tan2;  // 1 / (2 tan^2 sigma)
};

enum { SIM_MAX_RULE = 24 };

// Spots of the skin that an open eye may take the place of: columns of even steps in y. Between two spots lie
// SIM_SUB points at which the lids' mask is taken; light is interpolated to them.
enum { SIM_SUB = 4 };

struct sim_lid_spot {
    double alpha, beta, rho;  // as the lids see it; beta out of reach where no lid can be
    double on_lids;           // sim_relief_on_lids()
};

// About how many views of a site from a spot of the skin are worth their time, when hard shadows want more.
#define SIM_MOST_VIEWS 1.5e6

struct sim_lid_column {
    int first, n;  // of its spots; the first and the last three are there for interpolation only
};

// What the quadrature of the skin met, for reports.
struct sim_skin_facts {
    int spots, lid_spots;  // evaluated for the closed lids' sum; kept for lid poses
    double lid_step_mm;    // spacing of the latter
    double tolerance;      // of one panel of the former, in units of the pairs' mean
    double goal;           // the same before it was loosened
    unsigned char penumbra[2 * SIM_MAX_PORTS];  // whether a site's lens is partly hidden from any lit spot
};

// The skin at one place and both ends' factors there.
struct sim_skin_spot {
    double position[3], slope[2], normal[3], stretch;  // stretch: area per area of the frontal plane
    double sensor_part[SIM_MAX_PORTS], emitter_part[SIM_MAX_PORTS];
    int penumbra;  // of lenses whose shadows are narrow, one crosses the spot
};

struct sim_scene {
    struct sim_person person;
    struct sim_quality quality;
    struct sim_eye eye;
    struct sim_face face;
    int n_sites, n_sensors, n_emitters;
    struct sim_site sites[2 * SIM_MAX_PORTS];
    struct sim_window sensors[SIM_MAX_PORTS], emitters[SIM_MAX_PORTS];
    double *nodes;  // memory of the rules
    const double *rule[SIM_MAX_RULE + 1];  // rule[n]: Gauss-Legendre's n abscissas on -1..1, n weights
    struct sim_profile profile;            // of the eye, for the glint
    _Atomic long long glint_counts[3];     // see sim_scene_glint_counts()
    double *face_all;    // [sensors][emitters] response of all skin with the lids closed
    double *face_spots;  // [n_lid_spots][sensors + emitters], of what an open eye may replace
    struct sim_lid_spot *lid_spots;  // [n_lid_spots][1 + SIM_SUB]: the spot, then the points after it
    struct sim_lid_column *lid_columns;
    int n_lid_spots, n_lid_columns;
    struct sim_skin_facts skin_facts;
};

// A window's weight for light arriving along the unit vector `away` (from the scene to the site).
double sim_window_weight(const struct sim_window *window, const double away[3]);

// out += weight * sensor_part (x) emitter_part, each already including its window; sites' factors given per
// site.
void sim_add_pairs(const struct sim_scene *scene, double weight, const double *sensor_part,
                   const double *emitter_part, double *out);

// Both ends' factors at one place: each site's transfer times each port's window. away: unit vectors to the
// sites, used where transfer is not 0.
void sim_ports_at(const struct sim_scene *scene, const double *transfer, double (*away)[3],
                  double *sensor_part, double *emitter_part);

// Irradiance per intensity at a surface point (unit normal), the unit vector to the site and its distance.
double sim_surface_transfer(const struct sim_site *site, const double point[3], const double normal[3],
                            double away[3], double *distance);

// out[sensors][emitters] += the skin's term at one lid pose.
void sim_add_face(const struct sim_scene *scene, double elevation_deg, double opening, double *out);

// Integrates the skin with closed lids, and keeps the spots that lids may cut. Returns 0, or -1 for lack of
// memory.
int sim_prepare_face(struct sim_scene *scene);

// One spot of the skin. Returns a bound on any pair's response per area of the frontal plane; what is below
// dark_per_area is not looked into.
double sim_skin_at(struct sim_scene *scene, double x, double y, double dark_per_area,
                   struct sim_skin_spot *spot);

// Keeps the spots that lids may cut, but for those without light (dark: of one spot, as a response). Returns
// 0, or -1 for lack of memory.
int sim_keep_opening(struct sim_scene *scene, double dark);

// out[sensors][emitters] -= what the open eye takes the place of.
void sim_cut_opening(const struct sim_scene *scene, const struct sim_lid *lid, double *out);

#endif
