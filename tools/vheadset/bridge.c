// SPDX-License-Identifier: GPL-3.0-or-later
#include "bridge.h"

#include <asm/termbits.h>
#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/inotify.h>
#include <sys/ioctl.h>
#include <unistd.h>

static int ring_put(struct ring *r, uint8_t byte)
{
    if (r->used == BRIDGE_RING_BYTES)
        return -1;
    r->data[(r->head + r->used++) % BRIDGE_RING_BYTES] = byte;
    return 0;
}

static void ring_skip(struct ring *r, size_t n)
{
    r->head = (r->head + n) % BRIDGE_RING_BYTES;
    r->used -= n;
}

int bridge_open(struct bridge *b)
{
    struct termios2 mode;
    memset(b, 0, sizeof *b);
    b->slave = b->watch = -1;
    b->to_host.data = malloc(BRIDGE_RING_BYTES);
    b->to_device.data = malloc(BRIDGE_RING_BYTES);
    b->master = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (!b->to_host.data || !b->to_device.data || b->master < 0 || grantpt(b->master) || unlockpt(b->master)
        || ptsname_r(b->master, b->port, sizeof b->port))
        return -1;
    // Our own handle of the slave keeps the pty alive between clients.
    b->slave = open(b->port, O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (b->slave < 0 || ioctl(b->slave, TCGETS2, &mode))
        return -1;
    mode.c_iflag = 0;
    mode.c_oflag = 0;
    mode.c_lflag = 0;
    mode.c_cflag = (mode.c_cflag & ~(tcflag_t)(CSIZE | PARENB | CSTOPB)) | CS8 | CREAD | CLOCAL;
    mode.c_cc[VMIN] = 1;
    mode.c_cc[VTIME] = 0;
    if (ioctl(b->slave, TCSETS2, &mode) || fcntl(b->master, F_SETFL, O_NONBLOCK))
        return -1;
    b->watch = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
    if (b->watch < 0 || inotify_add_watch(b->watch, b->port, IN_OPEN | IN_CLOSE) < 0)
        return -1;
    bridge_poll_baud(b);
    return 0;
}

void bridge_close(struct bridge *b)
{
    if (b->watch >= 0)
        close(b->watch);
    if (b->slave >= 0)
        close(b->slave);
    if (b->master >= 0)
        close(b->master);
    free(b->to_host.data);
    free(b->to_device.data);
}

int bridge_opens(struct bridge *b)
{
    char events[4096] __attribute__((aligned(8)));
    int opens = 0;
    for (;;) {
        ssize_t n = read(b->watch, events, sizeof events);
        if (n <= 0)
            return opens;
        for (ssize_t at = 0; at < n;) {
            const struct inotify_event *event = (const void *)(events + at);
            at += (ssize_t)(sizeof *event + event->len);
            if (event->mask & IN_OPEN) {
                opens++;
                b->clients++;
            } else if ((event->mask & IN_CLOSE) && b->clients > 0 && --b->clients == 0) {
                bridge_flush_to_host(b);
            }
        }
    }
}

double bridge_baud(const struct bridge *b)
{
    return b->baud;
}

void bridge_poll_baud(struct bridge *b)
{
    struct termios2 mode;
    if (!ioctl(b->slave, TCGETS2, &mode))
        b->baud = mode.c_ospeed;
}

void bridge_read(struct bridge *b, size_t most)
{
    uint8_t block[4096];
    while (most) {
        ssize_t n = read(b->master, block, most < sizeof block ? most : sizeof block);
        if (n <= 0)
            return;
        most -= (size_t)n;
        b->read_bytes += (uint64_t)n;
        for (ssize_t i = 0; i < n; i++)
            if (ring_put(&b->to_device, block[i]))
                b->device_dropped++;
    }
}

void bridge_write(struct bridge *b)
{
    struct ring *r = &b->to_host;
    while (r->used) {
        size_t part = BRIDGE_RING_BYTES - r->head;
        if (part > r->used)
            part = r->used;
        ssize_t n = write(b->master, r->data + r->head, part);
        if (n <= 0)
            return;
        b->written_bytes += (uint64_t)n;
        ring_skip(r, (size_t)n);
    }
}

void bridge_flush_to_host(struct bridge *b)
{
    b->to_host.used = 0;
    ioctl(b->slave, TCFLSH, TCIFLUSH);
}

void bridge_give(struct bridge *b, uint8_t byte)
{
    if (!b->clients)
        return;
    if (ring_put(&b->to_host, byte))
        b->host_dropped++;
    else
        b->given_bytes++;
}

bool bridge_take(struct bridge *b, uint8_t *byte)
{
    struct ring *r = &b->to_device;
    if (!r->used)
        return false;
    *byte = r->data[r->head];
    ring_skip(r, 1);
    return true;
}
