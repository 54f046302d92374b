// SPDX-License-Identifier: Apache-2.0
//
// The skin's term: the whole face with closed lids, less what an open eye takes the place of.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846

void sim_add_face(const struct sim_scene *scene, double elevation_deg, double opening, double *out) {
    int pairs = scene->n_sensors * scene->n_emitters;
    struct sim_lid lid;
    sim_lid_pose(&lid, &scene->person, elevation_deg, opening);
    for (int k = 0; k < pairs; ++k) out[k] += scene->face_all[k];
    for (int i = 0; i < scene->n_lid_spots; ++i) {
        const struct sim_spot *spot = &scene->face.spots[scene->lid_spots[i]];
        struct sim_lid_point at;
        sim_lid_measure(&lid, spot->alpha, spot->beta, spot->rho, &at);
        if (at.above <= 0 || at.below <= 0) continue;
        double open = sim_lid_open(&lid, &at);
        const double *part = scene->face_spots + (size_t)i * (size_t)(scene->n_sensors + scene->n_emitters);
        sim_add_pairs(scene, -open, part, part + scene->n_sensors, out);
    }
}

int sim_prepare_face(struct sim_scene *scene) {
    struct sim_face *face = &scene->face;
    size_t pairs = (size_t)(scene->n_sensors * scene->n_emitters);
    size_t ports = (size_t)(scene->n_sensors + scene->n_emitters);
    for (int i = 0; i < face->n_spots; ++i) scene->n_lid_spots += face->spots[i].lid;
    scene->face_all = calloc(pairs, sizeof(double));
    scene->face_spots = calloc(ports * (size_t)scene->n_lid_spots + 1, sizeof(double));
    scene->lid_spots = calloc((size_t)scene->n_lid_spots + 1, sizeof(int));
    if (!scene->face_all || !scene->face_spots || !scene->lid_spots) return -1;
    double albedo = scene->person.albedo_skin / PI;
    for (int i = 0, lid = 0; i < face->n_spots; ++i) {
        const struct sim_spot *spot = &face->spots[i];
        double transfer[2 * SIM_MAX_PORTS], away[2 * SIM_MAX_PORTS][3], normal[3], distance;
        double area = sqrt(sim_dot(spot->area, spot->area)), sensor_part[SIM_MAX_PORTS],
               emitter_part[SIM_MAX_PORTS];
        for (int k = 0; k < 3; ++k) normal[k] = spot->area[k] / area;
        for (int k = 0; k < scene->n_sites; ++k) {
            transfer[k] = sim_surface_transfer(&scene->sites[k], spot->position, normal, away[k], &distance);
            transfer[k] *= face->reach[i * face->n_sites + k];
        }
        sim_ports_at(scene, transfer, away, sensor_part, emitter_part);
        sim_add_pairs(scene, albedo * area, sensor_part, emitter_part, scene->face_all);
        if (!spot->lid) continue;
        double *keep = scene->face_spots + (size_t)lid * ports;
        for (int k = 0; k < scene->n_sensors; ++k) keep[k] = albedo * area * sensor_part[k];
        memcpy(keep + scene->n_sensors, emitter_part, (size_t)scene->n_emitters * sizeof *keep);
        scene->lid_spots[lid++] = i;
    }
    return 0;
}
