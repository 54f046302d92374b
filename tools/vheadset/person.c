// SPDX-License-Identifier: GPL-3.0-or-later
#include "person.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "noise.h"

static const double DRIFT_S = 0.1, PUPIL_S = 10.0, HIPPUS_S = 0.25;
static const double FIXATION_S = 0.5;  // window that fixation_drift_deg is meant for
static const double MICRO_PER_S = 1.2, MICRO_DEG = 0.1;
static const double CLOSE_MS = 70, SHUT_MS = 20, OPEN_MS = 150, BLINK_GAP_MS = 800;
// Stated in the comment of physics.toml, [eye] pupil_mm.
static const double PUPIL_DRIFT_MM = 0.3, HIPPUS_MM = 0.15, PEOPLE_MM = 0.8;

// Minimum-jerk step from 0 to 1.
static double smooth(double x)
{
    return x <= 0 ? 0 : x >= 1 ? 1 : x * x * x * (10 + x * (6 * x - 15));
}

static void move_to(struct person_move *m, double now_ms, const double from[2], double azimuth,
                    double elevation)
{
    m->from[0] = from[0];
    m->from[1] = from[1];
    m->to[0] = azimuth;
    m->to[1] = elevation;
    m->start_ms = now_ms;
    m->length_ms = 21 + 2.2 * hypot(azimuth - from[0], elevation - from[1]);
}

static void moved(const struct person_move *m, double now_ms, double out[2])
{
    double x = m->length_ms > 0 ? smooth((now_ms - m->start_ms) / m->length_ms) : 1;
    for (int i = 0; i < 2; i++)
        out[i] = m->from[i] + (m->to[i] - m->from[i]) * x;
}

static const uint64_t FIRST_DRAW = 1ull << 60;  // counters of initial states, far from any tick's

// Initial state of filtered(), from its stationary distribution: Var a = 2 rms^2, and with the output b,
// Cov(a, b) / Var a = 1 / (1 + keep).
static void settle(double stage[2], double time_s, double rms, uint64_t seed, enum noise_purpose purpose,
                   uint64_t counter)
{
    double keep = exp(-1e-3 / time_s), share = 1 / (1 + keep), variance = 2 * rms * rms;
    double output = variance * (1 - keep + 2 * keep * keep * share) * share;
    stage[0] = sqrt(variance) * noise_normal(seed, purpose, FIRST_DRAW + counter);
    stage[1] = share * stage[0] + sqrt(output - share * share * variance)
             * noise_normal(seed, purpose, FIRST_DRAW + counter + 1);
}

// What of a unit variance of filtered() is left about the mean of a window: 1 - mean of its autocorrelation
// (1 + t/T) exp(-t/T) over the window's pairs of moments.
static double left_in_window(double time_s, double window_s)
{
    double n = window_s / time_s;
    return 1 - 2 * (2 * n - 3 + (n + 3) * exp(-n)) / (n * n);
}

// Two equal first-order stages: the output has the given rms and is smooth over a millisecond.
static double filtered(double stage[2], double time_s, double rms, double draw)
{
    double keep = exp(-1e-3 / time_s);
    stage[0] = keep * stage[0] + sqrt((1 - keep * keep) * 2) * rms * draw;
    stage[1] = keep * stage[1] + (1 - keep) * stage[0];
    return stage[1];
}

static double exponential(uint64_t seed, enum noise_purpose purpose, uint64_t n, double mean)
{
    return -mean * log(noise_uniform(seed, purpose, n));
}

static void plan_blink(struct person *p, double after_ms)
{
    double mean = 60e3 / fmax(p->blinks_per_min, 1e-6);
    double gap = fmin(BLINK_GAP_MS, mean / 2);
    p->blink_next_ms = after_ms + gap + exponential(p->seed, NOISE_EYE_BLINK, p->blinks++, mean - gap);
}

static double lids(struct person *p, double now_ms, bool *blink)
{
    if (p->blinks_per_min > 0 && now_ms >= p->blink_next_ms) {
        p->blink_start_ms = p->blink_next_ms;
        plan_blink(p, p->blink_start_ms);
    }
    double t = now_ms - p->blink_start_ms;
    *blink = t >= 0 && t < CLOSE_MS + SHUT_MS + OPEN_MS;
    return *blink ? 1 - smooth(t / CLOSE_MS) + smooth((t - CLOSE_MS - SHUT_MS) / OPEN_MS) : 1;
}

static double latency_ms(const struct person *p, uint64_t index)
{
    return fmin(fmax(200 + 20 * noise_normal(p->seed, NOISE_EYE_LATENCY, index), 140), 260);
}

static void tick(struct person *p, int64_t ms)
{
    struct person_tick *out = &p->ring[ms % PERSON_RING];
    double now = (double)ms, gaze[2], micro[2];
    uint64_t n = (uint64_t)ms;
    moved(&p->saccade, now, gaze);
    while (p->next < p->targets && now * 1e3 >= p->target[p->next].us + latency_ms(p, p->looked_at) * 1e3) {
        const struct person_target *t = &p->target[p->next++];
        uint64_t index = p->looked_at++;
        double size = p->motion ? p->bias_deg : 0;
        double bias_azimuth = size * noise_normal(p->seed, NOISE_EYE_BIAS, 2 * index);
        double bias_elevation = size * noise_normal(p->seed, NOISE_EYE_BIAS, 2 * index + 1);
        move_to(&p->saccade, now, gaze, t->azimuth_deg + bias_azimuth, t->elevation_deg + bias_elevation);
    }
    moved(&p->micro, now, micro);
    if (now >= p->micro_next_ms) {
        uint64_t k = p->micros++;
        move_to(&p->micro, now, micro, MICRO_DEG * noise_normal(p->seed, NOISE_EYE_MICRO, 3 * k),
                MICRO_DEG * noise_normal(p->seed, NOISE_EYE_MICRO, 3 * k + 1));
        p->micro_next_ms = now + 100
                         + exponential(p->seed, NOISE_EYE_MICRO, 3 * k + 2, 1e3 / MICRO_PER_S - 100);
    }
    double drift[2];
    for (int i = 0; i < 2; i++)
        drift[i] = filtered(p->drift[i], DRIFT_S, p->drift_deg,
                            noise_normal(p->seed, NOISE_EYE_DRIFT, 2 * n + (uint64_t)i));
    double pupil_draw = noise_normal(p->seed, NOISE_EYE_PUPIL, n);
    double slow = filtered(p->pupil_slow, PUPIL_S, PUPIL_DRIFT_MM, pupil_draw);
    double hippus_draw = noise_normal(p->seed, NOISE_EYE_HIPPUS, n);
    double fast = filtered(p->hippus, HIPPUS_S, HIPPUS_MM, hippus_draw);
    double lid = lids(p, now, &out->blink);
    double on = p->motion ? 1 : 0, flicks = p->microsaccades ? 1 : 0;
    out->azimuth_deg = gaze[0] + on * (flicks * micro[0] + drift[0]);
    out->elevation_deg = gaze[1] + on * (flicks * micro[1] + drift[1]);
    out->pupil_mm = fmin(fmax(p->pupil_mean_mm + on * (slow + fast), 1.5), 8);
    out->lid_opening = p->motion ? lid : 1;
    out->blink = out->blink && p->motion;
}

static double between(double a, double b, double x)
{
    return a + (b - a) * x;
}

void person_view_at(struct person *p, double us, struct person_view *view)
{
    double ms = fmax(us, 0) / 1e3, x = ms - floor(ms);
    int64_t low = (int64_t)floor(ms);
    while (p->ticked < low + 1)
        tick(p, ++p->ticked);
    if (low < p->ticked - (PERSON_RING - 2))
        low = p->ticked - (PERSON_RING - 2);
    const struct person_tick *a = &p->ring[low % PERSON_RING], *b = &p->ring[(low + 1) % PERSON_RING];
    const struct person_target *shown = NULL;
    for (size_t i = p->targets; i-- && !shown;)
        if (p->target[i].us <= us)
            shown = &p->target[i];
    memset(view, 0, sizeof *view);
    view->target_azimuth_deg = shown ? shown->azimuth_deg : 0;
    view->target_elevation_deg = shown ? shown->elevation_deg : 0;
    view->state.azimuth_deg = view->target_azimuth_deg;
    view->state.elevation_deg = view->target_elevation_deg;
    if (p->follow) {
        view->state.azimuth_deg = between(a->azimuth_deg, b->azimuth_deg, x);
        view->state.elevation_deg = between(a->elevation_deg, b->elevation_deg, x);
    }
    view->state.pupil_mm = between(a->pupil_mm, b->pupil_mm, x);
    view->state.lid_opening = p->lid_forced >= 0 ? p->lid_forced : between(a->lid_opening, b->lid_opening, x);
    memcpy(view->state.slip_mm, p->slip_mm, sizeof p->slip_mm);
    view->blink = a->blink || b->blink;
}

int person_target_at(struct person *p, double us, double azimuth_deg, double elevation_deg)
{
    if (p->targets == p->room) {
        size_t room = p->room ? 2 * p->room : 64;
        struct person_target *grown = realloc(p->target, room * sizeof *grown);
        if (!grown)
            return -1;
        p->target = grown;
        p->room = room;
    }
    size_t at = p->targets++;
    for (; at > p->next && p->target[at - 1].us > us; at--)
        p->target[at] = p->target[at - 1];
    p->target[at] = (struct person_target){us, azimuth_deg, elevation_deg};
    return 0;
}

void person_targets_clear(struct person *p)
{
    p->targets = p->next;  // what was looked at stays: it is still being fixated
}

void person_seed(struct person *p, uint64_t seed)
{
    p->seed = seed;
}

void person_init(struct person *p, const struct config *config, uint64_t seed)
{
    memset(p, 0, sizeof *p);
    p->seed = seed;
    p->bias_deg = config->physics.eye.fixation_bias_deg;
    p->drift_deg = config->physics.eye.fixation_drift_deg / sqrt(left_in_window(DRIFT_S, FIXATION_S));
    p->blinks_per_min = config->physics.eye.blinks_per_min;
    p->pupil_mean_mm = config->pupil_mean_mm;
    if (p->pupil_mean_mm == 0)
        p->pupil_mean_mm = fmin(fmax(config->physics.eye.pupil_mm
                                     + PEOPLE_MM * noise_normal(config->seed, NOISE_EYE_PART, 0), 2.2), 6);
    p->follow = p->motion = p->microsaccades = true;
    for (uint64_t i = 0; i < 2; i++)
        settle(p->drift[i], DRIFT_S, p->drift_deg, seed, NOISE_EYE_DRIFT, 2 * i);
    settle(p->pupil_slow, PUPIL_S, PUPIL_DRIFT_MM, seed, NOISE_EYE_PUPIL, 0);
    settle(p->hippus, HIPPUS_S, HIPPUS_MM, seed, NOISE_EYE_HIPPUS, 0);
    p->lid_forced = -1;
    p->blink_start_ms = -1e9;
    p->micro_next_ms = exponential(p->seed, NOISE_EYE_MICRO, UINT64_MAX / 4, 1e3 / MICRO_PER_S);
    p->ticked = -1;
    plan_blink(p, 0);
}

void person_free(struct person *p)
{
    free(p->target);
    p->target = NULL;
}
