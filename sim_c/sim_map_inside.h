// SPDX-License-Identifier: Apache-2.0
//
// A response map in memory, for sim_map.c, which evaluates it, and sim_map_file.c, which reads it. Whoever
// reads maps compiles these two and nothing else.
#ifndef SIM_MAP_INSIDE_H
#define SIM_MAP_INSIDE_H

#include "sim_map.h"
#include "sim_map_spline.h"

enum { SIM_MAP_AXES = 7 };

struct sim_map_table {
    int kind, bytes;
    struct spline_axis axis[SIM_MAP_AXES];
    size_t stride[SIM_MAP_AXES];    // in values
    const double *offset, *scale;   // per pair; NULL for 4-byte values
    const void *values;             // float or uint16_t
};

struct sim_map {
    int sensors, emitters, pairs, n_tables;
    double mean;
    struct sim_map_error error;
    struct sim_map_table table[SIM_MAP_MAX_TABLES];
    double *knots;        // of all axes
    unsigned char *file;  // nodes, offsets, scales and coefficients live in here
};

#endif
