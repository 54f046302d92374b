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

double sim_eye_refract(const struct sim_eye *eye, const double site[3], const double spot[3],
                       double exit[3]) {
    double n = eye->index, r_max2 = 0.9 * eye->radius * eye->radius / (eye->p > 0.1 ? eye->p : 0.1);
    double toward[3] = {site[0] - spot[0], site[1] - spot[1], site[2] - spot[2]};
    double along = toward[2] > 0.1 ? toward[2] : 0.1, rise = (eye->apex - eye->iris_z) * 0.8 / n;
    double lateral = sqrt(toward[0] * toward[0] + toward[1] * toward[1]);
    double shift = rise / (along + lateral);
    double x = spot[0] + toward[0] * shift, y = spot[1] + toward[1] * shift;
    double u[3], v[3], s1 = 0, s2 = 0, zx = 0, zy = 0, hxx = 1, hxy = 0, hyy = 1, q[3] = {0, 0, 0};
    int settled = 0;
    for (int i = 0; i < 30; ++i) {
        double r2 = x * x + y * y;
        if (r2 > r_max2) {
            double back = sqrt(r_max2 / r2);
            x *= back;
            y *= back;
            r2 = r_max2;
        }
        double root = sqrt(eye->radius * eye->radius - eye->p * r2), cube = eye->p / (root * root * root);
        q[0] = x;
        q[1] = y;
        q[2] = eye->apex - r2 / (eye->radius + root);
        zx = -x / root;
        zy = -y / root;
        for (int k = 0; k < 3; ++k) {
            u[k] = q[k] - site[k];
            v[k] = q[k] - spot[k];
        }
        s1 = sqrt(sim_dot(u, u));
        s2 = sqrt(sim_dot(v, v));
        for (int k = 0; k < 3; ++k) {
            u[k] /= s1;
            v[k] /= s2;
        }
        double ux = u[0] + u[2] * zx, uy = u[1] + u[2] * zy, vx = v[0] + v[2] * zx, vy = v[1] + v[2] * zy;
        double gx = ux + n * vx, gy = uy + n * vy, bend = u[2] + n * v[2];
        double k1 = 1 / s1, k2 = n / s2;
        hxx = (1 + zx * zx) * (k1 + k2) - ux * ux * k1 - vx * vx * k2 - bend * (1 / root + x * x * cube);
        hyy = (1 + zy * zy) * (k1 + k2) - uy * uy * k1 - vy * vy * k2 - bend * (1 / root + y * y * cube);
        hxy = zx * zy * (k1 + k2) - ux * uy * k1 - vx * vy * k2 - bend * x * y * cube;
        double det = hxx * hyy - hxy * hxy;
        if (settled) break;
        double dx, dy;
        if (det > 0 && hxx > 0) {
            dx = -(hyy * gx - hxy * gy) / det;
            dy = -(hxx * gy - hxy * gx) / det;
        } else {
            dx = -gx;
            dy = -gy;
        }
        double step = sqrt(dx * dx + dy * dy);
        if (step > 2) {
            dx *= 2 / step;
            dy *= 2 / step;
        }
        x += dx;
        y += dy;
        settled = step < 1e-7;
    }
    memcpy(exit, q, sizeof q);
    if (!settled) return 0;
    double metric = 1 + zx * zx + zy * zy, det = (hxx * hyy - hxy * hxy) / metric, length = sqrt(metric);
    double cos_out = -(u[2] - zx * u[0] - zy * u[1]) / length,
           cos_in = (v[2] - zx * v[0] - zy * v[1]) / length;
    if (det <= 0 || cos_out <= 0 || cos_in <= 0 || v[2] <= 0) return 0;
    double spread = n * n * cos_out * cos_in / (s1 * s1 * s2 * s2 * det);
    return v[2] * (1 - sim_fresnel(n, cos_out)) * spread;
}
