// SPDX-License-Identifier: GPL-3.0-or-later
#include "command.h"

#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include "session.h"

enum { WORDS = 6, LINE_BYTES = 1400 };

struct call {
    struct session *session;
    struct nano *nano;
    int words;
    const char *word[WORDS];   // word[0] is the command
    const char *rest;          // everything after the command: paths may hold blanks
    char *reply;
};

static void say(struct call *c, const char *format, ...)
{
    va_list list;
    va_start(list, format);
    vsnprintf(c->reply, COMMAND_REPLY_BYTES - 2, format, list);
    va_end(list);
}

static bool real(const char *text, double low, double high, double *out)
{
    char *end;
    double value = text ? strtod(text, &end) : 0;
    if (!text || end == text || *end || !isfinite(value) || value < low || value > high)
        return false;
    *out = value;
    return true;
}

static bool whole(const char *text, uint64_t *out)
{
    char *end;
    if (!text || *text < '0' || *text > '9')
        return false;
    *out = strtoull(text, &end, 10);
    return !*end;
}

static bool flag(struct call *c, bool *out)
{
    if (c->words != 2 || (strcmp(c->word[1], "0") && strcmp(c->word[1], "1"))) {
        say(c, "err %s takes 0 or 1", c->word[0]);
        return false;
    }
    *out = c->word[1][0] == '1';
    say(c, "ok");
    return true;
}

static void do_time(struct call *c)
{
    uint64_t cycle = c->nano->avr->cycle;
    say(c, "ok %" PRIu64 " %" PRIu64 " %d", cycle, cycle / 16,
        c->nano->powered && c->session->started && !c->session->lockstep);
}

static void do_lockstep(struct call *c)
{
    bool on;
    if (!c->nano->config.unpaced)
        say(c, "err lockstep needs an unpaced board");
    else if (flag(c, &on))
        session_lockstep(c->session, on);
}

static void do_advance(struct call *c)
{
    uint64_t us, bytes;
    if (c->words != 3 || !whole(c->word[1], &us) || !whole(c->word[2], &bytes)) {
        say(c, "err advance takes microseconds and a byte count");
        return;
    }
    const char *why = session_advance(c->session, us, bytes);
    if (why)
        say(c, "err %s", why);
    else
        say(c, "ok %" PRIu64 " %" PRIu64, c->nano->avr->cycle / 16,
            c->session->bridge.written_bytes - c->session->lock_written);
}

static void do_target(struct call *c)
{
    double us, azimuth, elevation;
    if (c->words != 4 || !real(c->word[1], 0, 1e15, &us) || !real(c->word[2], -90, 90, &azimuth)
        || !real(c->word[3], -90, 90, &elevation))
        say(c, "err target takes microseconds, azimuth and elevation in degrees");
    else if (person_target_at(&c->nano->person, us, azimuth, elevation))
        say(c, "err out of memory");
    else
        say(c, "ok");
}

static void do_targets(struct call *c)
{
    if (c->words != 2 || strcmp(c->word[1], "clear")) {
        say(c, "err targets takes clear");
        return;
    }
    person_targets_clear(&c->nano->person);
    say(c, "ok");
}

static void do_follow(struct call *c)
{
    flag(c, &c->nano->person.follow);
}

static void do_motion(struct call *c)
{
    flag(c, &c->nano->person.motion);
}

static void do_state(struct call *c)
{
    struct person_view v;
    uint64_t cycle = c->nano->avr->cycle;
    person_view_at(&c->nano->person, (double)cycle / 16, &v);
    say(c, "ok %" PRIu64 " %.6f %.6f %.5f %.5f %.6f %.6f %d", cycle / 16, v.state.azimuth_deg,
        v.state.elevation_deg, v.state.pupil_mm, v.state.lid_opening, v.target_azimuth_deg,
        v.target_elevation_deg, v.blink);
}

static void do_truth(struct call *c)
{
    if (c->words < 2)
        say(c, "err truth takes a path or off");
    else if (truth_open(&c->session->truth, strcmp(c->rest, "off") ? c->rest : NULL, c->nano->avr->cycle))
        say(c, "err cannot write there: %m");
    else
        say(c, "ok");
}

static void do_frames(struct call *c)
{
    FILE **file = &c->nano->markers.frames;
    const char *path = c->rest;
    if (!strncmp(path, "on ", 3))
        path += 3;
    else if (strcmp(path, "off")) {
        say(c, "err frames takes on PATH or off");
        return;
    }
    if (*file)
        fclose(*file);
    *file = NULL;
    if (path != c->rest) {
        *file = fopen(path, "w");
        if (!*file) {
            say(c, "err cannot write there: %m");
            return;
        }
        fprintf(*file, "event,cycle\n");
    }
    say(c, "ok");
}

static void do_reset(struct call *c)
{
    nano_press_reset(c->nano);
    session_start(c->session);
    say(c, "ok");
}

static void do_power(struct call *c)
{
    bool on = c->words == 2 && !strcmp(c->word[1], "on");
    if (!on && (c->words != 2 || strcmp(c->word[1], "off")))
        say(c, "err power takes on or off");
    else if (nano_power(c->nano, on))
        say(c, "err cannot save the memory images: %m");
    else
        say(c, "ok");
}

static void do_cut(struct call *c)
{
    uint64_t cycle;
    if (c->words != 2 || !whole(c->word[1], &cycle))
        say(c, "err cut takes a cycle");
    else if (cycle < c->nano->avr->cycle)
        say(c, "err that cycle is past");
    else {
        c->nano->cut_cycle = cycle;
        say(c, "ok");
    }
}

static void do_set(struct call *c)
{
    struct setting setting;
    const char *why = c->words != 3 ? "set takes a key and a value"
                                    : setting_parse(c->nano, c->word[1], c->word[2], &setting);
    if (!why)
        setting_apply(c->nano, &setting, c->nano->avr->cycle);
    say(c, why ? "err %s" : "ok", why);
}

static void do_set_at(struct call *c)
{
    struct setting setting;
    uint64_t cycle = 0;
    const char *why;
    if (c->words == 2 && !strcmp(c->word[1], "clear")) {
        schedule_clear(&c->nano->schedule);
        say(c, "ok");
        return;
    }
    if (c->words != 4 || !whole(c->word[1], &cycle))
        why = "set_at takes a cycle, a key and a value, or clear";
    else if (cycle < c->nano->avr->cycle)
        why = "that cycle is past";
    else
        why = setting_parse(c->nano, c->word[2], c->word[3], &setting);
    if (!why && schedule_add(&c->nano->schedule, cycle, &setting))
        why = "too many settings are waiting";
    say(c, why ? "err %s" : "ok", why);
}

static void do_fault(struct call *c)
{
    struct setting setting;
    char key[32];
    if (c->words != 3) {
        say(c, "err fault takes a part and a kind");
        return;
    }
    snprintf(key, sizeof key, "fault_%.20s", c->word[1]);
    const char *why = setting_parse(c->nano, key, c->word[2], &setting);
    if (!why)
        setting_apply(c->nano, &setting, c->nano->avr->cycle);
    say(c, why ? "err %s" : "ok", why);
}

static void do_swap(struct call *c)
{
    uint64_t a, b;
    if (c->words != 3 || !whole(c->word[1], &a) || !whole(c->word[2], &b) || a >= LEDS_COUNT
        || b >= LEDS_COUNT || a == b) {
        say(c, "err swap takes two different pins, 0..5");
        return;
    }
    leds_swap(&c->nano->leds, (int)a, (int)b, c->nano->avr->cycle);
    say(c, "ok");
}

// What is lit now, and what that does to the board: emitters' mask, amperes of all, supply, rail.
static void do_lamps(struct call *c)
{
    const struct lamps *l = &c->nano->leds.lamps;
    say(c, "ok %d %.9g %.9g %.9g", l->on.lit, l->total_amperes, lamps_supply_at(l, c->nano->avr->cycle),
        l->rail_volts);
}

static void do_markers(struct call *c)
{
    if (c->words == 2 && !strcmp(c->word[1], "clear")) {
        markers_clear(&c->nano->markers);
        say(c, "ok");
        return;
    }
    strcpy(c->reply, "ok ");
    markers_print(&c->nano->markers, c->reply + 3, COMMAND_REPLY_BYTES - 5);
}

static void do_counters(struct call *c)
{
    struct nano *n = c->nano;
    struct lamps *l = &n->leds.lamps;
    if (c->words == 2 && !strcmp(c->word[1], "clear")) {
        nano_clear_counters(n);
        say(c, "ok");
        return;
    }
    if (c->words != 1) {
        say(c, "err counters takes nothing or clear");
        return;
    }
    lamps_count(l, n->avr->cycle);
    const struct bridge *b = &c->session->bridge;
    say(c, "ok uart_overruns=%" PRIu64 " longest_rx_cycles=%" PRIu64 " rx_garbage=%" PRIu64
        " tx_garbage=%" PRIu64 " rx_bytes=%" PRIu64 " tx_bytes=%" PRIu64 " spm_denied=%" PRIu64
        " page_writes=%" PRIu64 " eeprom_writes=%" PRIu64 " wdt_resets=%" PRIu64 " resets=%" PRIu64
        " power_ons=%" PRIu64 " session=%" PRIu64 " crashes=%" PRIu64 " host_dropped=%" PRIu64
        " device_dropped=%" PRIu64 " clients=%d conversions=%" PRIu64 " asleep_cycles=%" PRIu64
        " lit_cycles_0=%" PRIu64 " lit_cycles_1=%" PRIu64
        " lit_cycles_2=%" PRIu64 " lit_cycles_3=%" PRIu64 " lit_cycles_4=%" PRIu64 " lit_cycles_5=%" PRIu64
        " most_lit=%u longest_pulse_cycles=%" PRIu64 " led_charge_nc=%.0f",
        n->uart.overruns, n->uart.longest_rx, n->uart.rx_garbage, n->uart.tx_garbage,
        n->uart.rx_bytes, n->uart.tx_bytes, n->selfprog.denied, n->selfprog.page_writes, n->eeprom.writes,
        n->watchdog_resets, n->resets, n->power_ons, n->session, n->crashes, b->host_dropped,
        b->device_dropped, b->clients, n->adc.conversions, n->asleep_cycles,
        l->lit_cycles[0], l->lit_cycles[1], l->lit_cycles[2], l->lit_cycles[3],
        l->lit_cycles[4], l->lit_cycles[5], l->most_lit, l->longest_pulse, l->charge_nc);
}

// For bench tests: a node's voltage now, how it is driven, when that began or a sample was taken, and what
// the sample capacitor holds.
static void do_node(struct call *c)
{
    uint64_t i;
    if (c->words != 2 || !whole(c->word[1], &i) || i >= LEDS_COUNT) {
        say(c, "err node takes 0..5");
        return;
    }
    const struct led *led = &c->nano->leds.led[i];
    double volts = leds_peek(&c->nano->leds, (int)i, c->nano->avr->cycle);
    say(c, "ok %.15g %d %" PRIu64 " %.15g", volts, (int)led->drive, led->event, c->nano->adc.held_volts);
}

static void do_quit(struct call *c)
{
    c->session->stop = 1;
    say(c, "ok");
}

void command_run(struct session *session, const char *line, char *reply)
{
    static const struct { const char *name; void (*run)(struct call *); } commands[] = {
        {"time", do_time}, {"lockstep", do_lockstep}, {"advance", do_advance}, {"target", do_target},
        {"targets", do_targets}, {"follow", do_follow}, {"motion", do_motion}, {"state", do_state},
        {"truth", do_truth}, {"frames", do_frames}, {"reset", do_reset}, {"power", do_power}, {"cut", do_cut},
        {"set", do_set}, {"set_at", do_set_at}, {"fault", do_fault}, {"swap", do_swap},
        {"lamps", do_lamps}, {"markers", do_markers}, {"counters", do_counters}, {"node", do_node},
        {"quit", do_quit},
    };
    char words[LINE_BYTES], rest[LINE_BYTES];
    struct call c = {.session = session, .nano = &session->nano, .rest = "", .reply = reply};
    session_notice(session);
    snprintf(words, sizeof words, "%s", line);
    words[strcspn(words, "\r")] = 0;
    snprintf(rest, sizeof rest, "%s", words);
    char *save = NULL;
    for (char *w = strtok_r(words, " \t", &save); w && c.words < WORDS; w = strtok_r(NULL, " \t", &save))
        c.word[c.words++] = w;
    if (c.words > 1)
        c.rest = rest + (c.word[1] - words);
    for (size_t i = 0; c.words && i < sizeof commands / sizeof *commands; i++)
        if (!strcmp(c.word[0], commands[i].name)) {
            commands[i].run(&c);
            // Logs are complete up to the answer: who asks may read them.
            if (session->nano.markers.frames)
                fflush(session->nano.markers.frames);
            return;
        }
    say(&c, "err unknown command");
}
