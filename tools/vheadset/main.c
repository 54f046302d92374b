// SPDX-License-Identifier: GPL-3.0-or-later
// vheadset: an Arduino Nano with its six LEDs and a simulated person, on a pseudo terminal. See README.md.
#include <errno.h>
#include <inttypes.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "config.h"
#include "control.h"
#include "session.h"

static struct session session;

static void on_signal(int number)
{
    (void)number;
    session.stop = 1;
}

static void print_json_text(const char *text)
{
    putchar('"');
    for (; *text; text++)
        if (*text == '"' || *text == '\\')
            printf("\\%c", *text);
        else if ((unsigned char)*text < ' ')
            printf("\\u%04x", *text);
        else
            putchar(*text);
    putchar('"');
}

static void on_sent(void *param, uint8_t byte, uint64_t cycle)
{
    if (byte == 0)
        markers_log(param, "delimiter", cycle);
}

// Make path a link to the port, replacing an older link at once, and nothing else: a file or directory of
// that name is somebody's. Returns 0, or -1 with errno set, EEXIST when it is not ours to replace.
static int make_link(const char *path, const char *port)
{
    char temporary[CONFIG_PATH_BYTES + 32];
    struct stat there;
    if (!symlink(port, path))
        return 0;
    if (errno != EEXIST || lstat(path, &there))
        return -1;
    if (!S_ISLNK(there.st_mode)) {
        errno = EEXIST;
        return -1;
    }
    snprintf(temporary, sizeof temporary, "%s.%ld", path, (long)getpid());
    if (symlink(port, temporary))
        return -1;
    if (rename(temporary, path)) {
        int keep = errno;
        unlink(temporary);
        errno = keep;
        return -1;
    }
    return 0;
}

static void remove_link(const char *path, const char *port)
{
    char where[128];
    ssize_t n = readlink(path, where, sizeof where - 1);
    if (n > 0 && (size_t)n == strlen(port) && !memcmp(where, port, (size_t)n))
        unlink(path);
}

static void serve(struct control *control)
{
    sigset_t blocked, before;
    sigemptyset(&blocked);
    sigaddset(&blocked, SIGTERM);
    sigaddset(&blocked, SIGINT);
    for (;;) {
        struct pollfd fds[CONTROL_CLIENTS + 4];
        session_notice(&session);
        double wait = session_run(&session);
        int n = control_polled(control, fds);
        fds[n++] = (struct pollfd){.fd = session.bridge.watch, .events = POLLIN};
        if (session.started && !session.lockstep)
            fds[n++] = (struct pollfd){.fd = session.bridge.master, .events = POLLIN};
        struct timespec timeout = {.tv_sec = (time_t)wait};
        timeout.tv_nsec = (long)((wait - (double)timeout.tv_sec) * 1e9);
        // Blocked between the question and ppoll, so that no signal is slept through.
        sigprocmask(SIG_BLOCK, &blocked, &before);
        if (!session.stop)
            ppoll(fds, (nfds_t)n, wait < 0 ? NULL : &timeout, &before);
        sigprocmask(SIG_SETMASK, &before, NULL);
        if (session.stop)
            return;
        control_serve(control);
    }
}

int main(int argc, char **argv)
{
    char error[CONFIG_PATH_BYTES + 256] = "";
    struct config config;
    struct control control;
    struct sigaction action = {.sa_handler = on_signal};
    if (argc == 2 && !strcmp(argv[1], "--list-physics")) {
        config_list_physics(stdout);
        return 0;
    }
    if (argc != 3 || strcmp(argv[1], "--config")) {
        fprintf(stderr, "usage: vheadset --config FILE | --list-physics\n");
        return argc == 2 && !strcmp(argv[1], "--help") ? 0 : 1;
    }
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    signal(SIGPIPE, SIG_IGN);
    if (config_read(&config, argv[2], error, sizeof error)
        || session_open(&session, &config, error, sizeof error)) {
        fprintf(stderr, "vheadset: %s\n", error);
        return 1;
    }
    session.nano.uart.on_sent = on_sent;
    session.nano.uart.on_sent_param = &session.nano.markers;
    if (control_open(&control, config.control, &session)) {
        fprintf(stderr, "vheadset: cannot listen on %s: %s\n", config.control, strerror(errno));
        return 1;
    }
    if (*config.link && make_link(config.link, session.bridge.port)) {
        fprintf(stderr, errno == EEXIST
                ? "vheadset: %s exists and is not a symbolic link: remove it or name another path\n"
                : "vheadset: cannot link %s: %m\n", config.link);
        control_close(&control);
        session_close(&session);
        return 1;
    }
    printf("{\"port\": ");
    print_json_text(session.bridge.port);
    printf(", \"control\": ");
    print_json_text(config.control);
    printf(", \"pid\": %ld}\n", (long)getpid());
    fflush(stdout);
    serve(&control);
    if (*config.link)
        remove_link(config.link, session.bridge.port);
    control_close(&control);
    if (session.nano.markers.frames)
        fclose(session.nano.markers.frames);
    if (session_close(&session)) {
        fprintf(stderr, "vheadset: cannot save the memory images in %s: %s\n", config.state, strerror(errno));
        return 1;
    }
    return 0;
}
