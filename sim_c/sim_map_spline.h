// SPDX-License-Identifier: Apache-2.0
//
// B-splines of response maps along one axis: knots for sim_map_file.c, values and slopes for sim_map.c.
#ifndef SIM_MAP_SPLINE_H
#define SIM_MAP_SPLINE_H

enum { SPLINE_TAPS = 4 };

// One axis: n nodes, degree min(3, n - 1), n + degree + 1 knots.
struct spline_axis {
    int n, degree;
    double *nodes, *knots;  // knots has room for n + 4
};

static inline void spline_knots(struct spline_axis *axis) {
    int n = axis->n, d = axis->degree = n < 4 ? n - 1 : 3;
    const double *x = axis->nodes;
    for (int i = 0; i <= d; ++i) {
        axis->knots[i] = x[0];
        axis->knots[n + i] = x[n - 1];
    }
    for (int i = d + 1; i < n; ++i) axis->knots[i] = x[i - 2];  // none unless n > 4
}

// Where v lies on an axis: coefficients first .. first + taps - 1 count, with these weights, and with these
// for the derivative (0 where v is clamped).
struct spline_place {
    int first, taps;
    double weight[SPLINE_TAPS], slope[SPLINE_TAPS];
};

// Basis functions by the Cox-de Boor recurrence, in its form without divisions by zero: the differences of
// knots below all span the interval that holds v.
static inline void spline_place(const struct spline_axis *axis, double v, struct spline_place *place) {
    const double *t = axis->knots;
    int n = axis->n, d = axis->degree, clamped = v < t[0] || v > t[n];
    if (v < t[0]) v = t[0];
    if (v > t[n]) v = t[n];
    int low = d, high = n;  // t[low] <= v < t[high], or v is the last node
    while (high - low > 1) {
        int mid = (low + high) / 2;
        if (v >= t[mid]) low = mid;
        else high = mid;
    }
    double *w = place->weight, lower[SPLINE_TAPS] = {1, 0, 0, 0};
    place->first = low - d;
    place->taps = d + 1;
    w[0] = 1;
    for (int k = 1; k <= d; ++k) {
        for (int j = 0; j < k; ++j) lower[j] = w[j];
        double saved = 0;
        for (int j = 0; j < k; ++j) {
            double left = t[low + 1 + j - k], right = t[low + 1 + j], part = lower[j] / (right - left);
            w[j] = saved + (right - v) * part;
            saved = (v - left) * part;
        }
        w[k] = saved;
    }
    // d/dv of degree d: differences of those of degree d - 1, which `lower` still holds.
    double before = 0;
    for (int j = 0; j <= d; ++j) {
        double after = j < d ? d * lower[j] / (t[low + 1 + j] - t[low + 1 + j - d]) : 0;
        place->slope[j] = clamped ? 0 : before - after;
        before = after;
    }
}

#endif
