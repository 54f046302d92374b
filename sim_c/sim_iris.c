// SPDX-License-Identifier: Apache-2.0
//
// The iris, over rings in the eye's frame: light in and out through the cornea, by Fermat's paths found for a
// batch of spots at once.
#include <stdlib.h>

#include "sim_cornea.h"

#define PI 3.14159265358979323846
// At fineness 1: nodes of a piece of a row, mm between them; where the veil or a lid's edge is in mm per haze
// and softness; nodes of a piece across the rows, mm between rows.
static const double NODES_ROW = 3, STEP_ROW = 1.0, STEP_VEIL = 0.4, STEP_EDGE = 0.3;
static const double NODES_ACROSS = 3, STEP_ACROSS = 0.9;
static const double STEP_FOCUS = 0.8;  // between points, in standard deviations of the narrowest window
enum { NEWTON_STEPS = 6, PROBE_STEPS = 3 };

struct iris {
    const struct sim_scene *scene;
    struct sim_light *light;
    const double *axes, (*sites)[3];  // sites: eye frame
    const struct sim_lid *lids;
    int n_lids, folds[2 * SIM_MAX_PORTS];  // whether a site's rays fold
    int uneven;  // whether any site's do, or the face hides some of the eye from it
    double *ring, across[2], up[2];
    struct sim_spots at, probe;
};

// Where the paths cross the cornea, as the lids see it.
SIM_WIDE static void locate(const double axes[9], const double place[3], const struct sim_spots *s, int k,
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

static void flush(struct iris *iris) {
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
        sim_cornea_mend(&scene->eye, iris->sites[k], iris->folds[k], s, transfer);
        locate(iris->axes, scene->sites[k].position, s, k, light);
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

// How far a row's samples lie inside what either margin hides from site k, as in the sclera's rows.
SIM_WIDE static void look(const struct sim_lid *lid, const struct sim_light *light, int k, double *lower,
                          double *upper, double *full_lower, double *full_upper) {
    const double *alpha = light->alpha + k * SIM_BATCH, *beta = light->beta + k * SIM_BATCH;
    const double *rho = light->distance + k * SIM_BATCH;
    const double *out = light->out + k * SIM_BATCH, *tangent = light->tangent + k * SIM_BATCH;
    double per_half2 = 1 / (lid->half * lid->half), half = lid->thickness / 2, soft = lid->softness;
    double tilt = lid->tilt, upper_at = lid->upper, lower_at = lid->lower;
    SIM_EACH(p, SIM_SAMPLES) {
        double arch = 1 - alpha[p] * alpha[p] * per_half2, line = tilt * alpha[p], o = out[p], t = tangent[p];
        double size = sqrt(t * t + 0.01 * o * o);
        upper[p] = o * rho[p] * (line + upper_at * arch - beta[p]) - half * (size + t);
        lower[p] = o * rho[p] * (beta[p] - line - lower_at * arch) - half * (size - t);
        full_upper[p] = upper[p] - o * soft;
        full_lower[p] = lower[p] - o * soft;
    }
}

// Spots along a row, from end to end.
static void probe_row(struct iris *iris, double chord, double u) {
    for (int p = 0; p < SIM_SAMPLES; ++p) {
        double v = chord * (2.0 * p / (SIM_SAMPLES - 1) - 1);
        iris->probe.x[p] = u * iris->across[0] + v * iris->up[0];
        iris->probe.y[p] = u * iris->across[1] + v * iris->up[1];
    }
    iris->probe.n = SIM_SAMPLES;
}

// Breaks at the edges of what a site whose rays fold lights of a row. Returns their number.
static int break_edges(struct iris *iris, int k, double chord, double u, struct sim_breaks *breaks) {
    const struct sim_eye *eye = &iris->scene->eye;
    double *transfer = iris->light->transfer, exit[3];
    int edges = 0;
    sim_cornea_mend(eye, iris->sites[k], 1, &iris->probe, transfer);
    for (int p = 0; p + 1 < SIM_SAMPLES; ++p) {
        if ((transfer[p] > 0) == (transfer[p + 1] > 0)) continue;
        double from = chord * (2.0 * p / (SIM_SAMPLES - 1) - 1), to = from + 2 * chord / (SIM_SAMPLES - 1);
        for (int i = 0; i < 30; ++i) {
            double v = (from + to) / 2, x = u * iris->across[0] + v * iris->up[0];
            double spot[3] = {x, u * iris->across[1] + v * iris->up[1], eye->iris_z};
            if ((sim_eye_refract(eye, iris->sites[k], spot, exit) > 0) == (transfer[p] > 0)) from = v;
            else to = v;
        }
        sim_break_add(breaks, from, 1e-4);
        ++edges;
    }
    return edges;
}

// One row of the disc about the axis: u across, v upward, both in the iris' plane.
static void add_row(struct iris *iris, double radius, double u, double weight, double step_mm) {
    const struct sim_scene *scene = iris->scene;
    const struct sim_eye *eye = &scene->eye;
    struct sim_light *light = iris->light;
    struct sim_spots *probe = &iris->probe;
    double chord = sqrt(radius * radius - u * u), step = 2 * chord / (SIM_SAMPLES - 1);
    probe_row(iris, chord, u);
    double from = chord, to = -chord, edge_from = -chord, edge_to = chord;
    double lower[SIM_SAMPLES], upper[SIM_SAMPLES], full_lower[SIM_SAMPLES], full_upper[SIM_SAMPLES];
    struct sim_breaks breaks = {2, {-chord, chord}};
    int edges = 0;
    for (int i = 0; i < scene->n_sites; ++i) {
        int k = (int)(light->order[i] - scene->sites);
        sim_cornea_refract(eye, iris->sites[k], PROBE_STEPS, probe, light->transfer);
        if (iris->folds[k]) edges += break_edges(iris, k, chord, u, &breaks);
        locate(iris->axes, scene->sites[k].position, probe, k, light);
        for (int l = 0; l < iris->n_lids; ++l) {
            look(&iris->lids[l], light, k, lower, upper, full_lower, full_upper);
            if (sim_most_of_both(lower, upper) < -0.1 * iris->lids[l].softness) continue;
            from = fmin(from, -chord + step * sim_crossing(lower, 0, 1));
            to = fmax(to, -chord + step * sim_crossing(upper, SIM_SAMPLES - 1, -1));
            edge_from = fmax(edge_from, -chord + step * sim_crossing(full_lower, 0, 1));
            edge_to = fmin(edge_to, -chord + step * sim_crossing(full_upper, SIM_SAMPLES - 1, -1));
            if (iris->n_lids > 2) continue;
            // A site that sets goes behind the far margin once more.
            sim_break_changes(&breaks, lower, lower, upper, 1, -chord, step);
            sim_break_changes(&breaks, full_lower, lower, upper, 1, -chord, step);
            sim_break_changes(&breaks, upper, lower, upper, -1, -chord, step);
            sim_break_changes(&breaks, full_upper, lower, upper, -1, -chord, step);
        }
    }
    from -= 0.15;  // a little more, for what lies between the samples
    to += 0.15;
    if (from >= to) return;
    double veiled = eye->limbus - eye->haze, clear2 = veiled * veiled - u * u;
    double clear = clear2 > 0 ? sqrt(clear2) : 0;
    sim_break_add(&breaks, from, 0.01);
    sim_break_add(&breaks, to, 0.01);
    sim_break_add(&breaks, edge_from, 0.1);
    sim_break_add(&breaks, edge_to, 0.1);
    if (clear > 0) {
        sim_break_add(&breaks, -clear, 0.1);
        sim_break_add(&breaks, clear, 0.1);
    }
    for (int i = 0; i + 1 < breaks.n; ++i) {
        double at = (breaks.at[i] + breaks.at[i + 1]) / 2, length = breaks.at[i + 1] - breaks.at[i];
        double h = fmin(step_mm, STEP_ROW);
        if (at < from || at > to) continue;
        if (fabs(at) > clear) h = fmin(h, STEP_VEIL * eye->haze);
        if (at < edge_from || at > edge_to) h = fmin(h, STEP_EDGE * iris->lids[0].softness);
        double want = (edges ? 2 : 1) * (NODES_ROW + length / h);
        int parts, n = sim_nodes_for(scene->quality.iris * want, &parts);
        const double *rule = scene->rule[n];
        double half = length / (2 * parts);
        for (int j = 0; j < n * parts; ++j) {
            double t = half * (2 * (j / n) + 1 + rule[j % n]), v = breaks.at[i] + t, stretch = 1;
            if (edges) {  // an inverse square root at either end becomes smooth
                v = at - length / 2 * cos(PI * t / length);
                stretch = PI / 2 * sin(PI * t / length);
            }
            int p = iris->at.n++;
            iris->at.x[p] = u * iris->across[0] + v * iris->up[0];
            iris->at.y[p] = u * iris->across[1] + v * iris->up[1];
            iris->at.weight[p] = weight * half * stretch * rule[n + j % n];
            if (iris->at.n == SIM_BATCH) flush(iris);
        }
    }
}

// Where rows begin and cease to see each site past the first pose of the lids, as t of add_disc().
static void survey(struct iris *iris, double radius, struct sim_breaks *breaks) {
    const struct sim_scene *scene = iris->scene;
    struct sim_light *light = iris->light;
    int sites = scene->n_sites;
    if (sites > 8 || iris->n_lids > 2) return;
    double value[4][SIM_SAMPLES], *open = light->survey, *full = open + SIM_COLUMNS * sites, a, b;
    for (int l = 0; l < iris->n_lids; ++l) {
        for (int i = 0; i < SIM_COLUMNS; ++i) {
            double t = PI / 2 * (2.0 * i / (SIM_COLUMNS - 1) - 1);
            probe_row(iris, radius * cos(t), radius * sin(t));
            for (int j = 0; j < sites; ++j) {
                int k = (int)(light->order[j] - scene->sites);
                sim_cornea_refract(&scene->eye, iris->sites[k], PROBE_STEPS, &iris->probe, light->transfer);
                locate(iris->axes, scene->sites[k].position, &iris->probe, k, light);
                look(&iris->lids[l], light, k, value[0], value[1], value[2], value[3]);
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

// The disc within a radius, times a factor. Rows at radius * sin(t) are smooth in t up to their ends.
static void add_disc(struct iris *iris, double radius, double factor, double step_mm) {
    struct sim_breaks breaks = {2, {-PI / 2, PI / 2}};
    survey(iris, radius, &breaks);
    for (int piece = 0; piece + 1 < breaks.n; ++piece) {
        int parts;
        double from = breaks.at[piece], length = breaks.at[piece + 1] - from;
        double step = fmin(step_mm, iris->n_lids > 2 ? 0.6 * STEP_ACROSS : STEP_ACROSS);
        double want = (iris->uneven ? 3 : 1) * (NODES_ACROSS + radius * length / step);
        int n = sim_nodes_for(iris->scene->quality.iris * want, &parts);
        const double *rule = iris->scene->rule[n];
        double half = length / (2 * parts);
        for (int i = 0; i < n * parts; ++i) {
            double t = from + half * (2 * (i / n) + 1 + rule[i % n]);
            double weight = factor * radius * cos(t) * half * rule[n + i % n];
            add_row(iris, radius, radius * sin(t), weight, step_mm);
        }
    }
    flush(iris);
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
    struct iris *iris = malloc(sizeof *iris);
    if (!disc || !sites || !iris) {
        free(disc);
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
    for (int k = 0; k < scene->n_sites; ++k) {
        iris->folds[k] = sim_cornea_folds(eye, sites[k]);
        iris->uneven |= iris->folds[k] || !scene->face.eye_clear[k];
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
    free(sites);
    free(iris);
    return 0;
}
