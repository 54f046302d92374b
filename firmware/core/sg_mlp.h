// SPDX-License-Identifier: Apache-2.0
// A small tanh network in integers: 1..8 inputs, 0..4 hidden layers of 1..64, 1..8 linear outputs, stored as
// one image in memory or program flash. Second predictor beside sg_gp; the network of NextGaze has this form.
//
// An image is  head (64 B) | layer | layer | ...  All fields little endian, no alignment. A layer of r rows
// on c columns: r is rounded up to even (the row too many has scale 0), and the rows stand in
// groups of n = 4, at the end perhaps one of n = 2:
//   bias s24[n] | weight [c][n], 1 or 2 bytes each, as w + 128 or w + 32768 | scale u16[n]
//
// Meaning, with inputs x_j:
//   a_j   = clamp(((x_j - offset_j) * gain_q8_j) >> 8, 0, 65535)          activation a/32768 - 1: Q0.15 + 1
//   S     = sum_j a_j,  L = sum_j (a_j & 255)
//   z_i   = bias_i - (S >> 1) + sum_j ((w_ij * a_j) >> 8)                        w of 1 byte, as stored
//   z_i   = bias_i - 128 S + (L >> 1) + sum_j ((w_ij >> 8) * a_j + (w_ij & 255) * (a_j >> 8))      of 2 bytes
//   q_i   = (|z_i| * scale_i + 128) >> 8
//   hidden: u = min(q_i, 65535), argument in units of ln 2 / 8192; i = u >> 8; f = u & 255
//           t = T[i] + (((T[i + 1] - T[i]) * f + 128) >> 8),  a_i = 32768 + t if z_i >= 0 else 32768 - t
//   output: y_i = min((q_i + 128) >> 8, 32767) with the sign of z_i
//   T[i]  = 32768 tanh(i ln 2 / 32), raised by half of how far a chord falls short at most; T[0] = 0,
//           T[256] = 32767
// So the bias contains -128 sum_j (true w_ij), because a is offset; a row's scale frees its weights to use
// all their bits; L >> 1 stands for the mean of what the product of two low bytes, which is left out, owes to
// a; and the real-number network is  y = W tanh(... tanh(W a + b)) + b.
#ifndef SG_MLP_H
#define SG_MLP_H

#include <stddef.h>
#include <stdint.h>

// cdef begin
enum sg_mlp_limits {
    SG_MLP_MAGIC = 0x4C4D5A47,  // "GZML" in memory order
    SG_MLP_VERSION = 1,
    SG_MLP_HEAD_BYTES = 64,
    SG_MLP_INPUTS_MAX = 8,
    SG_MLP_OUTPUTS_MAX = 8,
    SG_MLP_HIDDEN_MAX = 4,
    SG_MLP_WIDTH_MAX = 64,
    SG_MLP_SCRATCH_MAX = 128,   // words of 16 bits
    SG_MLP_LENGTH_MAX = 28008,
};

// Bits of *flags; the value is that of SG_FLAG_OUT_OF_RANGE (sg_wire.h), which this module does not include.
enum sg_mlp_flag { SG_MLP_OUT_OF_RANGE = 4 };

struct sg_mlp_input {
    uint16_t offset;            // units of the input
    uint16_t gain_q8;           // activation steps per input step, Q8.8; 0 drops the input
};

// 64 bytes, no padding.
struct sg_mlp_head {
    uint32_t magic;             // SG_MLP_MAGIC
    uint32_t crc;               // sg_model_crc32 of bytes [8, length) of the image
    uint16_t length;            // of the whole image
    uint16_t version;           // SG_MLP_VERSION
    uint8_t inputs;             // 1..8
    uint8_t outputs;            // 1..8
    uint8_t hidden;             // layers, 0..4
    uint8_t reserved;
    uint8_t width[4];           // of hidden layer k, 1..64; 0 where there is none
    uint8_t weight_bytes[5];    // of layer k, the output layer being k = hidden: 1 or 2; 0 where none is
    uint8_t pad[7];             // zero
    struct sg_mlp_input input[8];
};
// cdef end

// cdef begin
// A validated network. The image is borrowed and must neither move nor change while the view is in use.
struct sg_mlp_view {
    const uint8_t *image;
    uint32_t crc;
    uint16_t length;
    uint8_t space;              // 0 ordinary memory, 1 program flash (they differ on AVR only)
    uint8_t inputs;
    uint8_t outputs;
    uint8_t hidden;
    uint8_t width[4];           // as stored
    uint8_t wide;               // bit k: layer k has weights of 2 bytes
    uint8_t scratch_words;      // for sg_mlp_predict: 2 * (the largest layer rounded up to even), 4..128
    uint8_t reserved;
};

// Validate an image and open it.
//
//   view    written only on SG_OK
//   image   start of the image, any alignment; `room` bytes may be read, no more, whatever they hold
//   space   0 ordinary memory, 1 program flash
//
// Checked, in this order: room for the head (SG_E_SHORT), magic (SG_E_MAGIC), version (SG_E_VERSION), counts,
// widths, weight_bytes and the length that follows from them (SG_E_BOUNDS), room for it (SG_E_SHORT), the CRC
// (SG_E_CRC), then SG_E_BOUNDS for: a reserved byte or the input of a channel that is not in use not 0; a row
// too many whose scale is not 0; a row whose z could leave 24 bits for some activations, with P and N the
// sums of its positive and negative weights:
//   bias + 256 (P + c) < 2^23   and   bias - 256 (N + c) >= -2^23
// where c covers the roundings: z is less than 255 a column away from the exact products' sum.
// Cost      two passes; on AVR about 100 cycles per byte of the image.
// Returns   SG_OK or one of the errors above.
int sg_mlp_open(struct sg_mlp_view *view, const uint8_t *image, uint32_t room, uint8_t space);

// Evaluate the network at one point.
//
//   view      opened by sg_mlp_open(); borrowed, not modified
//   input     view->inputs entries; every value is legal
//   scratch   view->scratch_words words; content before and after means nothing
//   output    view->outputs entries, in 1/128 of the unit that the network was trained in (degrees: Q8.7),
//             rounded half away from zero, saturated at +-32767
//   flags     SG_MLP_OUT_OF_RANGE when an input was clamped or an output saturated; else 0. Written, not
//             or-ed.
//
// Scaling and overflow
//   (x - offset) * gain: u16 * u16 in 32 bits. Products of weights and activations: 16 or 24 bits, summed
//   modulo 2^24; the final z is inside 24 bits because sg_mlp_open proved it from the weights. |z| <= 2^23
//   times scale < 2^16: q < 2^31. T rises by less than 2^10 a step: times f below 2^18.
// Accuracy
//   tanh: 1.8 * 2^-15 beside the exact tanh of u, over the whole domain, with 0 exact and odd symmetry.
//   Products, in units of z, about their mean: of 1 byte within 1/2, of 2 bytes within 64 (22 rms; a weight's
//   own rounding: 64, 37 rms). The host states the sum of all that for a network (mlp.py) and
//   tests/unit/test_mlp.py prints it beside the error measured.
// Cost      the same number of cycles for every input. On AVR with the assembly 15 cycles per weight of
//           1 byte, 22 of 2 bytes, 120 per row, 250 per layer; tests/unit/test_mlp_avr.py.
// Returns   SG_OK, or SG_E_RANGE if an output saturated (flags are set).
int sg_mlp_predict(const struct sg_mlp_view *view, const uint16_t *input, uint16_t *scratch, int16_t *output,
                   uint8_t *flags);
// cdef end

_Static_assert(sizeof(struct sg_mlp_head) == SG_MLP_HEAD_BYTES, "network layout");

#endif
