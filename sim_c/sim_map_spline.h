// SPDX-License-Identifier: Apache-2.0
//
// The splines of response maps along one axis: uniform cubic B-splines for gaze, cardinal splines over uneven
// nodes for the small axes (pupil, lids, slip). For sim_map.c only, which whoever reads maps compiles alone:
// therefore a header.
#ifndef SIM_MAP_SPLINE_H
#define SIM_MAP_SPLINE_H

#include <math.h>
#include <stdlib.h>
#include <string.h>

// Coefficients of the cubic B-spline through n >= 4 equally spaced values, not-a-knot at both ends.
// Setting the fourth difference of the coefficients to zero at the second node makes that node's coefficient
// explicit, (8 y1 - y0 - y2) / 6, and leaves a diagonally dominant tridiagonal system for those between.
//   y, n      values; c receives n + 2 coefficients, c[0] left of the first node; work: n doubles.
static inline void bspline_fit(const double *y, int n, double *c, double *work) {
    double *k = c + 1;
    k[1] = (8 * y[1] - y[0] - y[2]) / 6;
    k[n - 2] = (8 * y[n - 2] - y[n - 1] - y[n - 3]) / 6;
    if (n > 4) {
        double ratio = 0, value = k[1];
        for (int i = 2; i <= n - 3; ++i) {
            double d = 1 / (4 - ratio);
            ratio = work[i] = d;
            value = k[i] = (6 * y[i] - value) * d;
        }
        for (int i = n - 3; i >= 2; --i) k[i] -= work[i] * k[i + 1];
    }
    k[0] = 6 * y[1] - 4 * k[1] - k[2];
    k[n - 1] = 6 * y[n - 2] - 4 * k[n - 2] - k[n - 3];
    k[-1] = 6 * y[0] - 4 * k[0] - k[1];
    k[n] = 6 * y[n - 1] - 4 * k[n - 1] - k[n - 2];
}

// Second derivatives at the nodes of the n cardinal not-a-knot splines of a small axis: curve[i * n + j] at
// node i of the spline that is 1 at node j (n < 3: zeros, straight lines). By dense elimination: n is small.
// Returns 0, or -1 when memory is short or a result is not finite.
static inline int cardinal_curvature(const double *x, int n, double *curve) {
    if (n < 3) {
        memset(curve, 0, (size_t)(n * n) * sizeof *curve);
        return 0;
    }
    if (n == 3) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                double p = 2;
                for (int k = 0; k < 3; ++k)
                    if (k != j) p /= x[j] - x[k];
                curve[i * 3 + j] = p;
            }
        return 0;
    }
    int width = 2 * n;
    double *a = calloc((size_t)(n * width), sizeof *a);
    if (!a) return -1;
    for (int i = 1; i < n - 1; ++i) {
        double h0 = x[i] - x[i - 1], h1 = x[i + 1] - x[i], *row = a + i * width;
        row[i - 1] = h0 / 6;
        row[i] = (h0 + h1) / 3;
        row[i + 1] = h1 / 6;
        row[n + i - 1] = 1 / h0;
        row[n + i] = -1 / h0 - 1 / h1;
        row[n + i + 1] = 1 / h1;
    }
    for (int end = 0; end < 2; ++end) {
        int i = end ? n - 1 : 0, s = end ? -1 : 1;
        double h0 = x[i + s] - x[i], h1 = x[i + 2 * s] - x[i + s], *row = a + i * width;
        row[i] = h1;
        row[i + s] = -(h0 + h1);
        row[i + 2 * s] = h0;
    }
    for (int i = 0; i < n; ++i) {
        int pivot = i;
        for (int r = i + 1; r < n; ++r)
            if (fabs(a[r * width + i]) > fabs(a[pivot * width + i])) pivot = r;
        for (int k = 0; k < width && pivot != i; ++k) {
            double t = a[i * width + k];
            a[i * width + k] = a[pivot * width + k];
            a[pivot * width + k] = t;
        }
        double d = a[i * width + i];
        for (int k = 0; k < width; ++k) a[i * width + k] /= d;
        for (int r = 0; r < n; ++r) {
            double f = a[r * width + i];
            if (r == i || f == 0) continue;
            for (int k = 0; k < width; ++k) a[r * width + k] -= f * a[i * width + k];
        }
    }
    int finite = 1;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) {
            curve[i * n + j] = a[i * width + n + j];
            finite &= isfinite(curve[i * n + j]) != 0;
        }
    free(a);
    return finite ? 0 : -1;
}

// Weights of all n nodes of a small axis at v (clamped).
static inline void small_weights(const double *x, const double *curve, int n, double v, double *w) {
    for (int j = 0; j < n; ++j) w[j] = 0;
    if (n == 1 || v <= x[0]) {
        w[0] = 1;
        return;
    }
    if (v >= x[n - 1]) {
        w[n - 1] = 1;
        return;
    }
    int i = 0;
    while (i < n - 2 && v >= x[i + 1]) ++i;
    double h = x[i + 1] - x[i], b = (v - x[i]) / h, a = 1 - b;
    w[i] = a;
    w[i + 1] = b;
    double ca = (a * a * a - a) * h * h / 6, cb = (b * b * b - b) * h * h / 6;
    if (a == 1) return;
    for (int j = 0; j < n; ++j) w[j] += ca * curve[i * n + j] + cb * curve[(i + 1) * n + j];
}

// First coefficient and four weights of a gaze axis at v (clamped). For a constant axis: one coefficient.
static inline int gaze_weights(const double *x, int n, double v, int *first, double w[4]) {
    *first = 0;
    w[0] = 1;
    if (n == 1) return 1;
    double u = (v - x[0]) / (x[n - 1] - x[0]) * (n - 1);
    if (u < 0) u = 0;
    if (u > n - 1) u = n - 1;
    int i = (int)u;
    if (i > n - 2) i = n - 2;
    double t = u - i, s = 1 - t;
    *first = i;
    w[0] = s * s * s / 6;
    w[1] = (4 - 6 * t * t + 3 * t * t * t) / 6;
    w[2] = (4 - 6 * s * s + 3 * s * s * s) / 6;
    w[3] = t * t * t / 6;
    return 4;
}

#endif
