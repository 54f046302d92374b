// SPDX-License-Identifier: GPL-3.0-or-later
// A running board and its clock.
//
// Paced     true time = cycles / 16e6 / (1 + clock error); the board runs in slices of about a millisecond.
// Unpaced   as fast as it goes, from the first client on: until somebody opens the port, presses reset or
//           speaks about time, the clock stands at 0, so that what follows does not depend on how fast the
//           host was.
// Lockstep  (unpaced only) the clock stands still except inside session_advance(): what the device does then
//           depends on the seed and on the sequence of advances and bytes alone.
#ifndef SESSION_H
#define SESSION_H

#include <signal.h>
#include <stdbool.h>
#include <stdint.h>

#include "bridge.h"
#include "nano.h"
#include "truth.h"

struct session {
    struct nano nano;
    struct bridge bridge;
    struct truth truth;
    bool started, lockstep;
    uint64_t lock_read, lock_written;   // byte counts of the bridge when lockstep began
    double pace_start_s;                // true time of pace_start_cycle
    uint64_t pace_start_cycle;
    double saved_s;                     // when the images were last looked at
    volatile sig_atomic_t stop;
};

int session_open(struct session *session, const struct config *config, char *error, size_t error_bytes);
// Returns 0, or -1 with errno set when the images could not be saved.
int session_close(struct session *session);

// Opens of the port, its speed. Call before time passes and before anything that depends on them.
void session_notice(struct session *session);
// Let time pass as the mode has it. Returns how long the caller may sleep, seconds; negative: until something
// happens.
double session_run(struct session *session);
void session_start(struct session *session);
void session_lockstep(struct session *session, bool on);
// See the README. Returns NULL, or why not.
const char *session_advance(struct session *session, uint64_t us, uint64_t host_bytes);

#endif
