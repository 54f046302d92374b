// SPDX-License-Identifier: Apache-2.0
//
// The glint from mirror points: for checks, and in place of the lobe's quadrature where that is good enough.
//
// Round a mirror point the slope is nearly linear in the place, so the lobe is nearly a Gaussian there. What
// multiplies it (spreading, Fresnel, windows) is sampled by Gauss-Hermite's five points each way. The middle
// one alone is the mirror point's response; what the neighbours change along each direction is of the order
// alpha^2. A part of that, and all of it where it is no small part of the whole, is the estimate of what is
// left out of a result that includes the neighbours.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_glint.h"

#define PI 3.14159265358979323846
enum { MOST_VALUES = 64, RULES = 4 };
// Gauss-Hermite's five points, weights over sqrt(PI).
static const double NODE[3] = {0, 0.95857246461381850711, 2.02018287045608563293};
static const double SHARE[3] = {8 / 15.0, 0.22207592200561264, 0.011257411327720689};

// Where a lobe is seen through: least and greatest openness of each lid pose over the points looked at.
struct shade {
    double least[SIM_MAX_LIDS], most[SIM_MAX_LIDS];
};

static void look_through(const struct sim_lobe *lobe, const struct sim_ring *ring, double c, double s,
                         struct shade *shade) {
    double point[3] = {ring->r * c, ring->r * s, ring->z}, l[3], v[3], open[SIM_MAX_LIDS];
    for (int k = 0; k < 3; ++k) {
        l[k] = lobe->a[k] - point[k];
        v[k] = lobe->b[k] - point[k];
    }
    double ka = 1 / sqrt(sim_dot(l, l)), kb = 1 / sqrt(sim_dot(v, v));
    for (int k = 0; k < 3; ++k) {
        l[k] *= ka;
        v[k] *= kb;
    }
    int any = sim_lobe_open(lobe, point, l, v, open);
    for (int i = 0; i < lobe->gaze->n_lids; ++i) {
        double share = any ? open[i] : 0;
        shade->least[i] = fmin(shade->least[i], share);
        shade->most[i] = fmax(shade->most[i], share);
    }
}

// Five by five points round the mirror point at theta. sum: [rule][value], the rules having 1 x 1, 5 x 1,
// 1 x 5 and 5 x 5 points along the profile and around. Returns 0 where the estimate would not hold.
static int sample(struct sim_lobe *lobe, double theta, double slope, const struct sim_facing *middle,
                  double (*sum)[MOST_VALUES], int values) {
    const struct sim_eye *eye = &lobe->gaze->scene->eye;
    struct shade shade;
    double reach = sqrt(lobe->cut);
    for (int i = 0; i < lobe->gaze->n_lids; ++i) shade.least[i] = 1, shade.most[i] = 0;
    for (int i = -3; i <= 3; ++i) {
        int outer = abs(i) == 3;  // looked through only
        double x = outer ? i / 3 * reach : i < 0 ? -NODE[-i] : NODE[i];
        struct sim_ring ring;
        struct sim_facing at = *middle;
        sim_ring_at(eye, theta + lobe->alpha * x / slope, &ring);
        sim_ring_face(&ring, lobe->a, lobe->b, 0.02 * lobe->alpha, &at);
        double width = lobe->alpha / at.pace, sine = sqrt(fmax(0, 1 - at.cosine * at.cosine));
        if (width * reach > 0.7 || at.cosine < 2 * reach * lobe->alpha * sine) return 0;
        for (int j = outer ? 0 : -3; j <= (outer ? 0 : 3); ++j) {
            int edge = abs(j) == 3;
            if (edge && i) continue;
            double y = edge ? j / 3 * reach : j < 0 ? -NODE[-j] : NODE[j];
            double cy = cos(width * y), sy = sin(width * y), one[MOST_VALUES] = {0};
            double c = at.c * cy - at.s * sy, s = at.s * cy + at.c * sy;
            if (outer || edge || !i || !j) look_through(lobe, &ring, c, s, &shade);
            if (outer || edge) continue;
            double weight = PI * exp(x * x + y * y) * ring.area * width * lobe->alpha / slope;
            lobe->apart = one;
            sim_lobe_point(lobe, &ring, c, s, weight);
            lobe->apart = NULL;
            double wx = SHARE[abs(i)], wy = SHARE[abs(j)];
            for (int k = 0; k < values; ++k) {
                sum[0][k] += !i && !j ? one[k] : 0;
                sum[1][k] += !j ? wx * one[k] : 0;
                sum[2][k] += !i ? wy * one[k] : 0;
                sum[3][k] += wx * wy * one[k];
            }
        }
    }
    for (int i = 0; i < lobe->gaze->n_lids; ++i)
        if (shade.most[i] - shade.least[i] > 0.05) return 0;
    return 1;
}

static int count_values(const struct sim_lobe *lobe, int where[MOST_VALUES]) {
    const struct sim_scene *scene = lobe->gaze->scene;
    int n = 0, m = scene->n_emitters, pairs = scene->n_sensors * m;
    for (int s = 0; s < scene->n_sensors; ++s)
        for (int e = 0; e < m; ++e) {
            int from = scene->sensors[s].site, to = scene->emitters[e].site;
            if (!((from == lobe->site_a && to == lobe->site_b) ||
                  (from == lobe->site_b && to == lobe->site_a)))
                continue;
            for (int i = 0; i < lobe->gaze->n_lids; ++i) {
                if (n == MOST_VALUES) return 0;
                where[n++] = i * pairs + s * m + e;
            }
        }
    return n;
}

int sim_lobe_by_mirror(struct sim_lobe *lobe, const struct sim_stretch *stretches, int n) {
    const struct sim_scene *scene = lobe->gaze->scene;
    double reach = sqrt(lobe->cut) * lobe->alpha, sum[RULES][MOST_VALUES], slope, middle;
    int where[MOST_VALUES], values = reach < 0.4 ? count_values(lobe, where) : 0;
    if (!values) return 0;
    memset(sum, 0, sizeof sum);
    for (int i = 0, next; i < n; i = next) {
        int crossings = stretches[i].crossings;
        double steepest = stretches[i].steepest;
        for (next = i + 1; next < n && stretches[next].from - stretches[next - 1].to < 1e-9; ++next) {
            crossings += stretches[next].crossings;
            steepest = fmax(steepest, stretches[next].steepest);
        }
        double from = stretches[i].from, to = stretches[next - 1].to;
        // One root, the whole lobe, and no fold within reach: the slope is nearly the same all over it.
        if (crossings != 1 || !stretches[i].closed[0] || !stretches[next - 1].closed[1] ||
            steepest * (to - from) > 3.2 * reach)
            return 0;
        struct sim_facing facing = lobe->start;
        middle = sim_mirror_root(&scene->eye, lobe->a, lobe->b, from, to, 1e-3 * lobe->alpha, &facing,
                                 &slope);
        // The curvature has kinks where the limbus' blend begins, is centred and ends: they must be far off.
        for (int j = i + 1; j < next; ++j)
            if (fabs(stretches[j].from - middle) * fabs(slope) < 4 * lobe->alpha) return 0;
        if (!sample(lobe, middle, fabs(slope), &facing, sum, values)) return 0;
    }
    for (int k = 0; k < values; ++k) {
        double bend = fabs(sum[1][k] - sum[0][k]) + fabs(sum[2][k] - sum[0][k]) +
                      fabs(sum[3][k] - sum[1][k] - sum[2][k] + sum[0][k]);
        double whole = sum[3][k] + bend;
        if (whole > 0 && 0.15 * bend + 6 * bend * bend / whole > scene->quality.tolerance) return 0;
    }
    for (int k = 0; k < values; ++k) lobe->gaze->out[where[k]] += sum[3][k];
    return 1;
}

int sim_scene_mirrors(const struct sim_scene *scene, double azimuth_deg, double elevation_deg,
                      double lid_opening, int sensor, int emitter, struct sim_mirror_light *out, int most) {
    enum { ROOM = 32 };
    struct sim_gaze gaze = {.scene = scene};
    struct sim_mirror found[ROOM];
    if (sensor < 0 || sensor >= scene->n_sensors || emitter < 0 || emitter >= scene->n_emitters || most < 1 ||
        sim_gaze_open(&gaze, scene, azimuth_deg, elevation_deg, &lid_opening, 1))
        return -1;
    const struct sim_window *at_s = &scene->sensors[sensor], *at_e = &scene->emitters[emitter];
    struct sim_lobe lobe = {.gaze = &gaze, .site_a = at_s->site, .site_b = at_e->site};
    lobe.a = gaze.sites[at_s->site];
    lobe.b = gaze.sites[at_e->site];
    int n = sim_mirror_points(&scene->profile, &scene->eye, lobe.a, lobe.b, found, most < ROOM ? most : ROOM);
    for (int i = 0; i < n; ++i) {
        const struct sim_mirror *m = &found[i];
        struct sim_mirror_light *light = &out[i];
        double l[3], v[3], product = m->distance_a * m->distance_b;
        for (int k = 0; k < 3; ++k) {
            l[k] = (lobe.a[k] - m->point[k]) / m->distance_a;
            v[k] = (lobe.b[k] - m->point[k]) / m->distance_b;
            light->point_mm[k] = gaze.axes[3 * k] * m->point[0] + gaze.axes[3 * k + 1] * m->point[1] +
                                 gaze.axes[3 * k + 2] * m->point[2];
        }
        light->theta_deg = m->theta / SIM_RADIANS;
        light->sensor_mm = m->distance_a;
        light->emitter_mm = m->distance_b;
        light->cosine = m->cosine;
        light->determinant = m->determinant;
        light->response = sim_fresnel(scene->eye.index, m->cosine) * m->cosine * m->cosine /
                          (product * product * fabs(m->determinant)) *
                          sim_gaze_window(gaze.sensor_aim[sensor], at_s->per_tan2, l) *
                          sim_gaze_window(gaze.emitter_aim[emitter], at_e->per_tan2, v);
        if (m->cosine <= 0 || !sim_lobe_open(&lobe, m->point, l, v, &light->open)) light->open = 0;
    }
    return n;
}
