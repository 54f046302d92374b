// SPDX-License-Identifier: Apache-2.0
#include "sim_eye.h"

#include <math.h>
#include <string.h>

#define RADIANS (3.14159265358979323846 / 180)

static void direction(double azimuth_deg, double elevation_deg, double d[3]) {
    double a = azimuth_deg * RADIANS, e = elevation_deg * RADIANS;
    d[0] = sin(a) * cos(e);
    d[1] = sin(e);
    d[2] = -cos(a) * cos(e);
}

// Cosine of the angle from the axis where the surface is at distance r from the axis.
static double cosine_at(const struct sim_eye *eye, double r) {
    double from = 0, to = 90 * RADIANS, derivative;
    for (int i = 0; i < 60; ++i) {
        double t = (from + to) / 2;
        if (sim_eye_rho(eye, sin(t), cos(t), &derivative) * sin(t) < r) from = t;
        else to = t;
    }
    return cos(from);
}

void sim_eye_init(struct sim_eye *eye, const struct sim_person *person) {
    eye->radius = person->cornea_radius_mm;
    eye->p = 1 + person->cornea_asphericity;
    eye->globe = person->globe_radius_mm;
    eye->blend = person->limbus_blend_mm;
    eye->limbus = person->limbus_radius_mm;
    eye->haze = person->limbus_haze_mm;
    eye->index = person->refractive_index;
    double r2 = eye->limbus * eye->limbus;
    double sag = r2 / (eye->radius + sqrt(eye->radius * eye->radius - eye->p * r2));
    eye->apex = sqrt(eye->globe * eye->globe - r2) + sag;
    eye->iris_z = eye->apex - person->iris_depth_mm;
    eye->cos_clear = cosine_at(eye, eye->limbus - eye->haze / 2);
    eye->cos_white = cosine_at(eye, eye->limbus + eye->haze / 2);
    double from = acos(cosine_at(eye, eye->limbus)), to = 90 * RADIANS, derivative;
    for (int i = 0; i < 60; ++i) {
        double t = (from + to) / 2;
        if (sim_eye_rho(eye, sin(t), cos(t), &derivative) > eye->globe) from = t;
        else to = t;
    }
    eye->cos_blend = cos(from);
    double z[3];
    direction(person->kappa_azimuth_deg, person->kappa_elevation_deg, z);
    // x = up cross z, y = z cross x: any roll will do, the eye is round.
    double n = sqrt(z[0] * z[0] + z[2] * z[2]), x[3] = {z[2] / n, 0, -z[0] / n};
    double y[3] = {z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]};
    for (int i = 0; i < 3; ++i) {
        eye->rest[3 * i] = x[i];
        eye->rest[3 * i + 1] = y[i];
        eye->rest[3 * i + 2] = z[i];
    }
}

double sim_eye_rho(const struct sim_eye *eye, double s, double c, double *derivative) {
    // The ray rho (s, c) in the conic r^2 = 2 R (apex - z) - p (apex - z)^2: A rho^2 + 2 B c rho - C = 0.
    double b = eye->radius - eye->p * eye->apex, a = s * s + eye->p * c * c;
    double rest = eye->apex * (2 * eye->radius - eye->p * eye->apex);
    double root = sqrt(b * b * c * c + a * rest);
    double cornea = b * c > 0 ? rest / (root + b * c) : (root - b * c) / a;
    double cornea_d = (-(1 - eye->p) * s * c * cornea * cornea + b * s * cornea) / root;
    double gap = cornea - eye->globe, h = 1 - fabs(gap) / eye->blend;
    double rho = gap > 0 ? cornea : eye->globe, d = gap > 0 ? cornea_d : 0;
    if (h > 0) {
        rho += h * h * h * eye->blend / 6;
        d += (gap > 0 ? -1 : 1) * h * h / 2 * cornea_d;
    }
    *derivative = d;
    return rho;
}

double sim_eye_whiteness(const struct sim_eye *eye, double r) {
    return sim_step((r - eye->limbus) / eye->haze + 0.5);
}

void sim_eye_orient(const struct sim_eye *eye, double azimuth_deg, double elevation_deg, double axes[9]) {
    double g[3];
    direction(azimuth_deg, elevation_deg, g);
    // Rodrigues from (0, 0, -1) to g: v = rest x gaze = (g1, -g0, 0), cosine -g2.
    double vx = g[1], vy = -g[0], k = 1 / (1 - g[2]), c = -g[2];
    double turn[9] = {c + vx * vx * k, vx * vy * k, vy, vx * vy * k, c + vy * vy * k, -vx, -vy, vx, c};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            axes[3 * i + j] = turn[3 * i] * eye->rest[j] + turn[3 * i + 1] * eye->rest[3 + j] +
                              turn[3 * i + 2] * eye->rest[6 + j];
}

double sim_fresnel(double index, double cos_in) {
    double c = cos_in < 0 ? 0 : cos_in, t = sqrt(1 - (1 - c * c) / (index * index));
    double s = (c - index * t) / (c + index * t), p = (t - index * c) / (t + index * c);
    return (s * s + p * p) / 2;
}

// Fermat's length over the cornea's (x, y), with all that its stationary point is judged by.
struct path {
    double q[3], u[3], v[3];  // crossing; unit vectors to it from the site and from the spot
    double s1, s2, zx, zy;    // lengths of both legs; slopes of the cornea
    double length, gx, gy, hxx, hxy, hyy;
};

static void measure_path(const struct sim_eye *eye, const double site[3], const double spot[3], double x,
                         double y, struct path *path) {
    double r2 = x * x + y * y, root = sqrt(eye->radius * eye->radius - eye->p * r2), n = eye->index;
    double cube = eye->p / (root * root * root);
    path->q[0] = x;
    path->q[1] = y;
    path->q[2] = eye->apex - r2 / (eye->radius + root);
    for (int k = 0; k < 3; ++k) {
        path->u[k] = path->q[k] - site[k];
        path->v[k] = path->q[k] - spot[k];
    }
    path->s1 = sqrt(sim_dot(path->u, path->u));
    path->s2 = sqrt(sim_dot(path->v, path->v));
    for (int k = 0; k < 3; ++k) {
        path->u[k] /= path->s1;
        path->v[k] /= path->s2;
    }
    double zx = path->zx = -x / root, zy = path->zy = -y / root, k1 = 1 / path->s1, k2 = n / path->s2;
    double ux = path->u[0] + path->u[2] * zx, uy = path->u[1] + path->u[2] * zy;
    double vx = path->v[0] + path->v[2] * zx, vy = path->v[1] + path->v[2] * zy;
    double bend = path->u[2] + n * path->v[2];
    path->length = path->s1 + n * path->s2;
    path->gx = ux + n * vx;
    path->gy = uy + n * vy;
    path->hxx = (1 + zx * zx) * (k1 + k2) - ux * ux * k1 - vx * vx * k2 - bend * (1 / root + x * x * cube);
    path->hyy = (1 + zy * zy) * (k1 + k2) - uy * uy * k1 - vy * vy * k2 - bend * (1 / root + y * y * cube);
    path->hxy = zx * zy * (k1 + k2) - ux * uy * k1 - vx * vy * k2 - bend * x * y * cube;
}

double sim_eye_refract(const struct sim_eye *eye, const double site[3], const double spot[3],
                       double exit[3]) {
    double n = eye->index, r_max2 = 0.9 * eye->radius * eye->radius / (eye->p > 0.1 ? eye->p : 0.1);
    double toward[3] = {site[0] - spot[0], site[1] - spot[1], site[2] - spot[2]};
    double along = toward[2] > 0.1 ? toward[2] : 0.1, rise = (eye->apex - eye->iris_z) * 0.8 / n;
    // Far from the axis there is little chamber left above the iris.
    double free_part = 1 - (spot[0] * spot[0] + spot[1] * spot[1]) / (1.3 * eye->limbus * eye->limbus);
    double shift = rise * free_part / (along + sqrt(toward[0] * toward[0] + toward[1] * toward[1]));
    struct path path;
    measure_path(eye, site, spot, spot[0] + toward[0] * shift, spot[1] + toward[1] * shift, &path);
    int settled = 0;
    for (int i = 0; i < 40 && !settled; ++i) {
        // Newton's step on the Hessian made positive, shortened until the path gets shorter.
        double middle = (path.hxx + path.hyy) / 2, half = (path.hxx - path.hyy) / 2;
        double least = middle - sqrt(half * half + path.hxy * path.hxy),
               lift = least < 0.01 ? 0.01 - least : 0;
        double hxx = path.hxx + lift, hyy = path.hyy + lift, det = hxx * hyy - path.hxy * path.hxy;
        double dx = -(hyy * path.gx - path.hxy * path.gy) / det,
               dy = -(hxx * path.gy - path.hxy * path.gx) / det;
        double step = sqrt(dx * dx + dy * dy), scale = step > 1 ? 1 / step : 1;
        settled = step < 1e-7 && lift == 0;
        struct path next = path;
        for (int j = 0; j < 12; ++j, scale /= 2) {
            double x = path.q[0] + scale * dx, y = path.q[1] + scale * dy;
            if (x * x + y * y > r_max2) continue;
            measure_path(eye, site, spot, x, y, &next);
            if (next.length <= path.length + 1e-12) break;
        }
        path = next;
    }
    memcpy(exit, path.q, sizeof path.q);
    if (!settled) return 0;
    double metric = 1 + path.zx * path.zx + path.zy * path.zy, size = sqrt(metric);
    double det = (path.hxx * path.hyy - path.hxy * path.hxy) / metric;
    double cos_out = -(path.u[2] - path.zx * path.u[0] - path.zy * path.u[1]) / size;
    double cos_in = (path.v[2] - path.zx * path.v[0] - path.zy * path.v[1]) / size;
    if (det <= 0 || cos_out <= 0 || cos_in <= 0 || path.v[2] <= 0) return 0;
    double spread = n * n * cos_out * cos_in / (path.s1 * path.s1 * path.s2 * path.s2 * det);
    return path.v[2] * (1 - sim_fresnel(n, cos_out)) * spread;
}
