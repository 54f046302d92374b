// SPDX-License-Identifier: Apache-2.0
//
// The edge is found forward, along rays from the site: at each distance y from the plane of site and axis it
// is the horizon, or where the determinant of the path's second derivatives changes its sign.
#include "sim_edge.h"

#include "sim_path.h"

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
    struct sim_path path = sim_path_measure(eye, edge->site, spot[0], spot[1], x, y, n);
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

void sim_edge_find(const struct sim_eye *eye, const double site[3], struct sim_edge *edge) {
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
