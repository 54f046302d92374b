// SPDX-License-Identifier: Apache-2.0
//
// Fermat's path from a site through the cornea to a spot of the iris. Over the visible side of the cornea its
// length has one minimum, or none where the spot is out of reach; for a site beside the eye there is a saddle
// next to it (the longer path behind the caustic), and beyond the cornea's horizon a minimum that is no path.
// Newton's steps may slip over either. Whoever follows the minimum from refractive index 1, where it is the
// straight line, up to the eye's, and stays where the second derivatives are positive, cannot.
#include "sim_cornea.h"

#include "sim_path.h"

static const double SETTLED_MM = 1e-6;
// Determinants at the horizon below which rays fold, or nearly do: the light then rises within 0.1 mm.
static const double FOLDED = 0.002, NEARLY = 0.01;

// The furthest from the axis that a crossing is looked for, squared.
static double furthest2(const struct sim_eye *eye) {
    return 0.95 * eye->radius * eye->radius / (eye->p > 0.1 ? eye->p : 0.1);
}

// How far a path's place is from the cornea's horizon: cosine of incidence times the normal's length.
SIM_INLINE double facing(const struct sim_path *t) {
    return t->zx * t->ux + t->zy * t->uy - t->uz;
}

// Newton's steps to the minimum, as long as they stay on its side of saddle and horizon and get shorter.
static int settle(const struct sim_eye *eye, const double site[3], const double spot[3], double index,
                  double at[2], struct sim_path *t) {
    double last = 1.5, far2 = furthest2(eye);
    for (int i = 0; i < 40; ++i) {
        if (!(at[0] * at[0] + at[1] * at[1] < far2)) return 0;
        *t = sim_path_measure(eye, site, spot[0], spot[1], at[0], at[1], index);
        double det = t->hxx * t->hyy - t->hxy * t->hxy;
        if (!(det > 0 && t->hxx > 0 && facing(t) > 0)) return 0;
        double dx = (t->hxy * t->gy - t->hyy * t->gx) / det, dy = (t->hxy * t->gx - t->hxx * t->gy) / det;
        double step = sqrt(dx * dx + dy * dy);
        if (step < 1e-9) return 1;
        if (!(step < last)) return step < 1e-7;
        last = step;
        at[0] += dx;
        at[1] += dy;
    }
    return 0;
}

// The minimum, from the straight line's crossing upward in refractive index.
static int follow(const struct sim_eye *eye, const double site[3], const double spot[3], double at[2],
                  struct sim_path *t) {
    // spot + along * d on the conic r^2 + p s^2 = 2 R s, s the depth behind the apex: a l^2 + 2 b l = c.
    double d[3] = {site[0] - spot[0], site[1] - spot[1], site[2] - spot[2]}, s = eye->apex - spot[2];
    double a = d[0] * d[0] + d[1] * d[1] + eye->p * d[2] * d[2];
    double b = spot[0] * d[0] + spot[1] * d[1] + (eye->radius - eye->p * s) * d[2];
    double c = 2 * eye->radius * s - eye->p * s * s - spot[0] * spot[0] - spot[1] * spot[1];
    if (!(c > 0)) return 0;
    double root = sqrt(b * b + a * c), along = b > 0 ? c / (b + root) : (root - b) / a;
    at[0] = spot[0] + along * d[0];
    at[1] = spot[1] + along * d[1];
    double index = 1, rise = eye->index - 1, least = 0.01 * rise;
    if (!settle(eye, site, spot, index, at, t)) return 0;
    while (index < eye->index && rise > least) {
        // The minimum moves by -1/H times what the longer second leg adds to the slope.
        double vx = t->vx + t->vz * t->zx, vy = t->vy + t->vz * t->zy, to = fmin(index + rise, eye->index);
        double per_det = (to - index) / (t->hxx * t->hyy - t->hxy * t->hxy);
        double next[2] = {at[0] + (t->hxy * vy - t->hyy * vx) * per_det,
                          at[1] + (t->hxy * vx - t->hxx * vy) * per_det};
        struct sim_path there;
        if (!settle(eye, site, spot, to, next, &there)) {
            rise /= 2;
            continue;
        }
        memcpy(at, next, sizeof next);
        *t = there;
        index = to;
    }
    return index >= eye->index;
}

// A first guess: the straight way, bent as the cornea above the spot would.
struct place {
    double x, y;
};

SIM_INLINE struct place guess(const struct sim_eye *eye, const double site[3], double sx, double sy) {
    double per_index = 1 / eye->index, depth = eye->apex - eye->iris_z, r2 = sx * sx + sy * sy;
    double dx = site[0] - sx, dy = site[1] - sy, dz = site[2] - eye->iris_z;
    double root = sqrt(eye->radius * eye->radius - eye->p * r2);
    double height = sim_wide_max(depth - r2 / (eye->radius + root), 0.1);
    double per = 1 / sqrt(dx * dx + dy * dy + dz * dz), per_normal = 1 / sqrt(r2 + root * root);
    double nx = sx * per_normal, ny = sy * per_normal, nz = root * per_normal;
    double cosine = sim_wide_max((dx * nx + dy * ny + dz * nz) * per, 0.0);
    double bend = sqrt(1 - (1 - cosine * cosine) * per_index * per_index) - cosine * per_index;
    double along = per * per_index, rise = height / sim_wide_max(along * dz + bend * nz, 0.3);
    struct place at = {sx + (along * dx + bend * nx) * rise, sy + (along * dy + bend * ny) * rise};
    return at;
}

int sim_cornea_folds(const struct sim_eye *eye, const double site[3]) {
    // The horizon lies in the site's polar plane: x (along the site's azimuth) is linear in the depth.
    enum { PLACES = 32 };
    int found = 0;
    double far = sqrt(site[0] * site[0] + site[1] * site[1]), deep = eye->apex - site[2], n = eye->index;
    double rim = eye->limbus + eye->haze / 2, rim2 = rim * rim, ex = site[0] / far, ey = site[1] / far;
    double deepest = rim2 / (eye->radius + sqrt(eye->radius * eye->radius - eye->p * rim2));
    if (far < 1e-6) return 0;
    for (int i = 0; i < PLACES; ++i) {
        double s = deepest * i * i / (PLACES * PLACES), r2 = (2 * eye->radius - eye->p * s) * s;
        double along = (eye->radius * (deep + s) - eye->p * deep * s) / far, y2 = r2 - along * along;
        if (y2 < 0) continue;
        double x = ex * along - ey * sqrt(y2), y = ey * along + ex * sqrt(y2);
        // Snell's ray at grazing incidence: its way inside is that of least rise.
        double root = sqrt(eye->radius * eye->radius - eye->p * r2), z = eye->apex - s;
        double size = sqrt(r2 + root * root);
        double u[3] = {x - site[0], y - site[1], z - site[2]}, u1 = sqrt(sim_dot(u, u));
        double turn = sqrt(1 - 1 / (n * n)) / size, per_u = 1 / (n * u1);
        double v[3] = {u[0] * per_u - turn * x, u[1] * per_u - turn * y, u[2] * per_u - turn * root};
        double t = (eye->iris_z - z) / v[2], sx = x + t * v[0], sy = y + t * v[1];
        if (!(v[2] < -1e-3 && t > 0 && sx * sx + sy * sy < 1.05 * eye->limbus * eye->limbus)) continue;
        struct sim_path path = sim_path_measure(eye, site, sx, sy, x, y, n);
        double det = path.hxx * path.hyy - path.hxy * path.hxy;
        if (det < FOLDED || path.hxx <= 0) return 2;
        if (det < NEARLY) found = 1;
    }
    return found;
}

double sim_eye_refract(const struct sim_eye *eye, const double site[3], const double spot[3],
                       double exit[3]) {
    struct sim_path t;
    struct place start = guess(eye, site, spot[0], spot[1]);
    double at[2] = {start.x, start.y}, n = eye->index;
    int found = settle(eye, site, spot, n, at, &t) || follow(eye, site, spot, at, &t);
    double r2 = at[0] * at[0] + at[1] * at[1], far2 = furthest2(eye);
    if (!(r2 < far2)) {
        at[0] *= sqrt(far2 / r2);
        at[1] *= sqrt(far2 / r2);
        r2 = far2;
    }
    exit[0] = at[0];
    exit[1] = at[1];
    exit[2] = eye->apex - r2 / (eye->radius + sqrt(eye->radius * eye->radius - eye->p * r2));
    if (!found) return 0;
    double metric = 1 + t.zx * t.zx + t.zy * t.zy, size = sqrt(metric), cos_out = facing(&t) / size;
    double cos_in = (t.vz - t.zx * t.vx - t.zy * t.vy) / size;
    if (cos_in <= 0 || t.vz <= 0) return 0;
    double det = (t.hxx * t.hyy - t.hxy * t.hxy) / metric;
    double spread = n * n * cos_out * cos_in * t.per1 * t.per1 * t.per2 * t.per2 / det;
    return t.vz * (1 - sim_fresnel(n, cos_out)) * spread;
}

SIM_WIDE void sim_cornea_refract(const struct sim_eye *eye, const double site[3], int steps,
                                 struct sim_spots *s, double *transfer) {
    int n = sim_whole(s->n);
    double index = eye->index, far2 = furthest2(eye);
    double *x = s->exit[0], *y = s->exit[1], *z = s->exit[2];
    SIM_EACH(p, n) {
        struct place start = guess(eye, site, s->x[p], s->y[p]);
        x[p] = start.x;
        y[p] = start.y;
    }
    for (int i = 0; i < steps; ++i)
        SIM_EACH(p, n) {
            struct sim_path t = sim_path_measure(eye, site, s->x[p], s->y[p], x[p], y[p], index);
            double per_det = 1 / (t.hxx * t.hyy - t.hxy * t.hxy);
            double dx = (t.hxy * t.gy - t.hyy * t.gx) * per_det, dy = (t.hxy * t.gx - t.hxx * t.gy) * per_det;
            double scale = 1 / sim_wide_max(1.0, fabs(dx) + fabs(dy));
            double qx = x[p] + scale * dx, qy = y[p] + scale * dy;
            double back = sqrt(far2 / sim_wide_max(far2, qx * qx + qy * qy));
            x[p] = back * qx;
            y[p] = back * qy;
        }
    SIM_EACH(p, n) {
        struct sim_path t = sim_path_measure(eye, site, s->x[p], s->y[p], x[p], y[p], index);
        double det = t.hxx * t.hyy - t.hxy * t.hxy, middle = (t.hxx + t.hyy) / 2, half = (t.hxx - t.hyy) / 2;
        double dx = t.hxy * t.gy - t.hyy * t.gx, dy = t.hxy * t.gx - t.hxx * t.gy;
        double cos_out = facing(&t);
        s->least[p] = middle - sqrt(half * half + t.hxy * t.hxy);
        s->facing[p] = cos_out;
        s->step[p] = sqrt(dx * dx + dy * dy) / fabs(det);
        z[p] = t.z;
        double metric = 1 + t.zx * t.zx + t.zy * t.zy, per_size = 1 / sqrt(metric);
        double cos_in = (t.vz - t.zx * t.vx - t.zy * t.vy) * per_size;
        double c = sim_wide_max(cos_out * per_size, 0.0), inside = sqrt(1 - (1 - c * c) / (index * index));
        double across = (c - index * inside) / (c + index * inside);
        double along = (inside - index * c) / (inside + index * c);
        double through = 1 - (across * across + along * along) / 2;
        double r = sqrt(x[p] * x[p] + y[p] * y[p]);
        double veil = 1 - sim_wide_step((r - eye->limbus) / eye->haze + 0.5);
        double spread = index * index * c * cos_in * t.per1 * t.per1 * t.per2 * t.per2 * metric / det;
        double light = t.vz * through * spread * veil;
        transfer[p] = (cos_in <= 0) | (t.vz <= 0) ? 0.0 : light;
    }
}

void sim_cornea_mend(const struct sim_eye *eye, const double site[3], int folds, const unsigned char *dark,
                     struct sim_spots *s, double *transfer) {
    for (int p = 0; p < s->n; ++p) {
        if (dark && dark[p]) {
            transfer[p] = 0;
            continue;
        }
        if (s->least[p] > 1e-3 && s->step[p] < SETTLED_MM && (s->facing[p] > 0 || !folds)) continue;
        double spot[3] = {s->x[p], s->y[p], eye->iris_z}, exit[3];
        double t = sim_eye_refract(eye, site, spot, exit);
        for (int k = 0; k < 3; ++k) s->exit[k][p] = exit[k];
        double r = sqrt(exit[0] * exit[0] + exit[1] * exit[1]);
        transfer[p] = t > 0 ? t * (1 - sim_eye_whiteness(eye, r)) : 0;
    }
    for (int p = s->n; p < sim_whole(s->n); ++p) transfer[p] = 0;
}
