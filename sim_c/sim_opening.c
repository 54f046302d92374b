// SPDX-License-Identifier: Apache-2.0
//
// What open lids cut out of the skin's light: the integral of light times the lids' mask, for any pose.
//
// Light is smooth and known at spots that stay; the mask has edges a fraction of a millimetre wide, and
// moves. Along x the midpoint rule serves: margins run across the columns, and after integration over y
// nothing sharp is left. Along y the mask is sampled SIM_SUB times per spot where it is neither 0 nor 1,
// and each sample's weight is spread over the six spots about it as interpolation (Lagrange, degree 5) of
// the light wants.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846
enum { SIDE = 3, REACH = 2 * SIDE, MOST_ROWS = 3200 };
static const double NO_LID = 1e3;

// Lagrange weights of spots -2..3 at points (k + 1/2) / SIM_SUB after spot 0.
static void spread_weights(double w[SIM_SUB][REACH]) {
    for (int k = 0; k < SIM_SUB; ++k)
        for (int i = 0; i < REACH; ++i) {
            double t = (k + 0.5) / SIM_SUB, product = 1;
            for (int j = 0; j < REACH; ++j)
                if (j != i) product *= (t - (j - SIDE + 1)) / (double)(i - j);
            w[k][i] = product / SIM_SUB;
        }
}

// 0 above the opening, 2 below it, 1 within; the mask there.
static int mask_at(const struct sim_lid *lid, const struct sim_lid_spot *spot, double *open) {
    double upper, lower;
    struct sim_lid_point at;
    *open = 0;
    sim_lid_margins(lid, spot->alpha, &upper, &lower);
    if (spot->beta >= upper) return 0;
    if (spot->beta <= lower) return 2;
    sim_lid_measure(lid, spot->alpha, spot->beta, spot->rho, &at);
    *open = spot->on_lids * sim_lid_open(lid, &at);
    return 1;
}

void sim_cut_opening(const struct sim_scene *scene, const struct sim_lid *lid, double *out) {
    int ports = scene->n_sensors + scene->n_emitters;
    double spread[SIM_SUB][REACH], whole[REACH] = {0}, weight[MOST_ROWS + 2 * SIDE];
    spread_weights(spread);
    for (int k = 0; k < SIM_SUB; ++k)
        for (int i = 0; i < REACH; ++i) whole[i] += spread[k][i];
    for (int c = 0; c < scene->n_lid_columns; ++c) {
        const struct sim_lid_column *here = &scene->lid_columns[c];
        const struct sim_lid_spot *spot = scene->lid_spots + (size_t)here->first * (1 + SIM_SUB);
        int side = 0, from = here->n, to = 0;
        double open = 0;
        for (int j = SIDE - 1; j < here->n - SIDE; ++j) {
            int before = side;
            double was = open;
            const struct sim_lid_spot *next = spot + (size_t)(j + 1) * (1 + SIM_SUB);
            if (j == SIDE - 1) before = mask_at(lid, next - 1 - SIM_SUB, &was);
            side = mask_at(lid, next, &open);
            if (side == before && side != 1) continue;
            if (from == here->n) {
                from = j - SIDE + 1;
                memset(weight, 0, (size_t)here->n * sizeof *weight);
            }
            to = j + SIDE + 1;
            double *w = weight + j - SIDE + 1;
            if (was == 1 && open == 1) {
                for (int i = 0; i < REACH; ++i) w[i] += whole[i];
                continue;
            }
            for (int k = 0; k < SIM_SUB; ++k) {
                double part;
                if (mask_at(lid, next - SIM_SUB + k, &part) != 1) continue;
                for (int i = 0; i < REACH; ++i) w[i] += part * spread[k][i];
            }
        }
        const double *part = scene->face_spots + (size_t)(here->first + from) * (size_t)ports;
        for (int j = from; j < to; ++j, part += ports)
            sim_add_pairs(scene, -weight[j], part, part + scene->n_sensors, out);
    }
}

// Spacing of the spots: a fraction of the narrowest spot of light on the lids, and such that the mask is
// sampled often enough for the margins' softness.
static double lid_step(const struct sim_scene *scene) {
    double step = fmin(0.4, 0.5 * scene->person.lid_softness_mm);
    for (int p = 0; p < scene->n_sensors + scene->n_emitters; ++p) {
        const struct sim_window *w =
            p < scene->n_sensors ? &scene->sensors[p] : &scene->emitters[p - scene->n_sensors];
        const double *at = scene->sites[w->site].position;
        double near = sqrt(sim_dot(at, at)) - scene->person.lid_radius_mm;
        step = fmin(step, 0.5 * fmax(near, 0.2) / sqrt(2 * w->per_tan2));
    }
    return fmax(fmax(step, 0.08) / scene->quality.face, (SIM_SKIN_X_TO - SIM_SKIN_X_FROM) / MOST_ROWS);
}

// A point of the skin as the lids see it.
static struct sim_lid_spot seen_at(const struct sim_scene *scene, double x, double y) {
    struct sim_lid_spot seen = {0, NO_LID, 1, 0};
    struct sim_lid_point point;
    double head[3] = {x, y, -sim_relief_height(&scene->face.relief, x, y)};
    if (head[2] >= -1 || y <= SIM_SKIN_Y_FROM || y >= SIM_SKIN_Y_TO) return seen;
    seen.rho = sim_lid_locate(head, &point, &seen.alpha, &seen.beta);
    double canthus = (scene->person.canthus_deg + 4) * SIM_RADIANS;
    seen.on_lids = sim_relief_on_lids(&scene->face.relief, seen.rho);
    if (fabs(seen.alpha) >= canthus || fabs(seen.beta) >= 65 * SIM_RADIANS || seen.on_lids == 0)
        seen.beta = NO_LID;
    return seen;
}

static int grow(struct sim_scene *scene, int *room) {
    size_t n = *room ? 2 * (size_t)*room : 1024, ports = (size_t)(scene->n_sensors + scene->n_emitters);
    void *spots = realloc(scene->lid_spots, n * (1 + SIM_SUB) * sizeof *scene->lid_spots);
    if (spots) scene->lid_spots = spots;
    void *parts = realloc(scene->face_spots, n * ports * sizeof(double));
    if (parts) scene->face_spots = parts;
    *room = (int)n;
    return spots && parts ? 0 : -1;
}

// Spots at one step. *narrow: whether a shadow crosses one whose edge such a step may pass over.
static int keep_columns(struct sim_scene *scene, double wanted, double dark, int *narrow) {
    double side = SIM_SKIN_X_TO - SIM_SKIN_X_FROM;  // and SIM_SKIN_Y_TO - SIM_SKIN_Y_FROM: the skin is square
    int n = (int)ceil(side / wanted), rows = n + 2 * SIDE, room = scene->n_lid_spots;
    double step = side / n, area = step * step;
    size_t ports = (size_t)(scene->n_sensors + scene->n_emitters);
    struct sim_lid_column *columns = realloc(scene->lid_columns, (size_t)n * sizeof *columns);
    double *parts = malloc((size_t)rows * ports * sizeof *parts);
    if (columns) scene->lid_columns = columns;
    scene->n_lid_columns = scene->n_lid_spots = *narrow = 0;
    scene->skin_facts.lid_step_mm = step;
    int failed = !columns || !parts;
    for (int i = 0; i < n && !failed; ++i) {
        double x = SIM_SKIN_X_FROM + (i + 0.5) * step;
        int first = rows, last = -1;
        for (int j = 0; j < rows; ++j) {
            struct sim_skin_spot spot;
            double y = SIM_SKIN_Y_FROM + (j - SIDE + 0.5) * step;
            double bright = area * sim_skin_at(scene, x, y, dark / area, &spot);
            double *part = parts + (size_t)j * ports;
            double weight = area * spot.stretch * scene->person.albedo_skin / PI;
            for (int s = 0; s < scene->n_sensors; ++s) part[s] = weight * spot.sensor_part[s];
            memcpy(part + scene->n_sensors, spot.emitter_part, (size_t)scene->n_emitters * sizeof *part);
            if (j < SIDE || j >= rows - SIDE || bright <= dark) continue;
            if (seen_at(scene, x, y).beta == NO_LID) continue;
            if (first == rows) first = j;
            last = j;
            *narrow |= spot.penumbra;
        }
        if (last < 0) continue;
        struct sim_lid_column *column = &scene->lid_columns[scene->n_lid_columns++];
        column->first = scene->n_lid_spots;
        column->n = last - first + 1 + 2 * SIDE;
        while (room < column->first + column->n && !failed) failed = grow(scene, &room);
        if (failed) break;
        memcpy(scene->face_spots + (size_t)column->first * ports, parts + (size_t)(first - SIDE) * ports,
               (size_t)column->n * ports * sizeof *parts);
        struct sim_lid_spot *spot = scene->lid_spots + (size_t)column->first * (1 + SIM_SUB);
        for (int j = 0; j < column->n; ++j) {
            double y = SIM_SKIN_Y_FROM + (first - SIDE + j - SIDE + 0.5) * step;
            *spot++ = seen_at(scene, x, y);
            for (int k = 0; k < SIM_SUB; ++k) *spot++ = seen_at(scene, x, y + (k + 0.5) / SIM_SUB * step);
        }
        scene->n_lid_spots += column->n;
    }
    free(parts);
    scene->skin_facts.lid_spots = scene->n_lid_spots;
    return failed ? -1 : 0;
}

int sim_keep_opening(struct sim_scene *scene, double dark) {
    double step = lid_step(scene);
    int narrow;
    if (keep_columns(scene, step, dark, &narrow)) return -1;
    double side = SIM_SKIN_X_TO - SIM_SKIN_X_FROM;
    double least = side * sqrt(scene->n_sites / (2 * SIM_MOST_VIEWS)) / fmax(scene->quality.face, 1);
    double finer = fmax(fmax(0.4 * step, least), side / MOST_ROWS);
    return narrow && finer < step ? keep_columns(scene, finer, dark, &narrow) : 0;
}
