// SPDX-License-Identifier: Apache-2.0
//
// The sclera, over the lids' opening: rows of equal azimuth in the head frame, each in pieces between the
// places where something begins or ends (the lids' soft edges, the limbus), Gauss's rule on each piece.
#include <math.h>
#include <stdlib.h>

#include "sim_wide.h"

#define PI 3.14159265358979323846
// At fineness 1: nodes of a piece of a row, mm between them; at the lids' edges and in the limbus in mm per
// softness and haze; the same across the rows.
static const double NODES_BETA = 2, STEP_BETA = 1.2, STEP_EDGE = 0.3, STEP_HAZE = 0.4;
static const double NODES_ALPHA = 3, STEP_ALPHA = 0.5, STEP_ALPHA_HAZE = 0.5, STEP_ALPHA_EDGE = 0.4;
static const double STEP_FOCUS = 0.4;  // between points, in standard deviations of a narrow window
static const double APART = 0.012;     // least piece between two coarse breaks, radians
static const double CLOSE = 0.004;     // and beside a circle of the limbus
// Ports nearer than this to the globe, mm, want finer sums: what returns to them outshines all other pairs.
static const double NEAR_MM = 14, FINEST = 1.8;

// What one lid pose's sum is made with.
struct sweep {
    const struct sim_scene *scene;
    struct sim_light *light;
    struct sim_lid lid;
    const double *axes;
    double fineness;
    double *out;
    struct sim_surface at, probe;
    double bulge[3];  // centre of the sphere that the cornea is here, head frame
};

static void flush(struct sweep *sweep) {
    struct sim_surface *s = &sweep->at;
    const struct sim_scene *scene = sweep->scene;
    if (!s->n) return;
    for (int p = s->n; p < sim_whole(s->n); ++p) {
        s->row[0][p] = s->row[0][0];
        s->row[1][p] = s->row[1][0];
        s->alpha[p] = s->alpha[0];
        s->beta[p] = s->beta[0];
        s->weight[p] = 0;
    }
    sim_surface_place(&scene->eye, &sweep->lid, sweep->axes, scene->person.albedo_sclera / PI, s);
    for (int k = 0; k < scene->n_sites; ++k) {
        double *transfer = sweep->light->transfer + k * SIM_BATCH;
        double *away = sweep->light->away + 3 * k * SIM_BATCH;
        sim_surface_reach(scene, &scene->sites[k], sweep->bulge, &sweep->lid, s, away, transfer);
        if (sweep->lid.lash_opacity > 0) sim_surface_dim(&sweep->lid, s, away, transfer);
        if (scene->face.eye_clear[k]) continue;
        for (int p = 0; p < s->n; ++p)
            if (transfer[p] > 0) transfer[p] *= sim_face_eye_reach(&scene->face, k, s->alpha[p], s->beta[p]);
    }
    sim_light_windows(scene, sweep->light, s->n);
    sim_light_pairs(scene, sweep->light->part, s->weight, s->n, sweep->out);
    s->n = 0;
}

// The closest points that any focus asks for in a box of directions, mm.
static double spacing(const struct sim_light *light, double a0, double a1, double b0, double b1,
                      double widest) {
    for (int i = 0; i < light->n_foci; ++i) {
        const struct sim_focus *f = &light->foci[i];
        if (f->alpha + f->reach < a0 || f->alpha - f->reach > a1) continue;
        if (f->beta + f->reach < b0 || f->beta - f->reach > b1) continue;
        if (STEP_FOCUS * f->scale_mm < widest) widest = STEP_FOCUS * f->scale_mm;
    }
    return widest;
}

static void add_piece(struct sweep *sweep, const double row[2], double alpha, double weight, double from,
                      double to, double step_mm) {
    const struct sim_scene *scene = sweep->scene;
    double globe = scene->eye.globe, length = (to - from) * globe, reach_a = 0.5 / globe;
    double h = spacing(sweep->light, alpha - reach_a, alpha + reach_a, from, to, step_mm);
    if (h < step_mm && length > 12 * h) {
        add_piece(sweep, row, alpha, weight, from, (from + to) / 2, step_mm);
        add_piece(sweep, row, alpha, weight, (from + to) / 2, to, step_mm);
        return;
    }
    int parts, n = sim_nodes_for(sweep->fineness * (NODES_BETA + length / h), &parts);
    const double *rule = scene->rule[n];
    double half = (to - from) / (2 * parts);
    for (int i = 0; i < n * parts; ++i) {
        struct sim_surface *s = &sweep->at;
        int p = s->n++;
        s->row[0][p] = row[0];
        s->row[1][p] = row[1];
        s->alpha[p] = alpha;
        s->beta[p] = from + half * (2 * (i / n) + 1 + rule[i % n]);
        s->weight[p] = weight * half * rule[n + i % n];
        if (s->n == SIM_BATCH) flush(sweep);
    }
}

// What a column's samples show of one site. lower, upper: how far they lie inside what either margin hides,
// mm, times the rise of the ray toward the site: smooth where it sets; full: the same past the soft edge too.
// graze, hide: positive where the corneal bulge leaves all of it, some of it.
struct column {
    double lower[SIM_SAMPLES], upper[SIM_SAMPLES], full_lower[SIM_SAMPLES], full_upper[SIM_SAMPLES];
    double graze[SIM_SAMPLES], hide[SIM_SAMPLES];
};

SIM_WIDE static void look(const struct sim_site *site, const struct sim_lid *lid, double bulge,
                          const double centre[3], const struct sim_surface *s, struct column *column) {
    const double *point0 = s->point[0], *point1 = s->point[1], *point2 = s->point[2], *above = s->above;
    const double *radial0 = s->radial[0], *radial1 = s->radial[1], *radial2 = s->radial[2], *below = s->below;
    const double *up0 = s->up[0], *up1 = s->up[1], *up2 = s->up[2];
    double px = site->position[0], py = site->position[1], pz = site->position[2], lens = site->radius + 0.3;
    double half = lid->thickness / 2, soft = lid->softness, cx = centre[0], cy = centre[1], cz = centre[2];
    double *lower = column->lower, *upper = column->upper, *full_lower = column->full_lower;
    double *full_upper = column->full_upper, *graze = column->graze, *hide = column->hide;
    SIM_EACH(p, SIM_SAMPLES) {
        double x = point0[p], y = point1[p], z = point2[p], dx = px - x, dy = py - y, dz = pz - z;
        double per_distance = 1 / sqrt(dx * dx + dy * dy + dz * dz);
        double out = (dx * radial0[p] + dy * radial1[p] + dz * radial2[p]) * per_distance;
        double tangent = (dx * up0[p] + dy * up1[p] + dz * up2[p]) * per_distance;
        double size = sqrt(tangent * tangent + 0.01 * out * out);
        upper[p] = out * above[p] - half * (size + tangent);
        lower[p] = out * below[p] - half * (size - tangent);
        full_upper[p] = upper[p] - out * soft;
        full_lower[p] = lower[p] - out * soft;
        double bx = cx - x, by = cy - y, bz = cz - z, along = (bx * dx + by * dy + bz * dz) * per_distance;
        double miss = sqrt(sim_wide_max(bx * bx + by * by + bz * bz - along * along, 0.0)) - bulge;
        double spread = lens * along * per_distance;
        graze[p] = along > 0 ? miss - spread : 1.0;
        hide[p] = along > 0 ? miss + spread : 1.0;
    }
}

static void probe_column(struct sweep *sweep, double alpha, double lower, double upper) {
    struct sim_surface *s = &sweep->probe;
    double sa = sin(alpha), ca = cos(alpha);
    for (int p = 0; p < SIM_SAMPLES; ++p) {
        s->row[0][p] = sa;
        s->row[1][p] = ca;
        s->alpha[p] = alpha;
        s->beta[p] = lower + (upper - lower) * p / (SIM_SAMPLES - 1);
        s->weight[p] = 0;
    }
    s->n = SIM_SAMPLES;
    sim_surface_place(&sweep->scene->eye, &sweep->lid, sweep->axes, 0, s);
}

// Columns over the whole opening. open, full [column][site]: how well the best sample sees the site.
static void survey(struct sweep *sweep, double *open, double *full) {
    const struct sim_scene *scene = sweep->scene;
    struct column column;
    for (int i = 0; i < SIM_COLUMNS; ++i) {
        double alpha = sweep->lid.half * (2.0 * i / (SIM_COLUMNS - 1) - 1), lower, upper;
        sim_lid_margins(&sweep->lid, alpha, &upper, &lower);
        probe_column(sweep, alpha, lower, upper);
        for (int k = 0; k < scene->n_sites; ++k) {
            look(sweep->light->order[k], &sweep->lid, scene->eye.radius, sweep->bulge, &sweep->probe,
                 &column);
            for (int p = 0; p < SIM_SAMPLES; ++p) {
                column.lower[p] = fmin(column.lower[p], column.hide[p]);
                column.full_lower[p] = fmin(column.full_lower[p], column.graze[p]);
            }
            *open++ = sim_most_of_both(column.lower, column.upper);
            *full++ = sim_most_of_both(column.full_lower, column.full_upper);
        }
    }
}

// Where the face's shadow from a site crosses a row: its middle, and breaks around it.
static void break_at_shadow(const struct sim_scene *scene, int site, double alpha, double lower, double step,
                            struct sim_breaks *breaks) {
    double before = sim_face_eye_reach(&scene->face, site, alpha, lower);
    for (int p = 1; p < SIM_SAMPLES; ++p) {
        double from = lower + step * (p - 1), to = from + step;
        double after = sim_face_eye_reach(&scene->face, site, alpha, to);
        int falls = before > 0.5, changes = falls != (after > 0.5);
        before = after;
        if (!changes) continue;
        for (int i = 0; i < 5; ++i) {
            double middle = (from + to) / 2;
            if ((sim_face_eye_reach(&scene->face, site, alpha, middle) > 0.5) == falls) from = middle;
            else to = middle;
        }
        for (int i = -1; i <= 1; ++i) sim_break_add(breaks, (from + to) / 2 + 0.03 * i, 0.005);
    }
}

static void add_row(struct sweep *sweep, double alpha, double weight) {
    const struct sim_scene *scene = sweep->scene;
    const struct sim_eye *eye = &scene->eye;
    const struct sim_lid *lid = &sweep->lid;
    double upper, lower, row[2] = {sin(alpha), cos(alpha)};
    sim_lid_margins(lid, alpha, &upper, &lower);
    if (upper <= lower) return;
    struct sim_breaks breaks = {2, {lower, upper}};
    struct column column;
    double from = upper, to = lower, edge_from = lower, edge_to = upper;
    double step = (upper - lower) / (SIM_SAMPLES - 1);
    probe_column(sweep, alpha, lower, upper);
    for (int k = 0; k < scene->n_sites; ++k) {
        look(sweep->light->order[k], lid, eye->radius, sweep->bulge, &sweep->probe, &column);
        if (sim_most_of_both(column.lower, column.upper) < -0.1 * lid->softness) continue;
        from = fmin(from, lower + step * sim_crossing(column.lower, 0, 1));
        to = fmax(to, lower + step * sim_crossing(column.upper, SIM_SAMPLES - 1, -1));
        edge_from = fmax(edge_from, lower + step * sim_crossing(column.full_lower, 0, 1));
        edge_to = fmin(edge_to, lower + step * sim_crossing(column.full_upper, SIM_SAMPLES - 1, -1));
        sim_break_changes(&breaks, column.graze, column.lower, column.upper, 0, lower, step);
        sim_break_changes(&breaks, column.hide, column.lower, column.upper, 0, lower, step);
        int site = (int)(sweep->light->order[k] - scene->sites);
        if (!scene->face.eye_clear[site]) break_at_shadow(scene, site, alpha, lower, step, &breaks);
        // A site that sets goes behind the far margin once more.
        sim_break_changes(&breaks, column.lower, column.lower, column.upper, 1, lower, step);
        sim_break_changes(&breaks, column.full_lower, column.lower, column.upper, 1, lower, step);
        sim_break_changes(&breaks, column.upper, column.lower, column.upper, -1, lower, step);
        sim_break_changes(&breaks, column.full_upper, column.lower, column.upper, -1, lower, step);
    }
    if (from >= to) return;
    // A little more than the first light, for what lies between the samples.
    from = fmax(lower, from - 0.04 * (upper - lower));
    to = fmin(upper, to + 0.04 * (upper - lower));
    sim_break_add(&breaks, from, 0.0005);
    sim_break_add(&breaks, to, 0.0005);
    sim_break_add(&breaks, edge_from, APART);
    sim_break_add(&breaks, edge_to, APART);
    // e(beta) . axis = size cos(beta - middle): circles about the axis.
    double u = row[0] * sweep->axes[2] - row[1] * sweep->axes[8], v = sweep->axes[5];
    double size = sqrt(u * u + v * v), middle = atan2(v, u), reach_of[3] = {0, 0, 0};
    const double cosine[3] = {eye->cos_clear, eye->cos_white, eye->cos_blend};
    for (int i = 0; i < 3; ++i) {
        if (size <= fabs(cosine[i])) continue;
        reach_of[i] = acos(cosine[i] / size);
        sim_break_add(&breaks, middle - reach_of[i], CLOSE);
        sim_break_add(&breaks, middle + reach_of[i], CLOSE);
    }
    for (int i = 0; i + 1 < breaks.n; ++i) {
        double at = (breaks.at[i] + breaks.at[i + 1]) / 2, off = fabs(at - middle), step_mm = STEP_BETA;
        double outermost = fmax(fabs(breaks.at[i] - middle), fabs(breaks.at[i + 1] - middle));
        if (outermost < reach_of[0] + 1e-9 || at < from || at > to) continue;
        if (at < edge_from || at > edge_to) step_mm = STEP_EDGE * lid->softness;
        if (off < reach_of[1]) step_mm = fmin(step_mm, STEP_HAZE * eye->haze);
        add_piece(sweep, row, alpha, weight, breaks.at[i], breaks.at[i + 1], step_mm);
    }
}

static void add_rows(struct sweep *sweep, double from, double to, double step_mm) {
    double globe = sweep->scene->eye.globe, length = (to - from) * globe;
    double h = spacing(sweep->light, from, to, -PI, PI, step_mm);
    if (h < step_mm && length > 12 * h) {
        add_rows(sweep, from, (from + to) / 2, step_mm);
        add_rows(sweep, (from + to) / 2, to, step_mm);
        return;
    }
    int parts, n = sim_nodes_for(sweep->fineness * (NODES_ALPHA + length / h), &parts);
    const double *rule = sweep->scene->rule[n];
    double half = (to - from) / (2 * parts);
    for (int i = 0; i < n * parts; ++i)
        add_row(sweep, from + half * (2 * (i / n) + 1 + rule[i % n]), half * rule[n + i % n]);
}

static double fineness_for(const struct sim_scene *scene) {
    double nearest = NEAR_MM;
    for (int k = 0; k < scene->n_sites; ++k) {
        const double *at = scene->sites[k].position;
        nearest = fmin(nearest, sqrt(sim_dot(at, at)) - scene->eye.globe);
    }
    return scene->quality.sclera * fmin(NEAR_MM / nearest, FINEST);
}

void sim_add_sclera(const struct sim_scene *scene, struct sim_light *light, const double axes[9],
                    double elevation_deg, double opening, double *out) {
    const struct sim_eye *eye = &scene->eye;
    struct sweep sweep = {
        .scene = scene, .light = light, .axes = axes, .out = out, .fineness = fineness_for(scene)};
    sim_lid_pose(&sweep.lid, &scene->person, elevation_deg, opening);
    for (int k = 0; k < 3; ++k) sweep.bulge[k] = (eye->apex - eye->radius) * axes[3 * k + 2];
    double half = sweep.lid.half, ay2 = axes[5] * axes[5], middle = atan2(axes[2], -axes[8]);
    double reach_of[2] = {0, 0};
    int sites = scene->n_sites;
    double *open = light->survey, *full = open + SIM_COLUMNS * sites, from = half, to = -half, a, b;
    survey(&sweep, open, full);
    for (int k = 0; k < sites; ++k)
        if (sim_positive(open + k, sites, half, &a, &b)) {
            from = fmin(from, a - 0.02);
            to = fmax(to, b + 0.02);
        }
    if (from >= to) return;
    struct sim_breaks breaks = {2, {fmax(from, -half), fmin(to, half)}};
    double full_from = half, full_to = -half;
    for (int k = 0; k < sites; ++k) {
        if (sites <= 8 && sim_positive(open + k, sites, half, &a, &b)) {
            sim_break_add(&breaks, a, APART);
            sim_break_add(&breaks, b, APART);
        }
        if (!sim_positive(full + k, sites, half, &a, &b)) continue;
        full_from = fmin(full_from, a);
        full_to = fmax(full_to, b);
        if (sites > 8) continue;
        sim_break_add(&breaks, a, APART);
        sim_break_add(&breaks, b, APART);
    }
    const double cosine[2] = {eye->cos_clear, eye->cos_white};
    for (int i = 0; i < 2; ++i) {
        double c2 = (cosine[i] * cosine[i] - ay2) / (1 - ay2);
        if (cosine[i] <= 0 || c2 <= 0) continue;
        reach_of[i] = acos(sqrt(c2));
        sim_break_add(&breaks, middle - reach_of[i], APART);
        sim_break_add(&breaks, middle + reach_of[i], APART);
    }
    for (int i = 0; i + 1 < breaks.n; ++i) {
        double at = (breaks.at[i] + breaks.at[i + 1]) / 2, off = fabs(at - middle), step = STEP_ALPHA;
        if (off > reach_of[0] && off < reach_of[1]) step = fmin(step, STEP_ALPHA_HAZE * eye->haze);
        if (at < full_from || at > full_to) step = fmin(step, STEP_ALPHA_EDGE * sweep.lid.softness);
        add_rows(&sweep, breaks.at[i], breaks.at[i + 1], step);
    }
    flush(&sweep);
}
