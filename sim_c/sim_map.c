// SPDX-License-Identifier: Apache-2.0
#include "sim_map.h"
#include "sim_map_spline.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { N_AXES = 10, HEADER_BYTES = 80, N_SMALL = 6 };
enum { AX_PUPIL, AX_LID, AX_SLIP, AX_EL = 5, AX_AZ, AX_GLINT_LID, AX_GLINT_EL, AX_GLINT_AZ };
#define MAX_VALUES (UINT64_C(1) << 27)

static const unsigned char MAGIC[8] = {'S', 'G', 'M', 'A', 'P', '\r', '\n', 1};

struct sim_map {
    int sensors, emitters, pairs;
    int n[N_AXES];
    double *axis[N_AXES];
    double *curve[N_AXES];  // of the small axes: see sim_map_spline.h
    double mean;
    int smooth_gaze[2], glint_gaze[2];  // coefficients per gaze axis: n + 2 for splines, 1 for constants
    float *smooth, *glint;  // B-spline coefficients along gaze, node values along the other axes
};

static int fail(char *error, size_t bytes, const char *why) {
    if (error && bytes) snprintf(error, bytes, "%s", why);
    return -1;
}

static uint64_t get_le(const unsigned char *p, int bytes) {
    uint64_t v = 0;
    for (int i = bytes - 1; i >= 0; --i) v = v << 8 | p[i];
    return v;
}

static double get_f64(const unsigned char *p) {
    uint64_t bits = get_le(p, 8);
    double v;
    memcpy(&v, &bits, sizeof v);
    return v;
}

static float get_f32(const unsigned char *p) {
    uint32_t bits = (uint32_t)get_le(p, 4);
    float v;
    memcpy(&v, &bits, sizeof v);
    return v;
}

static uint32_t crc32_of(const unsigned char *p, size_t n) {
    uint32_t table[256], crc = 0xFFFFFFFFu;
    for (uint32_t i = 0; i < 256; ++i) {
        uint32_t c = i;
        for (int k = 0; k < 8; ++k) c = c & 1 ? 0xEDB88320u ^ c >> 1 : c >> 1;
        table[i] = c;
    }
    for (size_t i = 0; i < n; ++i) crc = table[(crc ^ p[i]) & 0xFF] ^ crc >> 8;
    return ~crc;
}

// Values [blocks][n_el][n_az][pairs], little-endian in the file, to spline coefficients
// [blocks][m_el][m_az][pairs].
static int fit_gaze(const unsigned char *file, uint64_t blocks, int n_el, int n_az, int pairs, int m_el,
                    int m_az, float *out) {
    int longest = n_el > n_az ? n_el : n_az;
    double *line = malloc((size_t)(3 * longest + 4) * sizeof *line);
    if (!line) return -1;
    double *coef = line + longest, *work = coef + longest + 2;
    int ok = 1;
    for (uint64_t b = 0; b < blocks && ok; ++b) {
        float *dst = out + b * (uint64_t)m_el * (uint64_t)m_az * (uint64_t)pairs;
        for (int e = 0; e < n_el; ++e)
            for (int p = 0; p < pairs; ++p) {
                for (int a = 0; a < n_az; ++a) {
                    uint64_t at = ((b * (uint64_t)n_el + (uint64_t)e) * (uint64_t)n_az + (uint64_t)a) *
                                      (uint64_t)pairs +
                                  (uint64_t)p;
                    float v = get_f32(file + 4 * at);
                    ok &= isfinite(v) && fabsf(v) < 1e30f;
                    line[a] = v;
                }
                if (n_az == 1) coef[0] = line[0];
                else bspline_fit(line, n_az, coef, work);
                for (int a = 0; a < m_az; ++a) dst[(e * m_az + a) * pairs + p] = (float)coef[a];
            }
        if (n_el == 1) continue;
        for (int a = 0; a < m_az; ++a)
            for (int p = 0; p < pairs; ++p) {
                for (int e = 0; e < n_el; ++e) line[e] = dst[(e * m_az + a) * pairs + p];
                bspline_fit(line, n_el, coef, work);
                for (int e = 0; e < m_el; ++e) dst[(e * m_az + a) * pairs + p] = (float)coef[e];
            }
    }
    free(line);
    return ok ? 0 : -1;
}

static int read_axes(struct sim_map *map, const unsigned char *p, char *error, size_t bytes) {
    for (int k = 0; k < N_AXES; ++k) {
        int n = map->n[k], is_gaze = k == AX_EL || k == AX_AZ || k >= AX_GLINT_EL;
        double *x = map->axis[k] = malloc((size_t)n * sizeof *x);
        if (!x) return fail(error, bytes, "out of memory");
        for (int i = 0; i < n; ++i, p += 8) {
            x[i] = get_f64(p);
            if (!isfinite(x[i]) || fabs(x[i]) > 1e6)
                return fail(error, bytes, "an axis holds a number that is not finite");
            if (i && x[i] - x[i - 1] < 1e-6) return fail(error, bytes, "an axis is not increasing");
        }
        if (is_gaze) {
            for (int i = 1; i < n; ++i) {
                double step = (x[n - 1] - x[0]) / (n - 1);
                if (fabs(x[i] - x[i - 1] - step) > 1e-6 * step)
                    return fail(error, bytes, "a gaze axis is not uniform");
            }
            continue;
        }
        map->curve[k] = malloc((size_t)(n * n) * sizeof(double));
        if (!map->curve[k]) return fail(error, bytes, "out of memory");
        if (cardinal_curvature(x, n, map->curve[k]))
            return fail(error, bytes, "an axis cannot be interpolated");
    }
    return 0;
}

static int parse(struct sim_map *map, const unsigned char *file, size_t size, char *error, size_t bytes) {
    if (size < HEADER_BYTES) return fail(error, bytes, "not a response map: too short");
    if (memcmp(file, MAGIC, sizeof MAGIC)) return fail(error, bytes, "not a response map of this version");
    if (get_le(file + 8, 8) != size)
        return fail(error, bytes, "truncated or extended: the length is not the one in the header");
    uint64_t sensors = get_le(file + 20, 4), emitters = get_le(file + 24, 4), n[N_AXES];
    if (sensors < 1 || sensors > SIM_MAP_MAX_SENSORS || emitters < 1 || emitters > SIM_MAP_MAX_EMITTERS)
        return fail(error, bytes, "number of sensors or emitters out of range");
    uint64_t axis_nodes = 0;
    for (int k = 0; k < N_AXES; ++k) {
        int is_gaze = k == AX_EL || k == AX_AZ || k >= AX_GLINT_EL;
        n[k] = get_le(file + 28 + 4 * k, 4);
        uint64_t most = is_gaze ? SIM_MAP_MAX_GAZE_NODES : SIM_MAP_MAX_STATE_NODES;
        if (n[k] < 1 || n[k] > most || (is_gaze && n[k] > 1 && n[k] < 4))
            return fail(error, bytes, "number of nodes out of range");
        axis_nodes += n[k];
        map->n[k] = (int)n[k];
    }
    if (get_le(file + 28 + 4 * N_AXES, 4)) return fail(error, bytes, "reserved field is not zero");
    // Every factor is below 2^10, so no product of these below wraps before it is compared.
    uint64_t pairs = sensors * emitters, slips = n[2] * n[3] * n[4];
    uint64_t smooth_blocks = slips * n[AX_PUPIL] * n[AX_LID], glint_blocks = slips * n[AX_GLINT_LID];
    uint64_t smooth = smooth_blocks * n[AX_EL] * n[AX_AZ],
             glint = glint_blocks * n[AX_GLINT_EL] * n[AX_GLINT_AZ];
    if (smooth > MAX_VALUES || glint > MAX_VALUES || (smooth + glint) * pairs > MAX_VALUES)
        return fail(error, bytes, "too large");
    if (size != HEADER_BYTES + 8 * axis_nodes + 4 * pairs * (smooth + glint))
        return fail(error, bytes, "the length does not fit the number of nodes");
    if (get_le(file + 16, 4) != crc32_of(file + 20, size - 20))
        return fail(error, bytes, "damaged: checksum mismatch");
    map->sensors = (int)sensors;
    map->emitters = (int)emitters;
    map->pairs = (int)pairs;
    map->mean = get_f64(file + 72);
    if (!isfinite(map->mean) || map->mean <= 0)
        return fail(error, bytes, "the mean response is not positive");
    const unsigned char *p = file + HEADER_BYTES;
    if (read_axes(map, p, error, bytes)) return -1;
    p += 8 * axis_nodes;
    for (int g = 0; g < 2; ++g) {
        map->smooth_gaze[g] = map->n[AX_EL + g] == 1 ? 1 : map->n[AX_EL + g] + 2;
        map->glint_gaze[g] = map->n[AX_GLINT_EL + g] == 1 ? 1 : map->n[AX_GLINT_EL + g] + 2;
    }
    map->smooth = malloc(smooth_blocks * (uint64_t)map->smooth_gaze[0] * (uint64_t)map->smooth_gaze[1] *
                         pairs * sizeof(float));
    map->glint = malloc(glint_blocks * (uint64_t)map->glint_gaze[0] * (uint64_t)map->glint_gaze[1] * pairs *
                        sizeof(float));
    if (!map->smooth || !map->glint) return fail(error, bytes, "out of memory");
    if (fit_gaze(p, smooth_blocks, map->n[AX_EL], map->n[AX_AZ], map->pairs, map->smooth_gaze[0],
                 map->smooth_gaze[1], map->smooth) ||
        fit_gaze(p + 4 * pairs * smooth, glint_blocks, map->n[AX_GLINT_EL], map->n[AX_GLINT_AZ], map->pairs,
                 map->glint_gaze[0], map->glint_gaze[1], map->glint))
        return fail(error, bytes, "a response is not finite");
    return 0;
}

static unsigned char *read_whole(const char *path, size_t *size, char *error, size_t bytes) {
    FILE *f = fopen(path, "rb");
    if (!f) {
        fail(error, bytes, "cannot be opened");
        return NULL;
    }
    unsigned char *data = NULL;
    long end = -1;
    if (!fseek(f, 0, SEEK_END)) end = ftell(f);
    if (end < 0 || (uint64_t)end > 4 * MAX_VALUES + (1u << 20) || fseek(f, 0, SEEK_SET))
        fail(error, bytes, "not a readable file of sane size");
    else if (!(data = malloc((size_t)end + 1))) fail(error, bytes, "out of memory");
    else if (fread(data, 1, (size_t)end, f) != (size_t)end) {
        fail(error, bytes, "cannot be read");
        free(data);
        data = NULL;
    }
    fclose(f);
    *size = data ? (size_t)end : 0;
    return data;
}

struct sim_map *sim_map_open(const char *path, char *error, size_t error_bytes) {
    size_t size;
    unsigned char *file = read_whole(path, &size, error, error_bytes);
    if (!file) return NULL;
    struct sim_map *map = calloc(1, sizeof *map);
    if (!map) fail(error, error_bytes, "out of memory");
    else if (parse(map, file, size, error, error_bytes)) {
        sim_map_close(map);
        map = NULL;
    }
    free(file);
    return map;
}

void sim_map_close(struct sim_map *map) {
    if (!map) return;
    for (int k = 0; k < N_AXES; ++k) {
        free(map->axis[k]);
        free(map->curve[k]);
    }
    free(map->smooth);
    free(map->glint);
    free(map);
}

int sim_map_sensors(const struct sim_map *map) {
    return map->sensors;
}
int sim_map_emitters(const struct sim_map *map) {
    return map->emitters;
}
double sim_map_mean(const struct sim_map *map) {
    return map->mean;
}

int sim_map_axis(const struct sim_map *map, int axis, const double **nodes) {
    if (axis < 0 || axis >= N_AXES) return 0;
    if (nodes) *nodes = map->axis[axis];
    return map->n[axis];
}

// Add weight times the spline surface of one block at one gaze.
static void add_block(const float *block, int m_az, int pairs, const int first[2], const int count[2],
                      double w_el[4], double w_az[4], double weight, double *out) {
    for (int e = 0; e < count[0]; ++e)
        for (int a = 0; a < count[1]; ++a) {
            const float *c =
                block + ((size_t)(first[0] + e) * (size_t)m_az + (size_t)(first[1] + a)) * (size_t)pairs;
            double w = weight * w_el[e] * w_az[a];
            for (int p = 0; p < pairs; ++p) out[p] += w * c[p];
        }
}

int sim_map_eval_parts(const struct sim_map *map, const struct sim_state *state, double *smooth,
                       double *glint) {
    const double v[7] = {state->pupil_mm,   state->lid_opening,   state->slip_mm[0], state->slip_mm[1],
                         state->slip_mm[2], state->elevation_deg, state->azimuth_deg};
    size_t pairs = (size_t)map->pairs;
    if (smooth) memset(smooth, 0, pairs * sizeof *smooth);
    if (glint) memset(glint, 0, pairs * sizeof *glint);
    for (int k = 0; k < 7; ++k)
        if (!isfinite(v[k])) return -1;
    double w[N_SMALL][SIM_MAP_MAX_STATE_NODES], w_gaze[4][4];
    int first[4], count[4];
    for (int k = 0; k < 5; ++k) small_weights(map->axis[k], map->curve[k], map->n[k], v[k], w[k]);
    small_weights(map->axis[AX_GLINT_LID], map->curve[AX_GLINT_LID], map->n[AX_GLINT_LID], v[1], w[5]);
    for (int g = 0; g < 4; ++g) {
        int axis = g < 2 ? AX_EL + g : AX_GLINT_EL + g - 2;
        count[g] = gaze_weights(map->axis[axis], map->n[axis], v[5 + g % 2], &first[g], w_gaze[g]);
    }
    size_t smooth_block = (size_t)map->smooth_gaze[0] * (size_t)map->smooth_gaze[1] * pairs;
    size_t glint_block = (size_t)map->glint_gaze[0] * (size_t)map->glint_gaze[1] * pairs, slip = 0;
    for (int x = 0; x < map->n[2]; ++x)
        for (int y = 0; y < map->n[3]; ++y)
            for (int z = 0; z < map->n[4]; ++z, ++slip) {
                double ws = w[2][x] * w[3][y] * w[4][z];
                if (ws == 0) continue;
                for (int i = 0; smooth && i < map->n[AX_PUPIL]; ++i)
                    for (int j = 0; j < map->n[AX_LID]; ++j) {
                        double weight = ws * w[0][i] * w[1][j];
                        size_t at = (slip * (size_t)map->n[AX_PUPIL] + (size_t)i) * (size_t)map->n[AX_LID] +
                                    (size_t)j;
                        if (weight != 0)
                            add_block(map->smooth + at * smooth_block, map->smooth_gaze[1], map->pairs, first,
                                      count, w_gaze[0], w_gaze[1], weight, smooth);
                    }
                for (int j = 0; glint && j < map->n[AX_GLINT_LID]; ++j) {
                    size_t at = slip * (size_t)map->n[AX_GLINT_LID] + (size_t)j;
                    if (ws * w[5][j] != 0)
                        add_block(map->glint + at * glint_block, map->glint_gaze[1], map->pairs, first + 2,
                                  count + 2, w_gaze[2], w_gaze[3], ws * w[5][j], glint);
                }
            }
    return 0;
}

int sim_map_eval(const struct sim_map *map, const struct sim_state *state, double *out) {
    double glint[SIM_MAP_MAX_SENSORS * SIM_MAP_MAX_EMITTERS];
    int bad = sim_map_eval_parts(map, state, out, glint);
    for (int p = 0; p < map->pairs; ++p) {
        out[p] = bad ? 0 : out[p] + glint[p];
        if (out[p] < 0) out[p] = 0;
    }
    return bad;
}

int sim_map_eval_many(const struct sim_map *map, const struct sim_state *states, size_t n, double *out) {
    int bad = 0;
    for (size_t i = 0; i < n; ++i) bad += sim_map_eval(map, &states[i], out + i * (size_t)map->pairs) != 0;
    return bad;
}
