// SPDX-License-Identifier: Apache-2.0
#include "sim_face.h"

#include <embree3/rtcore.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PI 3.14159265358979323846
enum { DISC_RAYS = 37 };

static const double X_FROM = -34, X_TO = 30, Y_FROM = -32, Y_TO = 32;
static const double VIEW_ALPHA = 80 * PI / 180, VIEW_BETA = 65 * PI / 180;

static double smooth_max(double a, double b, double k) {
    double h = 1 - fabs(a - b) / k, m = a > b ? a : b;
    return h > 0 ? m + h * h * h * k / 6 : m;
}

double sim_face_height(const struct sim_person *person, double x, double y) {
    double big = person->lid_radius_mm, r = sqrt(x * x + y * y), edge = 0.9 * big, cap;
    if (r < edge) cap = sqrt(big * big - r * r);
    else cap = sqrt(big * big - edge * edge) - (r - edge) * edge / sqrt(big * big - edge * edge);
    double brow = person->brow_mm * exp(-(y - 21) * (y - 21) / (2 * 7.0 * 7.0));
    double cheek = person->cheek_mm * exp(-(y + 24) * (y + 24) / (2 * 8.0 * 8.0));
    double nose = person->nose_mm * sim_step((-x - 13) / 18) * (1 - 0.3 * sim_step((y + 2) / 20));
    double temple = -8 * sim_step((x - 12) / 20);
    return smooth_max(cap, 4 + brow + cheek + nose + temple, 3);
}

static void spot_at(struct sim_spot *s, const struct sim_person *person, double x, double y, double step) {
    double e = 0.02, w = sim_face_height(person, x, y);
    double wx = (sim_face_height(person, x + e, y) - sim_face_height(person, x - e, y)) / (2 * e);
    double wy = (sim_face_height(person, x, y + e) - sim_face_height(person, x, y - e)) / (2 * e);
    struct sim_lid_point point;
    s->position[0] = x;
    s->position[1] = y;
    s->position[2] = -w;
    s->area[0] = -wx * step * step;
    s->area[1] = -wy * step * step;
    s->area[2] = -step * step;
    s->rho = sim_lid_locate(s->position, &point, &s->alpha, &s->beta);
    double canthus = (person->canthus_deg + 4) * PI / 180;
    s->lid = fabs(s->alpha) < canthus && fabs(s->beta) < 65 * PI / 180 && w > 1;
}

static int count_steps(double from, double to, double step) {
    return (int)ceil((to - from) / step);
}

static RTCScene mesh_of(RTCDevice device, const struct sim_person *person, double step) {
    int nx = count_steps(X_FROM, X_TO, step) + 1, ny = count_steps(Y_FROM, Y_TO, step) + 1;
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
            double x = X_FROM + i * step, y = Y_FROM + j * step;
            float *v = vertex + 3 * (j * nx + i);
            v[0] = (float)x;
            v[1] = (float)y;
            v[2] = (float)-sim_face_height(person, x, y);
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

static int blocked(RTCScene scene, const double from[3], const double to[3]) {
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
    ray.tnear = 0.0f;
    ray.tfar = 1.0f;
    ray.mask = ~0u;
    rtcOccluded1(scene, &context, &ray);
    return ray.tfar < 0;
}

// Share of a spot's area that sees a site, of its four quarters: shadows' edges fall between spots less
// roughly.
static float spot_share(RTCScene scene, const struct sim_spot *spot, const double site[3], double step) {
    double toward[3], length = sqrt(sim_dot(spot->area, spot->area)), from[3];
    for (int k = 0; k < 3; ++k) toward[k] = site[k] - spot->position[k];
    if (sim_dot(toward, spot->area) <= 0) return 1;  // sets behind the spot's own horizon: its cosine says so
    int seen = 0;
    for (int i = 0; i < 4; ++i) {
        double dx = (i & 1 ? 0.25 : -0.25) * step, dy = (i & 2 ? 0.25 : -0.25) * step;
        from[0] = spot->position[0] + dx;
        from[1] = spot->position[1] + dy;
        from[2] = spot->position[2] - (spot->area[0] * dx + spot->area[1] * dy) / spot->area[2];
        for (int k = 0; k < 3; ++k) from[k] += 0.05 * spot->area[k] / length;
        seen += !blocked(scene, from, site);
    }
    return (float)seen / 4;
}

// Share of the lens at a site seen from a point, over rings of a disc that faces the point.
static double lens_share(RTCScene scene, const double from[3], const double site[3], double radius) {
    double d[3] = {site[0] - from[0], site[1] - from[1], site[2] - from[2]}, n = sqrt(sim_dot(d, d));
    double flat = sqrt(d[0] * d[0] + d[2] * d[2]) + 1e-12;
    double u[3] = {d[2] / flat, 0, -d[0] / flat}, v[3];
    for (int k = 0; k < 3; ++k) d[k] /= n;
    v[0] = d[1] * u[2] - d[2] * u[1];
    v[1] = d[2] * u[0] - d[0] * u[2];
    v[2] = d[0] * u[1] - d[1] * u[0];
    int open = 0;
    for (int i = 0; i < DISC_RAYS; ++i) {  // sunflower: even over the disc
        double r = radius * sqrt((i + 0.5) / DISC_RAYS), a = i * 2.39996322972865332;
        double to[3];
        for (int k = 0; k < 3; ++k) to[k] = site[k] + r * (cos(a) * u[k] + sin(a) * v[k]);
        open += !blocked(scene, from, to);
    }
    return (double)open / DISC_RAYS;
}

// The eye itself lies behind the closed-lid surface, so rays to it start just outside the lids.
static void view_eye(struct sim_face *face, const struct sim_person *person, RTCScene scene,
                     const double (*sites)[3], const double *radius_mm) {
    for (int s = 0; s < face->n_sites; ++s) {
        float *share = face->eye_reach + (size_t)s * SIM_VIEW_NODES * SIM_VIEW_NODES;
        face->eye_clear[s] = 1;
        for (int j = 0; j < SIM_VIEW_NODES; ++j)
            for (int i = 0; i < SIM_VIEW_NODES; ++i) {
                double a = VIEW_ALPHA * (2.0 * i / (SIM_VIEW_NODES - 1) - 1);
                double b = VIEW_BETA * (2.0 * j / (SIM_VIEW_NODES - 1) - 1), rho = person->lid_radius_mm;
                double from[3] = {rho * sin(a) * cos(b), rho * sin(b), -rho * cos(a) * cos(b)};
                double surface = sim_face_height(person, from[0], from[1]);
                if (-from[2] < surface) from[2] = -surface;
                from[2] -= 0.05;
                int faces_it = sim_dot(from, sites[s]) > rho * rho;
                double open = lens_share(scene, from, sites[s], radius_mm[s] > 0.5 ? radius_mm[s] : 0.5);
                share[j * SIM_VIEW_NODES + i] = (float)(faces_it ? open : 1);
                if (faces_it && open < 1) face->eye_clear[s] = 0;
            }
    }
}

int sim_face_open(struct sim_face *face, const struct sim_person *person, const double (*sites)[3],
                  const double *radius_mm, int n_sites, double step_mm, char *error, size_t error_bytes) {
    memset(face, 0, sizeof *face);
    int nx = count_steps(X_FROM, X_TO, step_mm), ny = count_steps(Y_FROM, Y_TO, step_mm);
    face->n_spots = nx * ny;
    face->n_sites = n_sites;
    face->spots = calloc((size_t)face->n_spots, sizeof *face->spots);
    face->reach = calloc((size_t)face->n_spots * (size_t)n_sites, sizeof *face->reach);
    face->eye_reach = calloc((size_t)n_sites * SIM_VIEW_NODES * SIM_VIEW_NODES, sizeof *face->eye_reach);
    face->eye_clear = calloc((size_t)n_sites, sizeof *face->eye_clear);
    RTCDevice device = rtcNewDevice("threads=1");
    if (!device || !face->spots || !face->reach || !face->eye_reach || !face->eye_clear) {
        if (error) snprintf(error, error_bytes, "%s", device ? "out of memory" : "Embree does not start");
        if (device) rtcReleaseDevice(device);
        return -1;
    }
    RTCScene scene = mesh_of(device, person, 0.5);
    if (!scene) {
        if (error) snprintf(error, error_bytes, "out of memory");
        rtcReleaseDevice(device);
        return -1;
    }
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i) {
            struct sim_spot *s = &face->spots[j * nx + i];
            spot_at(s, person, X_FROM + (i + 0.5) * step_mm, Y_FROM + (j + 0.5) * step_mm, step_mm);
            for (int k = 0; k < n_sites; ++k)
                face->reach[(j * nx + i) * n_sites + k] = spot_share(scene, s, sites[k], step_mm);
        }
    view_eye(face, person, scene, sites, radius_mm);
    rtcReleaseScene(scene);
    rtcReleaseDevice(device);
    return 0;
}

void sim_face_close(struct sim_face *face) {
    free(face->spots);
    free(face->reach);
    free(face->eye_reach);
    free(face->eye_clear);
    memset(face, 0, sizeof *face);
}

double sim_face_eye_reach(const struct sim_face *face, int site, double alpha, double beta) {
    if (face->eye_clear[site]) return 1;
    const float *c = face->eye_reach + (size_t)site * SIM_VIEW_NODES * SIM_VIEW_NODES;
    double at[2] = {(beta / VIEW_BETA + 1) / 2 * (SIM_VIEW_NODES - 1),
                    (alpha / VIEW_ALPHA + 1) / 2 * (SIM_VIEW_NODES - 1)};
    double w[2][4];
    int first[2];
    for (int g = 0; g < 2; ++g) {
        if (at[g] < 1) at[g] = 1;
        if (at[g] > SIM_VIEW_NODES - 2.001) at[g] = SIM_VIEW_NODES - 2.001;
        int i = (int)at[g];
        double t = at[g] - i, s = 1 - t;
        first[g] = i - 1;
        w[g][0] = s * s * s / 6;
        w[g][1] = (4 - 6 * t * t + 3 * t * t * t) / 6;
        w[g][2] = (4 - 6 * s * s + 3 * s * s * s) / 6;
        w[g][3] = t * t * t / 6;
    }
    double sum = 0;
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i)
            sum += w[0][j] * w[1][i] * c[(first[0] + j) * SIM_VIEW_NODES + first[1] + i];
    return sum;
}
