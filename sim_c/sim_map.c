// SPDX-License-Identifier: Apache-2.0
//
// The value of a map at a state, and its gradient. sim_map_file.c reads maps.
#include "sim_map_inside.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

enum { N_AXES = SIM_MAP_AXES };
enum { MAX_PAIRS = SIM_MAP_MAX_SENSORS * SIM_MAP_MAX_EMITTERS };
enum { MAX_ROWS = 4 * 4 * 4 * 4 * 4 * 4 };  // four taps along all axes but azimuth
enum { AX_SLIP, AX_PUPIL = 3, AX_LID, AX_EL, AX_AZ };
#ifdef __GNUC__
#define PREFETCH(p) __builtin_prefetch(p)
#else
#define PREFETCH(p) ((void)(p))
#endif

int sim_map_sensors(const struct sim_map *map) {
    return map->sensors;
}
int sim_map_emitters(const struct sim_map *map) {
    return map->emitters;
}
double sim_map_mean(const struct sim_map *map) {
    return map->mean;
}
struct sim_map_error sim_map_error(const struct sim_map *map) {
    return map->error;
}

int sim_map_kind(const struct sim_map *map, int table) {
    return table < 0 || table >= map->n_tables ? -1 : map->table[table].kind;
}

int sim_map_axis(const struct sim_map *map, int table, int axis, const double **nodes) {
    if (table < 0 || table >= map->n_tables || axis < 0 || axis >= N_AXES) return 0;
    if (nodes) *nodes = map->table[table].axis[axis].nodes;
    return map->table[table].axis[axis].n;
}

// Weighted sum of the coefficients of up to four neighbours in azimuth, for every pair. In single precision:
// 1e-7 of the response.
#define DEFINE_ROW(name, type)                                                                            \
    static void name(const type *c, int taps, size_t pairs, const double *weight, float *restrict out) {  \
        float w0 = (float)weight[0];                                                                      \
        if (taps == 4) {                                                                                  \
            float w1 = (float)weight[1], w2 = (float)weight[2], w3 = (float)weight[3];                    \
            const type *c1 = c + pairs, *c2 = c1 + pairs, *c3 = c2 + pairs;                               \
            for (size_t p = 0; p < pairs; ++p)                                                            \
                out[p] = w0 * (float)c[p] + w1 * (float)c1[p] + w2 * (float)c2[p] + w3 * (float)c3[p];    \
            return;                                                                                       \
        }                                                                                                 \
        for (size_t p = 0; p < pairs; ++p) out[p] = w0 * (float)c[p];                                     \
        for (int a = 1; a < taps; ++a)                                                                    \
            for (size_t p = 0; p < pairs; ++p) out[p] += (float)weight[a] * (float)c[(size_t)a * pairs + p]; \
    }
DEFINE_ROW(row_f32, float)
DEFINE_ROW(row_u16, uint16_t)

static void row(const struct sim_map_table *t, size_t at, const struct spline_place *place,
                const double *weight, size_t pairs, float *out) {
    if (t->bytes == 2) row_u16((const uint16_t *)t->values + at, place->taps, pairs, weight, out);
    else row_f32((const float *)t->values + at, place->taps, pairs, weight, out);
}

static void add(double *restrict out, double weight, const float *restrict row, size_t pairs) {
    if (weight == 0) return;
    for (size_t p = 0; p < pairs; ++p) out[p] += weight * (double)row[p];
}

// Rows of up to four neighbours in azimuth about a place: where each begins, its taps along the other axes
// and the product of their weights.
struct rows {
    int n, tap[MAX_ROWS][AX_AZ];
    size_t at[MAX_ROWS];
    double weight[MAX_ROWS];
};

// The tables are larger than any cache and a state's rows lie far apart: all are asked for before the first
// is used, which halves the time of a state that was not looked at lately.
static void find_rows(const struct sim_map_table *t, const struct spline_place place[N_AXES], size_t pairs,
                      int all, struct rows *rows) {
    rows->n = 1;
    rows->at[0] = (size_t)place[AX_AZ].first * pairs;
    rows->weight[0] = 1;
    for (int k = 0; k < AX_AZ; ++k) {
        const struct spline_place *p = &place[k];
        int before = rows->n, n = before;
        for (int tap = p->taps - 1; tap >= 0; --tap) {
            if (p->weight[tap] == 0 && !all && tap) continue;
            // The first tap overwrites what it is made from: last.
            int to = tap ? n : 0;
            for (int r = 0; r < before; ++r) {
                rows->at[to + r] = rows->at[r] + (size_t)(p->first + tap) * t->stride[k];
                rows->weight[to + r] = rows->weight[r] * p->weight[tap];
                if (to) memcpy(rows->tap[to + r], rows->tap[r], sizeof *rows->tap);
                rows->tap[to + r][k] = tap;
            }
            if (tap) n += before;
        }
        rows->n = n;
    }
    size_t line = 64 / (size_t)t->bytes, row = (size_t)place[AX_AZ].taps * pairs;
    if (rows->n == 1 || row > 16 * line) return;
    for (int r = 0; r < rows->n; ++r)
        for (size_t i = 0; i < row; i += line)
            PREFETCH((const char *)t->values + (rows->at[r] + i) * (size_t)t->bytes);
}

// Add one table at one place. gradient, [N_AXES][pairs] by the table's axes, may be NULL.
static void add_table(const struct sim_map_table *t, const double v[N_AXES], size_t pairs, double *out,
                      double *gradient) {
    struct spline_place place[N_AXES];
    struct rows rows;
    for (int k = 0; k < N_AXES; ++k) spline_place(&t->axis[k], v[k], &place[k]);
    find_rows(t, place, pairs, gradient != NULL, &rows);
    double sum[MAX_PAIRS], slope_sum[N_AXES][MAX_PAIRS];
    float value[MAX_PAIRS], slope[MAX_PAIRS];
    memset(sum, 0, pairs * sizeof *sum);
    for (int k = 0; gradient && k < N_AXES; ++k) memset(slope_sum[k], 0, pairs * sizeof *sum);
    for (int r = 0; r < rows.n; ++r) {
        if (rows.weight[r] == 0 && !gradient) continue;
        const int *tap = rows.tap[r];
        row(t, rows.at[r], &place[AX_AZ], place[AX_AZ].weight, pairs, value);
        add(sum, rows.weight[r], value, pairs);
        if (!gradient) continue;
        if (place[AX_AZ].taps > 1) {
            row(t, rows.at[r], &place[AX_AZ], place[AX_AZ].slope, pairs, slope);
            add(slope_sum[AX_AZ], rows.weight[r], slope, pairs);
        }
        for (int k = 0; k < AX_AZ; ++k) {
            double by = place[k].slope[tap[k]];
            for (int j = 0; j < AX_AZ && by != 0; ++j)
                if (j != k) by *= place[j].weight[tap[j]];
            add(slope_sum[k], by, value, pairs);
        }
    }
    for (size_t p = 0; p < pairs; ++p) out[p] += t->scale ? t->offset[p] + t->scale[p] * sum[p] : sum[p];
    for (int k = 0; gradient && k < N_AXES; ++k)
        for (size_t p = 0; p < pairs; ++p)
            gradient[(size_t)k * pairs + p] += t->scale ? t->scale[p] * slope_sum[k][p] : slope_sum[k][p];
}

static int place_of(const struct sim_state *s, double v[N_AXES]) {
    const double values[N_AXES] = {s->slip_mm[0],  s->slip_mm[1],    s->slip_mm[2],  s->pupil_mm,
                                   s->lid_opening, s->elevation_deg, s->azimuth_deg};
    for (int k = 0; k < N_AXES; ++k) {
        if (!isfinite(values[k])) return -1;
        v[k] = values[k];
    }
    return 0;
}

int sim_map_eval_parts(const struct sim_map *map, const struct sim_state *state, double *smooth,
                       double *glint) {
    double v[N_AXES], *part[2] = {smooth, glint};
    size_t pairs = (size_t)map->pairs;
    for (int k = 0; k < 2; ++k)
        if (part[k]) memset(part[k], 0, pairs * sizeof *smooth);
    if (place_of(state, v)) return -1;
    for (int i = 0; i < map->n_tables; ++i) {
        double *out = part[map->table[i].kind == SIM_MAP_GLINT];
        if (out) add_table(&map->table[i], v, pairs, out, NULL);
    }
    return 0;
}

int sim_map_eval_gradient(const struct sim_map *map, const struct sim_state *state, double *out,
                          double *gradient) {
    static const int ORDER[N_AXES] = {AX_AZ, AX_EL, AX_PUPIL, AX_LID, AX_SLIP, AX_SLIP + 1, AX_SLIP + 2};
    double v[N_AXES], unused[MAX_PAIRS], by_axis[N_AXES * MAX_PAIRS];
    size_t pairs = (size_t)map->pairs;
    double *value = out ? out : unused;
    memset(value, 0, pairs * sizeof *value);
    memset(gradient, 0, N_AXES * pairs * sizeof *gradient);
    if (place_of(state, v)) return -1;
    memset(by_axis, 0, N_AXES * pairs * sizeof *by_axis);
    for (int i = 0; i < map->n_tables; ++i) add_table(&map->table[i], v, pairs, value, by_axis);
    for (int k = 0; k < N_AXES; ++k)
        memcpy(gradient + (size_t)k * pairs, by_axis + (size_t)ORDER[k] * pairs, pairs * sizeof *gradient);
    return 0;
}

int sim_map_eval(const struct sim_map *map, const struct sim_state *state, double *out) {
    double v[N_AXES];
    size_t pairs = (size_t)map->pairs;
    memset(out, 0, pairs * sizeof *out);
    if (place_of(state, v)) return -1;
    for (int i = 0; i < map->n_tables; ++i) add_table(&map->table[i], v, pairs, out, NULL);
    for (size_t p = 0; p < pairs; ++p)
        if (out[p] < 0) out[p] = 0;
    return 0;
}

int sim_map_eval_many(const struct sim_map *map, const struct sim_state *states, size_t n, double *out) {
    int bad = 0;
    for (size_t i = 0; i < n; ++i) bad += sim_map_eval(map, &states[i], out + i * (size_t)map->pairs) != 0;
    return bad;
}
