// SPDX-License-Identifier: Apache-2.0
//
// The iris, over rows of a disc in the eye's frame: light in and out through the cornea, by Fermat's paths
// found for a batch of spots at once.
#include "sim_iris.h"

#include <stdlib.h>

#define PI 3.14159265358979323846
// At fineness 1: nodes of a piece across the rows, mm between rows; how many more where rays fold or the face
// hides some of the eye.
static const double NODES_ACROSS = 3, STEP_ACROSS = 0.9, UNEVEN = 1.4;
static const double STEP_FOCUS = 0.8;  // between points, in standard deviations of the narrowest window
enum { NEWTON_STEPS = 6 };

SIM_WIDE void sim_iris_locate(const double axes[9], const double place[3], const struct sim_spots *s, int k,
                            struct sim_light *light) {
    int n = sim_whole(s->n);
    double *away = light->away + 3 * k * SIM_BATCH, *alpha = light->alpha + k * SIM_BATCH;
    double *beta = light->beta + k * SIM_BATCH, *distance = light->distance + k * SIM_BATCH;
    double *out = light->out + k * SIM_BATCH, *tangent = light->tangent + k * SIM_BATCH;
    const double *from_x = s->exit[0], *from_y = s->exit[1], *from_z = s->exit[2];
    SIM_EACH(p, n) {
        double ex = from_x[p], ey = from_y[p], ez = from_z[p];
        double x = axes[0] * ex + axes[1] * ey + axes[2] * ez, y = axes[3] * ex + axes[4] * ey + axes[5] * ez;
        double z = axes[6] * ex + axes[7] * ey + axes[8] * ez;
        double flat2 = x * x + z * z, flat = sqrt(flat2), rho = sqrt(flat2 + y * y), per_rho = 1 / rho;
        double dx = place[0] - x, dy = place[1] - y, dz = place[2] - z;
        double per = 1 / sqrt(dx * dx + dy * dy + dz * dz);
        dx *= per;
        dy *= per;
        dz *= per;
        // Radial (x, y, z) / rho; up (-sin a sin b, cos b, cos a sin b).
        double level = (dx * x + dz * z) / flat, rise = dy;
        double sin_b = y * per_rho, cos_b = flat * per_rho;
        out[p] = level * cos_b + rise * sin_b;
        tangent[p] = rise * cos_b - level * sin_b;
        alpha[p] = sim_wide_angle(x, -z, flat);
        beta[p] = sim_wide_angle(y, flat, rho);
        distance[p] = rho;
        away[p] = dx;
        away[SIM_BATCH + p] = dy;
        away[2 * SIM_BATCH + p] = dz;
    }
}

// cos b of |b| < 1.5, to 1e-10.
SIM_INLINE double wide_cosine(double b) {
    double q = b * b, c = 1 - q / 240;
    c = 1 - q / 182 * c;
    c = 1 - q / 132 * c;
    c = 1 - q / 90 * c;
    c = 1 - q / 56 * c;
    c = 1 - q / 30 * c;
    c = 1 - q / 12 * c;
    return 1 - q / 2 * c;
}

// How open one lid pose is toward one site.
SIM_WIDE static void open_toward(const struct sim_lid *lid, const struct sim_light *light, int k, int n,
                                 double *open) {
    const double *alpha = light->alpha + k * SIM_BATCH, *beta = light->beta + k * SIM_BATCH;
    const double *rho = light->distance + k * SIM_BATCH;
    const double *out = light->out + k * SIM_BATCH, *tangent = light->tangent + k * SIM_BATCH;
    double per_half2 = 1 / (lid->half * lid->half), thickness = lid->thickness;
    double per_softness = 1 / lid->softness;
    double tilt = lid->tilt, upper = lid->upper, lower = lid->lower;
    SIM_EACH(p, n) {
        double slope = -2 * alpha[p] * per_half2, arch = 1 - alpha[p] * alpha[p] * per_half2;
        double line = tilt * alpha[p], b = beta[p];
        double per_cos = 1 / wide_cosine(b);
        double su = (tilt + upper * slope) * per_cos, sl = (tilt + lower * slope) * per_cos;
        double above = rho[p] * (line + upper * arch - b) / sqrt(1 + su * su);
        double below = rho[p] * (b - line - lower * arch) / sqrt(1 + sl * sl);
        open[p] = sim_wide_open(thickness, per_softness, above, below, out[p], tangent[p]);
    }
}

// The same through the lashes.
SIM_WIDE static void dim(const struct sim_lid *lid, const struct sim_light *light, int k, int n,
                         double *open) {
    const double *alpha = light->alpha + k * SIM_BATCH, *beta = light->beta + k * SIM_BATCH;
    const double *rho = light->distance + k * SIM_BATCH;
    const double *out = light->out + k * SIM_BATCH, *tangent = light->tangent + k * SIM_BATCH;
    SIM_EACH(p, n) {
        double a = alpha[p] / lid->half, slope = lid->tilt - 2 * lid->upper * a / lid->half;
        double su = slope / wide_cosine(beta[p]), upper = lid->tilt * alpha[p] + lid->upper * (1 - a * a);
        double above = rho[p] * (upper - beta[p]) / sqrt(1 + su * su);
        open[p] *= sim_wide_lashes(lid, above, out[p], tangent[p]);
    }
}

SIM_WIDE static void shade(const double *part, const double *open, int n, double *shown) {
    SIM_EACH(p, n) shown[p] = part[p] * open[p];
}

void sim_iris_flush(struct sim_iris *iris) {
    const struct sim_scene *scene = iris->scene;
    struct sim_light *light = iris->light;
    struct sim_spots *s = &iris->at;
    if (!s->n) return;
    int whole = sim_whole(s->n), ports = scene->n_sensors + scene->n_emitters;
    for (int p = s->n; p < whole; ++p) {
        s->x[p] = s->x[0];
        s->y[p] = s->y[0];
        s->weight[p] = 0;
    }
    for (int k = 0; k < scene->n_sites; ++k) {
        double *transfer = light->transfer + k * SIM_BATCH;
        sim_cornea_refract(&scene->eye, iris->sites[k], NEWTON_STEPS, s, transfer);
        sim_cornea_mend(&scene->eye, iris->sites[k], iris->folds[k] > 1, iris->dark[k], s, transfer);
        sim_iris_locate(iris->axes, scene->sites[k].position, s, k, light);
        if (scene->face.eye_clear[k]) continue;
        const double *alpha = light->alpha + k * SIM_BATCH, *beta = light->beta + k * SIM_BATCH;
        for (int p = 0; p < s->n; ++p)
            if (transfer[p] > 0) transfer[p] *= sim_face_eye_reach(&scene->face, k, alpha[p], beta[p]);
    }
    sim_light_windows(scene, light, s->n);
    for (int l = 0; l < iris->n_lids; ++l) {
        double *open = light->open;
        for (int k = 0; k < scene->n_sites; ++k) {
            open_toward(&iris->lids[l], light, k, whole, open + k * SIM_BATCH);
            if (iris->lids[l].lash_opacity > 0) dim(&iris->lids[l], light, k, whole, open + k * SIM_BATCH);
        }
        for (int i = 0; i < ports; ++i) {
            int e = i - scene->n_sensors, site = e < 0 ? scene->sensors[i].site : scene->emitters[e].site;
            shade(light->part + i * SIM_BATCH, open + site * SIM_BATCH, whole, light->shown + i * SIM_BATCH);
        }
        double *ring = iris->ring + l * scene->n_sensors * scene->n_emitters;
        sim_light_pairs(scene, light->shown, s->weight, s->n, ring);
    }
    s->n = 0;
}

// Where rows begin and cease to see each site past the first pose of the lids, as t of add_disc().
static void survey(struct sim_iris *iris, double radius, struct sim_breaks *breaks) {
    const struct sim_scene *scene = iris->scene;
    struct sim_light *light = iris->light;
    int sites = scene->n_sites;
    if (sites > 8 || iris->n_lids > 2) return;
    double value[4][SIM_SAMPLES], *open = light->survey, *full = open + SIM_COLUMNS * sites, a, b;
    for (int l = 0; l < iris->n_lids; ++l) {
        for (int i = 0; i < SIM_COLUMNS; ++i) {
            double t = PI / 2 * (2.0 * i / (SIM_COLUMNS - 1) - 1);
            for (int j = 0; j < sites; ++j) {
                int k = (int)(light->order[j] - scene->sites);
                sim_iris_probe(iris, k, radius, radius * sin(t));
                sim_iris_look(&iris->lids[l], light, k, value[0], value[1], value[2], value[3]);
                open[i * sites + j] = sim_most_of_both(value[0], value[1]);
                full[i * sites + j] = sim_most_of_both(value[2], value[3]);
            }
        }
        for (int k = 0; k < 2 * sites; ++k)
            if (sim_positive(k < sites ? open + k : full + k - sites, sites, PI / 2, &a, &b)) {
                sim_break_add(breaks, a, 0.05);
                sim_break_add(breaks, b, 0.05);
            }
    }
}

// What the face does to the row at t, as bits: whether it leaves any of site k's lens anywhere, all of it
// somewhere, any everywhere, all everywhere.
static int past_face(struct sim_iris *iris, int k, double radius, double t) {
    double share[SIM_SAMPLES], most = 0, least = 1;
    sim_iris_probe(iris, k, radius, radius * sin(t));
    sim_iris_past_face(iris, k, share);
    for (int p = 0; p < SIM_SAMPLES; ++p) {
        if (share[p] < 0) continue;
        most = fmax(most, share[p]);
        least = fmin(least, share[p]);
    }
    return (most > 0) + 2 * (most >= 1) + 4 * (least > 0) + 8 * (least >= 1);
}

// Where rows begin and cease to be in the shadow of the face.
static void survey_shadow(struct sim_iris *iris, double radius, struct sim_breaks *breaks) {
    const struct sim_scene *scene = iris->scene;
    for (int j = 0; j < scene->n_sites; ++j) {
        int k = (int)(iris->light->order[j] - scene->sites), last = 0;
        if (scene->face.eye_clear[k]) continue;
        for (int i = 0; i < SIM_COLUMNS; ++i) {
            double t = PI / 2 * (2.0 * i / (SIM_COLUMNS - 1) - 1), before = t - PI / (SIM_COLUMNS - 1);
            int now = past_face(iris, k, radius, t);
            for (int bit = 1; i > 0 && bit < 16; bit *= 2) {
                double low = before, high = t;
                if ((last & bit) == (now & bit)) continue;
                for (int step = 0; step < SIM_SHADOW_STEPS; ++step) {
                    double middle = (low + high) / 2;
                    if ((past_face(iris, k, radius, middle) & bit) == (last & bit)) low = middle;
                    else high = middle;
                }
                sim_break_add(breaks, (low + high) / 2, 0.02);
            }
            last = now;
        }
    }
}

// The disc within a radius, times a factor. Rows at radius * sin(t) are smooth in t up to their ends.
static void add_disc(struct sim_iris *iris, double radius, double factor, double step_mm) {
    struct sim_breaks breaks = {2, {-PI / 2, PI / 2}};
    double turn[SIM_EDGE_MOST];
    for (int i = 0; i < iris->n_edges; ++i)
        for (int n = sim_edge_turns(&iris->edges[i], iris->across, radius, turn); n--;)
            if (fabs(turn[n]) < radius) sim_break_add(&breaks, asin(turn[n] / radius), 1e-6);
    survey_shadow(iris, radius, &breaks);
    survey(iris, radius, &breaks);
    for (int piece = 0; piece + 1 < breaks.n; ++piece) {
        int parts;
        double from = breaks.at[piece], length = breaks.at[piece + 1] - from;
        double step = fmin(step_mm, iris->n_lids > 2 ? 0.6 * STEP_ACROSS : STEP_ACROSS);
        double want = (iris->uneven ? UNEVEN : 1) * (NODES_ACROSS + radius * length / step);
        int n = sim_nodes_for(iris->scene->quality.iris * want, &parts);
        const double *rule = iris->scene->rule[n];
        double half = length / (2 * parts);
        for (int i = 0; i < n * parts; ++i) {
            double t = from + half * (2 * (i / n) + 1 + rule[i % n]);
            double weight = factor * radius * cos(t) * half * rule[n + i % n];
            sim_iris_add_row(iris, radius, radius * sin(t), weight, step_mm);
        }
    }
    sim_iris_flush(iris);
}

// The iris of a pupil is the disc within the limbus less that within the pupil: nothing but the domain
// depends on the pupil.
int sim_add_iris(const struct sim_scene *scene, struct sim_light *light, const double axes[9],
                 double elevation_deg, const double *pupil_mm, int n_pupils, const double *lid_opening,
                 int n_lids, double *out) {
    const struct sim_eye *eye = &scene->eye;
    size_t block = (size_t)(n_lids * scene->n_sensors * scene->n_emitters);
    struct sim_lid lids[SIM_MAX_LIDS];
    double(*sites)[3] = malloc((size_t)scene->n_sites * sizeof *sites), *disc = calloc(block, sizeof *disc);
    struct sim_iris *iris = malloc(sizeof *iris);
    struct sim_edge *edges = malloc((size_t)scene->n_sites * sizeof *edges);
    if (!disc || !sites || !iris || !edges) {
        free(disc);
        free(edges);
        free(sites);
        free(iris);
        return -1;
    }
    for (int l = 0; l < n_lids; ++l) sim_lid_pose(&lids[l], &scene->person, elevation_deg, lid_opening[l]);
    for (int k = 0; k < scene->n_sites; ++k)
        for (int j = 0; j < 3; ++j) {
            const double *p = scene->sites[k].position;
            sites[k][j] = axes[j] * p[0] + axes[3 + j] * p[1] + axes[6 + j] * p[2];
        }
    double step = 1e9, up = sqrt(axes[3] * axes[3] + axes[4] * axes[4]);
    for (int i = 0; i < light->n_foci; ++i) step = fmin(step, STEP_FOCUS * light->foci[i].scale_mm);
    iris->scene = scene;
    iris->uneven = 0;
    iris->edges = edges;
    iris->n_edges = 0;
    for (int k = 0; k < scene->n_sites; ++k) {
        iris->folds[k] = sim_cornea_folds(eye, sites[k]);
        if (iris->folds[k]) {
            iris->edge_of[k] = &edges[iris->n_edges++];
            sim_edge_find(eye, sites[k], iris->edge_of[k]);
        }
        iris->uneven |= iris->folds[k] > 1 || !scene->face.eye_clear[k];
    }
    iris->light = light;
    iris->axes = axes;
    iris->sites = (const double(*)[3])sites;
    iris->lids = lids;
    iris->n_lids = n_lids;
    iris->ring = disc;
    iris->at.n = 0;
    iris->up[0] = axes[3] / up;  // the head's up, seen along the axis
    iris->up[1] = axes[4] / up;
    iris->across[0] = iris->up[1];
    iris->across[1] = -iris->up[0];
    double albedo = scene->person.albedo_iris / (PI * eye->index * eye->index);
    add_disc(iris, eye->limbus, albedo, step);
    for (int p = 0; p < n_pupils; ++p)
        for (size_t i = 0; i < block; ++i) out[(size_t)p * block + i] += disc[i];
    for (int p = 0; p < n_pupils; ++p) {
        iris->ring = out + (size_t)p * block;
        add_disc(iris, pupil_mm[p] / 2, -albedo, step);
    }
    free(disc);
    free(edges);
    free(sites);
    free(iris);
    return 0;
}
