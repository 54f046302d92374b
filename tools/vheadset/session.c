// SPDX-License-Identifier: GPL-3.0-or-later
#include "session.h"

#include <poll.h>
#include <string.h>
#include <time.h>

enum { SLICE_CYCLES = 16000, BURST_CYCLES = 10 * SLICE_CYCLES, UNPACED_CYCLES = 2 * SLICE_CYCLES };
enum { HOST_BYTES_WAIT_MS = 5000 };
static const double SLICE_S = 1e-3, LAG_FORGIVEN_S = 1.0, SAVE_EVERY_S = 0.2;

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

int session_open(struct session *s, const struct config *config, char *error, size_t error_bytes)
{
    memset(s, 0, sizeof *s);
    if (bridge_open(&s->bridge)) {
        snprintf(error, error_bytes, "cannot make a pseudo terminal: %m");
        return -1;
    }
    if (nano_open(&s->nano, config, &s->bridge, error, error_bytes))
        return -1;
    if (*config->truth && truth_open(&s->truth, config->truth, 0)) {
        snprintf(error, error_bytes, "cannot write %s: %m", config->truth);
        return -1;
    }
    if (!config->unpaced)
        session_start(s);
    return 0;
}

int session_close(struct session *s)
{
    truth_open(&s->truth, NULL, 0);
    int bad = nano_power(&s->nano, false);
    nano_close(&s->nano);
    bridge_close(&s->bridge);
    return bad;
}

void session_start(struct session *s)
{
    if (s->started)
        return;
    s->started = true;
    s->pace_start_s = now_s();
    s->pace_start_cycle = s->nano.avr->cycle;
}

void session_notice(struct session *s)
{
    int opens = bridge_opens(&s->bridge);
    bridge_poll_baud(&s->bridge);
    if (!opens)
        return;
    if (s->nano.config.auto_reset)
        nano_press_reset(&s->nano);
    session_start(s);
}

static void run_until(struct session *s, uint64_t cycle)
{
    nano_run_until(&s->nano, cycle);
    truth_write(&s->truth, &s->nano.person, s->nano.avr->cycle);
}

static void save_now_and_then(struct session *s, double now)
{
    if (now - s->saved_s < SAVE_EVERY_S)
        return;
    s->saved_s = now;
    nano_save(&s->nano);
}

static double run_paced(struct session *s)
{
    double now = now_s(), rate = s->nano.cycles_per_true_second;
    uint64_t cycle = s->nano.avr->cycle;
    uint64_t due = s->pace_start_cycle + (uint64_t)((now - s->pace_start_s) * rate);
    if (due > cycle + (uint64_t)(LAG_FORGIVEN_S * rate)) {  // the machine slept: do not race after it
        s->pace_start_s = now;
        s->pace_start_cycle = cycle;
        due = cycle;
    }
    if (due > cycle + BURST_CYCLES)
        due = cycle + BURST_CYCLES;
    if (due > cycle)
        run_until(s, due);
    save_now_and_then(s, now);
    double ahead = (double)(s->nano.avr->cycle - s->pace_start_cycle) / rate - (now_s() - s->pace_start_s);
    return ahead + SLICE_S > 0 ? ahead + SLICE_S : 0;
}

double session_run(struct session *s)
{
    if (!s->started || s->lockstep) {
        save_now_and_then(s, now_s());
        return s->nano.selfprog.dirty || s->nano.eeprom.dirty ? SAVE_EVERY_S : -1;
    }
    double wait = 0;
    bridge_read(&s->bridge, BRIDGE_RING_BYTES - s->bridge.to_device.used);
    if (s->nano.powered)
        uart_line_wake(&s->nano.uart);
    if (s->nano.config.unpaced) {
        run_until(s, s->nano.avr->cycle + UNPACED_CYCLES);
        save_now_and_then(s, now_s());
    } else {
        wait = run_paced(s);
    }
    bridge_write(&s->bridge);
    return wait;
}

void session_lockstep(struct session *s, bool on)
{
    session_start(s);
    s->lockstep = on;
    s->pace_start_s = now_s();
    s->pace_start_cycle = s->nano.avr->cycle;
    s->lock_read = s->bridge.read_bytes;
    s->lock_written = s->bridge.written_bytes;
}

const char *session_advance(struct session *s, uint64_t us, uint64_t host_bytes)
{
    if (!s->lockstep)
        return "advance needs lockstep 1";
    if (us > UINT64_MAX / 32)
        return "no such time";
    while (s->bridge.read_bytes - s->lock_read < host_bytes) {
        struct pollfd wait = {.fd = s->bridge.master, .events = POLLIN};
        if (poll(&wait, 1, HOST_BYTES_WAIT_MS) <= 0 || !(wait.revents & POLLIN))
            return "the host's bytes did not arrive";
        bridge_read(&s->bridge, host_bytes - (s->bridge.read_bytes - s->lock_read));
    }
    if (s->nano.powered)
        uart_line_wake(&s->nano.uart);
    while (s->nano.avr->cycle < us * 16 && !s->stop) {
        uint64_t left = us * 16 - s->nano.avr->cycle;
        run_until(s, s->nano.avr->cycle + (left < BURST_CYCLES ? left : BURST_CYCLES));
        bridge_write(&s->bridge);
    }
    bridge_write(&s->bridge);
    return NULL;
}
