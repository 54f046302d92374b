// SPDX-License-Identifier: Apache-2.0
// The port contract: everything the application asks of a board, and everything a board tells the
// application.
//
// A port is one directory of firmware/ports with hal_port.h (sizes and markers) and the down-calls below. It
// owns the chip: timers, ADC, LEDs, serial line, watchdog, non-volatile memory. It never calls anything but
// the up-calls. All calls are made from the main loop; interrupts stay inside the port. No call waits for
// hardware, except hal_boot() and hal_load().
#ifndef HAL_H
#define HAL_H

#include <stdint.h>

#include "hal_port.h"
#include "sg_light.h"
#include "sg_wire.h"

enum { HAL_CHANNELS = SG_WIRE_CHANNELS };

// One sensing cycle, as measured: three pairs of sensors, each lit by the other emitters and then unlit.
struct hal_cycle {
    uint32_t t_us;                      // mean of the six lit mid-exposure times, device time
    uint16_t span_us;                   // from t_us to the last sample of the cycle
    // Low half of the number of frames begun since boot: the frame it belongs to.
    uint16_t seq;
    uint8_t left;                       // cycles of this frame still to come; 0: its last
    struct sg_reading reading;
};

// How to sense. A frame is `repeats` cycles in a row; frames begin every frame_cycles, dark in between.
struct hal_timing {
    uint32_t frame_cycles;              // of hal_describe()'s cpu_hz; 0: cycles without a pause
    uint16_t period_cycles;             // of one sensing cycle
    uint8_t repeats;
    uint8_t wiring;                     // enum sg_wiring
    uint8_t lights;                     // 0: never lit
    uint8_t probe;                      // 0..5: the only emitter, which does not sense then; 255: as wired
    // 1: hal_poll() sleeps until the next interrupt when it has nothing to do.
    uint8_t sleep;
};

// ----------------------------------------------------------------------------------------------------
// Down-calls: the application calls, the port implements.

// Bring the chip up, lights out, interrupts off. First call of all.
void hal_boot(void);

// Fill in the board's part of `hello`: slot_bytes, slot_base, cpu_hz, frame_period_us, exposure_min_us,
// exposure_max_us, page_bytes, board. The rest is left alone.
void hal_describe(struct sg_hello *hello);

// Start sensing, serial line and watchdog, with this timing and these exposures (cycles), both clipped as
// below. After a reset by the watchdog the lights stay off for a second (hal_report's alarm says so).
void hal_start(struct hal_timing *timing, uint16_t exposure_cycles[HAL_CHANNELS]);

// One turn of the main loop: delivers what has arrived through the up-calls, moves slow writes and plans on,
// and feeds the watchdog if, and only if, a new sensing cycle has come since it last did, or a pause between
// frames goes on. Returns 0 when the port has ended.
int hal_poll(void);

// Device time, microseconds since boot; wraps after 2^32.
uint32_t hal_now_us(void);
// Its low half, at less cost.
uint16_t hal_now_us16(void);

// Exposures from a cycle soon on, clipped to the port's limits and to what the timing allows, and moved by a
// few per cent where two releases would collide: `exposure_cycles` is what was taken. Whole: no cycle sees
// half of it.
void hal_expose(uint16_t exposure_cycles[HAL_CHANNELS]);

// Timing from a cycle soon on, clipped to what the port can do: `timing` is what was taken. A frame begins
// with it. Pauses that the port cannot make (some hundred cycles) become longer or shorter cycles. Exposures
// are clipped as by hal_expose().
void hal_set_timing(struct hal_timing *timing);
// Longest exposure of a channel under this timing, cycles.
uint16_t hal_exposure_most(uint8_t channel);

// Encode a packet (sg_wire_encode_ring: n + 8 bytes) into the send queue if at least keep_free bytes of the
// queue stay free after it. n <= SG_WIRE_BODY_MAX. Returns 1, or 0 if not queued. Without a head, NULL, that is
// only asked: 1 if it would be queued.
uint8_t hal_send(const struct sg_head *head, const void *body, uint8_t n, uint8_t keep_free);

// Once everything queued has left: change the line speed, or reset through the watchdog (slow writes are
// finished first). Until then hal_send() refuses.
enum hal_after { HAL_AFTER_BAUD_1M = 0, HAL_AFTER_BAUD_500K = 1, HAL_AFTER_REBOOT = 2 };
void hal_after_sending(uint8_t action);

// Where model slot 0 or 1 begins (in the memory space HAL_SLOT_SPACE of sg_model_open), or NULL: no such
// slot.
const uint8_t *hal_slot(uint8_t slot);

// Live state, kept through power cycles in two copies. hal_load returns 1 and fills `record` with the newest
// whole copy of exactly n bytes, or returns 0; records of different n do not disturb each other. hal_save
// begins a write in the background and returns 1, or 0: ask again. `record` is borrowed until it is written;
// after a change in it call hal_save again before the next hal_poll(), and the write begins afresh. What was
// stored before stays whole meanwhile, and what equals it is not written again. n <= HAL_RECORD_MAX.
uint8_t hal_load(void *record, uint8_t n);
uint8_t hal_save(const void *record, uint8_t n);

// The port's bits of sg_status.alarm, at little cost.
uint8_t hal_alarm(void);

// Fill in the port's part: frames, late_frames (app_on_cycle returned after the next cycle was complete, or
// was never called), late_slots (cycles given up because interrupts were blocked), rx_overrun, stack_free,
// reset_cause, eeprom_writes, supply_mv, cycles_max, and its bits of alarm.
void hal_report(struct sg_status *status);

// ----------------------------------------------------------------------------------------------------
// Up-calls: the port calls, the application implements.

// A sensing cycle is complete. Called at most once per hal_poll(), with the newest; borrowed until the
// next hal_poll().
void app_on_cycle(const struct hal_cycle *cycle);

// One byte arrived; zero_us is when the latest 0x00 arrived.
void app_on_byte(uint8_t byte, uint32_t zero_us);
// Is there time for this byte, and for some more if it is not 0x00? While this is 0 it waits.
uint8_t app_listens(uint8_t byte);

#endif
