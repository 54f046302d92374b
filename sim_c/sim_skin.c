// SPDX-License-Identifier: Apache-2.0
//
// The skin's term: the whole face with closed lids, integrated once, less what an open eye takes the place
// of.
//
// The first integrand is smooth but for penumbras and kinks of the relief's third derivatives: Gauss panels,
// halved where halving changes any pair's sum. What the eye takes is sim_opening.c's.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846
enum { PANEL = 4, BASE_PANELS = 8, DEEPEST = 10 };
static const double PANEL_X[PANEL] = {-0.86113631159405258, -0.33998104358485626, 0.33998104358485626,
                                      0.86113631159405258};
static const double PANEL_W[PANEL] = {0.34785484513745386, 0.65214515486254614, 0.65214515486254614,
                                      0.34785484513745386};
// Error per panel, and light per port or spot, that are not worth pursuing: of the scale below.
static const double PANEL_TOLERANCE = 5e-6, DARK = 1e-11;
static const double NEAR_MM = 20;  // a shadow's edge is this far from what casts it, or less

void sim_add_face(const struct sim_scene *scene, double elevation_deg, double opening, double *out) {
    int pairs = scene->n_sensors * scene->n_emitters;
    struct sim_lid lid;
    sim_lid_pose(&lid, &scene->person, elevation_deg, opening);
    for (int k = 0; k < pairs; ++k) out[k] += scene->face_all[k];
    sim_cut_opening(scene, &lid, out);
}

struct work {
    struct sim_scene *scene;
    int pairs;
    double scale;      // mean response of the skin over pairs of different sites; 0 = not known yet
    double tolerance;  // of one panel, in units of the scale
    double *panels;    // [DEEPEST + 1][4][pairs]
    int dry;           // only to learn the scale: nothing is halved for its error
    double most_spots;  // give up beyond
};

double sim_skin_at(struct sim_scene *scene, double x, double y, double dark_per_area,
                   struct sim_skin_spot *spot) {
    const struct sim_face *face = &scene->face;
    spot->position[0] = x;
    spot->position[1] = y;
    spot->position[2] = -sim_relief_slope(&face->relief, x, y, spot->slope);
    spot->stretch = sqrt(1 + spot->slope[0] * spot->slope[0] + spot->slope[1] * spot->slope[1]);
    spot->normal[0] = -spot->slope[0] / spot->stretch;
    spot->normal[1] = -spot->slope[1] / spot->stretch;
    spot->normal[2] = -1 / spot->stretch;
    spot->penumbra = 0;
    double transfer[2 * SIM_MAX_PORTS], away[2 * SIM_MAX_PORTS][3];
    double distance[2 * SIM_MAX_PORTS], share[2 * SIM_MAX_PORTS];
    for (int k = 0; k < scene->n_sites; ++k) {
        const struct sim_site *site = &scene->sites[k];
        transfer[k] = sim_surface_transfer(site, spot->position, spot->normal, away[k], distance + k);
        share[k] = -1;
    }
    sim_ports_at(scene, transfer, away, spot->sensor_part, spot->emitter_part);
    double sensed = 0, lit = 0, weight = spot->stretch * scene->person.albedo_skin / PI;
    for (int s = 0; s < scene->n_sensors; ++s) sensed = fmax(sensed, spot->sensor_part[s]);
    for (int e = 0; e < scene->n_emitters; ++e) lit = fmax(lit, spot->emitter_part[e]);
    if (weight * sensed * lit <= dark_per_area) return weight * sensed * lit;
    for (int p = 0; p < scene->n_sensors + scene->n_emitters; ++p) {
        int sensing = p < scene->n_sensors, e = p - scene->n_sensors;
        double *part = sensing ? &spot->sensor_part[p] : &spot->emitter_part[e];
        int k = sensing ? scene->sensors[p].site : scene->emitters[e].site;
        if (weight * *part * (sensing ? lit : sensed) <= dark_per_area) continue;
        if (share[k] < 0) {
            share[k] = sim_relief_share(&face->relief, spot->position, spot->slope, face->sites[k],
                                        face->lens[k]);
            int partly = share[k] > 0 && share[k] < 1;
            scene->skin_facts.penumbra[k] |= partly;
            spot->penumbra |= partly && face->lens[k] * NEAR_MM < 0.6 * distance[k];
        }
        *part *= share[k];
    }
    return weight * sensed * lit;
}

static void panel_sum(struct work *work, double x, double y, double half, double *out) {
    struct sim_scene *scene = work->scene;
    struct sim_skin_spot spot;
    scene->skin_facts.spots += PANEL * PANEL;
    memset(out, 0, (size_t)work->pairs * sizeof *out);
    for (int j = 0; j < PANEL; ++j)
        for (int i = 0; i < PANEL; ++i) {
            double area = half * half * PANEL_W[i] * PANEL_W[j];
            double at[2] = {x + half * PANEL_X[i], y + half * PANEL_X[j]};
            if (sim_skin_at(scene, at[0], at[1], DARK * work->scale / area, &spot) == 0) continue;
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
    if (scene->skin_facts.spots > work->most_spots) return;
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
        int fine = depth >= DEEPEST;
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
    work->scene->skin_facts.spots = 0;
    double half = (SIM_SKIN_X_TO - SIM_SKIN_X_FROM) / (2 * BASE_PANELS);
    for (int j = 0; j < BASE_PANELS; ++j)
        for (int i = 0; i < BASE_PANELS; ++i)
            integrate(work, SIM_SKIN_X_FROM + (2 * i + 1) * half, SIM_SKIN_Y_FROM + (2 * j + 1) * half, half,
                      0, NULL);
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

int sim_prepare_face(struct sim_scene *scene) {
    double q = scene->quality.face;
    struct work work = {.scene = scene, .pairs = scene->n_sensors * scene->n_emitters};
    work.tolerance = scene->skin_facts.goal = PANEL_TOLERANCE / (q * q * q);
    scene->face_all = calloc((size_t)work.pairs, sizeof(double));
    work.panels = malloc(5 * (DEEPEST + 1) * (size_t)work.pairs * sizeof(double));
    if (scene->face_all && work.panels) {
        work.dry = 1;
        work.most_spots = INFINITY;
        integrate_all(&work);
        work.dry = 0;
        work.scale = mean_of_pairs(scene);
        // Many far points cast many hard shadows: rather a larger error than no end.
        work.most_spots = scene->skin_facts.spots * 5.0 + SIM_MOST_VIEWS * fmax(q, 1) / scene->n_sites;
        for (int i = 0; i < 12; ++i, work.tolerance *= 8) {
            integrate_all(&work);
            if (scene->skin_facts.spots <= work.most_spots) break;
            if (i == 10) work.most_spots = INFINITY;
        }
        scene->skin_facts.tolerance = work.tolerance;
    }
    int failed = !scene->face_all || !work.panels || sim_keep_opening(scene, DARK * work.scale);
    free(work.panels);
    return failed ? -1 : 0;
}
