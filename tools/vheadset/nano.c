// SPDX-License-Identifier: GPL-3.0-or-later
#include "nano.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

#include <simavr/avr_extint.h>

#include "../../sim_c/sim_map.h"
#include "access.h"
#include "hexfile.h"
#include "images.h"
#include "noise.h"

enum { ACSR = 0x50, MCUSR = 0x54, SRAM = 0x100, SRAM_END = 0x900, BATCH_CYCLES = 16000 };
static const char FLASH_IMAGE[] = "flash.bin", EEPROM_IMAGE[] = "eeprom.bin";
static const char SESSION_COUNT[] = "power_ons.bin";

// Of libsimavr; exported but not declared in an installed header.
avr_flashaddr_t avr_run_one(avr_t *avr);

// One batch of instructions, up to the next timer or interrupt. Replaces libsimavr's loop, which sleeps in
// real time and overshoots a sleep by a cycle.
static void run_batch(struct nano *nano)
{
    avr_t *avr = nano->avr;
    avr_flashaddr_t pc = avr->pc;
    if (avr->state == cpu_Running)
        pc = avr_run_one(avr);
    if (avr->interrupt_state == -2)
        avr->interrupt_state = -1;  // one instruction after SEI or RETI is safe from interrupts, not two
    avr_cycle_count_t idle = avr_cycle_timer_process(avr);
    avr->pc = pc;
    if (nano->watchdog.expired)
        return;
    if (avr->state == cpu_Sleeping) {
        nano->markers.slept = true;
        avr->cycle += idle;
        nano->asleep_cycles += idle;
        idle = avr_cycle_timer_process(avr);
    } else if (avr->state != cpu_Running) {
        // The program ran off the end or into nonsense: only the watchdog or a reset helps.
        if (avr->state != cpu_Stopped)
            nano->crashes++;
        avr->state = cpu_Stopped;
        avr->cycle += idle ? idle : 1;
        return;
    }
    if (avr->state != cpu_Sleeping && avr->interrupt_state) {
        avr_service_interrupts(avr);
        avr_cycle_timer_process(avr);  // an entry takes cycles: the next batch must still end at its timer
    }
    if (avr->state == cpu_Running && !avr->interrupt_state)
        nano->markers.slept = false;
}

static avr_cycle_count_t stop_here(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr, (void)when, (void)param;
    return 0;
}

// What avr_reset() leaves undone or undoes.
static void after_reset(struct nano *nano, enum nano_reset cause)
{
    avr_t *avr = nano->avr;
    nano->resets++;
    if (cause == NANO_RESET_WATCHDOG)
        nano->watchdog_resets++;
    nano->reset_flags = cause == NANO_RESET_POWER ? NANO_RESET_POWER : nano->reset_flags | (uint8_t)cause;
    avr->data[MCUSR] = nano->reset_flags;
    avr->run_cycle_limit = BATCH_CYCLES;
    // INT0 and INT1 may be on pins that are driven. Left alone, the stock module looks at such a pin every
    // cycle while it is low, once more for every time it became low.
    avr_extint_set_strict_lvl_trig(avr, 0, 0);
    avr_extint_set_strict_lvl_trig(avr, 1, 0);
    timer1_reset(&nano->timer1);
    adc_reset(&nano->adc);
    eeprom_reset(&nano->eeprom);
    selfprog_reset(&nano->selfprog);
    pins_reset(&nano->pins);
    if (cause == NANO_RESET_POWER)
        leds_empty(&nano->leds, avr->cycle);
    markers_reset(&nano->markers);
    watchdog_reset(&nano->watchdog, nano->reset_flags & NANO_RESET_WATCHDOG);
    uart_reset(&nano->uart);
}

static void write_mcusr(avr_t *avr, avr_io_addr_t at, uint8_t value, void *param)
{
    struct nano *nano = param;
    nano->reset_flags &= value;  // flags are cleared by writing zeros and cannot be set
    avr->data[at] = nano->reset_flags;
}

void nano_press_reset(struct nano *nano)
{
    if (!nano->powered)
        return;
    avr_reset(nano->avr);
    after_reset(nano, NANO_RESET_EXTERNAL);
    bridge_flush_to_host(nano->bridge);
}

static void seed_noise(struct nano *nano)
{
    nano->noise_seed = noise_session(nano->config.seed, nano->session);
    nano->adc.seed = nano->uart.seed = nano->noise_seed;
    person_seed(&nano->person, nano->noise_seed);
    leds_seed(&nano->leds, nano->noise_seed);
}

// The count on disk is that of the next session: a program that is killed has used its own up.
static int power_on(struct nano *nano)
{
    avr_t *avr = nano->avr;
    if (nano->power_ons) {
        nano->session++;
        seed_noise(nano);
    }
    uint8_t next[8];
    for (unsigned i = 0; i < sizeof next; i++)
        next[i] = (uint8_t)((nano->session + 1) >> 8 * i);
    if (images_save(nano->config.state, SESSION_COUNT, next, sizeof next))
        return -1;
    nano->power_ons++;
    nano->powered = true;
    avr_reset(avr);
    for (int i = 0; i < SRAM_END; i++)
        if (i < 32 || i >= SRAM)
            avr->data[i] = (uint8_t)noise_bits(nano->noise_seed, NOISE_SRAM, (uint64_t)i);
    after_reset(nano, NANO_RESET_POWER);
    return 0;
}

int nano_power(struct nano *nano, bool on)
{
    if (on == nano->powered)
        return 0;
    if (on)
        return power_on(nano);
    eeprom_cut(&nano->eeprom, nano->noise_seed);
    selfprog_cut(&nano->selfprog, nano->noise_seed);
    nano->powered = false;
    nano->bridge->to_device.used = 0;
    nano->cut_cycle = UINT64_MAX;
    return nano_save(nano);
}

int nano_save(struct nano *nano)
{
    if (nano->selfprog.dirty) {
        if (images_save(nano->config.state, FLASH_IMAGE, nano->selfprog.flash, FLASH_BYTES))
            return -1;
        nano->selfprog.dirty = false;
    }
    if (nano->eeprom.dirty) {
        if (images_save(nano->config.state, EEPROM_IMAGE, nano->eeprom.data, EEPROM_BYTES))
            return -1;
        nano->eeprom.dirty = false;
    }
    return 0;
}

static void before_cycle(void *param, uint64_t cycle)
{
    struct nano *nano = param;
    schedule_run(&nano->schedule, nano, cycle);
}

void nano_clear_counters(struct nano *nano)
{
    lamps_clear(&nano->leds.lamps, nano->avr->cycle);
    nano->uart.longest_rx = 0;
    nano->asleep_cycles = 0;
}

void nano_run_until(struct nano *nano, uint64_t cycle)
{
    avr_t *avr = nano->avr;
    while (avr->cycle < cycle || avr->cycle >= nano->cut_cycle) {
        if (avr->cycle >= nano->cut_cycle)
            nano_power(nano, false);
        if (!nano->powered) {
            nano->bridge->to_device.used = 0;
            if (avr->cycle < cycle)
                avr->cycle = cycle;
            schedule_run(&nano->schedule, nano, avr->cycle);
            return;
        }
        uint64_t limit = cycle < nano->cut_cycle ? cycle : nano->cut_cycle;
        if (schedule_next(&nano->schedule) < limit)
            limit = schedule_next(&nano->schedule);
        access_at(avr, limit, stop_here, nano);
        while (avr->cycle < limit && !nano->watchdog.expired)
            run_batch(nano);
        avr_cycle_timer_cancel(avr, stop_here, nano);
        schedule_run(&nano->schedule, nano, avr->cycle);
        if (nano->watchdog.expired) {
            avr_reset(avr);
            after_reset(nano, NANO_RESET_WATCHDOG);
        }
    }
}

// libsimavr's comparator looks at its pins after every access to an ADC register, which is slow, and knows no
// voltages. It goes, with the register watchers it has set up (nobody else has any). ACSR is plain memory.
static void take_comparator_out(avr_t *avr)
{
    access_module(avr, "ac")->reset = NULL;
    avr_cycle_timer_reset(avr);
    for (int i = 0; i < MAX_IOs; i++)
        avr->io[i].irq = NULL;
    access_take_write(avr, ACSR, NULL, NULL);
    access_take_read(avr, ACSR, NULL, NULL);
}

static void silent(avr_t *avr, const int level, const char *format, va_list list)
{
    (void)avr, (void)level, (void)format, (void)list;
}

static int load(struct nano *nano, char *error, size_t error_bytes)
{
    const struct config *c = &nano->config;
    uint8_t *flash = nano->selfprog.flash, boot[2 * FLASH_BYTES], before[FLASH_BYTES];
    if (images_load(c->state, FLASH_IMAGE, flash, FLASH_BYTES, error, error_bytes)
        || images_load(c->state, EEPROM_IMAGE, nano->eeprom.data, EEPROM_BYTES, error, error_bytes))
        return -1;
    memcpy(before, flash, sizeof before);
    if (*c->bootloader) {
        // Room behind the flash: Debian's build of Optiboot has 20 bytes more than its section (README.md).
        memset(boot, 0xFF, sizeof boot);
        if (hexfile_load(c->bootloader, boot, sizeof boot, error, error_bytes) < 0)
            return -1;
        memcpy(flash + c->bootloader_start, boot + c->bootloader_start, FLASH_BYTES - c->bootloader_start);
    }
    uint32_t limit = *c->bootloader ? c->bootloader_start : FLASH_BYTES;
    if (*c->app && hexfile_load(c->app, flash, limit, error, error_bytes) < 0)
        return -1;
    nano->selfprog.dirty = memcmp(before, flash, sizeof before) != 0;
    return 0;
}

int nano_open(struct nano *nano, const struct config *config, struct bridge *bridge, char *error,
              size_t error_bytes)
{
    memset(nano, 0, sizeof *nano);
    nano->config = *config;
    nano->bridge = bridge;
    nano->cut_cycle = UINT64_MAX;
    nano->cycles_per_true_second = 16e6 * (1 + config->physics.clock.error
                                           * (2 * noise_uniform(config->seed, NOISE_CLOCK, 0) - 1));
    if (*config->map) {
        char why[200] = "";
        nano->map = sim_map_open(config->map, why, sizeof why);
        if (!nano->map) {
            snprintf(error, error_bytes, "cannot read the map %s: %s", config->map, why);
            return -1;
        }
        int emitters = config->wiring.photodiodes ? LEDS_EMITTERS : LEDS_COUNT;
        if (sim_map_sensors(nano->map) != LEDS_COUNT || sim_map_emitters(nano->map) != emitters) {
            snprintf(error, error_bytes, "%s is not a map of %d sensors and %d emitters", config->map,
                     LEDS_COUNT, emitters);
            return -1;
        }
    }
    uint8_t count[8] = {0};
    if (images_load(config->state, SESSION_COUNT, count, sizeof count, error, error_bytes))
        return -1;
    for (unsigned i = 0; i < sizeof count; i++)
        nano->session |= (uint64_t)count[i] << 8 * i;
    avr_global_logger_set(silent);
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    if (!avr || avr_init(avr)) {
        snprintf(error, error_bytes, "libsimavr has no atmega328p");
        return -1;
    }
    nano->avr = avr;
    avr->frequency = 16000000;
    avr->codeend = avr->flashend;
    avr->reset_pc = *config->bootloader ? config->bootloader_start : 0;
    take_comparator_out(avr);
    watchdog_attach(&nano->watchdog, avr);
    selfprog_attach(&nano->selfprog, avr, config->bootloader_start);
    eeprom_attach(&nano->eeprom, avr);
    person_init(&nano->person, config, noise_session(config->seed, nano->session));
    leds_attach(&nano->leds, &nano->adc, &nano->person, nano->map, config, nano->cycles_per_true_second);
    adc_attach(&nano->adc, avr, &nano->leds, &nano->config.physics, config->seed);
    pins_attach(&nano->pins, avr, &nano->leds);
    nano->leds.log = nano->adc.log = markers_log_value;
    nano->leds.log_param = nano->adc.log_param = &nano->markers;
    nano->adc.before = before_cycle;
    nano->adc.before_param = nano;
    timer1_attach(&nano->timer1, avr, &nano->adc);
    uart_attach(&nano->uart, avr, bridge, nano->cycles_per_true_second);
    markers_attach(&nano->markers, avr);
    access_take_write(avr, MCUSR, write_mcusr, nano);
    if (load(nano, error, error_bytes))
        return -1;
    seed_noise(nano);
    if (power_on(nano)) {
        snprintf(error, error_bytes, "cannot write %s/%s: %s", config->state, SESSION_COUNT, strerror(errno));
        return -1;
    }
    return 0;
}

void nano_close(struct nano *nano)
{
    person_free(&nano->person);
    sim_map_close(nano->map);
}
