// SPDX-License-Identifier: Apache-2.0
//
// The terms that vary slowly with gaze, and what they share: windows, and sums over batches of points.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_wide.h"

double sim_window_weight(const struct sim_window *window, const double away[3]) {
    double c = -sim_dot(window->aim, away);
    if (c < 0.03) return 0;
    double t = (1 - c * c) / (c * c) * window->per_tan2;
    return t > 40 ? 0 : exp(-t);
}

void sim_add_pairs(const struct sim_scene *scene, double weight, const double *sensor_part,
                   const double *emitter_part, double *out) {
    int m = scene->n_emitters;
    for (int s = 0; s < scene->n_sensors; ++s) {
        double w = weight * sensor_part[s];
        if (w == 0) continue;
        for (int e = 0; e < m; ++e) out[s * m + e] += w * emitter_part[e];
    }
}

// Both ends' factors at one place: the site's transfer times each port's window.
void sim_ports_at(const struct sim_scene *scene, const double *transfer, double (*away)[3],
                     double *sensor_part, double *emitter_part) {
    for (int s = 0; s < scene->n_sensors; ++s) {
        int k = scene->sensors[s].site;
        sensor_part[s] = transfer[k] ? transfer[k] * sim_window_weight(&scene->sensors[s], away[k]) : 0;
    }
    for (int e = 0; e < scene->n_emitters; ++e) {
        int k = scene->emitters[e].site;
        emitter_part[e] = transfer[k] ? transfer[k] * sim_window_weight(&scene->emitters[e], away[k]) : 0;
    }
}

// Cosine of incidence from a lens of finite size: rounded where the lens sets behind the local horizon.
static double lens_cosine(double cosine, double half_angle) {
    if (cosine >= half_angle) return cosine;
    if (cosine <= -half_angle) return 0;
    double t = cosine + half_angle;
    return t * t / (4 * half_angle);
}

// Irradiance per intensity at a surface point, and the unit vector to the site.
double sim_surface_transfer(const struct sim_site *site, const double point[3], const double normal[3],
                               double away[3], double *distance) {
    double d[3] = {site->position[0] - point[0], site->position[1] - point[1], site->position[2] - point[2]};
    double n2 = sim_dot(d, d), n = sqrt(n2);
    for (int k = 0; k < 3; ++k) away[k] = d[k] / n;
    *distance = n;
    return lens_cosine(sim_dot(away, normal), site->radius / n + 1e-9) / n2;
}

// A port's narrowness where its axis comes nearest to the eye's centre; a site's where it is above the eye.
static int focus_on(const double at[3], double scale, double reach_mm, double globe,
                    struct sim_focus *focus) {
    double size = sqrt(sim_dot(at, at)) + 1e-9;
    if (scale > 3) return 0;
    focus->alpha = atan2(at[0], -at[2]);
    focus->beta = asin(at[1] / size);
    focus->reach = reach_mm / globe + (size < globe ? 0 : 0.2);
    focus->scale_mm = scale;
    return 1;
}

static void find_foci(const struct sim_scene *scene, struct sim_light *light) {
    double globe = scene->eye.globe;
    for (int i = 0; i < scene->n_sensors + scene->n_emitters; ++i) {
        int e = i - scene->n_sensors;
        const struct sim_window *w = e < 0 ? &scene->sensors[i] : &scene->emitters[e];
        const double *from = scene->sites[w->site].position;
        double nearest = -sim_dot(from, w->aim), miss2 = sim_dot(from, from) - nearest * nearest;
        double inside = globe * globe - miss2, length = nearest - (inside > 0 ? sqrt(inside) : 0), at[3];
        if (length < 1) continue;  // looks away
        for (int k = 0; k < 3; ++k) at[k] = from[k] + length * w->aim[k];
        double scale = length / sqrt(2 * w->per_tan2);
        light->n_foci += focus_on(at, scale, 4.5 * scale, globe, &light->foci[light->n_foci]);
    }
    for (int k = 0; k < scene->n_sites; ++k) {
        const double *at = scene->sites[k].position;
        double height = sqrt(sim_dot(at, at)) - globe, below[3];
        for (int i = 0; i < 3; ++i) below[i] = at[i] * 0.9 * globe / (height + globe);
        light->n_foci += focus_on(below, height / 2, 2 * height, globe, &light->foci[light->n_foci]);
    }
}

static int by_place(const void *a, const void *b) {
    const struct sim_site *one = *(const struct sim_site *const *)a;
    const struct sim_site *other = *(const struct sim_site *const *)b;
    for (int k = 0; k < 3; ++k)
        if (one->position[k] != other->position[k]) return one->position[k] < other->position[k] ? -1 : 1;
    return (one->radius > other->radius) - (one->radius < other->radius);
}

int sim_light_open(struct sim_light *light, const struct sim_scene *scene) {
    size_t sites = (size_t)scene->n_sites * SIM_BATCH;
    size_t ports = (size_t)(scene->n_sensors + scene->n_emitters), foci = ports + (size_t)scene->n_sites;
    memset(light, 0, sizeof *light);
    light->memory = calloc(10 * sites + 2 * ports * SIM_BATCH + 2 * SIM_COLUMNS * (size_t)scene->n_sites,
                           sizeof(double));
    light->foci = malloc(foci * sizeof *light->foci);
    light->order = malloc((size_t)scene->n_sites * sizeof *light->order);
    if (!light->memory || !light->foci || !light->order) return -1;
    for (int k = 0; k < scene->n_sites; ++k) light->order[k] = &scene->sites[k];
    qsort(light->order, (size_t)scene->n_sites, sizeof *light->order, by_place);
    double **array[] = {&light->transfer, &light->alpha, &light->beta, &light->distance, &light->out,
                        &light->tangent, &light->open};
    light->away = light->memory;
    for (size_t i = 0; i < sizeof array / sizeof *array; ++i) *array[i] = light->memory + (3 + i) * sites;
    light->part = light->memory + 10 * sites;
    light->shown = light->part + ports * SIM_BATCH;
    light->survey = light->shown + ports * SIM_BATCH;
    find_foci(scene, light);
    return 0;
}

void sim_light_close(struct sim_light *light) {
    free(light->memory);
    free(light->foci);
    free(light->order);
}

SIM_WIDE static void weigh_window(const struct sim_window *window, const double *away,
                                  const double *transfer, int n, double *part) {
    const double *x = away, *y = away + SIM_BATCH, *z = away + 2 * SIM_BATCH;
    double ax = -window->aim[0], ay = -window->aim[1], az = -window->aim[2], per_tan2 = window->per_tan2;
    SIM_EACH(p, n)
        part[p] = transfer[p] * sim_wide_window(ax * x[p] + ay * y[p] + az * z[p], per_tan2);
}

static int same_window(const struct sim_window *a, const struct sim_window *b) {
    return a->site == b->site && a->per_tan2 == b->per_tan2 && !memcmp(a->aim, b->aim, sizeof a->aim);
}

void sim_light_windows(const struct sim_scene *scene, struct sim_light *light, int n) {
    for (int i = 0; i < scene->n_sensors + scene->n_emitters; ++i) {
        int e = i - scene->n_sensors;
        const struct sim_window *w = e < 0 ? &scene->sensors[i] : &scene->emitters[e];
        double *part = light->part + i * SIM_BATCH;
        // One lens that senses and emits: the usual headset.
        if (e >= 0 && e < scene->n_sensors && same_window(w, &scene->sensors[e]))
            memcpy(part, light->part + e * SIM_BATCH, SIM_BATCH * sizeof *part);
        else
            weigh_window(w, light->away + 3 * SIM_BATCH * w->site, light->transfer + SIM_BATCH * w->site,
                         sim_whole(n), part);
    }
}

SIM_WIDE static void add_rows(const double *sensor, const double *emitters, const double *weight, int n,
                              int m, double *out) {
    double here[SIM_BATCH];
    SIM_EACH(p, n) here[p] = weight[p] * sensor[p];
    for (int e = 0; e < m; ++e) {
        const double *there = emitters + e * SIM_BATCH;
        double sum[SIM_LANES] = {0};
        for (int p = 0; p < n; p += SIM_LANES)
            for (int j = 0; j < SIM_LANES; ++j) sum[j] += here[p + j] * there[p + j];
        out[e] += ((sum[0] + sum[4]) + (sum[2] + sum[6])) + ((sum[1] + sum[5]) + (sum[3] + sum[7]));
    }
}

void sim_light_pairs(const struct sim_scene *scene, const double *part, const double *weight, int n,
                     double *out) {
    const double *emitters = part + scene->n_sensors * SIM_BATCH;
    for (int s = 0; s < scene->n_sensors; ++s)
        add_rows(part + s * SIM_BATCH, emitters, weight, sim_whole(n), scene->n_emitters,
                 out + s * scene->n_emitters);
}

void sim_break_add(struct sim_breaks *breaks, double at, double apart) {
    double from = breaks->at[0], to = breaks->at[breaks->n - 1];
    const int most = (int)(sizeof breaks->at / sizeof *breaks->at);
    if (!(at > from + apart && at < to - apart) || breaks->n == most) return;
    for (int i = 1; i + 1 < breaks->n; ++i)
        if (fabs(breaks->at[i] - at) < apart) return;
    int i = breaks->n++;
    for (; breaks->at[i - 1] > at; --i) breaks->at[i] = breaks->at[i - 1];
    breaks->at[i] = at;
}

void sim_break_changes(struct sim_breaks *breaks, const double *value, const double *lower,
                       const double *upper, int direction, double from, double step) {
    for (int p = 0; p + 1 < SIM_SAMPLES; ++p) {
        if ((value[p] < 0) == (value[p + 1] < 0)) continue;
        if (direction && direction * (value[p + 1] - value[p]) > 0) continue;
        if (fmin(lower[p], upper[p]) < 0 && fmin(lower[p + 1], upper[p + 1]) < 0) continue;
        sim_break_add(breaks, from + step * (p + value[p] / (value[p] - value[p + 1])), 0.04 * step);
    }
}

int sim_positive(const double *value, int stride, double half, double *from, double *to) {
    double step = 2 * half / (SIM_COLUMNS - 1);
    int i = 0, j = SIM_COLUMNS - 1;
    while (i < j && value[i * stride] < 0) ++i;
    while (j > i && value[j * stride] < 0) --j;
    if (value[i * stride] < 0) return 0;
    *from = -half + step * i;
    *to = -half + step * j;
    if (i > 0) *from -= step * value[i * stride] / (value[i * stride] - value[(i - 1) * stride]);
    if (j < SIM_COLUMNS - 1) *to += step * value[j * stride] / (value[j * stride] - value[(j + 1) * stride]);
    return 1;
}

double sim_crossing(const double *value, int first, int direction) {
    int i = first;
    for (int j = 1; j < SIM_SAMPLES && value[i] < 0; ++j, i += direction) {
        double here = value[i], next = value[i + direction];
        if (next >= 0) return i - direction * here / (next - here);
    }
    return i;
}

double sim_most_of_both(const double *a, const double *b) {
    double most = -1e9;
    for (int p = 0; p < SIM_SAMPLES; ++p) {
        double least = a[p] < b[p] ? a[p] : b[p];
        most = least > most ? least : most;
    }
    return most;
}

int sim_nodes_for(double want, int *parts) {
    *parts = (int)ceil(want / SIM_MAX_RULE);
    int n = (int)ceil(want / *parts);
    return n < 2 ? 2 : n;
}

static int bad_lids(const double *lid_opening, int n_lids) {
    if (n_lids < 1 || n_lids > SIM_MAX_LIDS) return 1;
    for (int l = 0; l < n_lids; ++l)
        if (!(lid_opening[l] >= 0 && lid_opening[l] <= 1)) return 1;
    return 0;
}

int sim_scene_smooth(const struct sim_scene *scene, double azimuth_deg, double elevation_deg, int terms,
                     const double *pupil_mm, int n_pupils, const double *lid_opening, int n_lids,
                     double *out) {
    if (n_pupils < 1 || n_pupils > SIM_MAX_PUPILS || bad_lids(lid_opening, n_lids)) return -1;
    if (!(fabs(azimuth_deg) <= 60 && fabs(elevation_deg) <= 60)) return -1;
    for (int p = 0; p < n_pupils; ++p) {
        double least = p ? pupil_mm[p - 1] : 0;
        if (!(pupil_mm[p] > least && pupil_mm[p] < 2 * scene->eye.limbus)) return -1;
    }
    size_t pairs = (size_t)(scene->n_sensors * scene->n_emitters), block = (size_t)n_lids * pairs;
    double axes[9];
    struct sim_light light;
    sim_eye_orient(&scene->eye, azimuth_deg, elevation_deg, axes);
    memset(out, 0, (size_t)n_pupils * block * sizeof *out);
    int bad = sim_light_open(&light, scene);
    for (int l = 0; !bad && l < n_lids; ++l) {
        double *at = out + (size_t)l * pairs;
        if (terms & SIM_TERM_FACE) sim_add_face(scene, elevation_deg, lid_opening[l], at);
        if (terms & SIM_TERM_SCLERA)
            sim_add_sclera(scene, &light, axes, elevation_deg, lid_opening[l], out + (size_t)l * pairs);
    }
    for (int p = 1; p < n_pupils; ++p) memcpy(out + (size_t)p * block, out, block * sizeof *out);
    if (!bad && (terms & SIM_TERM_IRIS))
        bad = sim_add_iris(scene, &light, axes, elevation_deg, pupil_mm, n_pupils, lid_opening, n_lids, out);
    sim_light_close(&light);
    return bad;
}
