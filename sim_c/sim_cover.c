// SPDX-License-Identifier: Apache-2.0
#include "sim_cover.h"

#include <math.h>
#include <string.h>

#define PI 3.14159265358979323846
static const double SMALL = 0.6;     // part of the reach over which slopes may vary in a cell
static const double LARGEST = 0.2;   // radian, the same
static const double FAST = 1e6;      // 1/mm, bend's bound
enum { MOST_LEVELS = 100 };

struct node {
    struct sim_cell cell;
    struct sim_ring ring;  // in the middle
    double c, s;           // cosine and sine of the azimuth there
    double rate, along;    // bounds over it: the normal's turn, and the length, per theta
    int band;              // of the profile, or -1 below its smallest
};

struct search {
    const struct sim_profile *profile;
    const struct sim_eye *eye;
    const double *a, *b;
    double cutoff, small;
};

enum verdict { DROP, KEEP, BY_THETA, BY_AZIMUTH };

// Arc sine, from above, for 0..0.7.
static double turned_by(double x) {
    return x * (1 + 0.25 * x * x);
}

static enum verdict judge(const struct search *search, struct node *node) {
    const struct sim_ring *ring = &node->ring;
    struct sim_cell *cell = &node->cell;
    double half = (cell->to - cell->from) / 2, half_phi = PI * (cell->hi - cell->lo);
    double c = node->c, s = node->s, l[3], v[3], h[3];
    double point[3] = {ring->r * c, ring->r * s, ring->z};
    double normal[3] = {ring->n_out * c, ring->n_out * s, ring->n_up};
    for (int k = 0; k < 3; ++k) {
        l[k] = search->a[k] - point[k];
        v[k] = search->b[k] - point[k];
    }
    double da = sqrt(sim_dot(l, l)), db = sqrt(sim_dot(v, v)), ka = 1 / (da + 1e-12), kb = 1 / (db + 1e-12);
    for (int k = 0; k < 3; ++k) {
        l[k] *= ka;
        v[k] *= kb;
        h[k] = l[k] + v[k];
    }
    double size = sqrt(sim_dot(h, h)) + 1e-12;
    double tilt = node->rate * half, move = node->along * half, out = fmin(1, fabs(ring->n_out) + tilt);
    double far = ring->r + move;
    // Lengths of the normal's and the point's way from the middle to any place of the cell.
    double turn = sqrt(tilt * tilt + out * out * half_phi * half_phi);
    double moved = sqrt(move * move + far * far * half_phi * half_phi);
    // Greatest turns of the unit vectors to the sites, and of their sum.
    int near = moved > 0.7 * fmin(da, db);
    double turn_a = near ? PI : turned_by(moved * ka), turn_b = near ? PI : turned_by(moved * kb);
    double turn_h = (turn_a + turn_b) / size, nl = sim_dot(normal, l), nv = sim_dot(normal, v);
    int vague = near || turn_h > 0.7;
    double spread = turn + (vague ? PI : turned_by(turn_h)), reach = search->cutoff + spread;
    double sink_a = turn + turn_a, sink_b = turn + turn_b;
    if (nl < -sink_a || nv < -sink_b) return DROP;
    double reach2 = reach * reach;  // cosine from below
    double cosine = 1 - reach2 / 2 * (1 - reach2 / 12 * (1 - reach2 / 30));
    if (reach < PI && nl + nv < size * (cosine - 1e-13)) return DROP;
    double most = vague ? FAST : (1 / (da - moved) + 1 / (db - moved)) / (size - turn_a - turn_b + 1e-6);
    double per = (ka + kb) / size;
    if (!(most > 0 && most < 1.4 * per)) most = 1.4 * per;
    cell->bend = fmin((most + per) / 2, FAST);
    cell->steep = node->rate + node->along * cell->bend;
    cell->edge = nl < sink_a || nv < sink_b;
    if (spread < search->small) return KEEP;
    double by_theta = (node->rate + node->along * per) * half, by_azimuth = (out + far * per) * half_phi;
    return by_theta >= by_azimuth ? BY_THETA : BY_AZIMUTH;
}

// Cosine of a turn that is a power of a half.
static double quarter_cosine(double turn) {
    static const double table[] = {-1, 0, 0.70710678118654752, 0.92387953251128674, 0.98078528040323043,
                                   0.99518472667219693, 0.99879545620517241, 0.99969881869620425};
    int halvings = -ilogb(turn) - 1;
    return halvings < 8 ? table[halvings] : cos(2 * PI * turn);
}

static void divide(const struct search *search, const struct node *node, int by_theta, struct node out[2]) {
    out[0] = out[1] = *node;
    if (!by_theta) {
        double turn = (node->cell.hi - node->cell.lo) / 4, c = quarter_cosine(turn);
        double s = sqrt(fmax(0, 1 - c * c));
        out[0].cell.hi = out[1].cell.lo = (node->cell.lo + node->cell.hi) / 2;
        for (int i = 0; i < 2; ++i, s = -s) {
            out[i].c = node->c * c + node->s * s;
            out[i].s = node->s * c - node->c * s;
        }
        return;
    }
    double mid = (node->cell.from + node->cell.to) / 2;
    out[0].cell.to = out[1].cell.from = mid;
    int half = node->band < 0 ? -1 : search->profile->bands[node->band].half;
    for (int i = 0; i < 2; ++i) {
        out[i].band = half < 0 ? -1 : half + i;
        if (half >= 0) {
            const struct sim_band *band = &search->profile->bands[half + i];
            out[i].ring = band->ring;
            out[i].rate = band->rate;
            out[i].along = band->along;
        } else {
            sim_ring_at(search->eye, (out[i].cell.from + out[i].cell.to) / 2, &out[i].ring);
        }
    }
}

static void sort_cells(struct sim_cell *cells, int n) {
    for (int gap = n / 2; gap > 0; gap = gap > 2 ? gap * 5 / 11 : gap / 2)
        for (int i = gap; i < n; ++i) {
            struct sim_cell one = cells[i];
            int j = i;
            for (; j >= gap && cells[j - gap].from > one.from; j -= gap) cells[j] = cells[j - gap];
            cells[j] = one;
        }
}

int sim_cover(const struct sim_profile *profile, const struct sim_eye *eye, const double a[3],
              const double b[3], double reach, struct sim_cell out[SIM_COVER_CELLS]) {
    struct search search = {.profile = profile, .eye = eye, .a = a, .b = b, .cutoff = atan(reach)};
    search.small = fmin(SMALL * search.cutoff, LARGEST);
    struct node level[2][SIM_COVER_CELLS];
    int n = 0, kept = 0;
    for (int p = 0; p < profile->n_pieces; ++p) {
        const struct sim_band *band = &profile->bands[p];
        struct node *node = &level[0][n++];
        memset(&node->cell, 0, sizeof node->cell);
        node->cell.from = band->from;
        node->cell.to = band->to;
        node->cell.hi = 1;
        node->c = -1;
        node->s = 0;
        node->cell.piece = p;
        node->ring = band->ring;
        node->rate = band->rate;
        node->along = band->along;
        node->band = p;
    }
    for (int depth = 0; n; ++depth) {
        struct node *now = level[depth & 1], *next = level[(depth & 1) ^ 1];
        // Where room for halves runs out, what is left is kept whole.
        int last = depth == MOST_LEVELS || kept + 2 * n > SIM_COVER_CELLS, made = 0;
        for (int i = 0; i < n; ++i) {
            enum verdict verdict = judge(&search, &now[i]);
            if (verdict == DROP) continue;
            if (verdict == KEEP || last) {
                out[kept++] = now[i].cell;
                continue;
            }
            divide(&search, &now[i], verdict == BY_THETA, &next[made]);
            made += 2;
        }
        n = made;
    }
    sort_cells(out, kept);
    return kept;
}
