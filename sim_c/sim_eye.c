// SPDX-License-Identifier: Apache-2.0
#include "sim_eye.h"

#include <math.h>

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
