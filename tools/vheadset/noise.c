// SPDX-License-Identifier: GPL-3.0-or-later
#include "noise.h"

#include <math.h>

// Finaliser of SplitMix64 (Steele, Lea, Flood 2014), used as a hash.
static uint64_t mix(uint64_t z)
{
    z += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
}

uint64_t noise_bits(uint64_t seed, enum noise_purpose purpose, uint64_t counter)
{
    return mix(mix(mix(seed) ^ (uint64_t)purpose) ^ counter);
}

uint64_t noise_session(uint64_t seed, uint64_t session)
{
    return noise_bits(seed, NOISE_SESSION, session);
}

static double unit(uint64_t bits)
{
    return ((double)(bits >> 11) + 0.5) * 0x1p-53;
}

double noise_uniform(uint64_t seed, enum noise_purpose purpose, uint64_t counter)
{
    return unit(noise_bits(seed, purpose, counter));
}

double noise_normal(uint64_t seed, enum noise_purpose purpose, uint64_t counter)
{
    uint64_t base = counter * 2 + (1ull << 62);
    double radius = sqrt(-2.0 * log(unit(noise_bits(seed, purpose, base))));
    return radius * cos(2.0 * M_PI * unit(noise_bits(seed, purpose, base + 1)));
}

double noise_spread(double relative_sd, uint64_t seed, enum noise_purpose purpose, uint64_t counter)
{
    double sigma = sqrt(log1p(relative_sd * relative_sd));
    return exp(sigma * noise_normal(seed, purpose, counter) - 0.5 * sigma * sigma);
}
