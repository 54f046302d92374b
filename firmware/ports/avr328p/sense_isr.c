// SPDX-License-Identifier: Apache-2.0
// The sensing interrupt: serves the events of a plan one after the other (port_sense.h).
//
// In assembler for its cycles: some 25 events in 15984 of them. Where the list stands is kept in OCR0A and
// OCR0B, whether it runs lit in GPIOR2 (0xFF; 0: unlit): one instruction reads or writes these, and nothing
// else uses Timer0. An event that is due when the one before ends is served at once; else OCR1A brings the
// interrupt. r26 and r27 hold an event's word, Z the list, then others.
#include "port_sense.h"
#include "port_serial.h"

#include <stddef.h>

enum { WAIT_LEAST = 4, SOON_CYCLES = 48 };

#define CALL_C(function)                                                                                \
    "push r0" "\n\t" "push r1" "\n\t" "push r18" "\n\t" "push r19" "\n\t"                               \
    "push r20" "\n\t" "push r21" "\n\t" "push r22" "\n\t" "push r23" "\n\t"                             \
    "clr r1" "\n\t" "call " function "\n\t"                                                             \
    "pop r23" "\n\t" "pop r22" "\n\t" "pop r21" "\n\t" "pop r20" "\n\t"                                 \
    "pop r19" "\n\t" "pop r18" "\n\t" "pop r1" "\n\t" "pop r0" "\n\t"

ISR(TIMER1_COMPA_vect, ISR_NAKED)
{
    __asm__ volatile(
        "push r30" "\n\t"
        "in r30, __SREG__" "\n\t"
        "push r30" "\n\t"
        "push r31" "\n\t"
        "push r24" "\n\t"
        "push r25" "\n\t"
        "push r26" "\n\t"
        "push r27" "\n\t"
        "ldi r24, %[begin]" "\n\t"
        "out %[mark], r24" "\n"
        "sense_next:" "\t"
        "in r30, %[list_low]" "\n\t"
        "in r31, %[list_high]" "\n"
        "sense_event:" "\t"
        "ld r26, Z+" "\n\t"
        "ld r27, Z+" "\n\t"
        "sbrc r27, 7" "\n\t"
        "rjmp sense_release" "\n\t"
        "sbrc r27, 6" "\n\t"
        "rjmp sense_special" "\n\t"
        "sbrc r27, 5" "\n\t"
        "sbrs r27, 4" "\n\t"
        "rjmp sense_service" "\n\t"
        // Lights out, all nodes held.
        "ldi r24, 0" "\n\t"
        "out %[portc], r24" "\n\t"
        "ldi r24, %[all]" "\n\t"
        "out %[ddrc], r24" "\n\t"
        "ldi r24, %[dark]" "\n\t"
        "out %[portd], r24" "\n"
        "sense_service:" "\t"
        "sbis %[flags], %[matched]" "\n\t"      // no trigger since the last service: this one came too late
        "rjmp sense_missed" "\n\t"
        "ld r24, Z+" "\n\t"
        "sts %[admux], r24" "\n\t"
        "out %[list_low], r30" "\n\t"
        "out %[list_high], r31" "\n\t"
        : : [begin] "M"(2 * HAL_SECTION_SENSE + 1), [mark] "I"(_SFR_IO_ADDR(GPIOR0)),
          [list_low] "I"(_SFR_IO_ADDR(OCR0A)), [list_high] "I"(_SFR_IO_ADDR(OCR0B)),
          [portc] "I"(_SFR_IO_ADDR(PORTC)), [ddrc] "I"(_SFR_IO_ADDR(DDRC)), [portd] "I"(_SFR_IO_ADDR(PORTD)),
          [all] "M"(PORTC_ALL), [dark] "M"(PORTD_DARK), [flags] "I"(_SFR_IO_ADDR(TIFR1)),
          [matched] "I"(OCF1B),
          [admux] "i"(_SFR_MEM_ADDR(ADMUX)));
    __asm__ volatile(
        "mov r24, r27" "\n\t"
        "andi r24, %[keep]" "\n\t"
        "breq sense_arm" "\n\t"
        "lds r30, %[out]" "\n\t"
        "lds r31, %[out]+1" "\n\t"
        "lds r24, %[adc]" "\n\t"
        "lds r25, %[adc]+1" "\n\t"
        "st Z+, r24" "\n\t"
        "st Z+, r25" "\n\t"
        "sbrc r27, 5" "\n\t"
        "sbrc r27, 4" "\n\t"
        "rjmp 1f" "\n\t"
        "in r24, %[lit]" "\n\t"
        "sbrc r24, 0" "\n\t"
        "rjmp sense_complete" "\n"
        "1:" "\t" "sts %[out], r30" "\n\t"
        "sts %[out]+1, r31" "\n"
        "sense_arm:" "\t"
        "lds r24, %[trigger]" "\n\t"
        "lds r25, %[trigger]+1" "\n\t"
        "lds r30, %[slot]" "\n\t"
        "lds r31, %[slot]+1" "\n\t"
        "add r24, r30" "\n\t"
        "adc r25, r31" "\n\t"
        "sts %[trigger]+1, r25" "\n\t"
        "sts %[trigger], r24" "\n\t"
        "ldi r24, 1 << %[matched]" "\n\t"       // the trigger is an edge of this flag: it must be down
        "out %[flags], r24" "\n"
        "sense_then:" "\t"
        "lds r24, %[match]" "\n\t"
        "lds r25, %[match]+1" "\n\t"
        "andi r27, %[cycles]" "\n\t"
        "add r24, r26" "\n\t"
        "adc r25, r27" "\n\t"
        "sts %[match]+1, r25" "\n\t"
        "sts %[match], r24" "\n\t"
        "lds r26, %[now]" "\n\t"
        "lds r27, %[now]+1" "\n\t"
        "sub r24, r26" "\n\t"
        "sbc r25, r27" "\n\t"
        "cpi r25, 0" "\n\t"
        "brne 3f" "\n\t"
        "cpi r24, %[soon]" "\n\t"
        "brlo sense_soon" "\n\t"
        "rjmp sense_leave" "\n"                // the line can wait
        "3:" "\t"
        "cpi r25, %[cycles] + 1" "\n\t"
        "brsh sense_due" "\n"
        "sense_exit:" "\t"
        "lds r24, %[state]" "\n\t"
        "sbrc r24, %[came]" "\n\t"
        "rjmp sense_receive" "\n\t"
        "sbrs r24, %[room]" "\n\t"
        "rjmp 5f" "\n\t"
        "lds r30, %[tail]" "\n\t"
        "lds r24, %[head]" "\n\t"
        "cp r30, r24" "\n\t"
        "breq 5f" "\n\t"
        "lds r24, %[control]" "\n\t"
        "sbrc r24, %[itself]" "\n\t"           // it has its own interrupt
        "rjmp 5f" "\n\t"
        "mov r24, r30" "\n\t"
        "ldi r31, 0" "\n\t"
        "subi r30, lo8(-(%[ring]))" "\n\t"
        "sbci r31, hi8(-(%[ring]))" "\n\t"
        "ld r25, Z" "\n\t"
        "sts %[data], r25" "\n\t"
        "inc r24" "\n\t"
        "cpi r24, %[size]" "\n\t"
        "brne 4f" "\n\t"
        "ldi r24, 0" "\n"
        "4:" "\t" "sts %[tail], r24" "\n\t"
        "rjmp sense_exit" "\n"
        "5:" "\n"
        "sense_leave:" "\t"
        "ldi r24, %[end]" "\n\t"
        "out %[mark], r24" "\n\t"
        "pop r27" "\n\t"
        "pop r26" "\n\t"
        "pop r25" "\n\t"
        "pop r24" "\n\t"
        "pop r31" "\n\t"
        "pop r30" "\n\t"
        "out __SREG__, r30" "\n\t"
        "pop r30" "\n\t"
        "reti" "\n"
        "sense_due:" "\t"
        "inc r25" "\n\t"
        "breq 6f" "\n\t"
        "rjmp sense_missed" "\n"               // 256 cycles ago and more
        "sense_soon:" "\t"                      // too soon to return first
        "sbis %[flags], %[due]" "\n\t"
        "rjmp sense_soon" "\n"
        "6:" "\t"
        "ldi r24, 1 << %[due]" "\n\t"
        "out %[flags], r24" "\n\t"
        "lds r24, %[state]" "\n\t"
        "sbrs r24, %[came]" "\n\t"
        "rjmp sense_next" "\n\t"
        "rjmp sense_receive_next" "\n\t"
        : : [lit] "I"(_SFR_IO_ADDR(GPIOR2)), [soon] "M"(SOON_CYCLES),
          [keep] "M"(EVENT_STORE | EVENT_COMPLETE), [out] "i"(&sense_out), [adc] "i"(_SFR_MEM_ADDR(ADCL)),
          [trigger] "i"(_SFR_MEM_ADDR(OCR1BL)), [slot] "i"(&sense_slot), [matched] "I"(OCF1B),
          [due] "I"(OCF1A),
          [flags] "I"(_SFR_IO_ADDR(TIFR1)), [match] "i"(_SFR_MEM_ADDR(OCR1AL)), [cycles] "M"(EVENT_CYCLES),
          [now] "i"(_SFR_MEM_ADDR(TCNT1L)), [tail] "i"(&tx_tail), [head] "i"(&tx_head), [ring] "i"(tx_ring),
          [size] "M"(TX_RING), [state] "i"(_SFR_MEM_ADDR(UCSR0A)), [control] "i"(_SFR_MEM_ADDR(UCSR0B)),
          [itself] "I"(UDRIE0), [room] "I"(UDRE0), [came] "I"(RXC0),
          [data] "i"(_SFR_MEM_ADDR(UDR0)), [end] "M"(2 * HAL_SECTION_SENSE + 2),
          [mark] "I"(_SFR_IO_ADDR(GPIOR0)));
    __asm__ volatile(
        "sense_release:" "\t"
        "sbrs r27, 6" "\n\t"
        "rjmp 1f" "\n\t"
        "ld r24, Z+" "\n\t"
        "in r25, %[lit]" "\n\t"
        "and r24, r25" "\n\t"
        "out %[portc], r24" "\n\t"
        "ldi r24, %[all]" "\n\t"
        "out %[ddrc], r24" "\n\t"
        "ld r24, Z+" "\n\t"
        "and r24, r25" "\n\t"
        "ori r24, %[dark]" "\n\t"
        "out %[portd], r24" "\n"
        "sense_wait_lit:" "\t"
        "lds r24, %[state]" "\n\t"
        "sbrc r24, %[came]" "\n\t"
        "rjmp sense_receive_first" "\n\t"
        "ld r25, Z+" "\n\t"
        "rjmp 2f" "\n"
        "1:" "\t" "ldi r25, %[lead]" "\n"
        "2:" "\t" "ld r24, Z+" "\n\t"
        "out %[list_low], r30" "\n\t"
        "out %[list_high], r31" "\n\t"
        "push r28" "\n\t"
        "lds r30, %[now]" "\n\t"                // r31:r30 = cycles since the match
        "lds r31, %[now]+1" "\n\t"
        "lds r28, %[match]" "\n\t"
        "sub r30, r28" "\n\t"
        "lds r28, %[match]+1" "\n\t"
        "sbc r31, r28" "\n\t"
        "pop r28" "\n\t"
        "cpi r31, 0" "\n\t"
        "brne sense_far" "\n\t"
        "sub r25, r30" "\n\t"
        "brlo sense_near" "\n\t"
        "subi r25, %[fixed]" "\n\t"
        "brlo sense_nearer" "\n\t"
        "cpi r25, %[least]" "\n\t"
        "brlo sense_nearest" "\n\t"
        "sbrc r25, 0" "\n\t"                    // bits 0 and 1 of what is left, then turns of four cycles
        "rjmp .+0" "\n\t"
        "sbrc r25, 1" "\n\t"
        "rjmp .+0" "\n\t"
        "sbrc r25, 1" "\n\t"
        "rjmp .+0" "\n\t"
        "lsr r25" "\n\t"
        "lsr r25" "\n"
        "3:" "\t" "nop" "\n\t"
        "dec r25" "\n\t"
        "brne 3b" "\n\t"
        "out %[ddrc], r24" "\n"
        "sense_released:" "\t"
        "mov r24, r27" "\n\t"
        "andi r24, %[alone]" "\n\t"
        "cpi r24, %[alone]" "\n\t"
        "breq 5f" "\n\t"
        "in r30, %[list_low]" "\n\t"
        "in r31, %[list_high]" "\n\t"
        "rjmp sense_service" "\n"
        "5:" "\t" "rjmp sense_then" "\n"
        // Too late to wait: at once, and by how much goes into the reading.
        "sense_near:" "\t" "subi r25, %[fixed]" "\n\t"
        "nop" "\n"
        "sense_nearer:" "\t" "rjmp .+0" "\n"
        "sense_nearest:" "\t"
        "rjmp .+0" "\n\t"                      // never before its time
        "rjmp .+0" "\n\t"
        "rjmp .+0" "\n\t"
        "rjmp .+0" "\n\t"
        "rjmp .+0" "\n\t"
        "in r31, %[ddrc]" "\n\t"
        "out %[ddrc], r24" "\n\t"
        "neg r25" "\n\t"
        "subi r25, -(%[least] + 1)" "\n\t"
        "rjmp 4f" "\n"
        "sense_far:" "\t"
        "in r31, %[ddrc]" "\n\t"
        "out %[ddrc], r24" "\n\t"
        "ldi r25, 255" "\n"
        "4:" "\t"
        "push r28" "\n\t"
        "com r24" "\n\t"                       // what was let go just now
        "and r24, r31" "\n\t"
        "lds r28, %[turn]" "\n\t"
        "ldi r30, lo8(%[log])" "\n\t"
        "ldi r31, hi8(%[log])" "\n\t"
        "add r30, r28" "\n\t"
        "brcc 5f" "\n\t"
        "inc r31" "\n"
        "5:" "\t"
        "ldi r28, 1" "\n\t"
        "std Z+%[any], r28" "\n\t"
        "in r28, %[lit]" "\n\t"
        "sbrs r28, 0" "\n\t"
        "rjmp 7f" "\n"
        "5:" "\t" "lsr r24" "\n\t"
        "brcc 6f" "\n\t"
        "st Z, r25" "\n"
        "6:" "\t" "adiw r30, 1" "\n\t"
        "cpi r24, 0" "\n\t"
        "brne 5b" "\n\t"
        "pop r28" "\n\t"
        "rjmp sense_released" "\n"
        "7:" "\t" "adiw r30, %[channels]" "\n\t"
        "rjmp 5b" "\n\t"
        : : [portc] "I"(_SFR_IO_ADDR(PORTC)), [ddrc] "I"(_SFR_IO_ADDR(DDRC)),
          [portd] "I"(_SFR_IO_ADDR(PORTD)),
          [all] "M"(PORTC_ALL), [lit] "I"(_SFR_IO_ADDR(GPIOR2)), [dark] "M"(PORTD_DARK),
          [lead] "M"(RELEASE_LEAD_CYCLES - LEAD_LESS_CYCLES), [list_low] "I"(_SFR_IO_ADDR(OCR0A)),
          [list_high] "I"(_SFR_IO_ADDR(OCR0B)), [now] "i"(_SFR_MEM_ADDR(TCNT1L)),
          [match] "i"(_SFR_MEM_ADDR(OCR1AL)), [fixed] "M"(RELEASE_FIXED_CYCLES - LEAD_LESS_CYCLES),
          [least] "M"(WAIT_LEAST), [log] "i"(sense_late), [turn] "i"(&sense_turn),
          [any] "I"(offsetof(struct late, any)), [channels] "I"(HAL_CHANNELS),
          [state] "i"(_SFR_MEM_ADDR(UCSR0A)), [came] "I"(RXC0), [alone] "M"(EVENT_ALONE));
    __asm__ volatile(
        "sense_complete:" "\t"                  // Z behind the last code, r24 and r25 free
        "push r28" "\n\t"
        "push r29" "\n\t"
        "lds r24, %[trigger]" "\n\t"
        "lds r25, %[trigger]+1" "\n\t"
        "lds r28, %[slot]" "\n\t"              // armed first: this takes long
        "lds r29, %[slot]+1" "\n\t"
        "add r28, r24" "\n\t"
        "adc r29, r25" "\n\t"
        "sts %[trigger]+1, r29" "\n\t"
        "sts %[trigger], r28" "\n\t"
        "ldi r28, 1 << %[matched]" "\n\t"
        "out %[flags], r28" "\n\t"
        "st Z+, r24" "\n\t"
        "st Z+, r25" "\n\t"
        "lds r28, %[base]" "\n\t"
        "cp r24, r28" "\n\t"
        "lds r28, %[base]+1" "\n\t"
        "cpc r25, r28" "\n\t"
        "sts %[base], r24" "\n\t"
        "sts %[base]+1, r25" "\n\t"
        "lds r28, %[wraps]" "\n\t"
        "brsh 1f" "\n\t"
        "lds r24, %[wraps]+1" "\n\t"
        "lds r25, %[wraps]+2" "\n\t"
        "subi r28, -1" "\n\t"
        "sbci r24, -1" "\n\t"
        "sbci r25, -1" "\n\t"
        "sts %[wraps], r28" "\n\t"
        "sts %[wraps]+1, r24" "\n\t"
        "sts %[wraps]+2, r25" "\n\t"
        "lds r24, %[wraps]+3" "\n\t"
        "sbci r24, -1" "\n\t"
        "sts %[wraps]+3, r24" "\n"
        "1:" "\t"
        "lds r25, %[current]" "\n\t"
        "in r24, %[list_low]" "\n\t"           // which plan is this?
        "subi r24, lo8(%[plan]+%[plan_bytes])" "\n\t"
        "in r24, %[list_high]" "\n\t"
        "sbci r24, hi8(%[plan]+%[plan_bytes])" "\n\t"
        "sbc r24, r24" "\n\t"
        "inc r24" "\n\t"
        "sts %[current], r24" "\n\t"
        "lds r24, %[drop]" "\n\t"
        "cpi r24, 0" "\n\t"
        "brne sense_dropped" "\n\t"
        "st Z+, r28" "\n\t"                    // wraps
        "st Z+, r25" "\n\t"                    // plan
        "lds r24, %[turn]" "\n\t"
        "st Z+, r24" "\n\t"
        : : [trigger] "i"(_SFR_MEM_ADDR(OCR1BL)), [slot] "i"(&sense_slot), [matched] "I"(OCF1B),
          [flags] "I"(_SFR_IO_ADDR(TIFR1)), [base] "i"(&sense_base), [wraps] "i"(&sense_wraps),
          [current] "i"(&sense_current), [list_low] "I"(_SFR_IO_ADDR(OCR0A)),
          [list_high] "I"(_SFR_IO_ADDR(OCR0B)),
          [plan] "i"(sense_plan), [plan_bytes] "i"(sizeof(struct plan)), [drop] "i"(&sense_drop),
          [turn] "i"(&sense_turn));
    __asm__ volatile(
        "lds r24, %[seq]" "\n\t"
        "lds r25, %[seq]+1" "\n\t"
        "lds r28, %[left]" "\n\t"
        "st Z+, r28" "\n\t"
        "st Z+, r24" "\n\t"
        "st Z+, r25" "\n\t"
        "subi r28, 1" "\n\t"
        "brsh 1f" "\n\t"
        "adiw r24, 1" "\n\t"                   // the running cycle is the first of the next frame
        "sts %[seq], r24" "\n\t"
        "sts %[seq]+1, r25" "\n\t"
        "lds r28, %[last]" "\n"
        "1:" "\t" "sts %[left], r28" "\n\t"
        "cpi r28, 0" "\n\t"
        "brne 2f" "\n\t"
        "lds r24, %[pause]" "\n\t"
        "cpi r24, 0" "\n\t"
        "breq 2f" "\n\t"
        "ldi r24, lo8(%[gap])" "\n\t"
        "ldi r25, hi8(%[gap])" "\n\t"
        "sts %[list_next], r24" "\n\t"
        "sts %[list_next]+1, r25" "\n"
        "2:" "\t"
        "ld r24, Z+" "\n\t"                    // the other one
        "ld r25, Z" "\n\t"
        "sts %[out], r24" "\n\t"
        "sts %[out]+1, r25" "\n\t"
        "lds r24, %[done]" "\n\t"
        "inc r24" "\n\t"
        "sts %[done], r24" "\n\t"
        "ldi r24, 2" "\n\t"
        "out %[moment], r24" "\n\t"
        "lds r31, %[first]+1" "\n\t"
        "cpi r31, 0" "\n\t"                   // RAM begins at 0x100
        "breq 3f" "\n\t"
        "lds r30, %[first]" "\n\t"
        "ldi r24, 0" "\n\t"
        "sts %[first]+1, r24" "\n\t"
        "ldi r24, %[ground]" "\n\t"
        "st Z, r24" "\n"
        "3:" "\t"
        "rjmp 4f" "\n"
        "sense_dropped:" "\t"
        "lds r24, %[turns]" "\n\t"
        "inc r24" "\n\t"
        "sts %[turns], r24" "\n\t"
        "ldi r24, 0" "\n\t"
        "sts %[drop], r24" "\n\t"
        "sbiw r30, %[back]" "\n\t"
        "sts %[out], r30" "\n\t"
        "sts %[out]+1, r31" "\n"
        "4:" "\t"
        "pop r29" "\n\t"
        "pop r28" "\n\t"
        "rjmp sense_then" "\n\t"
        : : [seq] "i"(&sense_seq), [left] "i"(&sense_left), [last] "i"(&sense_last),
          [pause] "i"(&sense_pause),
          [gap] "i"(sense_gap), [list_next] "i"(&sense_list_next), [out] "i"(&sense_out),
          [done] "i"(&sense_done),
          [moment] "I"(_SFR_IO_ADDR(GPIOR1)), [first] "i"(&sense_first), [ground] "M"(ADMUX_GROUND),
          [drop] "i"(&sense_drop), [turns] "i"(&sense_pauses),
          [back] "M"(offsetof(struct taken, wraps)));
    __asm__ volatile(
        "sense_special:" "\t"
        "sbrc r27, 5" "\n\t"
        "rjmp sense_pausing" "\n\t"
        "in r24, %[lit]" "\n\t"
        "com r24" "\n\t"
        "out %[lit], r24" "\n\t"
        "breq 1f" "\n\t"
        "sbrc r27, 4" "\n\t"
        "rjmp 2f" "\n\t"
        "adiw r30, 1" "\n\t"
        "rjmp sense_event" "\n"
        "1:" "\t" "ld r24, Z" "\n\t"
        "sub r30, r24" "\n\t"
        "sbci r31, 0" "\n\t"
        "rjmp sense_event" "\n"
        "2:" "\t"
        "ldi r24, %[turns]" "\n\t"
        "lds r25, %[turn]" "\n\t"
        "sub r24, r25" "\n\t"
        "sts %[turn], r24" "\n\t"
        "lds r30, %[list_next]" "\n\t"
        "lds r31, %[list_next]+1" "\n\t"
        "ldi r24, 1" "\n\t"
        "out %[moment], r24" "\n\t"
        "rjmp sense_event" "\n"
        "sense_missed:" "\t"
        "ldi r24, 0" "\n\t"
        "out %[portc], r24" "\n\t"
        "ldi r24, %[dark]" "\n\t"
        "out %[portd], r24" "\n\t"
        "ldi r24, %[all]" "\n\t"
        "out %[ddrc], r24" "\n\t"
        CALL_C("%x[give_up]")
        "rjmp sense_list" "\n"
        "sense_pausing:" "\t"
        CALL_C("%x[wait]") "\n"
        "sense_list:" "\t"
        "out %[list_low], r24" "\n\t"
        "out %[list_high], r25" "\n\t"
        "rjmp sense_exit" "\n\t"
        : : [list_next] "i"(&sense_list_next), [moment] "I"(_SFR_IO_ADDR(GPIOR1)),
          [portc] "I"(_SFR_IO_ADDR(PORTC)), [portd] "I"(_SFR_IO_ADDR(PORTD)), [dark] "M"(PORTD_DARK),
          [ddrc] "I"(_SFR_IO_ADDR(DDRC)), [all] "M"(PORTC_ALL), [give_up] "i"(sense_give_up),
          [wait] "i"(sense_wait), [turn] "i"(&sense_turn), [turns] "M"(sizeof(struct late)),
          [lit] "I"(_SFR_IO_ADDR(GPIOR2)), [list_low] "I"(_SFR_IO_ADDR(OCR0A)),
          [list_high] "I"(_SFR_IO_ADDR(OCR0B)));
    // The receiver holds no more than comes while a release is waited for.
    __asm__ volatile("sense_receive_first:" "\t"
                     "push r30" "\n\t"
                     "push r31" "\n\t"
                     "rcall sense_byte" "\n\t"
                     "pop r31" "\n\t"
                     "pop r30" "\n\t"
                     "rjmp sense_wait_lit" "\n"
                     "sense_receive_next:" "\t"
                     "rcall sense_byte" "\n\t"
                     "rjmp sense_next" "\n"
                     "sense_receive:" "\t"
                     "rcall sense_byte" "\n\t"
                     "rjmp sense_exit" "\n"
                     "sense_byte:" "\t");
    serial_receive();
    __asm__ volatile("ret" "\n\t");
}
