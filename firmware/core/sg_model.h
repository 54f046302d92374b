// SPDX-License-Identifier: Apache-2.0
// The stored model: its layout in a flash slot (or in RAM for a trial), and its validation.
//
// A model is one contiguous image:  header page (128 B) | guard page (128 B) | n records of 13 B. The header
// page is the first page of a slot and the last one written, so a slot whose upload was cut is never taken
// for a model: either the magic is not there or the CRC does not fit. All fields little endian. PROTOCOL.md
// section 5.
//
// Meaning, with d channels and features x_j (sg_raw.feature):
//   s_j  = clamp(((x_j - offset_j) * gain_q12_j) >> 12, 0, 4095)   u8.4, u = 76.87 whole steps a length scale
//   S2   = (sum_j s_j^2) >> 5
//   T_i  = S2 + half_c2_i - sum_j c_ij * s_j                       half squared distance, 20.4, at least 0
//   k_i  = exp(-T_i / (16 u^2))                                    Q0.16, 0 from T_i >= 2^20; see below
//   gaze = bias + sum_j trend_j * s_j + sum_i weight_i * k_i       32-bit, 2^-(weight_frac_bits + 16) deg
// where u = sqrt(4096 / ln 2), so that T >> 16 is a whole number of halvings. k is interpolated in a table:
//   level[i] = floor(2^(16 - i/64) * (1 - (ln 2 / 64)^2 / 16)),  i = T >> 10
//   k        = level[i] - ((((level[i] - level[i + 1]) << 6) * (T & 1023)) >> 16)
// Equation: GP mean k^T C^-1 u of the paper (section 5.2), distilled to n vectors with a linear trend;
// DESIGN.md section 5.
#ifndef SG_MODEL_H
#define SG_MODEL_H

#include <stddef.h>
#include <stdint.h>

// cdef begin
enum sg_model_limits {
    SG_MODEL_MAGIC = 0x4D475A47,    // "GZGM" in memory order
    SG_MODEL_VERSION = 1,
    SG_MODEL_PAGE = 128,
    SG_MODEL_HEAD_BYTES = 256,      // header page and guard page
    SG_MODEL_RECORD_BYTES = 13,
    SG_MODEL_CHANNELS = 6,
    SG_MODEL_SLOT_BYTES = 3072,
    SG_MODEL_VECTORS_MAX = 216,     // (3072 - 256) / 13
    SG_MODEL_TRIAL_VECTORS_MAX = 48,
};
enum sg_model_kernel { SG_KERNEL_RBF = 0 };

// First page. 128 bytes, no padding.
struct sg_model_head {
    uint32_t magic;                 // SG_MODEL_MAGIC
    uint32_t crc;                   // CRC-32 (IEEE 802.3) of bytes [8, length) of the image
    uint32_t generation;            // the larger of two valid slots wins (as signed difference)
    uint32_t length;                // SG_MODEL_HEAD_BYTES + vectors * SG_MODEL_RECORD_BYTES
    int32_t bias[2];                // azimuth, elevation; unit 2^-(weight_frac_bits + 16) deg
    int32_t trend[2][6];            // per output and channel, same unit per step of s_j
    uint16_t offset[6];             // feature units
    uint16_t gain_q12[6];           // s steps per feature step, Q4.12; 0 drops the channel
    uint16_t version;               // SG_MODEL_VERSION
    uint8_t vectors;                // n, 1..SG_MODEL_VECTORS_MAX
    uint8_t channels;               // d, 1..6; channels >= d have gain 0 and zero centres
    uint8_t kernel;                 // enum sg_model_kernel
    uint8_t weight_frac_bits;       // 6..10
    uint8_t guards;                 // rows in use in the guard page, 0..8
    uint8_t reserved;
    uint8_t pad[24];                // zero
};

// Second page: linear guards. A gaze is OUT_OF_RANGE unless  low <= sum_j row_j * s_j <= high  for every row
// in use (and no feature was clamped). They bound the calibrated cloud along its principal directions.
struct sg_model_guard {
    int32_t low;
    int32_t high;
    int8_t row[6];
    uint8_t reserved[2];
};
// guard page = struct sg_model_guard[8]

// One calibration vector. 13 bytes, read byte by byte: half_c2 (u24, 20.4, below 2^22; 8 * sum c^2 for the
// exact distance), c[6] (u8), weight azimuth, elevation (s16).

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
    uint8_t space;              // 0 ordinary memory, 1 program flash (they differ on AVR only)
    uint8_t vectors;
    uint8_t channels;
    uint8_t guards;
    uint8_t weight_frac_bits;
    uint8_t reserved;
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
// the length against vectors, slot (SG_E_BOUNDS) and room (SG_E_SHORT), the CRC (SG_E_CRC), then SG_E_BOUNDS
// for: channels, kernel, weight_frac_bits or guards outside their ranges; a channel >= d with an offset,
// gain, trend, guard row entry or centre that is not 0; a guard with low > high; a row not in use, reserved
// or pad byte that is not 0; half_c2 >= 2^22. sg_gp relies on all of it.
// Cost      one pass for the CRC, one over the records; on AVR about 45 cycles per byte of the image.
// Returns   SG_OK or one of the errors above.
int sg_model_open(struct sg_model_view *view, const uint8_t *image, uint32_t room, uint8_t space);

// The same, judged without the CRC pass, for a caller that has just computed it (crc over bytes [8, length))
// in pieces.
int sg_model_open_checked(struct sg_model_view *view, const uint8_t *image, uint32_t room, uint8_t space,
                          uint32_t crc);

// The length an image claims, for a caller that computes the CRC in pieces: header checks up to SG_E_SHORT as
// above.
// Returns the length in bytes, 269..3072, or the error.
int sg_model_length(const uint8_t *image, uint32_t room, uint8_t space);
// cdef end

_Static_assert(sizeof(struct sg_model_head) == SG_MODEL_PAGE, "model layout");
_Static_assert(sizeof(struct sg_model_guard) * 8 == SG_MODEL_PAGE, "model layout");

#endif
