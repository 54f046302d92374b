// SPDX-License-Identifier: Apache-2.0
//
// Response map of a headset on one person: file reader and smooth interpolator. No dependencies beyond the C
// library; used by the virtual Nano and, through cffi, by the SDK.
//
// The map is response[sensor][emitter] = smooth(pupil, lid, slip, gaze) + glint(lid, slip, gaze), each part
// tabulated on its own gaze grid because the glint's ring at the limbus is about 3 degrees wide while the
// rest varies over tens.
//
// Units     relative irradiance: what the sensor collects per unit of axial emitter intensity, 1/mm^4 scale;
//           only ratios mean something. Scale with sim_map_mean().
// Between   cubic splines with not-a-knot ends (C2) along axes of four or more nodes, the polynomial through
//           the nodes along shorter ones. Outside the grid the state is clamped. Measured error: simulate.py.
//
// File      little-endian, no padding, float64 axes, float32 values:
//   0   char   magic[8]        "SGMAP\r\n\x01"
//   8   u64    file_bytes      the whole file
//   16  u32    crc32           IEEE 802.3, of every byte from 20 on
//   20  u32    sensors         1..32
//   24  u32    emitters        1..32
//   28  u32    nodes[11]       pupil, lid, slip x, slip y, slip z, elevation, azimuth of the smooth part;
//                              lid, elevation, azimuth of the glint part; 0 (reserved)
//   72  f64    mean            see sim_map_mean(); > 0
//   80  f64    axes            in that order, strictly increasing; gaze axes uniform, 1 or >= 4 nodes
//   ..  f32    smooth[slip x][slip y][slip z][pupil][lid][elevation][azimuth][sensor][emitter]
//   ..  f32    glint [slip x][slip y][slip z][lid][elevation][azimuth][sensor][emitter]
#ifndef SIM_MAP_H
#define SIM_MAP_H

#include <stddef.h>

// cdef begin
enum {
    SIM_MAP_MAX_SENSORS = 32,
    SIM_MAP_MAX_EMITTERS = 32,
    SIM_MAP_MAX_STATE_NODES = 32,
    SIM_MAP_MAX_GAZE_NODES = 513
};

// Where the eye looks and how it is. Angles are Fick azimuth/elevation in degrees, +x right, +y up
// (OpenXR's frame).
struct sim_state {
    double azimuth_deg, elevation_deg;
    double pupil_mm;     // diameter of the real pupil
    double lid_opening;  // 0 closed .. 1 as open as these lids are at that gaze
    double slip_mm[3];   // displacement of the headset relative to the head
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
// Returns 0, or -1 when a state field is not finite (out is then all zero). Reentrant. About 10 microseconds
// for 36 pairs.
int sim_map_eval(const struct sim_map *map, const struct sim_state *state, double *out);

// The same for n states in a row: out[n][sensors][emitters]. Returns the number of states that were not
// finite.
int sim_map_eval_many(const struct sim_map *map, const struct sim_state *states, size_t n, double *out);

// The same as two terms whose sum is the response; either pointer may be NULL. Not clamped at zero.
int sim_map_eval_parts(const struct sim_map *map, const struct sim_state *state, double *smooth,
                       double *glint);

// Mean over gaze within +-20 deg (both axes), over all sensors, of the sum over the other emitters, at
// pupil 3.5 mm, lids open, no slip: the number that [photocurrent].nominal_na belongs to.
double sim_map_mean(const struct sim_map *map);

// Nodes of one axis, numbered as in the file (0 pupil .. 9 glint azimuth). Returns their count and points
// *nodes at them (borrowed), or 0 for an unknown axis.
int sim_map_axis(const struct sim_map *map, int axis, const double **nodes);
// cdef end

#endif
