// SPDX-License-Identifier: Apache-2.0
// The sensing engine: LED i senses while the other five emit, six slots of 640 us a frame, all in interrupts.
//
//   slot + 0       OCR1A   the other five light; ~5 us later the charged cathode is released, the release
//                          instant is read from TCNT1, and OCR1B is set to release + exposure
//   + exposure     OCR1B   hardware starts the ADC; sample-and-hold closes 132 cycles later. No code involved
//   + 1 cycle      OCR1A   lights out: its interrupt came earlier and waited. The next LED's cathode is driven
//                          high, the ADC goes free-running
//   + 46 us        ADC     first code; three more follow every 52 us, of the same charge: the cathode floats on
//   + 202 us       ADC     fourth code: their sum is the reading, noise of the ADC and of its reference halved;
//                          a throw-away conversion of the next channel charges the sample capacitor to Vcc
//                          through that channel's cathode
// An interrupt that comes late moves the release and, with it, the sample: never the exposure. Where other
// light than ours goes on discharging the cathode between the codes, or ours went out late, the first code
// alone counts.
//
// The charge is always done before the next light. In cycles of a slot of 10240, at the longest exposure and
// with bytes back to back both ways:
//     145   to the light: its interrupt waits for another to end (none comes before it), then its entry
//      80   settling
//    4864   the exposure
//    3232   to the end of the fourth code: 11.5 ADC clocks of 64, then 3 * 13. Free-running: no code involved
//     605   its interrupt waits: it comes after the UART's two, which take 120 of every 160 cycles then
//      95   its entry
//     896   up to 64 until the ADC's prescaler turns, 13 ADC clocks
//    9917   in all: 323 (20 us) to spare
#include "port.h"
#include "port_serial.h"

enum {
    LED_FIRST_ANODE = 2,            // anodes on PD2..PD7, cathodes on PC0..PC5
    PORTD_DARK = 1 << PD0,          // pull-up on the UART's input
    DDRD_ALL = 0xFC,
    DDRC_ALL = 0x3F,
    READS = 4,
    // TCNT1 = OCR1B to the closing of sample-and-hold: the flag rises one cycle after the match, three cycles
    // go into synchronisation (datasheet, ADC auto triggering), then two ADC clocks of 64 cycles.
    SAMPLE_CYCLES = 1 + 3 + 2 * 64,
    // Release (the OUT to PORTC) to the TCNT1 value that the LDS after it returns.
    RELEASE_READ_CYCLES = 1,
    EXPOSURE_FIXED_CYCLES = SAMPLE_CYCLES + RELEASE_READ_CYCLES,
    // Lights-out against TCNT1 = OCR1B, and how much earlier its interrupt is asked for: 75 for another that
    // may be running, 80 until it looks at the timer, and the shortest wait.
    DARK_CYCLES = SAMPLE_CYCLES + 1,
    DARK_AHEAD_CYCLES = 176,
    DARK_FIXED_CYCLES = 10,         // from the look at the timer to the end of OUT, without the waiting
    DARK_WAIT_LEAST = 20,           // to the look
    // Fall of the code from the first to the last, mean of 16 frames, 1/16 LSB: above, or no longer above,
    // what leakage does. Room light on a nominal LED is 10 codes.
    OTHER_LIGHT_Q4 = 5 * 16,
    NO_OTHER_LIGHT_Q4 = 4 * 16,
    SETTLE_CYCLES = 5 * CYCLES_PER_US - 50,     // 50: from the light to the release without the delay
    LATE_CYCLES = 40 * CYCLES_PER_US,
    SOON_CYCLES = 64,               // a compare value nearer than this may be missed
    WAIT_CYCLES = 60 * CYCLES_PER_US,
    ADC_ON = (1 << ADEN) | (1 << ADPS2) | (1 << ADPS1),         // 250 kHz
    ADC_ARMED = ADC_ON | (1 << ADATE) | (1 << ADIE) | (1 << ADIF),
    // ADSC does nothing while a conversion runs; it starts the one that did not because lights_out() came
    // after the first code.
    ADC_AGAIN = ADC_ON | (1 << ADATE) | (1 << ADIE) | (1 << ADSC),
    ADC_LAST = ADC_ON | (1 << ADIE) | (1 << ADSC),
    ADC_PRECHARGE = ADC_ON | (1 << ADSC),
    ADMUX_AVCC = 1 << REFS0,
    START_BY_COMPARE_B = (1 << ADTS2) | (1 << ADTS0),           // ADCSRB
    START_BY_ITSELF = 0,
};
_Static_assert(EXPOSURE_MIN_CYCLES > EXPOSURE_FIXED_CYCLES + SOON_CYCLES, "the trigger must lie ahead");
_Static_assert((5 + 6) * CYCLES_PER_US + EXPOSURE_MAX_CYCLES < SLOT_CYCLES / 2, "lit at most half");

struct slot {
    uint16_t release;               // TCNT1
    uint16_t exposure_cycles;
    uint16_t code_q2;
};

struct raw_frame {
    struct slot slot[HAL_CHANNELS];
    uint32_t overflows;             // of TCNT1, at the first release
    uint16_t seq;
};

static struct raw_frame buffer[2];
static struct slot *filling;                    // slot of the frame being sensed
static uint8_t filling_buffer;
static volatile uint8_t ready;                  // 1 + index of a complete frame; 0: none
static uint8_t led;                             // sensing now
static uint8_t exposing;                        // between release and sample
static uint8_t reads;                           // codes in the sum so far
static uint16_t first_code;
static uint16_t fall_q4[HAL_CHANNELS];          // first code to last, mean
static uint8_t first_only;                      // bits of LEDs that other light falls on
static uint8_t dark_late;                       // the lights were on beyond the sample
static uint16_t dark;                           // TCNT1 at which they go out
static uint8_t charging;                        // all codes are read, the next channel's charge has begun
static uint16_t slot_start;                     // TCNT1 at which the slot's light goes on
static uint16_t trigger_cycles[HAL_CHANNELS];   // release to OCR1B
static volatile uint32_t overflows;
static volatile uint32_t frames;
static volatile uint16_t late_frames;
static volatile uint16_t late_slots;

static const uint8_t led_bit[HAL_CHANNELS] = { 1, 2, 4, 8, 16, 32 };

ISR(TIMER1_OVF_vect)
{
    overflows++;
}

// Call with interrupts off. The overflow that came after interrupts went off is pending, not counted.
static uint32_t overflows_at(uint16_t ticks)
{
    return overflows + ((TIFR1 & (1 << TOV1)) && ticks < 0x8000U);
}

static inline __attribute__((always_inline)) void light_and_release(void)
{
    const uint8_t bit = led_bit[led];
    PORTD = PORTD_DARK | (uint8_t)(DDRD_ALL & ~(bit << LED_FIRST_ANODE));

    const uint16_t now = TCNT1;
    if ((uint16_t)(now - slot_start) > LATE_CYCLES)
        late_slots++;
    TIFR1 = 1 << OCF1B;             // the trigger is an edge of this flag: it must be down
    ADCSRB = START_BY_COMPARE_B;
    ADCSRA = ADC_ARMED;
    const uint16_t trigger = trigger_cycles[led];
    const uint8_t ddrc = DDRC_ALL & ~bit;
    if (UCSR0A & (1 << RXC0))
        serial_receive();               // this interrupt takes as long as two bytes
    else
        __builtin_avr_delay_cycles(SETTLE_CYCLES);

    // The pull-up is on for the one cycle between the two: the node is at Vcc anyway.
    uint16_t release;
    __asm__ volatile("out %[ddr], %[mask]" "\n\t"
                     "out %[port], __zero_reg__" "\n\t"
                     "lds %A[ticks], %[low]" "\n\t"
                     "lds %B[ticks], %[high]"
                     : [ticks] "=&r"(release)
                     : [ddr] "I"(_SFR_IO_ADDR(DDRC)), [port] "I"(_SFR_IO_ADDR(PORTC)), [mask] "r"(ddrc),
                       [low] "i"(_SFR_MEM_ADDR(TCNT1L)), [high] "i"(_SFR_MEM_ADDR(TCNT1H)));
    const uint16_t match = release + trigger;
    OCR1B = match;
    dark = match + DARK_CYCLES;
    OCR1A = match + (DARK_CYCLES - DARK_AHEAD_CYCLES);
    exposing = 1;
    charging = 0;
    reads = 0;

    filling->release = release;
    filling->code_q2 = 0;
    filling->exposure_cycles = trigger + EXPOSURE_FIXED_CYCLES;
    if (led == 0) {
        GPIOR1 = 1;
        buffer[filling_buffer].overflows = overflows_at(release);
    }
}

// The next slot that many cycles after this one; at once if that has passed, because a compare value in the
// past would wait for the timer's next turn.
static inline __attribute__((always_inline)) void next_slot_after(uint16_t cycles)
{
    uint16_t start = slot_start + cycles;
    const uint16_t soonest = TCNT1 + SOON_CYCLES;
    if ((int16_t)(start - soonest) < 0) {
        start = soonest;
        late_slots++;
    }
    slot_start = start;
    OCR1A = start;
}

// Waits for the cycle: bits 0 and 1 of what is left, then turns of four cycles.
static inline __attribute__((always_inline)) void lights_out_at(uint16_t cycle)
{
    const uint16_t left = cycle - TCNT1;
    uint8_t wait = (uint8_t)cycle - DARK_FIXED_CYCLES;
    uint8_t now;
    dark_late = left < DARK_FIXED_CYCLES + DARK_WAIT_LEAST || left > DARK_AHEAD_CYCLES;
    if (dark_late) {
        PORTD = PORTD_DARK;
        return;
    }
    __asm__ volatile("lds %[now], %[low]" "\n\t"
                     "sub %[wait], %[now]" "\n\t"
                     "sbrc %[wait], 0" "\n\t"
                     "rjmp .+0" "\n\t"
                     "sbrc %[wait], 1" "\n\t"
                     "rjmp .+0" "\n\t"
                     "sbrc %[wait], 1" "\n\t"
                     "rjmp .+0" "\n\t"
                     "lsr %[wait]" "\n\t"
                     "lsr %[wait]" "\n\t"
                     "1: nop" "\n\t"
                     "dec %[wait]" "\n\t"
                     "brne 1b" "\n\t"
                     "out %[port], %[off]"
                     : [wait] "+r"(wait), [now] "=&r"(now)
                     : [low] "i"(_SFR_MEM_ADDR(TCNT1L)), [port] "I"(_SFR_IO_ADDR(PORTD)),
                       [off] "r"((uint8_t)PORTD_DARK));
}

static inline __attribute__((always_inline)) void lights_out(void)
{
    lights_out_at(dark);
    ADCSRB = START_BY_ITSELF;       // once the conversion under way has ended
    PORTC = led == HAL_CHANNELS - 1 ? 1 : (uint8_t)(led_bit[led] << 1);
    exposing = 0;

    next_slot_after(SLOT_CYCLES);
}

ISR(TIMER1_COMPA_vect)
{
    HAL_BEGIN(HAL_SECTION_SENSE);
    if (exposing) {
        lights_out();
    } else if (!charging || (ADCSRA & (1 << ADSC))) {
        // Only when interrupts were late by 20 us: the codes are not read, or the sample capacitor not charged
        // yet.
        late_slots++;
        next_slot_after(WAIT_CYCLES);
    } else {
        light_and_release();
    }
    HAL_END(HAL_SECTION_SENSE);
}

ISR(ADC_vect)
{
    HAL_BEGIN(HAL_SECTION_SENSE);
    const uint16_t code = ADC;
    filling->code_q2 += code;
    if (reads++ == 0)
        first_code = code;
    if (reads < READS) {
        ADCSRA = reads < READS - 1 ? ADC_AGAIN : ADC_LAST;
        HAL_END(HAL_SECTION_SENSE);
        return;
    }
    DDRC = DDRC_ALL;                // floats no longer
    ADMUX = led == HAL_CHANNELS - 1 ? ADMUX_AVCC : ADMUX_AVCC + 1 + led;
    ADCSRA = ADC_PRECHARGE;
    charging = 1;

    const uint8_t bit = led_bit[led];
    uint16_t fall = fall_q4[led];
    fall -= fall >> 4;
    if (code < first_code)
        fall += first_code - code;
    fall_q4[led] = fall;
    if (fall > OTHER_LIGHT_Q4)
        first_only |= bit;
    else if (fall < NO_OTHER_LIGHT_Q4)
        first_only &= (uint8_t)~bit;
    if (dark_late || (first_only & bit))
        filling->code_q2 = 4 * first_code;
    filling++;
    if (++led == HAL_CHANNELS) {
        GPIOR1 = 2;
        led = 0;
        buffer[filling_buffer].seq = (uint16_t)frames++;
        if (ready)
            late_frames++;      // the one that waited was never taken
        ready = 1 + filling_buffer;
        filling_buffer = !filling_buffer;
        filling = buffer[filling_buffer].slot;
    }
    HAL_END(HAL_SECTION_SENSE);
}

void hal_expose(const uint16_t exposure_cycles[HAL_CHANNELS])
{
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        uint16_t cycles = exposure_cycles[i];
        if (cycles < EXPOSURE_MIN_CYCLES)
            cycles = EXPOSURE_MIN_CYCLES;
        if (cycles > EXPOSURE_MAX_CYCLES)
            cycles = EXPOSURE_MAX_CYCLES;
        cycles -= EXPOSURE_FIXED_CYCLES;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
            trigger_cycles[i] = cycles;
        }
    }
}

void sense_start(const uint16_t exposure_cycles[HAL_CHANNELS])
{
    hal_expose(exposure_cycles);
    PORTD = PORTD_DARK;
    DDRD = DDRD_ALL;
    DDRC = DDRC_ALL;
    PORTC = led_bit[0];
    DIDR0 = DDRC_ALL;               // the cathodes are analog

    filling = buffer[0].slot;
    ADMUX = ADMUX_AVCC;
    ADCSRB = START_BY_ITSELF;
    ADCSRA = ADC_PRECHARGE;
    charging = 1;

    TCCR1A = 0;
    TCCR1B = 0;
    TCNT1 = 0;
    slot_start = SLOT_CYCLES;       // the first conversion takes 25 ADC clocks, 100 us
    OCR1A = SLOT_CYCLES;
    TIFR1 = (1 << TOV1) | (1 << OCF1A) | (1 << OCF1B);
    TIMSK1 = (1 << OCIE1A) | (1 << TOIE1);
    TCCR1B = 1 << CS10;
}

uint32_t hal_now_us(void)
{
    uint32_t high;
    uint16_t ticks;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        ticks = TCNT1;
        high = overflows_at(ticks);
    }
    return (high << 12) | (ticks >> 4);
}

uint8_t sense_take(struct hal_frame *frame)
{
    uint8_t which;
    uint16_t last = 0;
    uint32_t sum_cycles = 0;

    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        which = ready;
        ready = 0;
    }
    if (!which)
        return 0;
    HAL_BEGIN(HAL_SECTION_FRAME);
    // Read without a lock: should the other buffer become complete meanwhile, the engine comes back to this
    // one with the next release, 90 us later at the earliest.
    const struct raw_frame *raw = &buffer[which - 1];
    const uint16_t first = raw->slot[0].release;
    for (uint8_t i = 0; i < HAL_CHANNELS; i++) {
        const uint16_t exposure_cycles = raw->slot[i].exposure_cycles;
        frame->code_q2[i] = raw->slot[i].code_q2;
        frame->exposure_cycles[i] = exposure_cycles;
        last = raw->slot[i].release - first;
        sum_cycles += last + (exposure_cycles >> 1);
    }
    last += frame->exposure_cycles[HAL_CHANNELS - 1];
    frame->seq = raw->seq;
    // sum / 6, as (sum / 2) * 21846 / 2^16: at most two cycles too much for frames below 4096 us, and 32 bits
    // hold it.
    const uint16_t mean = (uint16_t)(((sum_cycles >> 1) * 21846UL) >> 16);
    const uint32_t first_us = (raw->overflows << 12) | (first >> 4);
    frame->t_us = first_us + ((mean + (first & 15U) + 8U) >> 4);
    frame->span_us = (uint16_t)(last - mean + 8U) >> 4;
    return 1;
}

void sense_taken(void)
{
    ATOMIC_BLOCK(ATOMIC_FORCEON) {
        late_frames += ready != 0;
    }
    HAL_END(HAL_SECTION_FRAME);
}

void sense_report(struct sg_status *status)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        status->frames = frames;
        status->late_slots = late_slots;
        status->late_frames = late_frames;
    }
}
