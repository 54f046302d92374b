// SPDX-License-Identifier: Apache-2.0
// Gaussian-process prediction from a stored model: the mean k^T C^-1 u of the paper's section 5.2, distilled
// on the host to n calibration vectors and a linear trend, and how far it can be trusted. The formulas are
// stated once, in sg_model.h.
#ifndef SG_GP_H
#define SG_GP_H

#include <stdint.h>

#include "sg_model.h"

// cdef begin
// Bits of sg_gp_point.flags; the value is that of SG_FLAG_OUT_OF_RANGE (sg_wire.h), which this module does not
// include.
enum sg_gp_flag { SG_GP_OUT_OF_RANGE = 4 };
enum sg_gp_sigma { SG_GP_SIGMA_UNKNOWN = 0, SG_GP_SIGMA_HUGE = 255 };

// A gaze and what is known of its error.
struct sg_gp_point {
    int16_t deg_q7[2];          // azimuth and elevation, Q8.7 (1 LSB = 1/128 deg), rounded half up, saturated
    uint16_t doubt;             // m: 256 times the squared distance, in deviations, from what gaze explains
    uint8_t sigma_log2_q4;      // standard deviation of each angle: 2^(code / 16 - 8) deg; enum sg_gp_sigma
    uint8_t flags;              // SG_GP_OUT_OF_RANGE or 0
};

// Predict the gaze at one point.
//
//   view      opened by sg_model_open(); borrowed, not modified. n in 1..233, d in 1..6.
//   feature   6 entries, log2 photocurrent, 1/4096 octave; entries d..5 are not looked at. Every value is
//             legal.
//   point     written whole. OUT_OF_RANGE when a feature was clamped, a guard's projection left its range,
//             the doubt is above the model's limit or an angle saturated; sigma is then HUGE.
//
// Scaling and overflow
//   difference x - offset: unsigned 16 bits after the clamp at 0; times gain Q4.12 in 32 bits unsigned
//   exactly (65535^2 < 2^32); >> 12, clamped to 4095: s is u8.4.
//   S2: six squares of 24 bits in 32 bits (27 used), >> 5: below 2^22. half_c2 * 256 < 2^22 and is not less
//   than 8 sum c^2 (sg_model_open checks), so T = S2 + 256 half_c2 - sum c*s is in [0, 2^23): never negative.
//   k: Q0.16, from (L - ((L >> 8) * f >> 7)): f and L >> 8 have 8 bits each.
//   trend: Q.(weight_frac_bits + 12) in 32 bits: |bias| <= 2^30 and six products of s16 and u12 below 2^27.
//   accumulator: 24 bits, Q.(weight_frac_bits + 8), modulo 2^24, where partial sums wrap on purpose: only the
//   final value must fit, and the host proves that it does for every input that no range flags
//   (host_sdk/sparsegaze/rounding.py, reach). The result is the accumulator >> (weight_frac_bits + 1). The
//   order of the vectors does not matter, to the bit.
//   projections: |p| <= 63 * 255 < 2^14. m: four squares of 7 bits: 16 bits.
// Accuracy
//   |k - 2^16 exp(-T / 2^16)| <= 9 LSB for the T of this function: floor of the level 1, of the drop 1, low byte
//   of the level left out of the drop 4 one way; curvature 8 the other way. S2 being rounded up adds 1. Left out
//   of weight * k is the product of the low bytes. So the mean is within
//     10 * 2^-16 * sum_i |weight_i| + 2^-(weight_frac_bits + 8) * (1 + sum_i (weight_i & 255)) + 2^-8 deg
//   of the real-number mean at the same s and half_c2 (the second term is one-sided and mostly a constant, which
//   the fit on the device's own arithmetic absorbs). tests/unit/test_core_gp.py asserts the bound and prints it
//   beside the worst error seen.
// Cost       O(n d), the same for every input but for 8 cycles (flags). tests/budget.csv; on AVR with the assembly
//             about 2730 + 154 n cycles with sg_track around it.
// Returns    SG_OK, or SG_E_RANGE if an angle saturated (deg_q7 then holds the saturated value).
int sg_gp_predict(const struct sg_model_view *view, const uint16_t feature[6], struct sg_gp_point *point);
// cdef end

#endif
