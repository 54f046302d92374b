// SPDX-License-Identifier: Apache-2.0
//
// The terms that vary slowly with gaze: sclera over the lids' opening (from margin to margin, in the head
// frame), iris over rings between pupil edges (in the eye frame, light in and out through the cornea).
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846

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

static void to_eye(const double axes[9], const double head[3], double eye[3]) {
    for (int j = 0; j < 3; ++j) eye[j] = axes[j] * head[0] + axes[3 + j] * head[1] + axes[6 + j] * head[2];
}

static void to_head(const double axes[9], const double eye[3], double head[3]) {
    for (int i = 0; i < 3; ++i)
        head[i] = axes[3 * i] * eye[0] + axes[3 * i + 1] * eye[1] + axes[3 * i + 2] * eye[2];
}

// How much of a site's lens a point of the sclera sees past the corneal bulge. The bulge is a sphere here.
static double past_cornea(const struct sim_scene *scene, const double point[3], const double axis[3],
                          const double away[3], double distance, double lens) {
    const struct sim_eye *eye = &scene->eye;
    double centre = eye->apex - eye->radius, c[3];
    for (int k = 0; k < 3; ++k) c[k] = centre * axis[k] - point[k];
    double along = sim_dot(c, away);
    if (along <= 0) return 1;
    double miss2 = sim_dot(c, c) - along * along, miss = sqrt(miss2 > 0 ? miss2 : 0) - eye->radius;
    double spread = (lens + 0.3) * along / distance;
    return sim_step(miss / (2 * spread + 1e-9) + 0.5);
}

static void add_sclera(const struct sim_scene *scene, const double axes[9], double elevation_deg,
                       double opening, double *out) {
    const struct sim_eye *eye = &scene->eye;
    struct sim_lid lid;
    sim_lid_pose(&lid, &scene->person, elevation_deg, opening);
    double axis[3] = {axes[2], axes[5], axes[8]};
    double albedo = scene->person.albedo_sclera / PI;
    for (int i = 0; i < scene->gauss_nodes[0]; ++i) {
        double alpha = lid.half * scene->gauss[0][i], upper, lower;
        sim_lid_margins(&lid, alpha, &upper, &lower);
        if (upper <= lower) continue;
        double sa = sin(alpha), ca = cos(alpha);
        for (int j = 0; j < scene->gauss_nodes[1]; ++j) {
            double beta = (upper + lower) / 2 + (upper - lower) / 2 * scene->gauss[1][j];
            double sb = sin(beta), cb = cos(beta);
            struct sim_lid_point at = {.radial = {sa * cb, sb, -ca * cb}, .up = {-sa * sb, cb, ca * sb}};
            double d[3], rho_d;
            to_eye(axes, at.radial, d);
            double s = sqrt(d[0] * d[0] + d[1] * d[1]), rho = sim_eye_rho(eye, s, d[2], &rho_d);
            double white = d[2] > 0 ? sim_eye_whiteness(eye, rho * s) : 1;
            if (white == 0) continue;
            // Area vector rho (rho e_r - rho' e_theta) per unit solid angle.
            double cut = s > 1e-9 ? rho_d * d[2] / s : 0;
            double n_eye[3] = {rho * d[0] - cut * d[0], rho * d[1] - cut * d[1], rho * d[2] + rho_d * s},
                   normal[3];
            double length = sqrt(sim_dot(n_eye, n_eye));
            to_head(axes, n_eye, normal);
            double point[3], transfer[2 * SIM_MAX_PORTS], away[2 * SIM_MAX_PORTS][3];
            for (int k = 0; k < 3; ++k) {
                normal[k] /= length;
                point[k] = rho * at.radial[k];
            }
            sim_lid_measure(&lid, alpha, beta, rho, &at);
            int lit = 0;
            for (int k = 0; k < scene->n_sites; ++k) {
                double distance, t = sim_surface_transfer(&scene->sites[k], point, normal, away[k], &distance);
                if (t > 0) t *= sim_lid_open_toward(&lid, &at, away[k]);
                if (t > 0) t *= past_cornea(scene, point, axis, away[k], distance, scene->sites[k].radius);
                if (t > 0) t *= sim_face_eye_reach(&scene->face, k, alpha, beta);
                transfer[k] = t;
                lit |= t > 0;
            }
            if (!lit) continue;
            double sensor_part[SIM_MAX_PORTS], emitter_part[SIM_MAX_PORTS];
            sim_ports_at(scene, transfer, away, sensor_part, emitter_part);
            double weight = lid.half * scene->gauss[0][scene->gauss_nodes[0] + i] * (upper - lower) / 2 *
                            scene->gauss[1][scene->gauss_nodes[1] + j] * cb * rho * length;
            sim_add_pairs(scene, weight * albedo * white, sensor_part, emitter_part, out);
        }
    }
}

// One spot of the iris: light in and out through the cornea, for all lid poses.
static void add_iris_spot(const struct sim_scene *scene, const double axes[9], const double sites_eye[][3],
                          const double spot[3], double weight, const struct sim_lid *lids, int n_lids,
                          double *out) {
    int pairs = scene->n_sensors * scene->n_emitters;
    double transfer[2 * SIM_MAX_PORTS], away[2 * SIM_MAX_PORTS][3], alpha[2 * SIM_MAX_PORTS];
    double beta[2 * SIM_MAX_PORTS], rho[2 * SIM_MAX_PORTS];
    struct sim_lid_point at[2 * SIM_MAX_PORTS];
    for (int k = 0; k < scene->n_sites; ++k) {
        double exit[3], head[3], d[3];
        double t = sim_eye_refract(&scene->eye, sites_eye[k], spot, exit);
        if (t > 0) t *= 1 - sim_eye_whiteness(&scene->eye, sqrt(exit[0] * exit[0] + exit[1] * exit[1]));
        transfer[k] = t;
        if (t <= 0) continue;
        to_head(axes, exit, head);
        for (int i = 0; i < 3; ++i) d[i] = scene->sites[k].position[i] - head[i];
        double n = sqrt(sim_dot(d, d));
        for (int i = 0; i < 3; ++i) away[k][i] = d[i] / n;
        rho[k] = sim_lid_locate(head, &at[k], &alpha[k], &beta[k]);
        transfer[k] *= sim_face_eye_reach(&scene->face, k, alpha[k], beta[k]);
    }
    double sensor_all[SIM_MAX_PORTS], emitter_all[SIM_MAX_PORTS];
    sim_ports_at(scene, transfer, away, sensor_all, emitter_all);
    for (int l = 0; l < n_lids; ++l) {
        double open[2 * SIM_MAX_PORTS], sensor_part[SIM_MAX_PORTS], emitter_part[SIM_MAX_PORTS];
        for (int k = 0; k < scene->n_sites; ++k) {
            open[k] = 0;
            if (transfer[k] <= 0) continue;
            sim_lid_measure(&lids[l], alpha[k], beta[k], rho[k], &at[k]);
            open[k] = sim_lid_open_toward(&lids[l], &at[k], away[k]);
        }
        for (int s = 0; s < scene->n_sensors; ++s)
            sensor_part[s] = sensor_all[s] * open[scene->sensors[s].site];
        for (int e = 0; e < scene->n_emitters; ++e)
            emitter_part[e] = emitter_all[e] * open[scene->emitters[e].site];
        sim_add_pairs(scene, weight, sensor_part, emitter_part, out + l * pairs);
    }
}

// Rings between successive pupil edges and from the last to the limbus, summed from outside in: the iris of a
// small pupil is that of the next larger one plus a ring.
static int add_iris(const struct sim_scene *scene, const double axes[9], double elevation_deg,
                    const double *pupil_mm, int n_pupils, const double *lid_opening, int n_lids,
                    double *out) {
    const struct sim_eye *eye = &scene->eye;
    int around = (int)ceil(64 * scene->quality.iris);
    int block = n_lids * scene->n_sensors * scene->n_emitters;
    struct sim_lid lids[SIM_MAX_LIDS];
    double sites_eye[2 * SIM_MAX_PORTS][3], *ring = malloc((size_t)block * sizeof *ring);
    if (!ring) return -1;
    for (int l = 0; l < n_lids; ++l) sim_lid_pose(&lids[l], &scene->person, elevation_deg, lid_opening[l]);
    for (int k = 0; k < scene->n_sites; ++k) to_eye(axes, scene->sites[k].position, sites_eye[k]);
    double albedo = scene->person.albedo_iris / (PI * eye->index * eye->index);
    memset(ring, 0, (size_t)block * sizeof *ring);
    for (int p = n_pupils - 1; p >= 0; --p) {
        int last = p == n_pupils - 1, n = last ? scene->gauss_nodes[3] : scene->gauss_nodes[2];
        const double *gauss = scene->gauss[last ? 3 : 2];
        double from = pupil_mm[p] / 2, to = last ? eye->limbus : pupil_mm[p + 1] / 2;
        // The edge nodes are meant for the outermost 2 mm or so, where the cornea ends.
        int panels = (int)ceil((to - from) / 2);
        double half = (to - from) / (2 * panels);
        for (int i = 0; i < n * panels; ++i) {
            double r = from + half * (2 * (i / n) + 1 + gauss[i % n]);
            double weight = half * gauss[n + i % n] * r * 2 * PI / around * albedo;
            for (int j = 0; j < around; ++j) {
                double phi = 2 * PI * (j + 0.5) / around;
                double spot[3] = {r * cos(phi), r * sin(phi), eye->iris_z};
                add_iris_spot(scene, axes, (const double (*)[3])sites_eye, spot, weight, lids, n_lids, ring);
            }
        }
        for (int k = 0; k < block; ++k) out[(size_t)p * (size_t)block + (size_t)k] += ring[k];
    }
    free(ring);
    return 0;
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
    sim_eye_orient(&scene->eye, azimuth_deg, elevation_deg, axes);
    memset(out, 0, (size_t)n_pupils * block * sizeof *out);
    for (int l = 0; l < n_lids; ++l) {
        if (terms & SIM_TERM_FACE) sim_add_face(scene, elevation_deg, lid_opening[l], out + (size_t)l * pairs);
        if (terms & SIM_TERM_SCLERA)
            add_sclera(scene, axes, elevation_deg, lid_opening[l], out + (size_t)l * pairs);
    }
    for (int p = 1; p < n_pupils; ++p) memcpy(out + (size_t)p * block, out, block * sizeof *out);
    if (!(terms & SIM_TERM_IRIS)) return 0;
    return add_iris(scene, axes, elevation_deg, pupil_mm, n_pupils, lid_opening, n_lids, out);
}
