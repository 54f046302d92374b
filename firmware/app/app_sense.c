// SPDX-License-Identifier: Apache-2.0
// What the sensors need: their exposures, a look at their health, and the probe of a single emitter.
#include "app.h"

#include <string.h>

#include "sg_rom.h"

enum {
    EMITTERS_PHOTODIODES = 3,
    UNLIKE_LOOKS = 4,
    EXPOSE_US = 140,            // asking for exposures
    EXPOSE_CYCLES = 3,          // and if there is no time for it within so many cycles, it is done anyway
    COMING_CYCLES = 5,          // until a reading has them, mostly
    HEALTH_TURNS = 8,           // cycles from one look at the health of a channel to the next channel's; 2^n
    // Cycles of a probe, counted down: until the emitter is alone, its readings, until all is as before.
    PROBE_BEFORE = 4,
    PROBE_SUM = SG_LIGHT_REPEATS_MAX,
    PROBE_AFTER = 4,
    ALL_BITS = 15,              // of an exposure: nothing is left of one shifted by so many
};

static uint8_t wished;                  // cycles since exposures were chosen that are not asked for yet; 0: none
static uint8_t coming;                  // cycles until a reading has what was asked for: looks say little then
static uint8_t unlike;                  // looks in a row at exposures that are not those asked for

// The channel sampled right before each, per wiring (firmware/core/sg_light.h); 255: none.
static const uint8_t before[2][HAL_CHANNELS] SG_ROM = {
    { 5, 255, 255, 2, 1, 255 },
    { 255, 255, 255, 0, 1, 2 },
};

static struct hal_timing timing;        // in force
static uint16_t wanted_mark;            // CRC of what was asked for: the port may have taken something close to it
static uint8_t faulty;                  // a channel is
static uint8_t alarms;                  // bits of enum sg_alarm, as last looked at
static uint8_t turn;
static uint8_t look;                    // at the health of this channel next
static uint16_t probe_seq;
static uint8_t probe_cycles;            // to come

SELDOM static void look_at_alarms(void)
{
    alarms = hal_alarm() | (app_live.lights ? 0 : (uint8_t)SG_ALARM_LIGHTS_OFF);
}

uint8_t app_alarm(void)
{
    return alarms;
}

uint8_t app_fault(void)
{
    return faulty | alarms;
}

SELDOM void app_exposures(uint16_t cycles[HAL_CHANNELS])
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++)
        cycles[i] = app.expose.led[i].exposure_cycles;
}

// Ask the port for the exposures wanted, and for the rest take what it made of them.
SELDOM static void expose(void)
{
    uint16_t cycles[HAL_CHANNELS];
    app_exposures(cycles);
    hal_expose(cycles);
    sg_expose_taken(&app.expose, cycles);
}

// Begin at these, within what timing and, if they are automatic, the user allow.
SELDOM static void expose_at(const uint16_t exposure_cycles[HAL_CHANNELS])
{
    uint16_t most[HAL_CHANNELS];
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        most[i] = hal_exposure_most(i);
        if (app.exposure_auto && most[i] > app_live.limit_cycles[i])
            most[i] = app_live.limit_cycles[i];
    }
    sg_expose_start(&app.expose, exposure_cycles, most);
    expose();
}

SELDOM static void expose_again(void)
{
    uint16_t cycles[HAL_CHANNELS];
    app_exposures(cycles);
    expose_at(cycles);
}

SELDOM static void light_again(void)
{
    sg_light_start(&app.light, timing.wiring, timing.period_cycles);
    sg_light_curve(&app.light, app_live.curve_q10, app_live.zero_q2);
}

SELDOM static uint16_t mark_of(const struct hal_timing *t)
{
    return sg_wire_crc16(0xFFFF, (const uint8_t *)t, sizeof *t);
}

SELDOM void app_sense_start(const struct hal_timing *begin)
{
    timing = *begin;
    wanted_mark = mark_of(begin);
    uint16_t cycles[HAL_CHANNELS];
    memcpy(cycles, app_live.exposure_cycles, sizeof cycles);
    hal_start(&timing, cycles);
    light_again();
    look_at_alarms();
    expose_at(app_live.exposure_cycles);
    sg_health_start(&app.health);
}

SELDOM void app_sense_timing(const struct hal_timing *wanted)
{
    const uint16_t mark = mark_of(wanted);
    if (mark == wanted_mark)
        return;
    wanted_mark = mark;
    timing = *wanted;
    hal_set_timing(&timing);
    look_at_alarms();
    light_again();
    expose_again();
}

const struct hal_timing *app_timing(void)
{
    return &timing;
}

SELDOM void app_expose_by(uint8_t op, const uint16_t exposure_us_q4[HAL_CHANNELS])
{
    uint16_t cycles[HAL_CHANNELS];
    uint16_t *const to = op == SG_EXPOSURE_LIMIT ? app_live.limit_cycles : cycles;
    if (op == SG_EXPOSURE_GET)
        return;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++)
        to[i] = sg_expose_from_us_q4(exposure_us_q4[i]);
    if (op != SG_EXPOSURE_LIMIT)
        app.exposure_auto = op == SG_EXPOSURE_AUTO;
    if (op != SG_EXPOSURE_SET)
        app_exposures(cycles);
    expose_at(cycles);
    app_live_exposed(op == SG_EXPOSURE_SET);
}

SELDOM uint8_t app_exposures_far(const uint16_t cycles[HAL_CHANNELS], uint8_t shift)
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        const uint16_t wish = app.expose.led[i].exposure_cycles;
        // Mostly they are the same: then without the shift, a loop.
        if (wish != cycles[i]
            && (wish < cycles[i] ? cycles[i] - wish : wish - cycles[i]) > cycles[i] >> shift)
            return 1;
    }
    return 0;
}

SELDOM static void exposures_moved(void)
{
    wished = 0;
    coming = COMING_CYCLES;
    expose();
    app_count(&app.status.exposure_changes);
}

void app_sense_step(void)
{
    if (wished && (wished > EXPOSE_CYCLES || app_time_for(EXPOSE_US)))
        exposures_moved();
}

// Lids, not light, which waits for nothing: a look takes longest when sensors are full.
static uint8_t can_wait(const struct sg_reading *reading)
{
    return coming && !app.expose.acquiring
           && !((uint16_t)(reading->unlit_code[0] | reading->unlit_code[3] | reading->unlit_code[5]) >> 8);
}

static uint8_t first(uint8_t i)
{
    return sg_rom_byte(&before[timing.wiring][i], SG_ROM_FLASH);
}

static void look_at(const struct sg_reading *reading)
{
    struct sg_health_sight sight;
    const uint8_t i = look;
    const uint8_t pair = first(i);
    sight.lit_code = reading->lit_code[i];
    sight.unlit_code = reading->unlit_code[i];
    sight.before_code = pair < HAL_CHANNELS ? reading->lit_code[pair] : 0;
    sight.exposure_cycles = reading->exposure_cycles[i];
    sight.most_cycles = app.expose.led[i].most_cycles;
    sight.feature = app.feature[i];
    sg_track_range(app_model(), i, &sight);
    faulty = sg_health_look(&app.health, i, &sight);
    look = i == HAL_CHANNELS - 1 ? 0 : i + 1;
}

void app_sense_cycle(const struct hal_cycle *cycle)
{
    if (!cycle)
        return;
    const struct sg_reading *reading = &cycle->reading;
    const uint8_t health = (++turn & (HEALTH_TURNS - 1)) == 0;
    if (health) {
        look_at_alarms();
        // What the port makes is what counts, should it ever be something else than it said.
        unlike = app_exposures_far(reading->exposure_cycles, ALL_BITS) ? unlike + 1 : 0;
        if (unlike == UNLIKE_LOOKS) {
            // Not sg_expose_taken: what is in force while a change is on its way is nothing that the port insists on.
            for (uint8_t i = 0; i < HAL_CHANNELS; i++)
                app.expose.led[i].exposure_cycles = reading->exposure_cycles[i];
            unlike = 0;
        }
    }
    // In the dark there is nothing to learn.
    if (alarms & (SG_ALARM_LOCKOUT | SG_ALARM_LIGHTS_OFF))
        return;
    // One or the other: what a cycle takes at most counts.
    if (health)
        look_at(reading);
    else if (app.exposure_auto && !can_wait(reading)
             && sg_expose_cycle(&app.expose, reading, timing.wiring)) {
        // A quarter waits for a cycle at most.
        if (app_exposures_far(reading->exposure_cycles, 2))
            wished = app.expose.acquiring ? EXPOSE_CYCLES : EXPOSE_CYCLES - 1;
        else if (!wished)
            wished = 1;
    }
    wished += wished != 0;
    coming -= coming != 0;
}

SELDOM int8_t app_probe(uint8_t emitter, uint16_t seq)
{
    if (emitter >= (app_live.wiring == SG_WIRING_LEDS ? (uint8_t)HAL_CHANNELS : (uint8_t)EMITTERS_PHOTODIODES))
        return SG_E_ARG;
    if (probe_cycles)
        return SG_E_BUSY;
    if (alarms & (SG_ALARM_LOCKOUT | SG_ALARM_LIGHTS_OFF))
        return SG_E_STATE;
    probe_seq = seq;
    probe_cycles = PROBE_BEFORE + PROBE_SUM + PROBE_AFTER;
    app.probe = emitter;
    app_rate_renew();
    return SG_OK;
}

SELDOM static void probed(void)
{
    struct sg_probe *probe = &app_body.probe;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        // What emits does not sense, and leaves its 5 V on the sample capacitor for the one sampled next.
        const uint8_t blind = timing.wiring == SG_WIRING_LEDS && (i == app.probe || first(i) == app.probe);
        probe->feature[i] = blind || (app.light.channel[i].flags & SG_LIGHT_STARVED) ? 0 : app.feature[i];
    }
    probe->emitter = app.probe;
    probe->reserved = 0;
    // Not queued only while the line is full of answers: again after the next cycle.
    if (app_send(SG_MSG_PROBE | SG_REPLY, probe_seq, probe, sizeof *probe, 0)) {
        probe_cycles--;
        app.probe = APP_NO_PROBE;
        app_rate_renew();
    }
}

SELDOM static void probe_on(void)
{
    if (probe_cycles == PROBE_SUM + PROBE_AFTER + 1 || probe_cycles == PROBE_AFTER + 1 || probe_cycles == 1)
        sg_light_features(&app.light, app.feature);
    if (probe_cycles == PROBE_AFTER + 1)
        probed();
    else
        probe_cycles--;
}

uint8_t app_probing(void)
{
    if (!probe_cycles)
        return 0;
    probe_on();
    return 1;
}
