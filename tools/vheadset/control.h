// SPDX-License-Identifier: GPL-3.0-or-later
// The control socket: a Unix stream socket, one command a line, each answered by one line `ok ...` or `err
// ...`. The commands are described in README.md.
#ifndef CONTROL_H
#define CONTROL_H

#include <poll.h>
#include <stdbool.h>
#include <stddef.h>

struct session;

enum { CONTROL_CLIENTS = 8, CONTROL_LINE_BYTES = 1400 };

struct control_client { int fd; bool skipping; size_t used; char line[CONTROL_LINE_BYTES]; };

struct control {
    struct session *session;
    const char *path;
    int listener;
    struct control_client client[CONTROL_CLIENTS];
};

// Returns 0, or -1 with errno set.
int control_open(struct control *control, const char *path, struct session *session);
void control_close(struct control *control);
// Descriptors to poll (at most CONTROL_CLIENTS + 1); returns how many.
int control_polled(const struct control *control, struct pollfd *fds);
// Serve whatever has come in, without waiting.
void control_serve(struct control *control);

#endif
