// SPDX-License-Identifier: Apache-2.0
//
// Globally adaptive cubature of a vector of functions over rectangles: in every cell the tensor product of
// Gauss-Kronrod's 7 and 15 points; the cell with the greatest error of any component is halved across the
// axis along which the two rules differ more, until the summed errors of all components meet a goal. The
// error of a cell is the sum over both axes of |Kronrod - Gauss| along it: Kronrod's own error is far smaller
// where the function is smooth. Included by reference.c.
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef void (*integrand)(void *context, double x, double y, double *out);

struct cell {
    double x, y, half_x, half_y, worst;
    int along_y;   // which axis to halve
    double *part;  // [2][n]: value, error
};

struct cubature {
    int n, n_cells, room, failed;
    long points;
    integrand f;
    void *context;
    struct cell *heap;  // the worst first
    double *work;       // [6][n]
};

static const double KRONROD_AT[8] = {0.991455371120812639206854697526329, 0.949107912342758524526189684047851,
                                     0.864864423359769072789712788640926, 0.741531185599394439863864773280788,
                                     0.586087235467691130294144691693013, 0.405845151377397166906606412076961,
                                     0.207784955007898467600689403773245, 0};
static const double KRONROD_WEIGHT[8] = {
    0.022935322010529224963732008058970, 0.063092092629978553290700663189204,
    0.104790010322250183839876322541518, 0.140653259715525918745189590510238,
    0.169004726639267902826583426598550, 0.190350578064785409913256402421014,
    0.204432940075298892414161999234649, 0.209482141084727828012999174891714};
static const double GAUSS_WEIGHT[4] = {
    0.129484966168869693270611432679082, 0.279705391489276667901467771423780,
    0.381830050505118944950369775488975, 0.417959183673469387755102040816327};

static double node(int i, double *kronrod, double *gauss) {
    int k = i < 8 ? i : 14 - i;
    *kronrod = KRONROD_WEIGHT[k];
    *gauss = k % 2 ? GAUSS_WEIGHT[k / 2] : 0;
    return i < 8 ? -KRONROD_AT[k] : KRONROD_AT[k];
}

static void measure(struct cubature *c, struct cell *cell) {
    int n = c->n;
    double *value = c->work, *row_k = value + n, *row_g = row_k + n, *kg = row_g + n, *gk = kg + n;
    double *kk = cell->part, wk, wg;
    memset(kk, 0, (size_t)n * sizeof *kk);
    memset(kg, 0, 2 * (size_t)n * sizeof *kg);
    for (int j = 0; j < 15; ++j) {
        double y = cell->y + cell->half_y * node(j, &wk, &wg), wk_y = wk, wg_y = wg;
        memset(row_k, 0, 2 * (size_t)n * sizeof *row_k);
        for (int i = 0; i < 15; ++i) {
            double x = cell->x + cell->half_x * node(i, &wk, &wg);
            memset(value, 0, (size_t)n * sizeof *value);
            c->f(c->context, x, y, value);
            for (int m = 0; m < n; ++m) {
                row_k[m] += wk * value[m];
                row_g[m] += wg * value[m];
            }
        }
        for (int m = 0; m < n; ++m) {
            kk[m] += wk_y * row_k[m];
            kg[m] += wg_y * row_k[m];
            gk[m] += wk_y * row_g[m];
        }
    }
    c->points += 225;
    double area = cell->half_x * cell->half_y, worst_x = 0, worst_y = 0, *error = kk + n;
    cell->worst = 0;
    for (int m = 0; m < n; ++m) {
        double ex = fabs(kk[m] - gk[m]) * area, ey = fabs(kk[m] - kg[m]) * area;
        kk[m] *= area;
        error[m] = ex + ey;
        if (error[m] > cell->worst) cell->worst = error[m];
        if (ex > worst_x) worst_x = ex;
        if (ey > worst_y) worst_y = ey;
        if (!isfinite(kk[m])) c->failed = 1;
    }
    cell->along_y = worst_y > worst_x;
}

static void sift_up(struct cell *heap, int i) {
    for (; i && heap[(i - 1) / 2].worst < heap[i].worst; i = (i - 1) / 2) {
        struct cell t = heap[i];
        heap[i] = heap[(i - 1) / 2];
        heap[(i - 1) / 2] = t;
    }
}

static void sift_down(struct cell *heap, int n) {
    for (int i = 0, child; (child = 2 * i + 1) < n; i = child) {
        if (child + 1 < n && heap[child + 1].worst > heap[child].worst) ++child;
        if (heap[child].worst <= heap[i].worst) return;
        struct cell t = heap[i];
        heap[i] = heap[child];
        heap[child] = t;
    }
}

static void cubature_open(struct cubature *c, int n, integrand f, void *context) {
    memset(c, 0, sizeof *c);
    c->n = n;
    c->f = f;
    c->context = context;
    c->work = malloc(6 * (size_t)n * sizeof(double));
    c->failed = !c->work;
}

static void cubature_close(struct cubature *c) {
    for (int i = 0; i < c->n_cells; ++i) free(c->heap[i].part);
    free(c->heap);
    free(c->work);
    memset(c, 0, sizeof *c);
}

static void cubature_add(struct cubature *c, double x0, double x1, double y0, double y1) {
    if (c->failed) return;
    if (c->n_cells == c->room) {
        int room = c->room ? 2 * c->room : 256;
        struct cell *heap = realloc(c->heap, (size_t)room * sizeof *heap);
        if (!heap) {
            c->failed = 1;
            return;
        }
        c->heap = heap;
        c->room = room;
    }
    struct cell *cell = &c->heap[c->n_cells];
    *cell = (struct cell){.x = (x0 + x1) / 2, .y = (y0 + y1) / 2};
    cell->half_x = (x1 - x0) / 2;
    cell->half_y = (y1 - y0) / 2;
    if (!(cell->part = malloc(2 * (size_t)c->n * sizeof(double)))) {
        c->failed = 1;
        return;
    }
    measure(c, cell);
    sift_up(c->heap, c->n_cells++);
}

static void cubature_grid(struct cubature *c, double x0, double x1, int nx, double y0, double y1, int ny) {
    double dx = (x1 - x0) / nx, dy = (y1 - y0) / ny;
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i)
            cubature_add(c, x0 + i * dx, x0 + (i + 1) * dx, y0 + j * dy, y0 + (j + 1) * dy);
}

// Sums over all cells: value and error [n]. Returns the greatest error.
static double cubature_sum(const struct cubature *c, double *value, double *error) {
    double worst = 0;
    memset(value, 0, (size_t)c->n * sizeof *value);
    memset(error, 0, (size_t)c->n * sizeof *error);
    for (int i = 0; i < c->n_cells; ++i)
        for (int m = 0; m < c->n; ++m) {
            value[m] += c->heap[i].part[m];
            error[m] += c->heap[i].part[c->n + m];
        }
    for (int m = 0; m < c->n; ++m)
        if (error[m] > worst) worst = error[m];
    return worst;
}

// Halve cells until every component's error is at most the goal, or there are max_cells. May be called again
// with a smaller goal. value, error [n] receive the sums.
static void cubature_run(struct cubature *c, double goal, int max_cells, double *value, double *error) {
    while (!c->failed && cubature_sum(c, value, error) > goal && c->n_cells < max_cells) {
        // As many halvings as cells hold a twentieth of the excess, at least one, before summing again.
        double enough = goal / (20.0 * c->n_cells);
        for (int k = 0; k < 1 + c->n_cells / 16 && c->heap[0].worst > enough && !c->failed; ++k) {
            struct cell cell = c->heap[0];
            c->heap[0] = c->heap[--c->n_cells];
            sift_down(c->heap, c->n_cells);
            free(cell.part);
            double hx = cell.half_x, hy = cell.half_y;
            for (int side = -1; side <= 0; ++side) {
                double x = cell.x + (cell.along_y ? -hx : side * hx),
                       y = cell.y + (cell.along_y ? side * hy : -hy);
                cubature_add(c, x, x + (cell.along_y ? 2 * hx : hx), y, y + (cell.along_y ? hy : 2 * hy));
            }
        }
    }
}
