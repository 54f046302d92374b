// SPDX-License-Identifier: GPL-3.0-or-later
// Log of where the simulated eye really looked: a row every millisecond of device time.
#ifndef TRUTH_H
#define TRUTH_H

#include <stdint.h>
#include <stdio.h>

struct person;

struct truth { FILE *file; uint64_t next_ms; };

// Begin a file at the present; a previous one is closed. path NULL: only close. Returns 0, or -1 with errno
// set.
int truth_open(struct truth *truth, const char *path, uint64_t cycle);
// Write the rows up to a cycle and hand them to the system.
void truth_write(struct truth *truth, struct person *person, uint64_t cycle);

#endif
