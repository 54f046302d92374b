// SPDX-License-Identifier: Apache-2.0
// The stored model: its layout in a flash slot (or in RAM for a trial), and its validation.
//
// A model is one contiguous image:  header page (128 B) | trust page (128 B) | grid, 5 B a node | n records of
// 12 B. The header page is the first page of a slot and the last one written, so a slot whose upload was cut is
// never taken for a model: either the magic is not there or the CRC does not fit. All fields little endian.
// PROTOCOL.md section 5.
//
// Gaze, with d channels and features x_j (sg_raw.feature):
//   s_j  = clamp(((x_j - offset_j) * gain_q12_j) >> 12, 0, 4095)       u8.4, u = 64 whole steps a length scale
//   S2   = (sum_j s_j^2 + 31) >> 5
//   T_i  = S2 + 256 * half_c2_i - sum_j c_ij * s_j                     half squared distance, 20.4, at least 0
//   k_i  = exp(-T_i / 2^16)                                            Q0.16, 0 from T_i >= 710 * 2^10
//   gaze = ((bias + sum_j trend_j * s_j) >> 4) + sum_i weight_i * k_i  24-bit, 2^-(weight_frac_bits + 8) deg
// with, L being a table of 711 entries (make_tables.py), k = 0 from its last on and >> floors,
//   i = T >> 10,  f = (T >> 2) & 255,  k = L[i] - (((L[i] >> 8) * f) >> 6)
//   weight * k = (weight * k - (weight & 255) * (k & 255)) / 256       a multiple of 256 before the division
// half_c2_i is 8 * sum_j c_ij^2 in units of 256, rounded up; the weight takes the difference.
// Equation: GP mean k^T C^-1 u of the paper (section 5.2), distilled to n vectors with a linear trend;
// DESIGN.md section 5.
//
// Trust: is there a gaze that explains these features? With g guards and the gaze (azimuth, elevation; Q8.7,
// before recentring) of above, the grid tells what each guard's projection should be there:
//   p_k  = sum_j row_kj * (s_j >> 4)                                   flagged unless low_k <= p_k <= high_k
//   t    = clamp(((gaze - origin) * scale), 0, (nodes - 1) * 65536 - 1) in each axis; cell t >> 16
//   f    = (t >> 9) & 127;  w11 = (f_az * f_el) >> 7, w10 = f_az - w11, w01 = f_el - w11, w00 = 128 - f_az - w01
//   r_k  = clamp(p_k - base_k - ((sum of w * expected_k over the cell's corners) >> 4), -127, 127)
//   m    = sum_k r_k^2                                                 flagged when m > limit
//   sigma_log2_q4 = min(255, ((sum of w * sigma_log2_q4 over the corners) >> 7) + ((m * sigma_gain) >> 12))
// Rows are scaled so that 16 is one standard deviation of r_k in the calibration: m / 256 is a squared
// Mahalanobis distance from the surface of features that gaze can make. A flagged point has sigma 255.
// The sum over j of |row_kj| is at most 63, so that everything fits 16 bits.
#ifndef SG_MODEL_H
#define SG_MODEL_H

#include <stddef.h>
#include <stdint.h>

// cdef begin
enum sg_model_limits {
    SG_MODEL_MAGIC = 0x4D475A47,    // "GZGM" in memory order
    SG_MODEL_VERSION = 2,
    SG_MODEL_PAGE = 128,
    SG_MODEL_HEAD_BYTES = 256,      // header page and trust page
    SG_MODEL_NODE_BYTES = 5,
    SG_MODEL_RECORD_BYTES = 12,
    SG_MODEL_CHANNELS = 6,
    SG_MODEL_GUARDS = 4,
    SG_MODEL_NODES_MAX = 24,        // of the grid, along one axis
    SG_MODEL_SLOT_BYTES = 3072,
    SG_MODEL_VECTORS_MAX = 233,     // (3072 - 256 - 20) / 12
};
enum sg_model_kernel { SG_KERNEL_RBF = 0 };

// First page. 128 bytes, no padding.
struct sg_model_head {
    uint32_t magic;                 // SG_MODEL_MAGIC
    uint32_t crc;                   // CRC-32 (IEEE 802.3) of bytes [8, length) of the image
    uint32_t generation;            // the larger of two valid slots wins (as signed difference)
    uint32_t length;                // SG_MODEL_HEAD_BYTES + grid + vectors * SG_MODEL_RECORD_BYTES
    int32_t bias[2];                // azimuth, elevation; unit 2^-(weight_frac_bits + 12) deg, within +-2^30
    int16_t trend[2][6];            // per output and channel, same unit per step of s_j
    uint16_t offset[6];             // feature units
    uint16_t gain_q12[6];           // s steps per feature step, Q4.12; 0 drops the channel, its offset is 0 too
    uint16_t version;               // SG_MODEL_VERSION
    uint8_t vectors;                // n, 1..SG_MODEL_VECTORS_MAX
    uint8_t channels;               // d, 1..6; channels >= d have gain 0 and zero centres
    uint8_t kernel;                 // enum sg_model_kernel
    uint8_t weight_frac_bits;       // 5..9
    uint8_t pad[50];                // zero
};

// A direction in feature space in which gaze says what to expect. 12 bytes.
struct sg_model_guard {
    int16_t base;                   // of the expectation, +-14336
    int16_t low;                    // range of the projection
    int16_t high;
    int8_t row[6];
};

// Second page. 128 bytes, no padding.
struct sg_model_trust {
    struct sg_model_guard guard[4]; // those not in use are zero
    int16_t origin_deg_q7[2];       // gaze of the grid's first node: azimuth, elevation; Q8.7, +-16384
    uint16_t limit;                 // of m
    uint8_t scale[2];               // cells per 512 deg, at least 1
    uint8_t nodes[2];               // of the grid: azimuth, elevation; 2..SG_MODEL_NODES_MAX
    uint8_t guards;                 // in use, 0..4
    uint8_t sigma_gain;
    uint8_t pad[68];                // zero
};

// Grid: nodes[0] * nodes[1] nodes, azimuth first: expected projection per guard (u8[4], unit 8 of p_k; 0 for
// guards not in use), sigma_log2_q4 (u8; 0 throughout: unknown): 5 bytes.
//
// One calibration vector: half_c2 (u16), c[6] (u8), weight azimuth, elevation (s16): 12 bytes.

// CRC-32 (IEEE, reflected, init and xorout 0xFFFFFFFF). Start and continue with the returned value; start
// with 0.
uint32_t sg_model_crc32(uint32_t crc, const uint8_t *data, size_t n);
// cdef end

// cdef begin
// A validated model. The image is borrowed and must neither move nor change while the view is in use.
struct sg_model_view {
    const uint8_t *image;
    uint32_t crc;
    uint32_t generation;
    uint16_t length;
    uint16_t records;           // offset of the first record
    uint8_t space;              // 0 ordinary memory, 1 program flash (they differ on AVR only)
    uint8_t vectors;
    uint8_t channels;
    uint8_t weight_frac_bits;
};

// sg_model_crc32 over an image in either space. To spread a long check over frames, continue it piece by
// piece.
uint32_t sg_model_crc32_at(uint32_t crc, const uint8_t *data, uint16_t n, uint8_t space);

// Validate an image and open it.
//
//   view    written only on SG_OK
//   image   start of the image, any alignment; `room` bytes may be read, no more, whatever they hold
//   space   0 ordinary memory, 1 program flash
//
// Checked, in this order: room for the two pages (SG_E_SHORT), magic (SG_E_MAGIC), version (SG_E_VERSION),
// the length against vectors, grid, slot (SG_E_BOUNDS) and room (SG_E_SHORT), the CRC (SG_E_CRC), then
// SG_E_BOUNDS for: channels, kernel, weight_frac_bits, bias, guards, nodes, origin, scale or base outside
// their ranges; a channel >= d with an offset, gain, trend, guard row entry or centre that is not 0; a guard
// with low > high or too large a row; a guard not in use, an expectation without guard or a pad byte that is
// not 0; an offset without gain; a half_c2 that is not that of its centre. sg_gp relies on all of it.
// Cost      one pass for the CRC, one over the grid and the records; on AVR about 50 cycles per byte.
// Returns   SG_OK or one of the errors above.
int sg_model_open(struct sg_model_view *view, const uint8_t *image, uint32_t room, uint8_t space);

// The same for a caller that has gone over the image in pieces: crc is that of bytes [8, length), `parts` the first
// error of sg_model_check_part, or SG_OK.
int sg_model_open_checked(struct sg_model_view *view, const uint8_t *image, uint16_t room, uint8_t space,
                          uint32_t crc, int parts);

// The nodes and records of an image one by one, from byte SG_MODEL_HEAD_BYTES to its length, which
// sg_model_length has told: where the part after the one that begins at `at` begins (for an `at` inside of the
// two pages, the first), and whether the one at `at` is good: SG_OK or SG_E_BOUNDS.
uint16_t sg_model_part(const uint8_t *image, uint16_t at, uint8_t space);
int sg_model_check_part(const uint8_t *image, uint16_t at, uint8_t space);

// The length an image claims, for a caller that computes the CRC in pieces: header checks up to SG_E_SHORT as
// above.
// Returns the length in bytes, 288..3072, or the error.
int sg_model_length(const uint8_t *image, uint16_t room, uint8_t space);
// cdef end

_Static_assert(sizeof(struct sg_model_head) == SG_MODEL_PAGE, "model layout");
_Static_assert(sizeof(struct sg_model_guard) == 12, "model layout");
_Static_assert(sizeof(struct sg_model_trust) == SG_MODEL_PAGE, "model layout");

#endif
