// SPDX-License-Identifier: GPL-3.0-or-later
// Random draws by counter: a draw depends only on (seed, purpose, counter), never on how often or when the
// host asked for another one. That is what makes a run reproducible from its seed.
//
// There are two seeds. Parts (spread, leakage, offset, gain, INL, bandgap, clock error, mains frequency, the
// person's mean pupil) are drawn from the bare one. Behaviour and noise are drawn from the seed of a session,
// which mixes in how often the power was switched on before: what is streamed after a power cycle does not
// replay the noise of the calibration.
#ifndef NOISE_H
#define NOISE_H

#include <stdint.h>

enum noise_purpose {
    NOISE_CLOCK = 1, NOISE_SENSOR_SPREAD, NOISE_EMITTER_SPREAD, NOISE_LEAKAGE, NOISE_FLICKER,
    NOISE_ADC, NOISE_ADC_INL, NOISE_ADC_PART, NOISE_BANDGAP, NOISE_RAIL_RELEASE, NOISE_RIPPLE_SAMPLE,
    NOISE_RIPPLE_REFERENCE, NOISE_SRAM, NOISE_CORRUPT, NOISE_LINE_RX, NOISE_LINE_TX,
    NOISE_EYE_PART, NOISE_EYE_BIAS, NOISE_EYE_LATENCY, NOISE_EYE_DRIFT, NOISE_EYE_MICRO, NOISE_EYE_PUPIL,
    NOISE_EYE_HIPPUS, NOISE_EYE_BLINK, NOISE_SESSION, NOISE_FLICKER_PHASE,
    NOISE_RAIL_SAMPLE, NOISE_BANDGAP_REFERENCE, NOISE_RIPPLE_LIGHT,
};

// The seed of behaviour and noise after the power was switched on `session` times before.
uint64_t noise_session(uint64_t seed, uint64_t session);
uint64_t noise_bits(uint64_t seed, enum noise_purpose purpose, uint64_t counter);
// Uniform in (0, 1).
double noise_uniform(uint64_t seed, enum noise_purpose purpose, uint64_t counter);
// Standard normal. Uses a counter space of its own (two draws per counter).
double noise_normal(uint64_t seed, enum noise_purpose purpose, uint64_t counter);
// Log-normal with mean 1 and the given relative standard deviation.
double noise_spread(double relative_sd, uint64_t seed, enum noise_purpose purpose, uint64_t counter);

#endif
