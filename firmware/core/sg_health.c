// SPDX-License-Identifier: Apache-2.0
#include "sg_health.h"

enum {
    CHANNELS = 6,
    OCTAVE = 4096,
    // Above the middle of what was calibrated. Of eleven simulated persons ten never leave 1.5 octaves, lids shut or
    // open, wherever the eye looks and whatever its pupil; lids of one that stay shut make 1.64 in one channel. A
    // finger before the brightest LED makes 1.5 to 1.9, before the others more than 2.2.
    ABOVE = OCTAVE + (OCTAVE >> 1),
    MIDDLE_STEPS = 2048,        // of the model's range
    // A node without an LED has the pin's 6 pF and takes 14 of 20 parts of what the sample capacitor held:
    // 7/10 of the code before. It follows that code even as it moves, which no LED does.
    MIRROR_NUMERATOR = 7, MIRROR_DENOMINATOR = 10,
    MIRROR_LEAST = 64,          // codes before, below which 7/10 prove nothing
    MIRROR_SLACK = 40,          // tenths of a code
};

void sg_health_start(struct sg_health *health)
{
    *health = (struct sg_health) { .fault = { 0 } };
}

// Count a suspicion up, its absence down. Returns the fault to report: `suspected` once it has lasted,
// `known` until it has been gone as long.
static __attribute__((noinline)) uint8_t debounced(uint8_t *count, uint8_t suspected, uint8_t known)
{
    if (suspected) {
        if (*count < SG_HEALTH_PATIENCE)
            (*count)++;
        return *count == SG_HEALTH_PATIENCE ? suspected : known;
    }
    if (*count != 0)
        (*count)--;
    return *count == 0 ? 0 : known;
}

// Does the channel only repeat the one sampled before it? Asked until that one has moved by a sixteenth.
static uint8_t mirrors(struct sg_health *health, uint8_t i, const struct sg_health_sight *sight)
{
    if (sight->before_code < MIRROR_LEAST)
        return 0;
    const int16_t off = (int16_t)(MIRROR_DENOMINATOR * sight->lit_code
                                  - MIRROR_NUMERATOR * sight->before_code);
    if (off > MIRROR_SLACK || off < -MIRROR_SLACK) {
        health->least[i] = health->most[i] = 0;
        return 0;
    }
    const uint8_t before_q2 = (uint8_t)(sight->before_code >> 2);
    if (health->most[i] == 0)
        health->least[i] = health->most[i] = before_q2;
    if (before_q2 < health->least[i])
        health->least[i] = before_q2;
    if (before_q2 > health->most[i])
        health->most[i] = before_q2;
    return (uint8_t)(health->most[i] - health->least[i]) > health->most[i] >> 4;
}

static uint8_t electrical(struct sg_health *health, uint8_t i, const struct sg_health_sight *sight)
{
    if (sight->lit_code >= SG_HEALTH_FULL_CODE && sight->unlit_code >= SG_HEALTH_FULL_CODE
        && sight->exposure_cycles <= SG_HEALTH_SHORT_CYCLES)
        return SG_HEALTH_SHORT;
    if (sight->lit_code <= SG_HEALTH_NOTHING_CODE && sight->unlit_code <= SG_HEALTH_NOTHING_CODE
        && sight->exposure_cycles >= sight->most_cycles >> 1)
        return SG_HEALTH_OPEN;
    return mirrors(health, i, sight) ? SG_HEALTH_OPEN : 0;
}

static uint8_t optical(const struct sg_health_sight *sight)
{
    if (sight->gain_q12 == 0)
        return 0;
    if (sight->feature < sight->offset)
        return (uint16_t)(sight->offset - sight->feature) > OCTAVE ? SG_HEALTH_LOW : 0;
    const uint16_t past = (uint16_t)(sight->feature - sight->offset);
    if (past < ABOVE)
        return 0;
    const uint32_t above = (uint32_t)(uint16_t)(past - ABOVE) * sight->gain_q12;
    return above >> 12 >= MIDDLE_STEPS ? SG_HEALTH_HIGH : 0;
}

uint8_t sg_health_look(struct sg_health *health, uint8_t channel, const struct sg_health_sight *sight)
{
    if (channel < CHANNELS) {
        const uint8_t known = health->fault[channel];
        const uint8_t dark = debounced(&health->dark[channel], electrical(health, channel, sight),
                                       known & (SG_HEALTH_OPEN | SG_HEALTH_SHORT));
        const uint8_t far = debounced(&health->far[channel], optical(sight),
                                      known & (SG_HEALTH_LOW | SG_HEALTH_HIGH));
        health->fault[channel] = dark | far;
    }
    uint8_t any = 0;
    for (uint8_t i = 0; i < CHANNELS; i++)
        any |= health->fault[i];
    return any != 0;
}
