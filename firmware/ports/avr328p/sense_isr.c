// SPDX-License-Identifier: Apache-2.0
// The sensing interrupt: serves the events of a plan one after the other (port_sense.h).
//
// In assembler for its cycles: some 25 events in 15984 of them. Where the list stands is kept in OCR0A and OCR0B,
// which one instruction reads or writes; nothing else uses Timer0. An event that is due when the one before ends
// is served at once; else OCR1A brings the interrupt. r26 and r27 hold an event's word, Z the list, then others.
#include "port_sense.h"

#include <stddef.h>

enum { WAIT_LEAST = 4 };

#define CALL_C(function, arguments)                                                                         \
    "push r0" "\n\t" "push r1" "\n\t" "push r18" "\n\t" "push r19" "\n\t"                                       \
    "push r20" "\n\t" "push r21" "\n\t" "push r22" "\n\t" "push r23" "\n\t" "clr r1" "\n\t"                     \
    arguments "call " function "\n\t"                                                                         \
    "pop r23" "\n\t" "pop r22" "\n\t" "pop r21" "\n\t" "pop r20" "\n\t"                                         \
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
          [all] "M"(PORTC_ALL), [dark] "M"(PORTD_DARK), [flags] "I"(_SFR_IO_ADDR(TIFR1)), [matched] "I"(OCF1B),
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
        "cpi r25, %[cycles] + 1" "\n\t"
        "brsh sense_due" "\n"
        "sense_exit:" "\t"
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
        "cpi r25, 0xFF" "\n\t"
        "breq 2f" "\n\t"
        "rjmp sense_missed" "\n"               // 256 cycles ago and more
        "2:" "\t"
        "ldi r24, 1 << %[due]" "\n\t"
        "out %[flags], r24" "\n\t"
        "rjmp sense_next" "\n\t"
        : : [keep] "M"((EVENT_STORE | EVENT_COMPLETE) >> 8), [out] "i"(&sense_out), [adc] "i"(_SFR_MEM_ADDR(ADCL)),
          [trigger] "i"(_SFR_MEM_ADDR(OCR1BL)), [slot] "i"(&sense_slot), [matched] "I"(OCF1B), [due] "I"(OCF1A),
          [flags] "I"(_SFR_IO_ADDR(TIFR1)), [match] "i"(_SFR_MEM_ADDR(OCR1AL)), [cycles] "M"(EVENT_CYCLES >> 8),
          [now] "i"(_SFR_MEM_ADDR(TCNT1L)), [end] "M"(2 * HAL_SECTION_SENSE + 2),
          [mark] "I"(_SFR_IO_ADDR(GPIOR0)));
    __asm__ volatile(
        "sense_release:" "\t"
        "sbrs r27, 6" "\n\t"
        "rjmp 1f" "\n\t"
        "ld r24, Z+" "\n\t"
        "out %[portc], r24" "\n\t"
        "ldi r24, %[all]" "\n\t"
        "out %[ddrc], r24" "\n\t"
        "ld r24, Z+" "\n\t"
        "out %[portd], r24" "\n\t"
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
        "out %[ddrc], r24" "\n\t"
        "rjmp sense_then" "\n"
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
        "push r26" "\n\t"
        "push r27" "\n\t"
        CALL_C("%x[late]", "com r24" "\n\t" "and r24, r31" "\n\t" "mov r22, r25" "\n\t" "mov r20, r27" "\n\t")
        "pop r27" "\n\t"
        "pop r26" "\n\t"
        "rjmp sense_then" "\n\t"
        : : [portc] "I"(_SFR_IO_ADDR(PORTC)), [ddrc] "I"(_SFR_IO_ADDR(DDRC)), [portd] "I"(_SFR_IO_ADDR(PORTD)),
          [all] "M"(PORTC_ALL), [lead] "M"(RELEASE_LEAD_CYCLES), [list_low] "I"(_SFR_IO_ADDR(OCR0A)),
          [list_high] "I"(_SFR_IO_ADDR(OCR0B)), [now] "i"(_SFR_MEM_ADDR(TCNT1L)),
          [match] "i"(_SFR_MEM_ADDR(OCR1AL)), [fixed] "M"(RELEASE_FIXED_CYCLES), [least] "M"(WAIT_LEAST), [late] "i"(sense_late));
    __asm__ volatile(
        "sense_complete:" "\t"                  // Z behind the last code, r24 and r25 free
        "push r28" "\n\t"
        "lds r24, %[trigger]" "\n\t"
        "lds r25, %[trigger]+1" "\n\t"
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
        : : [trigger] "i"(_SFR_MEM_ADDR(OCR1BL)), [base] "i"(&sense_base), [wraps] "i"(&sense_wraps),
          [current] "i"(&sense_current), [list_low] "I"(_SFR_IO_ADDR(OCR0A)), [list_high] "I"(_SFR_IO_ADDR(OCR0B)),
          [plan] "i"(sense_plan), [plan_bytes] "i"(sizeof(struct plan)), [drop] "i"(&sense_drop));
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
        "pop r28" "\n\t"
        "rjmp sense_arm" "\n"
        "sense_dropped:" "\t"
        "ldi r24, 0" "\n\t"
        "sts %[drop], r24" "\n\t"
        "sbiw r30, %[back]" "\n\t"
        "sts %[out], r30" "\n\t"
        "sts %[out]+1, r31" "\n\t"
        "pop r28" "\n\t"
        "rjmp sense_arm" "\n\t"
        : : [seq] "i"(&sense_seq), [left] "i"(&sense_left), [last] "i"(&sense_last), [pause] "i"(&sense_pause),
          [gap] "i"(sense_gap), [list_next] "i"(&sense_list_next), [out] "i"(&sense_out), [done] "i"(&sense_done),
          [moment] "I"(_SFR_IO_ADDR(GPIOR1)), [drop] "i"(&sense_drop),
          [back] "M"(offsetof(struct taken, wraps)));
    __asm__ volatile(
        "sense_special:" "\t"
        "sbrc r27, 4" "\n\t"
        "rjmp sense_pausing" "\n\t"
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
        CALL_C("%x[give_up]", "")
        "rjmp sense_list" "\n"
        "sense_pausing:" "\t"
        CALL_C("%x[wait]", "") "\n"
        "sense_list:" "\t"
        "out %[list_low], r24" "\n\t"
        "out %[list_high], r25" "\n\t"
        "rjmp sense_exit" "\n\t"
        : : [list_next] "i"(&sense_list_next), [moment] "I"(_SFR_IO_ADDR(GPIOR1)),
          [portc] "I"(_SFR_IO_ADDR(PORTC)), [portd] "I"(_SFR_IO_ADDR(PORTD)), [dark] "M"(PORTD_DARK),
          [ddrc] "I"(_SFR_IO_ADDR(DDRC)), [all] "M"(PORTC_ALL), [give_up] "i"(sense_give_up),
          [wait] "i"(sense_wait), [list_low] "I"(_SFR_IO_ADDR(OCR0A)), [list_high] "I"(_SFR_IO_ADDR(OCR0B)));
}
