// SPDX-License-Identifier: GPL-3.0-or-later
#include "control.h"

#include <errno.h>
#include <fcntl.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "command.h"

int control_open(struct control *c, const char *path, struct session *session)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    memset(c, 0, sizeof *c);
    for (int i = 0; i < CONTROL_CLIENTS; i++)
        c->client[i].fd = -1;
    c->session = session;
    c->path = path;
    c->listener = -1;
    if (strlen(path) >= sizeof address.sun_path) {
        errno = ENAMETOOLONG;
        return -1;
    }
    strcpy(address.sun_path, path);
    c->listener = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    if (c->listener < 0)
        return -1;
    unlink(path);
    if (bind(c->listener, (struct sockaddr *)&address, sizeof address))
        return -1;
    return listen(c->listener, CONTROL_CLIENTS);
}

void control_close(struct control *c)
{
    for (int i = 0; i < CONTROL_CLIENTS; i++)
        if (c->client[i].fd >= 0)
            close(c->client[i].fd);
    if (c->listener >= 0) {
        close(c->listener);
        unlink(c->path);
    }
}

int control_polled(const struct control *c, struct pollfd *fds)
{
    int n = 0;
    fds[n++] = (struct pollfd){.fd = c->listener, .events = POLLIN};
    for (int i = 0; i < CONTROL_CLIENTS; i++)
        if (c->client[i].fd >= 0)
            fds[n++] = (struct pollfd){.fd = c->client[i].fd, .events = POLLIN};
    return n;
}

static void drop(struct control_client *client)
{
    close(client->fd);
    client->fd = -1;
}

static void accept_all(struct control *c)
{
    for (;;) {
        int fd = accept4(c->listener, NULL, NULL, SOCK_CLOEXEC | SOCK_NONBLOCK);
        if (fd < 0)
            return;
        int i = 0;
        while (i < CONTROL_CLIENTS && c->client[i].fd >= 0)
            i++;
        if (i == CONTROL_CLIENTS)
            close(fd);
        else
            c->client[i] = (struct control_client){.fd = fd};
    }
}

static void answer(struct control *c, struct control_client *client)
{
    char reply[COMMAND_REPLY_BYTES];
    if (client->skipping)
        strcpy(reply, "err line too long");
    else
        command_run(c->session, client->line, reply);
    strcat(reply, "\n");
    client->skipping = false;
    client->used = 0;
    // A client that asks without ever reading the answers is not worth waiting for.
    if (send(client->fd, reply, strlen(reply), MSG_NOSIGNAL) != (ssize_t)strlen(reply))
        drop(client);
}

static void serve_client(struct control *c, struct control_client *client)
{
    char block[4096];
    while (client->fd >= 0) {
        ssize_t n = recv(client->fd, block, sizeof block, 0);
        if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR))
            drop(client);
        if (n <= 0)
            return;
        for (ssize_t i = 0; i < n && client->fd >= 0; i++) {
            if (block[i] == '\n') {
                client->line[client->used] = 0;
                answer(c, client);
            } else if (client->used + 1 < CONTROL_LINE_BYTES) {
                client->line[client->used++] = block[i] ? block[i] : '?';
            } else {
                client->skipping = true;
            }
        }
    }
}

void control_serve(struct control *c)
{
    accept_all(c);
    for (int i = 0; i < CONTROL_CLIENTS; i++)
        if (c->client[i].fd >= 0)
            serve_client(c, &c->client[i]);
}
