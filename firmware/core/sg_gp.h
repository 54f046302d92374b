// SPDX-License-Identifier: Apache-2.0
// Gaussian-process prediction from a stored model: the mean k^T C^-1 u of the paper's section 5.2, distilled
// on the host to n calibration vectors and a linear trend. The formula is stated once, in sg_model.h.
#ifndef SG_GP_H
#define SG_GP_H

#include <stdint.h>

#include "sg_model.h"

// cdef begin
// Bits of *flags; the value is that of SG_FLAG_OUT_OF_RANGE (sg_wire.h), which this module does not include.
enum sg_gp_flag { SG_GP_OUT_OF_RANGE = 4 };

// Predict the gaze at one point.
//
//   view      opened by sg_model_open(); borrowed, not modified. n in 1..216, d in 1..6.
//   feature   6 entries, log2 photocurrent, 1/4096 octave; entries d..5 are not looked at. Every value is
//             legal.
//   deg_q7    azimuth and elevation, Q8.7 (1 LSB = 1/128 deg), rounded half up, saturated.
//   flags     SG_GP_OUT_OF_RANGE when a feature was clamped or a guard row is violated, or the result
//             saturated; else 0. Written, not or-ed.
//
// Scaling and overflow
//   difference x - offset: unsigned 16 bits after the clamp at 0; times gain Q4.12 in 32 bits unsigned
//   exactly (65535^2 < 2^32); >> 12, clamped to 4095: s is u8.4.
//   S2: six squares of 24 bits in 32 bits (27 used), >> 5: below 2^22.
//   T = S2 + half_c2 - sum c*s, 20.4 signed: half_c2 < 2^22 (sg_model_open checks) and sum c*s < 2^23 leave
//   it inside (-2^23, 2^23): 24 bits never wrap.
//   k: Q0.16, from (level - (drop * fraction >> 16)) with drop Q10.6 and fraction Q0.10: 26 bits.
//   accumulator: Qm.(weight_frac_bits + 16) in 32 bits modulo 2^32, where products of s16 and Q0.16 wrap on
//   purpose: only the final value must fit, and the host chooses weight_frac_bits so that it does inside the
//   calibrated range. Outside of it the point is flagged. The result is the accumulator >> (weight_frac_bits
//   + 9). The order of the vectors does not matter, to the bit.
// Accuracy
//   |k - 2^16 exp(-T/(16 u^2))| <= 1.5 LSB for the T of this function: level 1/2, floor of the interpolation
//   1/2, half the chord's height 0.48, the means of the last two being taken off the table. S2 being floored
//   adds 0.7. So the mean is within 2.2 * 2^-16 * sum_i |weight_i| + 2^-8 deg of the real-number mean at the
//   same s. tests/unit/test_core_gp.py asserts the bound and prints it beside the worst error seen.
// Cost       O(n d). On AVR with the assembly about 2320 + 195 n + 200 per guard cycles, less where a kernel
//            is 0; tests/unit/test_core_avr.py.
// Returns    SG_OK, or SG_E_RANGE if the result saturated (*deg_q7 then holds the saturated value, flags are
//            set).
int sg_gp_predict(const struct sg_model_view *view, const uint16_t feature[6], int16_t deg_q7[2],
                  uint8_t *flags);
// cdef end

#endif
