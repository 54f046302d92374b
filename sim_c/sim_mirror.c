// SPDX-License-Identifier: Apache-2.0
#include "sim_mirror.h"

#include <math.h>
#include <string.h>

#define PI 3.14159265358979323846
static const double THETA_END = 105 * PI / 180;
enum { MOST_HALVINGS = 40, MOST_SPLITS = 3000 };

void sim_ring_at(const struct sim_eye *eye, double theta, struct sim_ring *ring) {
    double s = sin(theta), c = cos(theta), d, rho = sim_eye_rho(eye, s, c, &d);
    double length = sqrt(rho * rho + d * d);
    ring->theta = theta;
    ring->r = rho * s;
    ring->z = rho * c;
    ring->n_out = (rho * s - d * c) / length;
    ring->n_up = (rho * c + d * s) / length;
    ring->along = length;
    ring->area = length * ring->r;
}

// Distance of the unblended cornea from the globe along the ray at theta.
static double gap_at(const struct sim_eye *eye, double theta) {
    struct sim_eye bare = *eye;
    double d;
    bare.blend = 1e-30;
    bare.globe = 0;
    return sim_eye_rho(&bare, sin(theta), cos(theta), &d) - eye->globe;
}

static void measure_band(const struct sim_eye *eye, struct sim_band *band, double from, double to) {
    enum { STEPS = 24 };
    band->from = from;
    band->to = to;
    band->rate = band->along = 0;
    band->half = -1;
    struct sim_ring ring, last;
    for (int i = 0; i <= STEPS; ++i) {
        sim_ring_at(eye, from + (to - from) * i / STEPS, &ring);
        double cross = i ? last.n_up * ring.n_out - last.n_out * ring.n_up : 0;
        band->rate = fmax(band->rate, fabs(cross) * STEPS / (to - from));
        band->along = fmax(band->along, ring.along);
        last = ring;
    }
    band->rate = 1.06 * band->rate + 0.02;
    band->along *= 1.02;
    sim_ring_at(eye, (from + to) / 2, &band->ring);
}

// Halves of the longest bands first, as far as there is room.
static void add_bands(struct sim_profile *profile, const struct sim_eye *eye) {
    for (int i = 0; i < profile->n_bands; ++i) {
        struct sim_band *band = &profile->bands[i];
        double mid = (band->from + band->to) / 2;
        if ((band->to - band->from) * band->rate < 0.03 || profile->n_bands + 2 > SIM_BANDS) continue;
        band->half = profile->n_bands;
        measure_band(eye, &profile->bands[profile->n_bands++], band->from, mid);
        measure_band(eye, &profile->bands[profile->n_bands++], mid, band->to);
    }
}

void sim_profile_init(struct sim_profile *profile, const struct sim_eye *eye) {
    double ends[SIM_PROFILE_PIECES + 1];
    int n = 0, steps = 420;
    ends[n++] = 0;
    for (int i = 0; i < steps; ++i) {
        double from = THETA_END * i / steps, to = THETA_END * (i + 1) / steps, found[3];
        int roots = 0;
        for (int k = -1; k <= 1; ++k) {
            double lo = from, hi = to, level = k * eye->blend, at_lo = gap_at(eye, lo) - level;
            if ((at_lo > 0) == (gap_at(eye, hi) - level > 0)) continue;
            for (int j = 0; j < 60; ++j) {
                double mid = (lo + hi) / 2;
                if ((gap_at(eye, mid) - level > 0) == (at_lo > 0)) lo = mid;
                else hi = mid;
            }
            found[roots++] = hi;
        }
        for (int done = 0; done < roots; ++done) {  // in order, and none twice
            double next = THETA_END;
            for (int k = 0; k < roots; ++k)
                if (found[k] > ends[n - 1] + 1e-9 && found[k] < next) next = found[k];
            if (next < THETA_END - 1e-9 && n < SIM_PROFILE_PIECES) ends[n++] = next;
        }
    }
    ends[n] = THETA_END;
    profile->n_pieces = profile->n_bands = n;
    for (int p = 0; p < n; ++p) measure_band(eye, &profile->bands[p], ends[p], ends[p + 1]);
    add_bands(profile, eye);
    profile->n_rings = 0;
    for (int p = 0; p < n; ++p) {
        profile->first[p] = profile->n_rings;
        double width = ends[p + 1] - ends[p];
        int cells = (int)ceil(width * (p + 1 < n ? 24 : 9));
        if (cells < 5) cells = 5;
        int room = SIM_PROFILE_RINGS - 1 - profile->n_rings - 6 * (n - 1 - p);
        if (cells > room) cells = room;
        profile->convex[p] = 1;
        for (int i = 0; i <= cells; ++i) {
            struct sim_ring *ring = &profile->rings[profile->n_rings++];
            sim_ring_at(eye, ends[p] + width * i / cells, ring);
            if (i && ring->n_out * ring[-1].n_up < ring->n_up * ring[-1].n_out) profile->convex[p] = 0;
        }
    }
    profile->first[n] = profile->n_rings;
}

void sim_facing_start(const double a[3], const double b[3], struct sim_facing *facing) {
    double da = sqrt(sim_dot(a, a)), db = sqrt(sim_dot(b, b));
    double x = a[0] / da + b[0] / db, y = a[1] / da + b[1] / db, n = sqrt(x * x + y * y);
    facing->c = n > 1e-12 ? x / n : 1;
    facing->s = n > 1e-12 ? y / n : 0;
}

void sim_ring_face(const struct sim_ring *ring, const double a[3], const double b[3],
                   double tolerance, struct sim_facing *facing) {
    double r = ring->r, out = ring->n_out, up = ring->n_up, az = a[2] - ring->z, bz = b[2] - ring->z;
    double c = facing->c, s = facing->s;
    for (int i = 0;; ++i) {
        // Outward, around and up, of unit vectors to the sites from the ring's point at this azimuth.
        double ar = a[0] * c + a[1] * s - r, at = a[1] * c - a[0] * s;
        double br = b[0] * c + b[1] * s - r, bt = b[1] * c - b[0] * s;
        double ka = 1 / sqrt(ar * ar + at * at + az * az), kb = 1 / sqrt(br * br + bt * bt + bz * bz);
        double lr = ar * ka, lt = at * ka, lz = az * ka, vr = br * kb, vt = bt * kb, vz = bz * kb;
        double hr = lr + vr, ht = lt + vt, hz = lz + vz, hn = hr * out + hz * up, hm = hr * up - hz * out;
        // Their derivatives by the azimuth, in the frame that turns along.
        double turn_a = r * ka * lt, turn_b = r * kb * vt;
        double dr = lr * turn_a + lt + vr * turn_b + vt;
        double dt = lt * turn_a - r * ka - lr + vt * turn_b - r * kb - vr;
        double dz = lz * turn_a + vz * turn_b, x = 0, pace2 = 0, pace = 0, scale = 1;
        int behind = hn < 1e-3;
        if (!behind) {
            double per = 1 / hn, sm = hm * per, st = ht * per, dn = dr * out + dz * up;
            double dm = (dr * up - dz * out - sm * dn) * per;
            dt = (dt - st * dn) * per;
            pace2 = dm * dm + dt * dt;
            pace = sqrt(pace2);
            if (pace2 > 1e-24) x = -(sm * dm + st * dt) / pace2;
            // Sites exactly on the axis: the same slope all around.
            if (pace2 > 1e-24) facing->miss = (st * dm - sm * dt) / pace;
            else facing->miss = copysign(sqrt(sm * sm + st * st), sm);
        } else {  // as good as infinitely far off
            facing->miss = hm > 0 ? 1e3 : -1e3;
        }
        int settled = behind || fabs(x) * (1 + pace) < tolerance || i == 20;
        if (x > 0.5) x = 0.5;
        if (x < -0.5) x = -0.5;
        scale = 1 / sqrt(1 + x * x);
        double turned = (c - x * s) * scale;
        s = (s + x * c) * scale;
        c = turned;
        if (!settled) continue;
        facing->c = c;
        facing->s = s;
        facing->pace = behind ? 1 : pace;
        facing->cosine = sqrt(hr * hr + ht * ht + hz * hz) / 2;
        facing->nearest = 1 / fmax(ka, kb);
        return;
    }
}

// The miss as a sine, which stays finite where a ring turns away.
struct node {
    double theta, miss;
    struct sim_facing facing;
};

struct scan {
    const struct sim_eye *eye;
    const double *a, *b;
    double reach, tolerance;
    struct sim_stretch *out;
    int n, open;  // stretches so far; whether the last one is in this piece
    int splits;   // left to make: a near tangent site's miss can jump from ring to ring
};

static struct node node_at(const struct scan *scan, const struct sim_ring *ring,
                           const struct sim_facing *start) {
    struct node node = {.theta = ring->theta, .facing = *start};
    sim_ring_face(ring, scan->a, scan->b, scan->tolerance, &node.facing);
    node.miss = node.facing.miss / sqrt(1 + node.facing.miss * node.facing.miss);
    return node;
}

static void take_cell(struct scan *scan, const struct node *lo, const struct node *hi) {
    double width = hi->theta - lo->theta, change = hi->miss - lo->miss, from = lo->theta, to = hi->theta;
    // Linear ends of the reach, a little too wide.
    double edge = 1.03 * scan->reach;
    if (fabs(lo->miss) > edge && lo->miss * change < 0) {
        double t = (fabs(lo->miss) - edge) / fabs(change);
        if (t < 0.98) from += t * width;
    }
    if (fabs(hi->miss) > edge && hi->miss * change > 0) {
        double t = (fabs(hi->miss) - edge) / fabs(change);
        if (t < 0.98) to -= t * width;
    }
    struct sim_stretch *last = scan->n ? &scan->out[scan->n - 1] : NULL;
    int joined = scan->open && last && (from - last->to < 1e-12 || scan->n == SIM_STRETCHES);
    if (!joined) {
        last = &scan->out[scan->n++];
        last->from = from;
        last->steepest = 0;
        last->crossings = 0;
        last->closed[0] = fabs(lo->miss) >= scan->reach;
    }
    last->to = to;
    last->closed[1] = fabs(hi->miss) >= scan->reach;
    double steep = fabs(change) / fmax(width, 1e-3 * (scan->reach + fabs(change)));  // a jump has no slope
    if (steep > last->steepest) last->steepest = steep;
    last->crossings += (lo->miss > 0) != (hi->miss > 0);
    scan->open = 1;
}

static void halve(struct scan *scan, const struct node *lo, const struct node *hi, double bend, int depth) {
    double width = hi->theta - lo->theta, dip = bend * width * width / 4;  // twice the parabola's
    double least = (lo->miss > 0) != (hi->miss > 0) ? 0 : fmin(fabs(lo->miss), fabs(hi->miss));
    // Half vectors turn fast near a site: only cells short against its distance tell by their ends.
    int coarse = width * scan->eye->apex > 0.4 * fmin(lo->facing.nearest, hi->facing.nearest);
    if (least - dip > scan->reach && !coarse) return;
    if (depth == MOST_HALVINGS || (!coarse && fabs(hi->miss - lo->miss) + dip < 1.2 * scan->reach) ||
        width < 1e-12) {
        take_cell(scan, lo, hi);
        return;
    }
    if (--scan->splits < 0) return;
    struct sim_ring ring;
    sim_ring_at(scan->eye, (lo->theta + hi->theta) / 2, &ring);
    struct node mid = node_at(scan, &ring, &lo->facing);
    double here = 4 * fabs(lo->miss - 2 * mid.miss + hi->miss) / (width * width);
    bend = fmax(here, bend / 4);
    halve(scan, lo, &mid, bend, depth + 1);
    halve(scan, &mid, hi, bend, depth + 1);
}

int sim_profile_scan(const struct sim_profile *profile, const struct sim_eye *eye, const double a[3],
                     const double b[3], double reach, struct sim_stretch *out) {
    struct scan scan = {.eye = eye, .a = a, .b = b, .out = out, .splits = MOST_SPLITS};
    scan.reach = reach / sqrt(1 + reach * reach);
    scan.tolerance = fmin(0.1 * reach, 0.03);
    struct node nodes[SIM_PROFILE_RINGS], last;
    struct sim_facing start;
    sim_facing_start(a, b, &start);
    for (int p = 0; p < profile->n_pieces; ++p) {
        int first = profile->first[p], cells = profile->first[p + 1] - first - 1;
        nodes[0] = p ? last : node_at(&scan, &profile->rings[first], &start);
        last = node_at(&scan, &profile->rings[first + cells], &nodes[0].facing);
        if (profile->convex[p] && reach < 0.3 && (nodes[0].miss < -scan.reach || last.miss > scan.reach))
            continue;
        for (int i = 1; i < cells; ++i)
            nodes[i] = node_at(&scan, &profile->rings[first + i], &nodes[i - 1].facing);
        nodes[cells] = last;
        double width = nodes[1].theta - nodes[0].theta;
        scan.open = 0;
        for (int i = 0; i < cells; ++i) {
            double bend = 0;
            for (int k = i > 0 ? i - 1 : 0; k <= i && k + 2 <= cells; ++k)
                bend = fmax(bend, fabs(nodes[k].miss - 2 * nodes[k + 1].miss + nodes[k + 2].miss));
            halve(&scan, &nodes[i], &nodes[i + 1], bend / (width * width), 0);
        }
    }
    return scan.splits < 0 ? 0 : scan.n;
}

// Miss of the ring at theta, found from a starting azimuth that is left at the ring's own.
static double miss_at(const struct scan *scan, double theta, struct sim_facing *facing) {
    struct sim_ring ring;
    sim_ring_at(scan->eye, theta, &ring);
    sim_ring_face(&ring, scan->a, scan->b, scan->tolerance, facing);
    return facing->miss;
}

static void mirror_at(const struct scan *scan, double theta, struct sim_facing *facing,
                      struct sim_mirror *mirror) {
    struct sim_ring ring, near[2];
    double step = 1e-6, to_a[3], to_b[3], flat[2];
    miss_at(scan, theta, facing);
    sim_ring_at(scan->eye, theta, &ring);
    sim_ring_at(scan->eye, theta - step, &near[0]);
    sim_ring_at(scan->eye, theta + step, &near[1]);
    double bend = ring.n_up * (near[1].n_out - near[0].n_out) - ring.n_out * (near[1].n_up - near[0].n_up);
    double across = bend / (2 * step * ring.along), around = ring.r > 1e-4 ? ring.n_out / ring.r : across;
    const double c = facing->c, s = facing->s;
    const double along[3] = {ring.n_up * c, ring.n_up * s, -ring.n_out}, turn[3] = {-s, c, 0};
    mirror->theta = theta;
    mirror->point[0] = ring.r * c;
    mirror->point[1] = ring.r * s;
    mirror->point[2] = ring.z;
    mirror->normal[0] = ring.n_out * c;
    mirror->normal[1] = ring.n_out * s;
    mirror->normal[2] = ring.n_up;
    for (int k = 0; k < 3; ++k) {
        to_a[k] = scan->a[k] - mirror->point[k];
        to_b[k] = scan->b[k] - mirror->point[k];
    }
    mirror->distance_a = sqrt(sim_dot(to_a, to_a));
    mirror->distance_b = sqrt(sim_dot(to_b, to_b));
    mirror->cosine = sim_dot(to_a, mirror->normal) / mirror->distance_a;
    flat[0] = sim_dot(to_a, along) / mirror->distance_a;
    flat[1] = sim_dot(to_a, turn) / mirror->distance_a;
    // Each leg's length is (1 - u u^T) / distance in its own tangents u, and bends with the surface by its
    // cosine.
    double k = 1 / mirror->distance_a + 1 / mirror->distance_b, twice = 2 * mirror->cosine;
    double h00 = k * (1 - flat[0] * flat[0]) + twice * across, h01 = -k * flat[0] * flat[1];
    double h11 = k * (1 - flat[1] * flat[1]) + twice * around;
    mirror->determinant = h00 * h11 - h01 * h01;
}

// The root between two thetas of which only the first has `up` as the sign of its miss.
static double root_between(const struct scan *scan, double lo, double hi, struct sim_facing *facing) {
    double at_lo = miss_at(scan, lo, facing), at_hi = miss_at(scan, hi, facing);
    for (int i = 0; i < 100 && hi - lo > 1e-14; ++i) {
        // The secant's point, or the middle where it makes slow progress.
        double t = at_lo / (at_lo - at_hi);
        double mid = i % 3 == 2 || !(t > 0 && t < 1) ? (lo + hi) / 2 : lo + t * (hi - lo);
        double value = miss_at(scan, mid, facing);
        if (value == 0) return mid;
        if ((value > 0) == (at_lo > 0)) lo = mid, at_lo = value;
        else hi = mid, at_hi = value;
    }
    return fabs(at_lo) < fabs(at_hi) ? lo : hi;
}

// Where |miss| is least between two thetas, unless its sign changes on the way there.
static double least_between(const struct scan *scan, double lo, double hi, struct sim_facing *facing) {
    int sign = miss_at(scan, lo, facing) > 0;
    for (int i = 0; i < 60; ++i) {
        double a = lo + 0.382 * (hi - lo), b = lo + 0.618 * (hi - lo);
        double at_a = miss_at(scan, a, facing), at_b = miss_at(scan, b, facing);
        if ((at_a > 0) != sign) return a;
        if ((at_b > 0) != sign) return b;
        if (fabs(at_a) < fabs(at_b)) hi = b;
        else lo = a;
    }
    return (lo + hi) / 2;
}

double sim_mirror_root(const struct sim_eye *eye, const double a[3], const double b[3], double from,
                       double to,
                       double tolerance, struct sim_facing *facing, double *slope) {
    struct scan scan = {.eye = eye, .a = a, .b = b, .tolerance = 3 * tolerance};
    double at_from = miss_at(&scan, from, facing), at_to = miss_at(&scan, to, facing), mid = from;
    for (int i = 0; i < 60; ++i) {
        double t = at_from / (at_from - at_to);
        mid = i % 4 == 3 || !(t > 0 && t < 1) ? (from + to) / 2 : from + t * (to - from);
        double value = miss_at(&scan, mid, facing);
        if (fabs(value) < tolerance) break;
        if ((value > 0) == (at_from > 0)) from = mid, at_from = value;
        else to = mid, at_to = value;
    }
    struct sim_facing beside = *facing;
    double step = 1e-5, above = miss_at(&scan, mid + step, &beside);
    *slope = (above - miss_at(&scan, mid - step, &beside)) / (2 * step);
    return mid;
}

int sim_mirror_points(const struct sim_profile *profile, const struct sim_eye *eye, const double a[3],
                      const double b[3], struct sim_mirror *out, int most) {
    enum { CELLS = 16 };
    struct sim_stretch stretches[SIM_STRETCHES];
    struct scan scan = {.eye = eye, .a = a, .b = b, .tolerance = 1e-9};
    struct sim_facing facing;
    sim_facing_start(a, b, &facing);
    int found = 0, n = sim_profile_scan(profile, eye, a, b, 1e-3, stretches);
    if (miss_at(&scan, 0, &facing) <= 0 && most > 0) mirror_at(&scan, 0, &facing, &out[found++]);
    for (int i = 0; i < n; ++i) {
        double from = stretches[i].from, step = (stretches[i].to - from) / CELLS, value[CELLS + 1];
        for (int j = 0; j <= CELLS; ++j) value[j] = miss_at(&scan, from + j * step, &facing);
        if (from == 0 && value[0] == 0) value[0] = value[1];  // counted above
        for (int j = 0; j < CELLS; ++j) {
            double lo = from + j * step, hi = lo + step, ends[3] = {lo, hi, hi};
            if ((value[j] > 0) == (value[j + 1] > 0)) {
                // Two roots may hide on both sides of a node that is nearer to zero than its neighbours.
                int dips = j > 0 && fabs(value[j]) <= fabs(value[j + 1]) &&
                           fabs(value[j]) <= fabs(value[j - 1]) && (value[j - 1] > 0) == (value[j] > 0);
                if (!dips) continue;
                ends[0] = lo - step;
                ends[1] = least_between(&scan, ends[0], hi, &facing);
                if ((miss_at(&scan, ends[1], &facing) > 0) == (value[j] > 0)) continue;
            }
            for (int k = 0; k < 2 && ends[k + 1] > ends[k]; ++k) {
                if (found == most) return found;
                mirror_at(&scan, root_between(&scan, ends[k], ends[k + 1], &facing), &facing, &out[found++]);
            }
        }
    }
    return found;
}
