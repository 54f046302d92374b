// SPDX-License-Identifier: GPL-3.0-or-later
// What `set KEY VALUE` changes: parsed first, applied at a cycle, at once or as scheduled.
#ifndef SETTING_H
#define SETTING_H

#include <stdint.h>

struct nano;

struct setting {
    int key;                 // index of setting.c's table
    double number;           // what was given, or the index of a name
};

// Returns NULL, or why not (text that holds until the next call).
const char *setting_parse(const struct nano *nano, const char *key, const char *value, struct setting *out);
// Bring the board forward to a cycle, then change it.
void setting_apply(struct nano *nano, const struct setting *setting, uint64_t cycle);

#endif
