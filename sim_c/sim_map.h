// SPDX-License-Identifier: Apache-2.0
//
// Response map of a headset on one person: file reader and smooth interpolator. No dependencies beyond the C
// library; used by the virtual Nano and, through cffi, by the SDK.
//
// The map is the sum of a few tables, each over its own nodes of (slip, pupil, lids, gaze): what does not
// depend on a quantity has one node there (the face sees neither pupil nor azimuth), what varies fast has
// many (the glint's ring at the limbus is 1 to 3 degrees wide, the rest varies over tens).
//
// Units     relative irradiance: what the sensor collects per unit of axial emitter intensity, 1/mm^4 scale;
//           only ratios mean something. Scale with sim_map_mean().
// Between   tensor-product B-splines through the nodes: cubic, not-a-knot (C2), along axes of four or more
//           nodes, the polynomial through the nodes along shorter ones. Outside the grid the state is
//           clamped. The file says how large the error is: sim_map_error().
//
// File      little-endian; each block below starts at a multiple of 8 bytes (zeros between):
//   0   char   magic[8]        "SGMAP\r\n\x02"
//   8   u64    file_bytes      the whole file
//   16  u32    crc32           IEEE 802.3, of every byte from 20 on
//   20  u32    sensors         1..32
//   24  u32    emitters        1..32
//   28  u32    tables          1..8
//   32  f64    mean            see sim_map_mean(); > 0
//   40  f64    error[4]        struct sim_map_error; each >= 0, or -1: not measured
//   72  table heads, each 10 u32: kind (enum below), bytes per value (2 or 4), nodes of slip x, slip y,
//              slip z, pupil, lid, elevation, azimuth, 0 (reserved)
//   then each table:
//       f64    nodes of its seven axes in that order, strictly increasing
//       f64    offset[pairs], scale[pairs] >= 0; of tables of 2-byte values only
//       f32 or u16  coefficients [slip x][slip y][slip z][pupil][lid][elevation][azimuth][sensor][emitter] of
//              the B-splines; u16: offset + scale * value
// An axis of n nodes x[] has n coefficients; its knots are x[0] and x[n-1], each degree + 1 times, and
// x[2..n-3] between them; degree = min(3, n - 1).
#ifndef SIM_MAP_H
#define SIM_MAP_H

#include <stddef.h>

// cdef begin
enum {
    SIM_MAP_MAX_SENSORS = 32,
    SIM_MAP_MAX_EMITTERS = 32,
    SIM_MAP_MAX_TABLES = 8,
    SIM_MAP_MAX_STATE_NODES = 128,
    SIM_MAP_MAX_GAZE_NODES = 513
};

enum { SIM_MAP_SMOOTH = 0, SIM_MAP_GLINT = 1 };  // kinds of tables

// Where the eye looks and how it is. Angles are Fick azimuth/elevation in degrees, +x right, +y up
// (OpenXR's frame).
struct sim_state {
    double azimuth_deg, elevation_deg;
    double pupil_mm;     // diameter of the real pupil
    double lid_opening;  // 0 closed .. 1 as open as these lids are at that gaze
    double slip_mm[3];   // displacement of the headset relative to the head
};

// Error of a response between the nodes and at them, against direct and finer integration, of all gaze and
// pupils that the map covers; in the map's unit. -1 = nobody measured it.
struct sim_map_error {
    double open_rms, open_max;  // lids open
    double lids_rms, lids_max;  // lids anywhere between closed and open
};

struct sim_map;

// Open and check a map file. The file is treated as hostile: every size is bounded before it is used, the
// length and the checksum must be right, every number must be finite.
//   error, error_bytes   receives a one-line reason on failure; may be NULL, 0.
// Returns the map (sim_map_close() it), or NULL.
struct sim_map *sim_map_open(const char *path, char *error, size_t error_bytes);
void sim_map_close(struct sim_map *map);  // NULL allowed

int sim_map_sensors(const struct sim_map *map);
int sim_map_emitters(const struct sim_map *map);

// Response of every pair at one state: out[sensor * emitters + emitter], never negative.
// Returns 0, or -1 when a state field is not finite (out is then all zero). Reentrant. 1.5 (lids open) to 6
// microseconds for 36 pairs when vectorised.
int sim_map_eval(const struct sim_map *map, const struct sim_state *state, double *out);

// The same for n states in a row: out[n][sensors][emitters]. Returns the number of states that were not
// finite.
int sim_map_eval_many(const struct sim_map *map, const struct sim_state *states, size_t n, double *out);

// The same as two terms whose sum is the response; either pointer may be NULL. Not clamped at zero.
int sim_map_eval_parts(const struct sim_map *map, const struct sim_state *state, double *smooth,
                       double *glint);

// The response (not clamped at zero) and its derivatives, of the same splines: gradient[7][sensors][emitters]
// by azimuth and elevation (per degree), pupil (per mm), lid opening, slip x, y, z (per mm), as in struct
// sim_state. Where the state is clamped, and along axes of one node, they are 0; on the edge of the map,
// those from within. out may be NULL. Returns as sim_map_eval(). Two to five times its cost.
int sim_map_eval_gradient(const struct sim_map *map, const struct sim_state *state, double *out,
                          double *gradient);

// Mean over gaze within +-20 deg (an integral over both axes), over all sensors, of the sum over the other
// emitters, at pupil 3.5 mm, lids open, no slip: the number that [photocurrent].nominal_na belongs to.
double sim_map_mean(const struct sim_map *map);

struct sim_map_error sim_map_error(const struct sim_map *map);

// Nodes of one axis of one table, numbered as in the file (0 slip x .. 6 azimuth). Returns their count and
// points *nodes at them (borrowed), or 0 for an unknown table or axis.
int sim_map_axis(const struct sim_map *map, int table, int axis, const double **nodes);

// What a table holds (SIM_MAP_SMOOTH, SIM_MAP_GLINT), or -1 when there is no such table.
int sim_map_kind(const struct sim_map *map, int table);
// cdef end

#endif
