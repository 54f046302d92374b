// SPDX-License-Identifier: GPL-3.0-or-later
// The simulated person: where the eye looks, pupil and lids, as a function of the device's time.
//
// Targets are scheduled in device microseconds. The eye follows a target after a latency (N(200, 20) ms,
// drawn per target) by a saccade on the main sequence (21 ms + 2.2 ms/deg, minimum-jerk profile), landing on
// the target plus a fixation bias drawn per target. Within a fixation: drift and microsaccades (1.2 per
// second, same profile). Pupil: mean of the person, slow drift (10 s) and hippus (0.25 s). Blinks: lids close
// in 70 ms, stay 20 ms, open in 150 ms. Everything steps on a 1 ms grid from counted draws, so the trajectory
// depends on the session's seed and the target schedule alone.
//
// Drift, slow drift and hippus are noise through two equal first-order stages, begun in their stationary
// state: their rms is the same at every moment. fixation_drift_deg is what drift leaves, per axis, about the
// mean of a window of 0.5 s, as a settled fixation is judged; over all time it is half as much again, because
// its time constant (0.1 s; 1.5 deg/s rms) lets the mean of such a window move too.
#ifndef PERSON_H
#define PERSON_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "../../sim_c/sim_map.h"
#include "config.h"

enum { PERSON_RING = 64 };

struct person_target { double us, azimuth_deg, elevation_deg; };

struct person_view {
    struct sim_state state;
    double target_azimuth_deg, target_elevation_deg;
    bool blink;
};

// One millisecond of the trajectory.
struct person_tick { double azimuth_deg, elevation_deg, pupil_mm, lid_opening; bool blink; };

struct person_move { double from[2], to[2], start_ms, length_ms; };

struct person {
    uint64_t seed;
    double bias_deg, drift_deg, pupil_mean_mm, blinks_per_min;  // drift_deg: rms over all time, per axis
    bool follow;               // false: the eye is exactly on the target, at once
    bool motion;               // false: no drift, microsaccades, bias, pupil motion, blinks
    bool microsaccades;
    double lid_forced;         // >= 0: lids held there
    double slip_mm[3];
    struct person_target *target;
    size_t targets, room, next;     // target[next..] are not yet looked at
    uint64_t looked_at;             // targets ever looked at: numbers the draws
    double latency_ms;              // of target[next]
    struct person_move saccade, micro;
    double drift[2][2], pupil_slow[2], hippus[2];  // filter stages
    double micro_next_ms, blink_start_ms, blink_next_ms;
    uint64_t micros, blinks;
    int64_t ticked;                 // last tick made
    struct person_tick ring[PERSON_RING];
};

// seed: of the session; the person's own traits come from the configuration's.
void person_init(struct person *person, const struct config *config, uint64_t seed);
// Draw behaviour from another session's seed from now on; what is under way goes on.
void person_seed(struct person *person, uint64_t seed);
void person_free(struct person *person);
// Look at a point from us on. Returns 0, or -1 when out of memory.
int person_target_at(struct person *person, double us, double azimuth_deg, double elevation_deg);
void person_targets_clear(struct person *person);
// State at a time not more than PERSON_RING - 4 ms before the latest one asked for.
void person_view_at(struct person *person, double us, struct person_view *view);

#endif
