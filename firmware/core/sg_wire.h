// SPDX-License-Identifier: Apache-2.0
// Messages on the wire: layouts, and the byte-level codec (COBS, CRC-16).
//
// This header is the one description of every byte that crosses the serial line. The region between the two
// `cdef` marks is cut out by host_sdk/sparsegaze/_core_build.py and given to cffi, so it holds only enums, structs of
// fixed-width integers and prototypes. A change of any layout is a change of SG_WIRE_VERSION (a test keeps the
// hash of the region per version).
//
// A frame on the wire is  COBS( head | body | crc16 ) 0x00  : little endian, CRC-16/CCITT-FALSE (poly 0x1021, init
// 0xFFFF, no reflection) over head and body, low byte first. PROTOCOL.md states it whole.
#ifndef SG_WIRE_H
#define SG_WIRE_H

#include <stddef.h>
#include <stdint.h>

#include "sg_rom.h"

// cdef begin
enum sg_wire_limits {
    SG_WIRE_VERSION = 3,
    SG_WIRE_CHANNELS = 6,       // feature channels in every stream frame; unused ones are 0
    SG_WIRE_HEAD_BYTES = 4,
    SG_WIRE_BODY_MAX = 64,      // largest body, bytes
    SG_WIRE_PACKET_MAX = 70,    // head + body + crc
    SG_WIRE_FRAME_MAX = 72,     // + COBS overhead + delimiter
    SG_WIRE_DATA_MAX = 48,      // bytes of model data in one read or trial-write message
    SG_WIRE_RATE_LEAST_HZ = 16, // slower, a frame's period would not fit its field
};

// Requests travel host -> device; the reply has type | SG_REPLY and the request's seq. A request that fails is
// answered by SG_MSG_ERROR with the request's seq.
enum sg_msg {
    SG_MSG_HELLO = 0x01,        // empty                     -> struct sg_hello
    SG_MSG_STATUS = 0x02,       // empty                     -> struct sg_status
    SG_MSG_PING = 0x03,         // struct sg_ping            -> struct sg_pong
    SG_MSG_MODE = 0x04,         // struct sg_mode            -> the same
    SG_MSG_INFER = 0x05,        // struct sg_infer           -> struct sg_gaze (t_us = 0)
    SG_MSG_MODEL_INFO = 0x06,   // empty                     -> struct sg_model_info
    SG_MSG_MODEL_READ = 0x07,   // struct sg_model_at        -> struct sg_model_data
    SG_MSG_MODEL_VERIFY = 0x08, // struct sg_model_at (slot) -> struct sg_model_verdict
    SG_MSG_TRIAL_WRITE = 0x09,  // struct sg_model_data (slot = SG_SLOT_RAM) -> struct sg_model_at
    SG_MSG_TRIAL_USE = 0x0A,    // struct sg_mode (mode 1: validate and use the trial, 0: back to the store) -> struct sg_model_verdict
    SG_MSG_EXPOSURE = 0x0B,     // struct sg_exposure        -> the same, as in force after the request
    SG_MSG_RECENTRE = 0x0C,     // struct sg_recentre        -> the same, as in force after the request
    SG_MSG_REBOOT = 0x0D,       // struct sg_mode (mode = 0xA5) -> the same, then a watchdog reset
    SG_MSG_BAUD = 0x0E,         // struct sg_mode (mode 0: 1 Mbaud, 1: 500 kbaud) -> the same at the old speed, then the switch; reset restores 1 Mbaud
    SG_MSG_SETTINGS = 0x0F,     // struct sg_settings        -> the same, as in force after the request
    SG_MSG_CURVE = 0x10,        // struct sg_curve           -> the same, as in force after the request
    SG_MSG_PROBE = 0x11,        // struct sg_mode (mode: emitter 0..5) -> struct sg_probe: every sensor by this emitter alone
    SG_MSG_RAW = 0x40,          // stream: struct sg_raw; seq counts sensing frames
    SG_MSG_GAZE = 0x41,         // stream: struct sg_gaze; seq of the raw frame it was computed from
    SG_MSG_COUNTS = 0x42,       // stream: struct sg_counts; the same seq
    SG_MSG_ERROR = 0x7F,        // struct sg_error
    SG_REPLY = 0x80,
};

// Bits of sg_mode.mode for SG_MSG_MODE, freely combined. 0 is off.
enum sg_stream { SG_STREAM_RAW = 1, SG_STREAM_GAZE = 2, SG_STREAM_COUNTS = 4 };

// Bits of sg_raw.flags and sg_gaze.flags. SG_FLAG_VALID is set only on a gaze that a model computed from features
// inside its calibrated range; a gaze without it is never to be shown as a gaze.
enum sg_flag {
    SG_FLAG_VALID = 1,
    SG_FLAG_NO_MODEL = 2,
    SG_FLAG_OUT_OF_RANGE = 4,   // a feature, or a guard projection of the features, is outside the calibrated range (blink, slip)
    SG_FLAG_SATURATED = 8,      // a channel's exposure ran into the bottom of its range
    SG_FLAG_STARVED = 16,       // a channel collected too little light to say anything
    SG_FLAG_EXPOSURE = 32,      // an exposure changed since the previous frame
    SG_FLAG_FAULT = 64,         // a channel or the board is at fault: sg_status names it
    SG_FLAG_RECOVERING = 128,   // out of range shortly before: the lids may still be opening; or exposures are being found
};

enum sg_exposure_op {
    SG_EXPOSURE_GET = 0,
    SG_EXPOSURE_SET = 1,        // hold these
    SG_EXPOSURE_AUTO = 2,
    SG_EXPOSURE_HOLD = 3,       // hold those in force
    SG_EXPOSURE_LIMIT = 4,      // automatic exposure stays at or below these
};
enum sg_settings_op { SG_SETTINGS_GET = 0, SG_SETTINGS_SET = 1 };
// What is on the pins: LEDs that sense and emit on A0..A5, or photodiodes on A0..A5 and emitters on D2..D4.
enum sg_wiring { SG_WIRING_LEDS = 0, SG_WIRING_PHOTODIODES = 1 };
enum sg_power { SG_POWER_NORMAL = 0, SG_POWER_LOW = 1 };
// Bits of sg_status.fault[channel].
enum sg_fault {
    SG_FAULT_OPEN = 1,          // no current at all, lit or not, at the longest exposure
    SG_FAULT_SHORT = 2,         // full at the shortest exposure, lit or not
    SG_FAULT_LOW = 4,           // far less light than in the calibration: covered, or its emitters dead
    SG_FAULT_HIGH = 8,          // far more light than in the calibration: something lies close before it
};
// Bits of sg_status.alarm.
enum sg_alarm {
    SG_ALARM_SUPPLY = 1,        // the supply is more than 4 % off the first value since boot, or cannot be
                                // measured any more (outside of some 3.5 .. 6.3 V); looked at once a second
    SG_ALARM_LOCKOUT = 2,       // lights are held off: the watchdog had to reset, and it is not 1 s ago
    SG_ALARM_LIGHTS_OFF = 4,    // lights are off by command
};
enum sg_recentre_op { SG_RECENTRE_GET = 0, SG_RECENTRE_SET = 1, SG_RECENTRE_CLEAR = 2 };
enum sg_slot { SG_SLOT_A = 0, SG_SLOT_B = 1, SG_SLOT_RAM = 2, SG_SLOT_NONE = 255 };
enum sg_board { SG_BOARD_TEMPLATE = 0, SG_BOARD_NANO328P = 1, SG_BOARD_MPS2AN386 = 2 };
enum sg_reset { SG_RESET_POWER = 1, SG_RESET_EXTERNAL = 2, SG_RESET_BROWNOUT = 4, SG_RESET_WATCHDOG = 8 };

struct sg_head {
    uint16_t seq;
    uint8_t type;               // enum sg_msg
    uint8_t flags;              // 0 in version 3; ignored by receivers
};

struct sg_hello {
    uint32_t firmware;          // product version: major << 16 | minor << 8 | patch
    uint32_t slot_bytes;        // room for one stored model
    uint32_t slot_base[2];      // flash addresses of the two model slots (bootloader writes go there)
    uint32_t cpu_hz;
    uint16_t wire_version;      // SG_WIRE_VERSION
    uint16_t model_version;     // SG_MODEL_VERSION
    uint16_t frame_period_us;   // device time
    uint16_t exposure_min_us;
    uint16_t exposure_max_us;   // the hard cap that no command lifts
    uint16_t page_bytes;        // flash page of the bootloader
    uint16_t trial_bytes;       // room for a RAM trial model, bytes; 0 = none
    uint8_t board;              // enum sg_board
    uint8_t channels;
};

struct sg_status {
    uint32_t t_us;              // device time now
    uint32_t frames;            // sensing frames since boot
    uint16_t exposure_us_q4[6]; // exposure in force per channel, 1/16 us
    uint16_t boot_count;
    uint16_t late_frames;       // frames whose inference or output was not done before the next one
    uint16_t late_slots;        // sensing slots that began late
    uint16_t tx_dropped;        // stream frames not sent because the line was full
    uint16_t rx_bad;            // received packets with a bad CRC, length or coding
    uint16_t rx_rejected;       // well-formed requests refused
    uint16_t rx_overrun;        // bytes lost by the receiver
    uint16_t saturated;         // saturated channel readings
    uint16_t starved;           // starved channel readings
    uint16_t stack_free;        // bytes of stack never touched since boot
    uint16_t exposure_changes;  // automatic exposure changes since boot
    uint8_t reset_cause;        // bits of enum sg_reset
    uint8_t stream;             // bits of enum sg_stream
    uint8_t exposure_auto;      // 1 automatic, 0 held
    uint8_t active;             // enum sg_slot of the model in use
    uint16_t eeprom_writes;     // live-state records written since boot
    uint16_t supply_mv;         // give or take 10 %; 0: not measured, or outside of what can be
    uint8_t fault[6];           // bits of enum sg_fault per channel
    uint8_t alarm;              // bits of enum sg_alarm
    uint8_t reserved;
    uint16_t cycles_max;        // most cycles between taking a frame's readings and the end of its work, since boot
};

struct sg_ping { uint32_t token; };
struct sg_pong {
    uint32_t token;
    uint32_t rx_us;             // device time when the request's last byte arrived
    uint32_t tx_us;             // device time when the reply was queued
};

struct sg_mode { uint8_t mode; };

struct sg_infer { uint16_t feature[6]; };

// Correction of a model's output g = (azimuth, elevation):  gaze = g + offset + G g.  Every value is legal:
// the entries of G are at least -1/4 and below 1/4, so no correction folds the picture or turns it over.
struct sg_affine {
    int16_t offset_deg_q7[2];   // azimuth, elevation
    int8_t gain_q9[4];          // G row by row: azimuth from azimuth, from elevation, elevation from each
};

struct sg_gaze {
    uint32_t t_us;              // mean sample time of the frame, device time
    int16_t azimuth_deg_q7;     // Fick azimuth, + right, 1/128 deg, recentre correction included
    int16_t elevation_deg_q7;   // Fick elevation, + up
    uint16_t infer_us;          // last sample to the end of inference, device time; 0 in replies to SG_MSG_INFER
    uint8_t flags;              // bits of enum sg_flag
    uint8_t sigma_log2_q4;      // deviation of the model's output: 2^(code / 16 - 8) deg; 0 unknown, 255 huge
};

// Everything the gaze of the same seq depends on.
struct sg_raw {
    uint32_t t_us;              // mean sample time of the frame
    uint32_t model_crc;         // CRC-32 of the model in use, 0 without one
    struct sg_affine recentre;  // in force
    uint16_t feature[6];        // log2 photocurrent, 1/4096 octave (sg_expose.h)
    uint16_t span_us;           // mean sample time to last sample, device time
    uint8_t flags;              // SATURATED, STARVED, EXPOSURE, FAULT, RECOVERING, as in the gaze frame
    uint8_t reserved;
};

// Of the last sensing cycle of the frame.
struct sg_counts {
    uint32_t t_us;
    uint16_t lit_code[6];       // ADC code, lights on
    uint16_t unlit_code[6];     // the same exposure, lights off
    uint16_t exposure_us_q4[6]; // 1/16 us, the same for both
};

struct sg_model_info {
    uint32_t crc[3];            // CRC-32 of slot A, slot B and the RAM trial; 0 where there is no valid model
    uint32_t generation[3];
    uint8_t vectors[3];
    uint8_t channels[3];
    int8_t verdict[3];          // SG_OK or the error that rejects what is there
    uint8_t active;             // enum sg_slot
    uint8_t reserved[2];
};

struct sg_model_at {
    uint16_t offset;
    uint8_t slot;               // enum sg_slot
    uint8_t length;             // 1..SG_WIRE_DATA_MAX
};

struct sg_model_data {
    uint16_t offset;
    uint8_t slot;
    uint8_t length;
    uint8_t data[48];           // `length` bytes travel, no more
};

struct sg_model_verdict {
    uint32_t crc;               // computed afresh over the stored bytes
    int8_t verdict;             // SG_OK or the error that rejects the model
    uint8_t slot;
    uint8_t reserved[2];
};

// A frame is `repeats` sensing cycles, whose photocurrents are averaged; a cycle takes period_us.
struct sg_settings {
    uint16_t rate_hz;           // frames a second wanted, in the reply too, even one above the limit;
                                // 0: as fast as can be, 1..15 are refused. In force is frame_period_us
    uint16_t rate_limit_hz;     // reply: the most that this model, these streams and these repeats allow
    uint16_t period_us;         // reply: one sensing cycle, device time
    uint16_t frame_period_us;   // reply: from frame to frame, device time
    uint8_t op;                 // enum sg_settings_op
    uint8_t repeats;            // 1, 2, 4, 8 or 16
    uint8_t wiring;             // enum sg_wiring
    uint8_t power;              // enum sg_power
    uint8_t rolling;            // 1: a gaze after every pair of sensors, three a cycle: refused, 0 so far
    uint8_t lights;             // 0: off, until set again
};

// Curvature of each channel's charge over its code, beside the nominal one: charge = code * (1 + ... + curve * code
// / 1024), curve in 1/1024. And the converter's zero: the code that 0 V would have, if codes went below 0.
struct sg_curve {
    int8_t curve_q10[6];
    int8_t zero_q2;             // quarter codes, 0 or less
    uint8_t op;                 // enum sg_settings_op
};

struct sg_probe {
    uint16_t feature[6];        // log2 photocurrent, 1/4096 octave, 0 where too little came
    uint8_t emitter;
    uint8_t reserved;
};

struct sg_exposure {
    uint16_t exposure_us_q4[6]; // 1/16 us; clipped to the limits in struct sg_hello and to the timing's
    uint8_t op;                 // enum sg_exposure_op; the reply's is AUTO or HOLD
    uint8_t reserved;
};

struct sg_recentre {
    struct sg_affine affine;    // of the model in use
    uint8_t op;                 // enum sg_recentre_op
    uint8_t reserved;
};

struct sg_error {
    int8_t error;               // enum sg_err
    uint8_t type;               // of the refused request
};

// CRC-16/CCITT-FALSE continued over `n` bytes; start with 0xFFFF. "123456789" -> 0x29B1.
uint16_t sg_wire_crc16(uint16_t crc, const uint8_t *data, size_t n);

// Encode one packet. out must hold SG_WIRE_FRAME_MAX bytes. body_bytes <= SG_WIRE_BODY_MAX.
// Returns the number of bytes written, delimiter included, or SG_E_BOUNDS.
int sg_wire_encode(const struct sg_head *head, const void *body, size_t body_bytes, uint8_t *out);

// The same into a ring of `size` bytes, from index `at` on, body_bytes + 8 bytes in all, which must be free.
// body_bytes <= SG_WIRE_BODY_MAX. Returns the index behind the delimiter.
uint16_t sg_wire_encode_ring(const struct sg_head *head, const void *body, uint8_t body_bytes, uint8_t *ring,
                             uint16_t size, uint16_t at);

// Decode one frame, given without its delimiter. body must hold SG_WIRE_BODY_MAX bytes.
// The frame is used up: its bytes become the packet's.
// Returns the body's length, or SG_E_SHORT, SG_E_BOUNDS, SG_E_CRC. Never reads or writes out of bounds,
// whatever comes.
int sg_wire_decode(uint8_t *frame, size_t n, struct sg_head *head, void *body);
// cdef end

_Static_assert(sizeof(struct sg_head) == SG_WIRE_HEAD_BYTES, "wire layout");
_Static_assert(sizeof(struct sg_hello) == 36, "wire layout");
_Static_assert(sizeof(struct sg_status) == 60, "wire layout");
_Static_assert(sizeof(struct sg_pong) == 12, "wire layout");
_Static_assert(sizeof(struct sg_infer) == 12, "wire layout");
_Static_assert(sizeof(struct sg_affine) == 8, "wire layout");
_Static_assert(sizeof(struct sg_gaze) == 12, "wire layout");
_Static_assert(sizeof(struct sg_raw) == 32, "wire layout");
_Static_assert(sizeof(struct sg_counts) == 40, "wire layout");
_Static_assert(sizeof(struct sg_model_info) == 36, "wire layout");
_Static_assert(sizeof(struct sg_model_at) == 4, "wire layout");
_Static_assert(sizeof(struct sg_model_data) == 52, "wire layout");
_Static_assert(sizeof(struct sg_model_verdict) == 8, "wire layout");
_Static_assert(sizeof(struct sg_exposure) == 14, "wire layout");
_Static_assert(sizeof(struct sg_settings) == 14, "wire layout");
_Static_assert(sizeof(struct sg_curve) == 8, "wire layout");
_Static_assert(sizeof(struct sg_probe) == 14, "wire layout");
_Static_assert(sizeof(struct sg_recentre) == 10, "wire layout");
_Static_assert(sizeof(struct sg_error) == 2, "wire layout");

#ifdef SG_WIRE_ASSEMBLY
#include "sg_wire_avr.h"
#endif

#endif
