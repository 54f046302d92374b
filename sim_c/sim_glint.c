// SPDX-License-Identifier: Apache-2.0
//
// The glint: light that the eye's front mirrors from an emitter into a sensor,
//     integral of D(n.h) F(l.h) / 4 * beam / d_l^2 * window / d_v^2 over the surface,
// D Beckmann's distribution. On a smooth surface with a compact smooth lobe the midpoint rule converges
// faster than any power of its step, so one uniform rule over (theta, phi) serves everywhere, fold included:
// along the profile all of it, around the axis only where the lobe is.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846
static const double REACH_WIDTHS = 4.2;  // exp(-4.2^2) = 2e-8 of the peak is cut off
static const double THETA_END = 105 * SIM_RADIANS;

struct ring {
    double rho, sin_theta, cos_theta;
    double n_out, n_up;  // unit normal: away from the axis, along it
    double tilt;         // its angle from the axis
    double area;         // rho * |tangent| * d theta, times sin_theta d phi gives the area
};

struct pair_view {
    const struct sim_scene *scene;
    const double *axes, *a, *b;  // site positions, eye frame
    int site_a, site_b;
    double alpha2, nearest;  // of the lobe; distance from the apex's sphere to the nearer site
    const struct sim_lid *lids;
    int n_lids;
    double *out;
};

static double unit_toward(const double from[3], const double to[3], double u[3]) {
    for (int k = 0; k < 3; ++k) u[k] = to[k] - from[k];
    double n = sqrt(sim_dot(u, u));
    for (int k = 0; k < 3; ++k) u[k] /= n;
    return n;
}

static void point_on(const struct ring *ring, double phi, double point[3], double normal[3]) {
    double c = cos(phi), s = sin(phi), r = ring->rho * ring->sin_theta;
    point[0] = r * c;
    point[1] = r * s;
    point[2] = ring->rho * ring->cos_theta;
    normal[0] = ring->n_out * c;
    normal[1] = ring->n_out * s;
    normal[2] = ring->n_up;
}

// The azimuth at which the half vector lies in the ring's meridian plane, and the half vector's angle from
// the axis.
static double facing_azimuth(const struct pair_view *view, const struct ring *ring, double phi,
                             double *angle) {
    double h[3] = {0, 0, 1};
    for (int i = 0; i < 3; ++i) {
        double point[3], normal[3], l[3], v[3];
        point_on(ring, phi, point, normal);
        unit_toward(point, view->a, l);
        unit_toward(point, view->b, v);
        for (int k = 0; k < 3; ++k) h[k] = l[k] + v[k];
        phi = atan2(h[1], h[0]);
    }
    *angle = atan2(sqrt(h[0] * h[0] + h[1] * h[1]), h[2]);
    return phi;
}

static void add_point(const struct pair_view *view, const struct ring *ring, double phi, double weight) {
    const struct sim_scene *scene = view->scene;
    double point[3], normal[3], l[3], v[3], h[3];
    point_on(ring, phi, point, normal);
    double da = unit_toward(point, view->a, l), db = unit_toward(point, view->b, v);
    if (sim_dot(normal, l) <= 0 || sim_dot(normal, v) <= 0) return;
    for (int k = 0; k < 3; ++k) h[k] = l[k] + v[k];
    double n = sqrt(sim_dot(h, h)), c = sim_dot(normal, h) / n;
    if (c < 0.1) return;
    double c2 = c * c, slope2 = (1 - c2) / (c2 * view->alpha2);
    if (slope2 > 30) return;
    double lobe = exp(-slope2) / (PI * view->alpha2 * c2 * c2);
    weight *= lobe * sim_fresnel(scene->eye.index, sim_dot(l, h) / n) / (4 * da * da * db * db);
    double head[3], away[2][3], alpha, beta;
    const double *axes = view->axes;
    for (int i = 0; i < 3; ++i) {
        head[i] = axes[3 * i] * point[0] + axes[3 * i + 1] * point[1] + axes[3 * i + 2] * point[2];
        away[0][i] = axes[3 * i] * l[0] + axes[3 * i + 1] * l[1] + axes[3 * i + 2] * l[2];
        away[1][i] = axes[3 * i] * v[0] + axes[3 * i + 1] * v[1] + axes[3 * i + 2] * v[2];
    }
    struct sim_lid_point at;
    double rho = sim_lid_locate(head, &at, &alpha, &beta), open[SIM_MAX_LIDS];
    weight *= sim_face_eye_reach(&scene->face, view->site_a, alpha, beta);
    weight *= sim_face_eye_reach(&scene->face, view->site_b, alpha, beta);
    int any = 0;
    for (int i = 0; i < view->n_lids; ++i) {
        sim_lid_measure(&view->lids[i], alpha, beta, rho, &at);
        open[i] = sim_lid_open_toward(&view->lids[i], &at, away[0]);
        if (open[i] > 0) open[i] *= sim_lid_open_toward(&view->lids[i], &at, away[1]);
        any |= open[i] > 0;
    }
    if (!any || weight == 0) return;
    int m = scene->n_emitters, pairs = scene->n_sensors * m;
    for (int s = 0; s < scene->n_sensors; ++s) {
        int site = scene->sensors[s].site, here = site == view->site_a;
        if (!here && site != view->site_b) continue;
        double ws = weight * sim_window_weight(&scene->sensors[s], away[!here]);
        if (ws == 0) continue;
        for (int e = 0; e < m; ++e) {
            // A pair belongs to this view when its two ends are the view's two sites.
            if (scene->emitters[e].site != (here ? view->site_b : view->site_a)) continue;
            double w = ws * sim_window_weight(&scene->emitters[e], away[here]);
            for (int i = 0; i < view->n_lids; ++i) view->out[i * pairs + s * m + e] += w * open[i];
        }
    }
}

static void add_pair(const struct pair_view *view, const struct ring *rings, int n_rings) {
    double alpha = sqrt(view->alpha2), phi = 0, step_widths = 1 / view->scene->quality.glint;
    double mid[3] = {view->a[0] + view->b[0], view->a[1] + view->b[1], view->a[2] + view->b[2]};
    double start = atan2(mid[1], mid[0]);
    for (int i = 0; i < n_rings; ++i) {
        double angle;
        phi = facing_azimuth(view, &rings[i], start, &angle);
        if (fabs(angle - rings[i].tilt) > 5 * alpha) continue;
        // The half vector turns against the normal as phi grows, so the lobe is passed up to 1.6 times
        // faster.
        double sine = rings[i].n_out > 1e-9 ? rings[i].n_out : 1e-9;
        double reach = REACH_WIDTHS * alpha / sine, step = step_widths * alpha / (1.6 * sine);
        if (reach > PI) reach = PI;
        int n = (int)ceil(2 * reach / step);
        if (n < 12) n = 12;
        step = 2 * reach / n;
        double weight = rings[i].area * rings[i].sin_theta * step;
        for (int j = 0; j < n; ++j) add_point(view, &rings[i], phi - reach + (j + 0.5) * step, weight);
    }
}

static int pair_used(const struct sim_scene *scene, int a, int b) {
    int sa = 0, sb = 0, ea = 0, eb = 0;
    for (int s = 0; s < scene->n_sensors; ++s)
        sa |= scene->sensors[s].site == a, sb |= scene->sensors[s].site == b;
    for (int e = 0; e < scene->n_emitters; ++e)
        ea |= scene->emitters[e].site == a, eb |= scene->emitters[e].site == b;
    return (sa && eb) || (sb && ea);
}

int sim_scene_glint(const struct sim_scene *scene, double azimuth_deg, double elevation_deg,
                    const double *lid_opening, int n_lids, double *out) {
    if (n_lids < 1 || n_lids > SIM_MAX_LIDS || !(fabs(azimuth_deg) <= 60 && fabs(elevation_deg) <= 60))
        return -1;
    struct sim_lid lids[SIM_MAX_LIDS];
    for (int i = 0; i < n_lids; ++i) {
        if (!(lid_opening[i] >= 0 && lid_opening[i] <= 1)) return -1;
        sim_lid_pose(&lids[i], &scene->person, elevation_deg, lid_opening[i]);
    }
    memset(out, 0, (size_t)(n_lids * scene->n_sensors * scene->n_emitters) * sizeof *out);
    double axes[9], sites[2 * SIM_MAX_PORTS][3], nearest = 1e9, away[2 * SIM_MAX_PORTS];
    for (int k = 0; k < scene->n_sites; ++k) {
        away[k] = sqrt(sim_dot(scene->sites[k].position, scene->sites[k].position)) - scene->eye.apex;
        if (away[k] < nearest) nearest = away[k];
    }
    double step = 0.5 / scene->quality.glint * SIM_RADIANS;
    if (nearest < scene->eye.apex) step *= nearest / scene->eye.apex;  // half vectors turn faster near a site
    if (step < 2e-5) step = 2e-5;
    int n_rings = (int)ceil(THETA_END / step);
    struct ring *rings = malloc((size_t)n_rings * sizeof *rings);
    if (!rings) return -1;
    for (int i = 0; i < n_rings; ++i) {
        double theta = (i + 0.5) * step, d;
        struct ring *r = &rings[i];
        r->sin_theta = sin(theta);
        r->cos_theta = cos(theta);
        r->rho = sim_eye_rho(&scene->eye, r->sin_theta, r->cos_theta, &d);
        double length = sqrt(r->rho * r->rho + d * d);
        r->n_out = (r->rho * r->sin_theta - d * r->cos_theta) / length;
        r->n_up = (r->rho * r->cos_theta + d * r->sin_theta) / length;
        r->tilt = atan2(r->n_out, r->n_up);
        r->area = r->rho * length * step;
    }
    sim_eye_orient(&scene->eye, azimuth_deg, elevation_deg, axes);
    for (int k = 0; k < scene->n_sites; ++k)
        for (int j = 0; j < 3; ++j) {
            const double *p = scene->sites[k].position;
            sites[k][j] = axes[j] * p[0] + axes[3 + j] * p[1] + axes[6 + j] * p[2];
        }
    double widen[2 * SIM_MAX_PORTS];
    for (int k = 0; k < scene->n_sites; ++k) {
        double d[3] = {sites[k][0], sites[k][1], sites[k][2] - scene->eye.apex + scene->eye.radius};
        double half = scene->sites[k].radius / (2 * (sqrt(sim_dot(d, d)) - 0.9 * scene->eye.radius));
        widen[k] = half * half / 2;
    }
    for (int a = 0; a < scene->n_sites; ++a)
        for (int b = a; b < scene->n_sites; ++b) {
            if (!pair_used(scene, a, b)) continue;
            double rough = scene->person.roughness;
            struct pair_view view = {.scene = scene,
                                     .axes = axes,
                                     .a = sites[a],
                                     .b = sites[b],
                                     .site_a = a,
                                     .site_b = b,
                                     .alpha2 = rough * rough + widen[a] + widen[b],
                                     .nearest = away[a] < away[b] ? away[a] : away[b],
                                     .lids = lids,
                                     .n_lids = n_lids,
                                     .out = out};
            add_pair(&view, rings, n_rings);
        }
    free(rings);
    return 0;
}
