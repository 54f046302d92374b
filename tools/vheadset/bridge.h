// SPDX-License-Identifier: GPL-3.0-or-later
// The USB bridge: a pseudo terminal, a ring of a megabyte each way, and the news of who opens the port.
//
// While nobody has the slave open, what the device sends is lost, as on a closed port; what a client left
// unread when it closed is thrown away. Opens and closes are watched with inotify, because polling for a
// hang-up misses a fast close and open.
#ifndef BRIDGE_H
#define BRIDGE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { BRIDGE_RING_BYTES = 1 << 20 };

struct ring { uint8_t *data; size_t head, used; };  // head: next byte to take

struct bridge {
    int master, slave, watch;
    char port[64];
    struct ring to_host, to_device;
    int clients;
    double baud;
    uint64_t read_bytes;     // ever read from the pty
    uint64_t given_bytes;    // ever put into to_host while a client was there
    uint64_t written_bytes;  // ever written to the pty
    uint64_t host_dropped, device_dropped;
};

// Returns 0, or -1 with errno set.
int bridge_open(struct bridge *bridge);
void bridge_close(struct bridge *bridge);

// Notice opens and closes. Returns how many times the port was opened since the last call.
int bridge_opens(struct bridge *bridge);
// Speed the client set on its side, in baud; bridge_poll_baud() looks it up.
double bridge_baud(const struct bridge *bridge);
void bridge_poll_baud(struct bridge *bridge);

// Move what is there without waiting: pty -> to_device (at most `most` bytes), to_host -> pty.
void bridge_read(struct bridge *bridge, size_t most);
void bridge_write(struct bridge *bridge);
// Throw away what the device has sent and nobody has read (a reset).
void bridge_flush_to_host(struct bridge *bridge);

// The device's side.
void bridge_give(struct bridge *bridge, uint8_t byte);
bool bridge_take(struct bridge *bridge, uint8_t *byte);

#endif
