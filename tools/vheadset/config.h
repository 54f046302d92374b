// SPDX-License-Identifier: GPL-3.0-or-later
// The configuration file: flat text, one `key value` per line, `#` starts a comment.
#ifndef CONFIG_H
#define CONFIG_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

enum { CONFIG_PATH_BYTES = 1024 };

// Field names and units are those of physics.toml; a name there is `section.key` here.
struct physics {
    struct { double nominal_na, dim_na, bright_na, part_spread, heat_per_k; } photocurrent;
    struct node_physics { double junction_pf, pin_pf, sample_hold_pf, leakage_na, leakage_spread; } node;
    struct { double noise_lsb, inl_lsb, offset_lsb, gain_error, bandgap_v; } adc;
    struct { double offset_mv, noise_mv, delay_ns; } comparator;
    struct { double volts, source_ohm, ripple_mv; } supply;
    struct { double error; } clock;
    struct { double room_na, bright_room_na, sun_gap_na, dark_na; } ambient;
    struct {
        double fixation_bias_deg, fixation_drift_deg, pupil_mm, blinks_per_min, lid_follow_gain;
    } eye;
};

// The board's own parts (README.md).
struct board_wiring {
    bool photodiodes;                    // else LEDs that sense and emit
    double rail_volts, rail_ohm, rail_noise_mv;
    int supply_channel;                  // of the converter, with the supply divider; -1 = none
};

enum ambient { AMBIENT_DARK, AMBIENT_ROOM, AMBIENT_BRIGHT_ROOM, AMBIENT_SUN_GAP };
enum light_level { LIGHT_NOMINAL, LIGHT_DIM, LIGHT_BRIGHT };

struct config {
    char bootloader[CONFIG_PATH_BYTES];  // "" = none: the chip starts at 0
    char state[CONFIG_PATH_BYTES];       // directory of flash.bin and eeprom.bin
    char app[CONFIG_PATH_BYTES];         // "" = none
    char map[CONFIG_PATH_BYTES];         // "" = no emitter reaches any sensor
    char link[CONFIG_PATH_BYTES];
    char control[CONFIG_PATH_BYTES];
    char truth[CONFIG_PATH_BYTES];
    uint32_t bootloader_start;
    uint64_t seed;
    bool unpaced, auto_reset;
    enum ambient ambient;
    enum light_level light;
    double pupil_mean_mm;                // 0 = drawn from the seed
    double map_reference;                // sim_map_mean() of a map that gives nominal_na; 0 = of this map
    struct board_wiring wiring;
    struct physics physics;
};

// Read a file. Returns 0, or -1 with a one-line reason in error.
int config_read(struct config *config, const char *path, char *error, size_t error_bytes);

// Names of ambient and light levels. Return 0, or -1 when there is no such level.
int config_ambient(const char *name, enum ambient *out);
int config_light(const char *name, enum light_level *out);

// Print the required section.key names, one a line.
void config_list_physics(FILE *out);

#endif
