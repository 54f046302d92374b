// SPDX-License-Identifier: Apache-2.0
//
// The skin's term: the whole face with closed lids, integrated once, less what an open eye takes the place of.
//
// The first integrand is smooth but for penumbras and kinks of the relief's third derivatives: Gauss panels,
// halved where halving changes any pair's sum. The second is multiplied by the lids' mask, which vanishes
// smoothly inside the region where the spots lie: an even grid (midpoint rule) finds such integrals to high
// order wherever the mask is.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846
enum { PANEL = 4, BASE_PANELS = 8, DEEPEST = 10, MOST_SPOTS = 4000000 };
static const double PANEL_X[PANEL] = {-0.86113631159405258, -0.33998104358485626, 0.33998104358485626,
                                      0.86113631159405258};
static const double PANEL_W[PANEL] = {0.34785484513745386, 0.65214515486254614, 0.65214515486254614,
                                      0.34785484513745386};
// Error per panel, and light per port or spot, that are not worth pursuing: of the scale below.
static const double PANEL_TOLERANCE = 1e-6, DARK = 1e-11;

void sim_add_face(const struct sim_scene *scene, double elevation_deg, double opening, double *out) {
    int pairs = scene->n_sensors * scene->n_emitters;
    struct sim_lid lid;
    sim_lid_pose(&lid, &scene->person, elevation_deg, opening);
    for (int k = 0; k < pairs; ++k) out[k] += scene->face_all[k];
    const double *part = scene->face_spots;
    for (int i = 0; i < scene->n_lid_spots; ++i, part += scene->n_sensors + scene->n_emitters) {
        const struct sim_lid_spot *spot = &scene->lid_spots[i];
        struct sim_lid_point at;
        double upper, lower;
        sim_lid_margins(&lid, spot->alpha, &upper, &lower);
        if (spot->beta >= upper || spot->beta <= lower) continue;
        sim_lid_measure(&lid, spot->alpha, spot->beta, spot->rho, &at);
        sim_add_pairs(scene, -sim_lid_open(&lid, &at), part, part + scene->n_sensors, out);
    }
}

struct work {
    struct sim_scene *scene;
    int pairs;
    double scale;      // mean response of the skin over pairs of different sites; 0 = not known yet
    double tolerance;  // of one panel, in units of the scale
    double *panels;    // [DEEPEST + 1][4][pairs]
    int dry;           // only to learn the scale: nothing is halved for its error
};

struct spot {
    double position[3], slope[2], normal[3], stretch;  // stretch: area per area of the frontal plane
    double sensor_part[SIM_MAX_PORTS], emitter_part[SIM_MAX_PORTS];
};

// The skin at (x, y) and both ends' factors there; `area` (frontal plane) is what the spot stands for. Returns a
// bound on any pair's light from it.
static double spot_at(struct work *work, double x, double y, double area, struct spot *spot) {
    struct sim_scene *scene = work->scene;
    const struct sim_face *face = &scene->face;
    spot->position[0] = x;
    spot->position[1] = y;
    spot->position[2] = -sim_relief_slope(&face->relief, x, y, spot->slope);
    spot->stretch = sqrt(1 + spot->slope[0] * spot->slope[0] + spot->slope[1] * spot->slope[1]);
    spot->normal[0] = -spot->slope[0] / spot->stretch;
    spot->normal[1] = -spot->slope[1] / spot->stretch;
    spot->normal[2] = -1 / spot->stretch;
    double transfer[2 * SIM_MAX_PORTS], away[2 * SIM_MAX_PORTS][3], distance, share[2 * SIM_MAX_PORTS];
    for (int k = 0; k < scene->n_sites; ++k) {
        transfer[k] = sim_surface_transfer(&scene->sites[k], spot->position, spot->normal, away[k], &distance);
        share[k] = -1;
    }
    sim_ports_at(scene, transfer, away, spot->sensor_part, spot->emitter_part);
    double sensed = 0, lit = 0, weight = area * spot->stretch * scene->person.albedo_skin / PI;
    for (int s = 0; s < scene->n_sensors; ++s) sensed = fmax(sensed, spot->sensor_part[s]);
    for (int e = 0; e < scene->n_emitters; ++e) lit = fmax(lit, spot->emitter_part[e]);
    ++scene->skin_facts.spots;
    if (weight * sensed * lit <= DARK * work->scale) return weight * sensed * lit;
    for (int p = 0; p < scene->n_sensors + scene->n_emitters; ++p) {
        int sensing = p < scene->n_sensors, e = p - scene->n_sensors;
        double *part = sensing ? &spot->sensor_part[p] : &spot->emitter_part[e];
        int k = sensing ? scene->sensors[p].site : scene->emitters[e].site;
        if (weight * *part * (sensing ? lit : sensed) <= DARK * work->scale) continue;
        if (share[k] < 0) {
            share[k] = sim_relief_share(&face->relief, spot->position, spot->slope, face->sites[k], face->lens[k]);
            scene->skin_facts.penumbra[k] |= share[k] > 0 && share[k] < 1;
        }
        *part *= share[k];
    }
    return weight * sensed * lit;
}

static void panel_sum(struct work *work, double x, double y, double half, double *out) {
    struct sim_scene *scene = work->scene;
    struct spot spot;
    memset(out, 0, (size_t)work->pairs * sizeof *out);
    for (int j = 0; j < PANEL; ++j)
        for (int i = 0; i < PANEL; ++i) {
            double area = half * half * PANEL_W[i] * PANEL_W[j];
            if (spot_at(work, x + half * PANEL_X[i], y + half * PANEL_X[j], area, &spot) == 0) continue;
            sim_add_pairs(scene, area * spot.stretch * scene->person.albedo_skin / PI, spot.sensor_part,
                          spot.emitter_part, out);
        }
}

// Whether a panel is too large for some port's distance or spot of light, so that its sums say nothing yet.
static int too_coarse(const struct work *work, double x, double y, double half) {
    const struct sim_scene *scene = work->scene;
    double centre[3] = {x, y, -sim_relief_height(&scene->face.relief, x, y)}, reach = 2 * half;
    for (int p = 0; p < scene->n_sensors + scene->n_emitters; ++p) {
        const struct sim_window *w =
            p < scene->n_sensors ? &scene->sensors[p] : &scene->emitters[p - scene->n_sensors];
        double d[3];
        for (int k = 0; k < 3; ++k) d[k] = centre[k] - scene->sites[w->site].position[k];
        double n = sqrt(sim_dot(d, d)), along = sim_dot(d, w->aim);
        if (n < reach) return 1;
        double sigma = along > 0 ? along / sqrt(2 * w->per_tan2) : n, off2 = n * n - along * along;
        double off = sqrt(off2 > 0 ? off2 : 0);
        if (half > 2 * sigma && along > -reach && off < 4 * sigma + reach) return 1;
    }
    return 0;
}

static void integrate(struct work *work, double x, double y, double half, int depth, const double *coarse) {
    struct sim_scene *scene = work->scene;
    size_t pairs = (size_t)work->pairs;
    double *kids = work->panels + 4 * pairs * (size_t)depth;
    int whole = coarse || depth == DEEPEST || !too_coarse(work, x, y, half);
    if (whole && work->dry) {
        panel_sum(work, x, y, half, kids);
        for (size_t k = 0; k < pairs; ++k) scene->face_all[k] += kids[k];
        return;
    }
    if (whole && !coarse) {
        // One level above, nobody has summed it: its place there is free.
        double *own = work->panels + 4 * pairs * (DEEPEST + 1) + pairs * (size_t)depth;
        panel_sum(work, x, y, half, own);
        coarse = own;
    }
    double h = half / 2;
    if (whole) {
        int fine = depth >= DEEPEST || scene->skin_facts.spots > MOST_SPOTS;
        for (int i = 0; i < 4; ++i)
            panel_sum(work, x + (i & 1 ? h : -h), y + (i & 2 ? h : -h), h, kids + (size_t)i * pairs);
        if (!fine) {
            fine = 1;
            for (size_t k = 0; k < pairs && fine; ++k) {
                double sum = kids[k] + kids[pairs + k] + kids[2 * pairs + k] + kids[3 * pairs + k];
                fine = fabs(sum - coarse[k]) <= work->tolerance * fmax(work->scale, sum);
            }
        }
        if (fine) {
            for (size_t k = 0; k < pairs; ++k)
                scene->face_all[k] += kids[k] + kids[pairs + k] + kids[2 * pairs + k] + kids[3 * pairs + k];
            return;
        }
    }
    for (int i = 0; i < 4; ++i)
        integrate(work, x + (i & 1 ? h : -h), y + (i & 2 ? h : -h), h, depth + 1,
                  whole ? kids + (size_t)i * pairs : NULL);
}

static void integrate_all(struct work *work) {
    memset(work->scene->face_all, 0, (size_t)work->pairs * sizeof(double));
    double half = (SIM_SKIN_X_TO - SIM_SKIN_X_FROM) / (2 * BASE_PANELS);
    for (int j = 0; j < BASE_PANELS; ++j)
        for (int i = 0; i < BASE_PANELS; ++i)
            integrate(work, SIM_SKIN_X_FROM + (2 * i + 1) * half, SIM_SKIN_Y_FROM + (2 * j + 1) * half, half, 0,
                      NULL);
}

static double mean_of_pairs(const struct sim_scene *scene) {
    double apart = 0, all = 0;
    int n = 0, m = scene->n_emitters;
    for (int s = 0; s < scene->n_sensors; ++s)
        for (int e = 0; e < m; ++e) {
            all += scene->face_all[s * m + e];
            if (scene->sensors[s].site == scene->emitters[e].site) continue;
            apart += scene->face_all[s * m + e];
            ++n;
        }
    return n ? apart / n : all / (scene->n_sensors * m);
}

// Spacing of the spots that lids cut: a fraction of the margins' softness and of the narrowest spot of light on
// the lids.
static double lid_step(const struct sim_scene *scene) {
    double step = fmin(0.25, 0.31 * scene->person.lid_softness_mm);
    for (int p = 0; p < scene->n_sensors + scene->n_emitters; ++p) {
        const struct sim_window *w =
            p < scene->n_sensors ? &scene->sensors[p] : &scene->emitters[p - scene->n_sensors];
        const double *at = scene->sites[w->site].position;
        double near = sqrt(sim_dot(at, at)) - scene->person.lid_radius_mm;
        step = fmin(step, 0.5 * fmax(near, 0.2) / sqrt(2 * w->per_tan2));
    }
    return fmax(step, 0.05) / scene->quality.face;
}

static int keep_lid_spots(struct work *work) {
    struct sim_scene *scene = work->scene;
    double wanted = lid_step(scene), canthus = (scene->person.canthus_deg + 4) * SIM_RADIANS;
    int nx = (int)ceil((SIM_SKIN_X_TO - SIM_SKIN_X_FROM) / wanted), room = 0;
    double step = (SIM_SKIN_X_TO - SIM_SKIN_X_FROM) / nx;
    int ny = (int)ceil((SIM_SKIN_Y_TO - SIM_SKIN_Y_FROM) / step);
    size_t ports = (size_t)(scene->n_sensors + scene->n_emitters);
    scene->skin_facts.lid_step_mm = step;
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i) {
            struct spot spot;
            struct sim_lid_spot seen;
            struct sim_lid_point point;
            double x = SIM_SKIN_X_FROM + (i + 0.5) * step, y = SIM_SKIN_Y_FROM + (j + 0.5) * step;
            double head[3] = {x, y, -sim_relief_height(&scene->face.relief, x, y)};
            if (head[2] >= -1) continue;
            seen.rho = sim_lid_locate(head, &point, &seen.alpha, &seen.beta);
            if (fabs(seen.alpha) >= canthus || fabs(seen.beta) >= 65 * SIM_RADIANS) continue;
            if (spot_at(work, x, y, step * step, &spot) <= DARK * work->scale) {
                ++scene->skin_facts.lid_spots_left_out;
                continue;
            }
            if (scene->n_lid_spots == room) {
                room = room ? 2 * room : 1024;
                void *spots = realloc(scene->lid_spots, (size_t)room * sizeof seen);
                if (spots) scene->lid_spots = spots;
                void *parts = realloc(scene->face_spots, (size_t)room * ports * sizeof(double));
                if (parts) scene->face_spots = parts;
                if (!spots || !parts) return -1;
            }
            double weight = step * step * spot.stretch * scene->person.albedo_skin / PI;
            double *part = scene->face_spots + (size_t)scene->n_lid_spots * ports;
            for (int s = 0; s < scene->n_sensors; ++s) part[s] = weight * spot.sensor_part[s];
            memcpy(part + scene->n_sensors, spot.emitter_part, (size_t)scene->n_emitters * sizeof *part);
            scene->lid_spots[scene->n_lid_spots++] = seen;
        }
    scene->skin_facts.lid_spots = scene->n_lid_spots;
    return 0;
}

int sim_prepare_face(struct sim_scene *scene) {
    double q = scene->quality.face;
    struct work work = {.scene = scene, .pairs = scene->n_sensors * scene->n_emitters};
    work.tolerance = PANEL_TOLERANCE / (q * q * q);
    scene->face_all = calloc((size_t)work.pairs, sizeof(double));
    work.panels = malloc(5 * (DEEPEST + 1) * (size_t)work.pairs * sizeof(double));
    if (scene->face_all && work.panels) {
        work.dry = 1;
        integrate_all(&work);
        work.dry = 0;
        work.scale = mean_of_pairs(scene);
        integrate_all(&work);
    }
    int failed = !scene->face_all || !work.panels || keep_lid_spots(&work);
    free(work.panels);
    return failed ? -1 : 0;
}
