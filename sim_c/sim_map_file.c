// SPDX-License-Identifier: Apache-2.0
//
// The reader of map files: checks every size and number before it is used.
#include "sim_map_inside.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { N_AXES = SIM_MAP_AXES, FIRST_GAZE_AXIS = 5, HEADER_BYTES = 72, HEAD_BYTES = 40 };
#define MAX_VALUES (UINT64_C(1) << 28)

static const unsigned char MAGIC[8] = {'S', 'G', 'M', 'A', 'P', '\r', '\n', 2};

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

// Eight bytes at a step: the table of byte k says what a byte does that k more bytes follow.
static uint32_t crc32_of(const unsigned char *p, size_t n) {
    static const int SLICES = 8;
    uint32_t table[8][256], crc = 0xFFFFFFFFu;
    for (uint32_t i = 0; i < 256; ++i) {
        uint32_t c = i;
        for (int k = 0; k < 8; ++k) c = c & 1 ? 0xEDB88320u ^ c >> 1 : c >> 1;
        table[0][i] = c;
    }
    for (int k = 1; k < SLICES; ++k)
        for (int i = 0; i < 256; ++i)
            table[k][i] = table[0][table[k - 1][i] & 0xFF] ^ table[k - 1][i] >> 8;
    for (; n >= 8; n -= 8, p += 8) {
        crc ^= (uint32_t)get_le(p, 4);
        crc = table[7][crc & 0xFF] ^ table[6][crc >> 8 & 0xFF] ^ table[5][crc >> 16 & 0xFF] ^
              table[4][crc >> 24] ^ table[3][p[4]] ^ table[2][p[5]] ^ table[1][p[6]] ^ table[0][p[7]];
    }
    for (; n; --n, ++p) crc = table[0][(crc ^ *p) & 0xFF] ^ crc >> 8;
    return ~crc;
}

// Bring n numbers to this machine's byte order, in place. Returns them, or NULL when one is not finite.
static const double *doubles_here(unsigned char *p, size_t n) {
    double *out = (double *)(void *)p;
    for (size_t i = 0; i < n; ++i) {
        out[i] = get_f64(p + 8 * i);
        if (!isfinite(out[i])) return NULL;
    }
    return out;
}

static int values_here(unsigned char *p, size_t n, int bytes) {
    if (bytes == 2) {
        uint16_t *out = (uint16_t *)(void *)p;
        for (size_t i = 0; i < n; ++i) out[i] = (uint16_t)(p[2 * i] | p[2 * i + 1] << 8);
        return 0;
    }
    float *out = (float *)(void *)p;
    int ok = 1;
    for (size_t i = 0; i < n; ++i) {
        const unsigned char *b = p + 4 * i;
        uint32_t bits = b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
        memcpy(&out[i], &bits, sizeof bits);
        ok &= fabsf(out[i]) < 1e30f;
    }
    return ok ? 0 : -1;
}

static int read_table(struct sim_map *map, struct sim_map_table *t, unsigned char **at, double **knots,
                      char *error, size_t bytes) {
    size_t pairs = (size_t)map->pairs, values = pairs;
    for (int k = N_AXES - 1; k >= 0; --k) {
        t->stride[k] = values;
        values *= (size_t)t->axis[k].n;
    }
    for (int k = 0; k < N_AXES; ++k) {
        int n = t->axis[k].n;
        const double *x = doubles_here(*at, (size_t)n);
        if (!x) return fail(error, bytes, "an axis holds a number that is not finite");
        for (int i = 0; i < n; ++i) {
            if (fabs(x[i]) > 1e6) return fail(error, bytes, "an axis holds an absurd number");
            if (i && x[i] - x[i - 1] < 1e-6) return fail(error, bytes, "an axis is not increasing");
        }
        t->axis[k].nodes = (double *)(void *)*at;
        t->axis[k].knots = *knots;
        spline_knots(&t->axis[k]);
        *knots += n + 4;
        *at += 8 * (size_t)n;
    }
    if (t->bytes == 2) {
        const double *range = doubles_here(*at, 2 * pairs);
        for (size_t i = 0; range && i < 2 * pairs; ++i)
            if (fabs(range[i]) > 1e30 || (i >= pairs && range[i] < 0)) range = NULL;
        if (!range) return fail(error, bytes, "a scale of responses is not finite");
        t->offset = range;
        t->scale = range + pairs;
        *at += 16 * pairs;
    }
    if (values_here(*at, values, t->bytes)) return fail(error, bytes, "a response is not finite");
    t->values = *at;
    *at += (values * (size_t)t->bytes + 7) / 8 * 8;
    return 0;
}

// Sizes of one table: its bytes in the file after its head, its axes' nodes; 0 when they are absurd.
static uint64_t table_bytes(const unsigned char *head, struct sim_map_table *t, uint64_t pairs,
                            uint64_t *nodes, uint64_t *all_values) {
    uint64_t kind = get_le(head, 4), width = get_le(head + 4, 4), values = pairs;
    *nodes = 0;
    if (kind > SIM_MAP_GLINT || (width != 2 && width != 4)) return 0;
    for (int k = 0; k < N_AXES; ++k) {
        uint64_t n = get_le(head + 8 + 4 * k, 4);
        if (n < 1 || n > (k >= FIRST_GAZE_AXIS ? SIM_MAP_MAX_GAZE_NODES : SIM_MAP_MAX_STATE_NODES)) return 0;
        t->axis[k].n = (int)n;
        *nodes += n;
        values *= n;  // at most 2^28 * 2^10 before it is compared
        if (values > MAX_VALUES) return 0;
    }
    *all_values += values;
    t->kind = (int)kind;
    t->bytes = (int)width;
    return 8 * *nodes + (width == 2 ? 16 * pairs : 0) + (values * width + 7) / 8 * 8;
}

static int parse(struct sim_map *map, size_t size, char *error, size_t bytes) {
    unsigned char *file = map->file;
    if (size < HEADER_BYTES) return fail(error, bytes, "not a response map: too short");
    if (memcmp(file, MAGIC, sizeof MAGIC)) return fail(error, bytes, "not a response map of this version");
    if (get_le(file + 8, 8) != size)
        return fail(error, bytes, "truncated or extended: the length is not the one in the header");
    uint64_t sensors = get_le(file + 20, 4), emitters = get_le(file + 24, 4), tables = get_le(file + 28, 4);
    if (sensors < 1 || sensors > SIM_MAP_MAX_SENSORS || emitters < 1 || emitters > SIM_MAP_MAX_EMITTERS)
        return fail(error, bytes, "number of sensors or emitters out of range");
    if (tables < 1 || tables > SIM_MAP_MAX_TABLES)
        return fail(error, bytes, "number of tables out of range");
    uint64_t length = HEADER_BYTES + HEAD_BYTES * tables, all_nodes = 0, all_values = 0;
    if (size < length) return fail(error, bytes, "not a response map: too short");
    for (uint64_t i = 0; i < tables; ++i) {
        const unsigned char *head = file + HEADER_BYTES + HEAD_BYTES * i;
        uint64_t nodes, more = table_bytes(head, &map->table[i], sensors * emitters, &nodes, &all_values);
        if (!more) return fail(error, bytes, "a table is of unknown kind or too large");
        if (get_le(head + 36, 4)) return fail(error, bytes, "reserved field is not zero");
        length += more;
        all_nodes += nodes;
    }
    if (all_values > MAX_VALUES) return fail(error, bytes, "too large");
    if (size != length) return fail(error, bytes, "the length does not fit the number of nodes");
    if (get_le(file + 16, 4) != crc32_of(file + 20, size - 20))
        return fail(error, bytes, "damaged: checksum mismatch");
    map->sensors = (int)sensors;
    map->emitters = (int)emitters;
    map->pairs = (int)(sensors * emitters);
    map->n_tables = (int)tables;
    map->mean = get_f64(file + 32);
    if (!isfinite(map->mean) || map->mean <= 0)
        return fail(error, bytes, "the mean response is not positive");
    double stated[4];
    for (int k = 0; k < 4; ++k) {
        stated[k] = get_f64(file + 40 + 8 * k);
        if (!(stated[k] == -1 || (stated[k] >= 0 && stated[k] < 1e30)))
            return fail(error, bytes, "a stated error is not a possible one");
    }
    map->error = (struct sim_map_error){stated[0], stated[1], stated[2], stated[3]};
    double *knots = map->knots = malloc((size_t)(all_nodes + 4 * N_AXES * tables) * sizeof *knots);
    if (!knots) return fail(error, bytes, "out of memory");
    unsigned char *at = file + HEADER_BYTES + HEAD_BYTES * tables;
    for (uint64_t i = 0; i < tables; ++i)
        if (read_table(map, &map->table[i], &at, &knots, error, bytes)) return -1;
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
    if (!map) {
        free(file);
        fail(error, error_bytes, "out of memory");
        return NULL;
    }
    map->file = file;
    if (!parse(map, size, error, error_bytes)) return map;
    sim_map_close(map);
    return NULL;
}

void sim_map_close(struct sim_map *map) {
    if (!map) return;
    free(map->knots);
    free(map->file);
    free(map);
}
