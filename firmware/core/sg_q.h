// SPDX-License-Identifier: Apache-2.0
// The only shifts with rounding and the only saturation of the core. Qm.n: m integer bits, n fraction bits,
// sign not counted.
#ifndef SG_Q_H
#define SG_Q_H

#include <stdint.h>

// The core shifts negative numbers right and means floor; C11 leaves it to the compiler, so ask once.
_Static_assert((-3 >> 1) == -2, "right shift of a negative number must be arithmetic");

// Saturate to 16 bits.
static inline int16_t sg_q_sat16(int32_t x)
{
    if (x > INT16_MAX)
        return INT16_MAX;
    if (x < INT16_MIN)
        return INT16_MIN;
    return (int16_t)x;
}

// floor(x / 2^bits + 1/2) for every x, bits in 1..31: the half is added after all bits but one are gone, so
// that it cannot overflow.
static inline int32_t sg_q_round_shift(int32_t x, uint8_t bits)
{
    return ((x >> (bits - 1U)) + 1) >> 1;
}

// Two's complement value of 16 bits.
static inline int16_t sg_q_signed16(uint16_t x)
{
    return x <= INT16_MAX ? (int16_t)x : (int16_t)(-1 - (int16_t)(UINT16_MAX - x));
}

// Two's complement value of 32 bits; spelled out because the C conversion is implementation-defined.
static inline int32_t sg_q_signed32(uint32_t x)
{
    return x <= INT32_MAX ? (int32_t)x : -1 - (int32_t)(UINT32_MAX - x);
}

#endif
