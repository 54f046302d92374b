// SPDX-License-Identifier: Apache-2.0
//
// Points of the eye's white in batches: their places, and what one site's light does there.
#include <math.h>

#include "sim_wide.h"

SIM_WIDE void sim_surface_place(const struct sim_eye *eye, const struct sim_lid *lid, const double axes[9],
                                double albedo, struct sim_surface *s) {
    int n = sim_whole(s->n);
    double *row0 = s->row[0];
    double *row1 = s->row[1];
    double *point0 = s->point[0];
    double *point1 = s->point[1];
    double *point2 = s->point[2];
    double *normal0 = s->normal[0];
    double *normal1 = s->normal[1];
    double *normal2 = s->normal[2];
    double *radial0 = s->radial[0];
    double *radial1 = s->radial[1];
    double *radial2 = s->radial[2];
    double *up0 = s->up[0];
    double *up1 = s->up[1];
    double *up2 = s->up[2];
    double sb[SIM_BATCH], cb[SIM_BATCH];
    const double *beta_of = s->beta, *alpha_of = s->alpha;
    double *weight = s->weight, *over = s->above, *under = s->below;
    for (int p = 0; p < n; ++p) {
        sb[p] = sin(s->beta[p]);
        cb[p] = cos(s->beta[p]);
    }
    double b = eye->radius - eye->p * eye->apex, rest = eye->apex * (2 * eye->radius - eye->p * eye->apex);
    double per_haze = 1 / eye->haze, from_haze = 0.5 - eye->limbus / eye->haze, per_blend = 1 / eye->blend;
    double globe = eye->globe, sixth = eye->blend / 6, p1 = eye->p;
    double tilt = lid->tilt, lid_u = lid->upper, lid_l = lid->lower;
    double per_half2 = 1 / (lid->half * lid->half);
    SIM_EACH(p, n) {
        double sa = row0[p], ca = row1[p], beta = beta_of[p], alpha = alpha_of[p];
        double e0 = sa * cb[p], e1 = sb[p], e2 = -ca * cb[p];
        double d0 = axes[0] * e0 + axes[3] * e1 + axes[6] * e2;
        double d1 = axes[1] * e0 + axes[4] * e1 + axes[7] * e2;
        double c = axes[2] * e0 + axes[5] * e1 + axes[8] * e2;
        double sine = sqrt(d0 * d0 + d1 * d1);
        // As sim_eye_rho().
        double a = sine * sine + p1 * c * c, root = sqrt(b * b * c * c + a * rest);
        double top = b * c > 0 ? rest : root - b * c, cornea = top / (b * c > 0 ? root + b * c : a);
        double cornea_d = (-(1 - p1) * c * cornea + b) * sine * cornea / root;
        double gap = cornea - globe, h = sim_wide_max(1 - fabs(gap) * per_blend, 0.0);
        double rho = sim_wide_max(cornea, globe) + h * h * h * sixth;
        double bend = h * h / 2, rho_d = cornea_d * (gap > 0 ? 1 - bend : bend);
        double tissue = sim_wide_step(rho * sine * per_haze + from_haze), white = c > 0 ? tissue : 1.0;
        // Area vector rho (rho e_r - rho' e_theta) per unit solid angle; e_theta = (cos e_r - axis) / sine.
        double cut = rho_d / (sine + 1e-12), along = rho - cut * c;
        double n0 = along * e0 + cut * axes[2], n1 = along * e1 + cut * axes[5];
        double n2 = along * e2 + cut * axes[8];
        double length = sqrt(n0 * n0 + n1 * n1 + n2 * n2), per_length = 1 / length;
        normal0[p] = n0 * per_length;
        normal1[p] = n1 * per_length;
        normal2[p] = n2 * per_length;
        point0[p] = rho * e0;
        point1[p] = rho * e1;
        point2[p] = rho * e2;
        radial0[p] = e0;
        radial1[p] = e1;
        radial2[p] = e2;
        up0[p] = -sa * sb[p];
        up1[p] = cb[p];
        up2[p] = ca * sb[p];
        weight[p] *= albedo * cb[p] * rho * length * white;
        // As sim_lid_measure().
        double slope = -2 * alpha * per_half2, per_cos = 1 / cb[p], arch = 1 - alpha * alpha * per_half2;
        double line = tilt * alpha;
        double su = (tilt + lid_u * slope) * per_cos, sl = (tilt + lid_l * slope) * per_cos;
        over[p] = rho * (line + lid_u * arch - beta) / sqrt(1 + su * su);
        under[p] = rho * (beta - line - lid_l * arch) / sqrt(1 + sl * sl);
    }
}

SIM_WIDE void sim_surface_reach(const struct sim_scene *scene, const struct sim_site *site,
                                const double centre[3], const struct sim_lid *lid,
                                const struct sim_surface *s, double *away, double *transfer) {
    int n = sim_whole(s->n);
    const double *point0 = s->point[0];
    const double *point1 = s->point[1];
    const double *point2 = s->point[2];
    const double *normal0 = s->normal[0];
    const double *normal1 = s->normal[1];
    const double *normal2 = s->normal[2];
    const double *radial0 = s->radial[0];
    const double *radial1 = s->radial[1];
    const double *radial2 = s->radial[2];
    const double *up0 = s->up[0];
    const double *up1 = s->up[1];
    const double *up2 = s->up[2];
    double px = site->position[0], py = site->position[1], pz = site->position[2], lens = site->radius;
    double bulge = scene->eye.radius, cx = centre[0], cy = centre[1], cz = centre[2];
    double thickness = lid->thickness, per_softness = 1 / lid->softness;
    SIM_EACH(p, n) {
        double x = point0[p], y = point1[p], z = point2[p];
        double dx = px - x, dy = py - y, dz = pz - z, per_distance = 1 / sqrt(dx * dx + dy * dy + dz * dz);
        dx *= per_distance;
        dy *= per_distance;
        dz *= per_distance;
        double cosine = dx * normal0[p] + dy * normal1[p] + dz * normal2[p];
        double half = lens * per_distance + 1e-9, over = sim_wide_max(cosine + half, 0.0);
        double light = (cosine >= half ? cosine : over * over / (4 * half)) * per_distance * per_distance;
        double out = dx * radial0[p] + dy * radial1[p] + dz * radial2[p];
        double tangent = dx * up0[p] + dy * up1[p] + dz * up2[p];
        light *= sim_wide_open(thickness, per_softness, s->above[p], s->below[p], out, tangent);
        // The corneal bulge, a sphere: how far the ray misses it, over the lens' shadow's blur there.
        double bx = cx - x, by = cy - y, bz = cz - z, along = bx * dx + by * dy + bz * dz;
        double miss = sqrt(sim_wide_max(bx * bx + by * by + bz * bz - along * along, 0.0)) - bulge;
        double spread = (lens + 0.3) * along * per_distance;
        double past = sim_wide_step(miss / (2 * sim_wide_max(spread, 0.0) + 1e-9) + 0.5);
        transfer[p] = light * (along <= 0 ? 1.0 : past);
        away[p] = dx;
        away[SIM_BATCH + p] = dy;
        away[2 * SIM_BATCH + p] = dz;
    }
}

SIM_WIDE void sim_surface_dim(const struct sim_lid *lid, const struct sim_surface *s,
                              const double *away, double *transfer) {
    int n = sim_whole(s->n);
    const double *radial0 = s->radial[0];
    const double *radial1 = s->radial[1];
    const double *radial2 = s->radial[2];
    const double *up0 = s->up[0];
    const double *up1 = s->up[1];
    const double *up2 = s->up[2];
    SIM_EACH(p, n) {
        double x = away[p], y = away[SIM_BATCH + p], z = away[2 * SIM_BATCH + p];
        double out = x * radial0[p] + y * radial1[p] + z * radial2[p];
        double tangent = x * up0[p] + y * up1[p] + z * up2[p];
        transfer[p] *= sim_wide_lashes(lid, s->above[p], out, tangent);
    }
}
