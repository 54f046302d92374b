// SPDX-License-Identifier: GPL-3.0-or-later
// The commands of the control socket (README.md).
#ifndef COMMAND_H
#define COMMAND_H

struct session;

enum { COMMAND_REPLY_BYTES = 4096 };

// Carry out one line. reply[COMMAND_REPLY_BYTES] receives `ok ...` or `err ...` without newline, room left
// for one.
void command_run(struct session *session, const char *line, char *reply);

#endif
