// SPDX-License-Identifier: Apache-2.0
#include "sim_image_face.h"

#include <embree3/rtcore.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sim_face.h"

static const double X_FROM = -34, X_TO = 30, Y_FROM = -32, Y_TO = 32, MESH_STEP = 0.25;
// Between its corners a triangle lies behind the face by up to 1.2e-3 mm, and a ray that grazes the face
// would pass: so the mesh stands this far before it. settle() knows better.
static const double MESH_FORWARD = 2e-3;
// The height field in a table, for horizons: between its nodes a parabola's error is 1e-3 mm at most.
enum { TABLE_NODES = 1281 };
static const double TABLE_FROM = -64, TABLE_STEP = 0.1;

struct sim_image_face {
    struct sim_person person;
    int relief_only;
    RTCDevice device;
    RTCScene scene;
    float *table;
};

static double height_of(const struct sim_person *person, int relief_only, double x, double y) {
    if (!relief_only) return sim_face_height(person, x, y);
    double brow = person->brow_mm * exp(-(y - 21) * (y - 21) / (2 * 7.0 * 7.0));
    double cheek = person->cheek_mm * exp(-(y + 24) * (y + 24) / (2 * 8.0 * 8.0));
    double nose = person->nose_mm * sim_step((-x - 13) / 18) * (1 - 0.3 * sim_step((y + 2) / 20));
    return 4 + brow + cheek + nose - 8 * sim_step((x - 12) / 20);
}

static double table_height(const struct sim_image_face *face, double x, double y) {
    double at[2] = {(x - TABLE_FROM) / TABLE_STEP, (y - TABLE_FROM) / TABLE_STEP};
    int cell[2];
    for (int k = 0; k < 2; ++k) {
        if (!(at[k] >= 0 && at[k] < TABLE_NODES - 1))
            return height_of(&face->person, face->relief_only, x, y);
        cell[k] = (int)at[k];
        at[k] -= cell[k];
    }
    const float *low = face->table + (size_t)cell[1] * TABLE_NODES + cell[0], *high = low + TABLE_NODES;
    return (1 - at[1]) * ((1 - at[0]) * low[0] + at[0] * low[1]) +
           at[1] * ((1 - at[0]) * high[0] + at[0] * high[1]);
}

static RTCScene mesh_of(RTCDevice device, const struct sim_person *person, int relief_only) {
    int nx = (int)ceil((X_TO - X_FROM) / MESH_STEP) + 1, ny = (int)ceil((Y_TO - Y_FROM) / MESH_STEP) + 1;
    RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    float *vertex = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                            3 * sizeof(float), (size_t)(nx * ny));
    unsigned *index = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                              3 * sizeof(unsigned), (size_t)(2 * (nx - 1) * (ny - 1)));
    if (!vertex || !index) {
        rtcReleaseGeometry(geometry);
        return NULL;
    }
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i) {
            double x = X_FROM + i * MESH_STEP, y = Y_FROM + j * MESH_STEP;
            float *v = vertex + 3 * (j * nx + i);
            v[0] = (float)x;
            v[1] = (float)y;
            v[2] = (float)-(height_of(person, relief_only, x, y) + MESH_FORWARD);
        }
    for (int j = 0; j + 1 < ny; ++j)
        for (int i = 0; i + 1 < nx; ++i) {
            unsigned a = (unsigned)(j * nx + i), b = a + (unsigned)nx;
            unsigned quad[6] = {a, a + 1, b, b, a + 1, b + 1};
            memcpy(index + 6 * (j * (nx - 1) + i), quad, sizeof quad);
        }
    rtcCommitGeometry(geometry);
    RTCScene scene = rtcNewScene(device);
    rtcSetSceneFlags(scene, RTC_SCENE_FLAG_ROBUST);
    rtcAttachGeometry(scene, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene);
    return scene;
}

struct sim_image_face *sim_image_face_open(const struct sim_person *person, int relief_only, char *error,
                                           size_t error_bytes) {
    struct sim_image_face *face = calloc(1, sizeof *face);
    if (face) {
        face->person = *person;
        face->relief_only = relief_only;
        face->table = malloc((size_t)TABLE_NODES * TABLE_NODES * sizeof *face->table);
        face->device = rtcNewDevice("threads=1");
        if (face->device) face->scene = mesh_of(face->device, person, relief_only);
    }
    if (!face || !face->table || !face->scene) {
        if (error) snprintf(error, error_bytes, "out of memory, or Embree does not start");
        sim_image_face_close(face);
        return NULL;
    }
    for (int j = 0; j < TABLE_NODES; ++j)
        for (int i = 0; i < TABLE_NODES; ++i)
            face->table[j * TABLE_NODES + i] = (float)height_of(
                person, relief_only, TABLE_FROM + i * TABLE_STEP, TABLE_FROM + j * TABLE_STEP);
    return face;
}

void sim_image_face_close(struct sim_image_face *face) {
    if (!face) return;
    if (face->scene) rtcReleaseScene(face->scene);
    if (face->device) rtcReleaseDevice(face->device);
    free(face->table);
    free(face);
}

static void slopes(const struct sim_image_face *face, double x, double y, double *wx, double *wy) {
    const struct sim_person *p = &face->person;
    double e = 1e-3;
    *wx = (height_of(p, face->relief_only, x + e, y) - height_of(p, face->relief_only, x - e, y)) / (2 * e);
    *wy = (height_of(p, face->relief_only, x, y + e) - height_of(p, face->relief_only, x, y - e)) / (2 * e);
}

static double gap_at(const struct sim_image_face *face, const double from[3], const double direction[3],
                     double t) {
    return -(from[2] + t * direction[2]) - height_of(&face->person, face->relief_only,
                                                     from[0] + t * direction[0], from[1] + t * direction[1]);
}

// From a triangle, at *t, onto the height field that it stands for. Returns 0 when the ray passes over it.
static int settle(const struct sim_image_face *face, const double from[3], const double direction[3],
                  double *t) {
    double a = *t, ga = gap_at(face, from, direction, a), b = a, gb = ga, step = 0.01;
    while (ga <= 0 && step < 1) b = a, gb = ga, a -= step, ga = gap_at(face, from, direction, a), step *= 1.5;
    while (gb > 0 && step < 1) a = b, ga = gb, b += step, gb = gap_at(face, from, direction, b), step *= 1.5;
    if (ga <= 0 || gb > 0) return 0;
    for (int i = 0; i < 60; ++i) {  // regula falsi (Illinois)
        *t = a + (b - a) * ga / (ga - gb);
        double g = gap_at(face, from, direction, *t);
        if (fabs(g) < 1e-12) break;
        if (g <= 0) b = *t, gb = g, ga /= 2;
        else a = *t, ga = g, gb /= 2;
    }
    return 1;
}

int sim_image_face_hit(const struct sim_image_face *face, const double from[3], const double direction[3],
                       double t_from, struct sim_image_hit *hit) {
    struct RTCIntersectContext context;
    struct RTCRayHit query;
    for (;;) {
        rtcInitIntersectContext(&context);
        memset(&query, 0, sizeof query);
        query.ray.org_x = (float)from[0];
        query.ray.org_y = (float)from[1];
        query.ray.org_z = (float)from[2];
        query.ray.dir_x = (float)direction[0];
        query.ray.dir_y = (float)direction[1];
        query.ray.dir_z = (float)direction[2];
        query.ray.tnear = (float)t_from;
        query.ray.tfar = INFINITY;
        query.ray.mask = ~0u;
        query.hit.geomID = RTC_INVALID_GEOMETRY_ID;
        rtcIntersect1(face->scene, &context, &query);
        if (query.hit.geomID == RTC_INVALID_GEOMETRY_ID) return 0;
        double t = query.ray.tfar, wx, wy, *n = hit->normal;
        t_from = t + 1e-3;
        // The ray leaves the face where it meets a triangle from below.
        const double side[3] = {query.hit.Ng_x, query.hit.Ng_y, query.hit.Ng_z};
        if (sim_dot(side, direction) * side[2] <= 0 || !settle(face, from, direction, &t)) continue;
        for (int k = 0; k < 3; ++k) hit->point[k] = from[k] + t * direction[k];
        slopes(face, hit->point[0], hit->point[1], &wx, &wy);
        double length = sqrt(1 + wx * wx + wy * wy);
        n[0] = -wx / length;
        n[1] = -wy / length;
        n[2] = -1 / length;
        if (sim_dot(n, direction) >= 0) continue;
        hit->beyond = t_from > t ? t_from : t + 1e-3;
        return 1;
    }
}

int sim_image_face_blocked(const struct sim_image_face *face, const double from[3], const double to[3]) {
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    struct RTCRay ray;
    memset(&ray, 0, sizeof ray);
    ray.org_x = (float)from[0];
    ray.org_y = (float)from[1];
    ray.org_z = (float)from[2];
    ray.dir_x = (float)(to[0] - from[0]);
    ray.dir_y = (float)(to[1] - from[1]);
    ray.dir_z = (float)(to[2] - from[2]);
    ray.tfar = 1.0f;
    ray.mask = ~0u;
    rtcOccluded1(face->scene, &context, &ray);
    return ray.tfar < 0;
}

// Height of the way to the site over the face, per part of the way.
static double rise(const struct sim_image_face *face, const double p[3], const double d[3], double u,
                   int exact) {
    double x = p[0] + u * d[0], y = p[1] + u * d[1];
    double w = exact ? height_of(&face->person, face->relief_only, x, y) : table_height(face, x, y);
    return (-p[2] - u * d[2] - w) / u;
}

double sim_image_face_share(const struct sim_image_face *face, const struct sim_image_hit *at,
                            const double site[3], double radius) {
    double r = radius > 0.25 ? radius : 0.25, d[3];
    for (int k = 0; k < 3; ++k) d[k] = site[k] - at->point[k];
    double start = sim_dot(at->normal, d) / -at->normal[2];  // limit of the rise at the place itself
    if (start <= -r) return 1;
    double least = start, best = 0, travel = sqrt(d[0] * d[0] + d[1] * d[1]);
    int n = (int)ceil(travel / 0.75);
    if (n < 16) n = 16;
    if (n > 1000) n = 1000;
    for (int i = 1; i <= n; ++i) {
        double h = rise(face, at->point, d, (double)i / n, 0);
        if (h < least) least = h, best = (double)i / n;
    }
    if (fabs(least) < 1.5 * r) {  // golden section about the least
        double from = best - 1.0 / n, to = best + 1.0 / n;
        if (from < 1e-6) from = 1e-6;
        if (to > 1) to = 1;
        double golden = 0.6180339887498949, a = to - golden * (to - from), b = from + golden * (to - from);
        double fa = rise(face, at->point, d, a, 1), fb = rise(face, at->point, d, b, 1);
        for (int i = 0; i < 18; ++i) {
            if (fa < fb) {
                to = b, b = a, fb = fa, a = to - golden * (to - from);
                fa = rise(face, at->point, d, a, 1);
            } else {
                from = a, a = b, fa = fb, b = from + golden * (to - from);
                fb = rise(face, at->point, d, b, 1);
            }
        }
        least = fa < fb ? fa : fb;
        if (start < least) least = start;
    }
    return sim_step(0.5 + least / (2 * r)) / sim_step(0.5 + start / (2 * r));
}
