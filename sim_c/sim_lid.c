// SPDX-License-Identifier: Apache-2.0
#include "sim_lid.h"

#include <math.h>

#define RADIANS (3.14159265358979323846 / 180)

void sim_lid_pose(struct sim_lid *lid, const struct sim_person *person, double elevation_deg,
                  double opening) {
    double upper = person->lid_upper_deg + person->lid_upper_follow * elevation_deg;
    double lower = person->lid_lower_deg + person->lid_lower_follow * elevation_deg;
    double meet = lower + person->lid_close_at * (upper - lower);
    lid->upper = (meet + opening * (upper - meet)) * RADIANS;
    lid->lower = (meet + opening * (lower - meet)) * RADIANS;
    lid->half = person->canthus_deg * RADIANS;
    lid->tilt = person->canthus_tilt_deg / 45;
    lid->thickness = person->lid_thickness_mm;
    lid->softness = person->lid_softness_mm;
    lid->lash_length = person->lash_length_mm;
    lid->lash_opacity = person->lash_opacity;
}

void sim_lid_margins(const struct sim_lid *lid, double alpha, double *upper, double *lower) {
    double a = alpha / lid->half, arch = 1 - a * a, line = lid->tilt * alpha;
    *upper = line + lid->upper * arch;
    *lower = line + lid->lower * arch;
}

double sim_lid_locate(const double head[3], struct sim_lid_point *point, double *alpha, double *beta) {
    double flat = sqrt(head[0] * head[0] + head[2] * head[2]), rho = sqrt(flat * flat + head[1] * head[1]);
    double sin_a = head[0] / flat, cos_a = -head[2] / flat, sin_b = head[1] / rho, cos_b = flat / rho;
    for (int k = 0; k < 3; ++k) point->radial[k] = head[k] / rho;
    point->up[0] = -sin_a * sin_b;
    point->up[1] = cos_b;
    point->up[2] = cos_a * sin_b;
    *alpha = atan2(head[0], -head[2]);
    *beta = atan2(head[1], flat);
    return rho;
}

void sim_lid_measure(const struct sim_lid *lid, double alpha, double beta, double rho,
                     struct sim_lid_point *point) {
    double upper, lower, slope = -2 * alpha / (lid->half * lid->half), per_cos = 1 / cos(beta);
    sim_lid_margins(lid, alpha, &upper, &lower);
    double su = (lid->tilt + lid->upper * slope) * per_cos, sl = (lid->tilt + lid->lower * slope) * per_cos;
    point->above = rho * (upper - beta) / sqrt(1 + su * su);
    point->below = rho * (beta - lower) / sqrt(1 + sl * sl);
}

double sim_lid_open(const struct sim_lid *lid, const struct sim_lid_point *point) {
    return sim_step(point->above / lid->softness) * sim_step(point->below / lid->softness);
}

double sim_lid_open_toward(const struct sim_lid *lid, const struct sim_lid_point *point,
                           const double toward[3]) {
    if (point->above <= 0 || point->below <= 0) return 0;
    double out = sim_dot(toward, point->radial), tangent = sim_dot(toward, point->up);
    if (out < 0.02) out = 0.02;
    tangent /= out;
    // Positive part of the slope toward each margin, rounded so that it is smooth where the ray is along the
    // normal.
    double size = sqrt(tangent * tangent + 0.01);
    double to_upper = lid->thickness * (size + tangent) / 2, to_lower = lid->thickness * (size - tangent) / 2;
    double open = sim_step((point->above - to_upper) / lid->softness) *
                  sim_step((point->below - to_lower) / lid->softness);
    if (lid->lash_opacity == 0) return open;
    double to_lash = lid->lash_length * (size + tangent) / 2;
    return open * (1 - lid->lash_opacity * (1 - sim_step((point->above - to_lash) / lid->softness)));
}
