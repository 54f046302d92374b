// SPDX-License-Identifier: Apache-2.0
//
// Fermat's path from a site through the cornea to a spot of the iris. Over the visible side of the cornea its
// length has one minimum, or none where the spot is out of reach; for a site beside the eye there is a saddle
// next to it (the longer path behind the caustic), and beyond the cornea's horizon a minimum that is no path.
// Newton's steps may slip over either. Whoever follows the minimum from refractive index 1, where it is the
// straight line, up to the eye's, and stays where the second derivatives are positive, cannot.
#include "sim_cornea.h"

static const double SETTLED_MM = 1e-6;
// Determinants at the horizon below which rays fold, or nearly do: the light then rises within 0.1 mm.
static const double FOLDED = 0.002, NEARLY = 0.01;

// Fermat's length site - (x, y) on the cornea - spot: slopes and second derivatives, lengths of both legs.
// n: refractive index.
struct path {
    double gx, gy, hxx, hyy, hxy, per1, per2, ux, uy, uz, vx, vy, vz, zx, zy, z;
};

SIM_INLINE struct path measure(const struct sim_eye *eye, const double site[3], double sx, double sy,
                               double x, double y, double n) {
    struct path t;
    double r2 = x * x + y * y, root = sqrt(eye->radius * eye->radius - eye->p * r2);
    double per_root = 1 / root, cube = eye->p * per_root * per_root * per_root;
    t.z = eye->apex - r2 / (eye->radius + root);
    t.zx = -x * per_root;
    t.zy = -y * per_root;
    double ux = x - site[0], uy = y - site[1], uz = t.z - site[2];
    double vx = x - sx, vy = y - sy, vz = t.z - eye->iris_z;
    t.per1 = 1 / sqrt(ux * ux + uy * uy + uz * uz);
    t.per2 = 1 / sqrt(vx * vx + vy * vy + vz * vz);
    t.ux = ux * t.per1;
    t.uy = uy * t.per1;
    t.uz = uz * t.per1;
    t.vx = vx * t.per2;
    t.vy = vy * t.per2;
    t.vz = vz * t.per2;
    double k1 = t.per1, k2 = n * t.per2, bend = t.uz + n * t.vz;
    double ax = t.ux + t.uz * t.zx, ay = t.uy + t.uz * t.zy, bx = t.vx + t.vz * t.zx, by = t.vy + t.vz * t.zy;
    t.gx = ax + n * bx;
    t.gy = ay + n * by;
    t.hxx = (1 + t.zx * t.zx) * (k1 + k2) - ax * ax * k1 - bx * bx * k2 - bend * (per_root + x * x * cube);
    t.hyy = (1 + t.zy * t.zy) * (k1 + k2) - ay * ay * k1 - by * by * k2 - bend * (per_root + y * y * cube);
    t.hxy = t.zx * t.zy * (k1 + k2) - ax * ay * k1 - bx * by * k2 - bend * x * y * cube;
    return t;
}

// The furthest from the axis that a crossing is looked for, squared.
static double furthest2(const struct sim_eye *eye) {
    return 0.95 * eye->radius * eye->radius / (eye->p > 0.1 ? eye->p : 0.1);
}

// How far a path's place is from the cornea's horizon: cosine of incidence times the normal's length.
SIM_INLINE double facing(const struct path *t) {
    return t->zx * t->ux + t->zy * t->uy - t->uz;
}

// Newton's steps to the minimum, as long as they stay on its side of saddle and horizon and get shorter.
static int settle(const struct sim_eye *eye, const double site[3], const double spot[3], double index,
                  double at[2], struct path *t) {
    double last = 1.5, far2 = furthest2(eye);
    for (int i = 0; i < 40; ++i) {
        if (!(at[0] * at[0] + at[1] * at[1] < far2)) return 0;
        *t = measure(eye, site, spot[0], spot[1], at[0], at[1], index);
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
                  struct path *t) {
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
        struct path there;
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
        struct path path = measure(eye, site, sx, sy, x, y, n);
        double det = path.hxx * path.hyy - path.hxy * path.hxy;
        if (det < FOLDED || path.hxx <= 0) return 2;
        if (det < NEARLY) found = 1;
    }
    return found;
}

// A place's part along a direction.
static double part_along(const double at[2], const double direction[2]) {
    return at[0] * direction[0] + at[1] * direction[1];
}

// The ray of an edge's site through (x, y), in the site's own plane: where it meets the iris, and the
// determinant that is negative behind a caustic. Returns 0 when it does not come to the iris' plane.
static int forward(const struct sim_edge *edge, double x, double y, double spot[2], double *determinant) {
    const struct sim_eye *eye = edge->eye;
    double r2 = x * x + y * y, root = sqrt(eye->radius * eye->radius - eye->p * r2), n = eye->index;
    double z = eye->apex - r2 / (eye->radius + root), per = 1 / sqrt(r2 + root * root);
    double ux = x - edge->site[0], uy = y, uz = z - edge->site[2];
    double per_u = 1 / sqrt(ux * ux + uy * uy + uz * uz);
    double c = fmax(0, -(ux * x + uy * y + uz * root) * per_u * per);
    double inside = sqrt(1 - (1 - c * c) / (n * n)), turn = (inside - c / n) * per;
    double vx = ux * per_u / n - turn * x, vy = uy * per_u / n - turn * y;
    double vz = uz * per_u / n - turn * root, t = (eye->iris_z - z) / vz;
    *determinant = 1;
    if (!(vz < -1e-3 && t > 0)) return 0;
    spot[0] = x + t * vx;
    spot[1] = y + t * vy;
    struct path path = measure(eye, edge->site, spot[0], spot[1], x, y, n);
    *determinant = path.hxx > 0 ? path.hxx * path.hyy - path.hxy * path.hxy : -1;
    return 1;
}

// A place of one of the two curves. Returns 0 when it has none there.
static int edge_at(const struct sim_edge *edge, int curve, double y, double at[2]) {
    enum { STEPS = 12 };
    const struct sim_eye *eye = edge->eye;
    // On the horizon x is linear in the depth s behind the apex, a + b s, and r^2 = 2 R s - p s^2.
    double deep = eye->apex - edge->site[2], a = eye->radius * deep / edge->site[0];
    double b = (eye->radius - eye->p * deep) / edge->site[0], middle = eye->radius - a * b;
    double rest = middle * middle - (b * b + eye->p) * (a * a + y * y);
    if (rest < 0 || middle <= 0) return 0;
    double s = (a * a + y * y) / (middle + sqrt(rest)), from = a + b * s;
    double rim2 = edge->widest * edge->widest - y * y, rim = rim2 > 0 ? sqrt(rim2) : 0;
    if (fabs(from) >= rim) return 0;
    double last = 0, last_x = from, spot[2] = {0, 0}, want = 1;
    int met = 0, comes = forward(edge, from, y, spot, &last);
    if (last > 0) {
        if (curve == 0) goto found;
        met = 1;
    }
    for (int i = 1; i <= STEPS; ++i) {
        double x = from + (rim - from) * i * i / (STEPS * STEPS), value;
        comes = forward(edge, x, y, spot, &value);
        want = met ? -1 : 1;
        if (value * want > 0 && met == curve) {
            // Illinois' regula falsi between last_x and x.
            double low = last_x, high = x, f_low = last, f_high = value;
            for (int j = 0; j < 60 && fabs(high - low) > 1e-11; ++j) {
                double next = high - f_high * (high - low) / (f_high - f_low), f;
                comes = forward(edge, next, y, spot, &f);
                if (fabs(f) < 1e-14) break;
                if ((f > 0) != (f_high > 0)) {
                    low = high;
                    f_low = f_high;
                } else {
                    f_low /= 2;
                }
                if (fabs(next - high) < 1e-11) break;
                high = next;
                f_high = f;
            }
            goto found;
        }
        if (value * want > 0) ++met;
        if (met > 1) return 0;
        last = value;
        last_x = x;
    }
    return 0;
found:
    if (!comes) return 0;
    at[0] = edge->azimuth[0] * spot[0] - edge->azimuth[1] * spot[1];
    at[1] = edge->azimuth[1] * spot[0] + edge->azimuth[0] * spot[1];
    return 1;
}

void sim_cornea_edge(const struct sim_eye *eye, const double site[3], struct sim_edge *edge) {
    double far = sqrt(site[0] * site[0] + site[1] * site[1]);
    edge->eye = eye;
    edge->site[0] = far;
    edge->site[1] = 0;
    edge->site[2] = site[2];
    edge->azimuth[0] = site[0] / far;
    edge->azimuth[1] = site[1] / far;
    edge->widest = eye->limbus + eye->haze / 2;
    for (int curve = 0; curve < 2; ++curve)
        for (int i = 0; i < SIM_EDGE_PLACES; ++i) {
            double y = edge->widest * (2.0 * i / (SIM_EDGE_PLACES - 1) - 1);
            struct sim_edge_place *place = &edge->place[curve][i];
            place->there = edge_at(edge, curve, y, place->at);
        }
}

static double y_of(const struct sim_edge *edge, double i) {
    return edge->widest * (2 * i / (SIM_EDGE_PLACES - 1) - 1);
}

int sim_edge_crossings(const struct sim_edge *edge, const double across[2], double u,
                       double out[SIM_EDGE_MOST]) {
    int n = 0;
    for (int curve = 0; curve < 2; ++curve)
        for (int i = 0; i + 1 < SIM_EDGE_PLACES && n < SIM_EDGE_MOST; ++i) {
            const struct sim_edge_place *a = &edge->place[curve][i], *b = a + 1;
            if (!a->there || !b->there) continue;
            double low = y_of(edge, i), high = y_of(edge, i + 1), at[2] = {b->at[0], b->at[1]};
            double f_low = part_along(a->at, across) - u, f_high = part_along(b->at, across) - u;
            if ((f_low > 0) == (f_high > 0)) continue;
            for (int j = 0; j < 40; ++j) {
                double next = high - f_high * (high - low) / (f_high - f_low);
                if (!edge_at(edge, curve, next, at)) break;
                double f = part_along(at, across) - u;
                if (fabs(f) < 1e-10) break;
                if ((f > 0) != (f_high > 0)) {
                    low = high;
                    f_low = f_high;
                } else {
                    f_low /= 2;
                }
                high = next;
                f_high = f;
            }
            out[n++] = at[1] * across[0] - at[0] * across[1];
        }
    return n;
}

int sim_edge_turns(const struct sim_edge *edge, const double across[2], double radius,
                   double out[SIM_EDGE_MOST]) {
    int n = 0;
    for (int curve = 0; curve < 2; ++curve)
        for (int i = 1; i + 1 < SIM_EDGE_PLACES && n < SIM_EDGE_MOST; ++i) {
            const struct sim_edge_place *b = &edge->place[curve][i], *a = b - 1, *c = b + 1;
            if (!a->there || !b->there || !c->there) continue;
            double ua = part_along(a->at, across), ub = part_along(b->at, across);
            double uc = part_along(c->at, across);
            if ((ub - ua) * (uc - ub) >= 0 || part_along(b->at, b->at) > radius * radius) continue;
            // The vertex of the parabola through three places, again and again.
            double y[3] = {y_of(edge, i - 1), y_of(edge, i), y_of(edge, i + 1)}, f[3] = {ua, ub, uc};
            for (int j = 0; j < 12; ++j) {
                double left = (f[1] - f[0]) / (y[1] - y[0]), right = (f[2] - f[1]) / (y[2] - y[1]);
                double bend = (right - left) / (y[2] - y[0]), at[2];
                double next = (y[0] + y[1]) / 2 - left / (2 * bend);
                if (!(fabs(next - y[1]) > 1e-5) || !edge_at(edge, curve, next, at)) break;
                double f_next = part_along(at, across);
                int better = (f_next > f[1]) == (bend < 0), right_of = next > y[1];
                int end = right_of ? 2 : 0;
                if (better) {
                    y[2 - end] = y[1];
                    f[2 - end] = f[1];
                    y[1] = next;
                    f[1] = f_next;
                } else {
                    y[end] = next;
                    f[end] = f_next;
                }
            }
            out[n++] = f[1];
        }
    return n;
}

double sim_eye_refract(const struct sim_eye *eye, const double site[3], const double spot[3],
                       double exit[3]) {
    struct path t;
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
            struct path t = measure(eye, site, s->x[p], s->y[p], x[p], y[p], index);
            double per_det = 1 / (t.hxx * t.hyy - t.hxy * t.hxy);
            double dx = (t.hxy * t.gy - t.hyy * t.gx) * per_det, dy = (t.hxy * t.gx - t.hxx * t.gy) * per_det;
            double scale = 1 / sim_wide_max(1.0, fabs(dx) + fabs(dy));
            double qx = x[p] + scale * dx, qy = y[p] + scale * dy;
            double back = sqrt(far2 / sim_wide_max(far2, qx * qx + qy * qy));
            x[p] = back * qx;
            y[p] = back * qy;
        }
    SIM_EACH(p, n) {
        struct path t = measure(eye, site, s->x[p], s->y[p], x[p], y[p], index);
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
