// SPDX-License-Identifier: Apache-2.0
; sg_light_loop.c for AVR with a multiplier, bit-identical to it. Formats there.
;
; The ordinary case of a channel is done here: same exposure as before, settled, on time, not full, light that
; rests or moves in full. Whatever else there is, the C twin does, one channel at a time.

#if defined(__AVR__) && !defined(SG_LIGHT_PORTABLE)

#include "sg_light_table.h"

#define CHANNEL_BYTES 20
#define CHANNEL_SUM 0
#define CHANNEL_EXPOSURE 4
#define CHANNEL_UNIT 6
#define CHANNEL_UNLIT 8
#define CHANNEL_EARLIER 10
#define CHANNEL_MEAN 12
#define CHANNEL_SLOPE 14
#define CHANNEL_SETTLED 16
#define CHANNEL_CYCLES 17
#define CHANNEL_FLAGS 18
#define LIGHT_BEFORE 120         /* those that follow: from there */
#define LIGHT_EARLIER 1
#define LIGHT_MOVING 2
#define LIGHT_WIRING 4
#define LIGHT_STATE 5
#define LIGHT_ZERO 6
#define LIGHT_DITHER 7
#define READING_HELD 48
#define READING_LIT 0
#define READING_UNLIT 12
#define READING_EXPOSURE 24
#define READING_LATE_LIT 36
#define READING_LATE_UNLIT 42
#define PASS_MISSED 0
#define PASS_LIT 2
#define PASS_UNLIT 4
#define PASS_DEPARTURE 6
#define PASS_MORE 8
#define PASS_BYTES 10
#define SETTLED 16
#define MOVING_FROM 1024         /* and MOVING_MOST: of whole 256 */
#define RESTING_BELOW 640
#define MOVING_MOST 4096
#define DEPARTURE_MOST 63
#define GAP_OR_BEGINS 3
#define BEGINS 2
#define MOVES 4
#define MOVES_BIT 2
#define SATURATED 8
#define STARVED 16
#define FULL_HIGH 0x7D          /* of 1000 codes, 1/32 */
#define STEP 112
#define CLIPPED 40
#define LEAP_HIGH 4
#define LEAST_LOW 128           /* of what is not starved */

#define zero r2
#define rail r3                 /* all bits if lit emitters lift it */
#define lightl r4
#define lighth r5
#define readingl r6
#define readingh r7
#define orderl r8
#define orderh r9
#define before_w r10
#define earlier_w r11
#define departl r12
#define departh r13
#define broughtl r14
#define broughth r15
#define dither r10              /* as it rests, in the place of the weights */
#define floor_q5 r11
#define moving r16              /* 0: light rests */
#define turn r17

; high:low = upper half of a:b times c:d, both signed; t is lost. a..d are of r16..r23.
.macro upper_signed high, low, a, b, c, d, t
    muls \a, \c
    movw \low, r0
    mul \b, \d
    mov \t, r1
    mulsu \a, \d
    sbc \high, zero             ; carry is the product's sign
    add \t, r0
    adc \low, r1
    adc \high, zero
    mulsu \c, \b
    sbc \high, zero
    add \t, r0
    adc \low, r1
    adc \high, zero
.endm

; code = 32 code
.macro to_q5 high, low
    ldi r24, 32
    mul \low, r24
    swap \high
    lsl \high
    add \high, r1
    mov \low, r0
.endm

; ---- void sg_light_add(struct sg_light *light r25:r24, const struct sg_reading *reading r23:r22)
; On the stack: struct sg_light_pass, for the twin. No register is saved but r28 and r29 (sg_light_avr.h).
    .section .text.sg_light_add, "ax", @progbits
    .global sg_light_add
    .type sg_light_add, @function
sg_light_add:
    push r28
    push r29
    movw lightl, r24
    movw readingl, r22
    clr zero
    movw r28, r24
    subi r28, lo8(-LIGHT_BEFORE)
    sbci r29, hi8(-LIGHT_BEFORE)
    ldd r20, Y + LIGHT_STATE
    andi r20, GAP_OR_BEGINS
    breq 1f
    call sg_light_prepare
1:  ldd moving, Y + LIGHT_STATE
    andi moving, MOVES
    ld before_w, Y
    ldd earlier_w, Y + LIGHT_EARLIER
    brne 2f
    ldd dither, Y + LIGHT_DITHER
    ldd floor_q5, Y + LIGHT_ZERO
2:  ldd r21, Y + LIGHT_WIRING
    mov rail, r21
    dec rail                    ; all bits for LEDs
    clr departl
    clr departh
    .rept 6
    push zero                   ; unlit_more_q5, departure, unlit_code
    .endr
    movw r30, readingl
    ldd r24, Z + READING_HELD
    ldd r25, Z + READING_HELD + 1
    push r25                    ; lit_code
    push r24
    clt                         ; T: this channel is not ordinary
    movw r22, r24
    or r24, r25
    breq 4f
    set
    .rept 5
    lsl r22
    rol r23
    .endr
4:  push r23                    ; missed_q5: what was held
    push r22
    clr broughtl
    clr broughth
      ldi r24, lo8(sg_light_order)
    ldi r25, hi8(sg_light_order)
    sbrc r21, 0
    adiw r24, 6
    movw orderl, r24
    clr turn

each:
    movw r30, orderl
    lpm r26, Z+
    movw orderl, r30
    ldi r24, CHANNEL_BYTES
    mul r26, r24
    movw r28, r0
    add r28, lightl
    adc r29, lighth
    brtc ordinary
    rjmp other
ordinary:
    movw r30, readingl
    add r30, r26
    adc r31, zero
    ldd r24, Z + READING_LATE_LIT
    ldd r25, Z + READING_LATE_UNLIT
    or r24, r25
    brne 2f
    add r30, r26
    adc r31, zero
    ldd r24, Z + READING_EXPOSURE
    ldd r25, Y + CHANNEL_EXPOSURE
    cp r24, r25
    brne fresh
    ldd r24, Z + READING_EXPOSURE + 1
    ldd r25, Y + CHANNEL_EXPOSURE + 1
    cp r24, r25
    brne fresh
    ldd r24, Y + CHANNEL_CYCLES
    cpse r24, zero
    rjmp 1f
    std Y + CHANNEL_FLAGS, zero
1:
    ldd r18, Z + READING_LIT
    ldd r19, Z + READING_LIT + 1
    ldd r20, Z + READING_UNLIT
    ldd r21, Z + READING_UNLIT + 1
    to_q5 r19, r18
    to_q5 r21, r20
    cpi r19, FULL_HIGH
    brsh full
    cpi r21, FULL_HIGH
    brsh full
known:
    ldd r22, Y + CHANNEL_MEAN
    ldd r23, Y + CHANNEL_MEAN + 1
    movw r24, r20
    sub r24, r22                ; departure from the mean
    sbc r25, r23
    tst moving
    breq 1f
    rjmp moves
1:

    ; light that rests: within 3.5 codes of the mean
    mov r27, r24
    lsl r27
    sbc r27, r27
    cp r27, r25
    brne 2f
    mov r25, r24
    subi r25, 1 - STEP
    cpi r25, 2 * STEP - 1
    brlo 3f
2:  rjmp other

fresh:                          ; another exposure
    ldd r20, Z + READING_UNLIT
    ldd r21, Z + READING_UNLIT + 1
    ldd r22, Z + READING_EXPOSURE
    ldd r23, Z + READING_EXPOSURE + 1
    movw r24, r28
    push r26
    clr r1
    call sg_light_begin
    pop r26
    clt
    rjmp ordinary

full:                           ; and nobody knows what the next of this pair gets from the sample capacitor
    ldd r24, Y + CHANNEL_FLAGS
    ori r24, SATURATED
    std Y + CHANNEL_FLAGS, r24
    in r30, 0x3D
    in r31, 0x3E
    std Z + 1 + PASS_MORE, zero
    std Z + 2 + PASS_MORE, zero
    std Z + 1 + PASS_MISSED, zero
    std Z + 2 + PASS_MISSED, zero
    set
    rjmp known

3:  mov r27, r24
    add r24, dither             ; a sixteenth of it in a byte
    asr r24
    asr r24
    asr r24
    asr r24
    mov r25, r24
    lsl r25
    sbc r25, r25
    add departl, r24
    adc departh, r25
    ldd r26, Y + CHANNEL_SETTLED
    cpi r26, SETTLED
    breq 4f
    inc r26                     ; at first, a quarter
    std Y + CHANNEL_SETTLED, r26
    subi r27, -2
    asr r27
    asr r27
    mov r24, r27
    mov r25, r24
    lsl r25
    sbc r25, r25
4:  add r22, r24
    adc r23, r25
    std Y + CHANNEL_MEAN, r22
    std Y + CHANNEL_MEAN + 1, r23
    cpi r22, CLIPPED
    cpc r23, zero
    brsh meant_near
    ldi r30, lo8(sg_light_clipped_table)
    ldi r31, hi8(sg_light_clipped_table)
    add r30, r22
    adc r31, zero
    lpm r22, Z
    subi r22, 128
    cp r22, floor_q5
    brge 4f
    mov r22, floor_q5
4:  mov r23, r22
    lsl r23
    sbc r23, r23
meant_near:
    rjmp meant

moves:
    ldd r22, Y + CHANNEL_UNLIT
    ldd r23, Y + CHANNEL_UNLIT + 1
    sub r22, r20                ; before - now
    sbc r23, r21
    movw r30, r22
    sbrs r31, 7
    rjmp 4f
    com r31
    neg r30
    sbci r31, -1
4:  cpi r31, LEAP_HIGH
    brlo 5f
    movw r0, r20                ; a leap? The twin asks exactly, half of the larger code is asked here
    tst r23
    brmi 4f
    add r0, r22
    adc r1, r23
4:  lsr r1
    ror r0
    cp r30, r0
    cpc r31, r1
    brlo 5f
    rjmp other
5:  movw r30, r24
    adiw r24, 8
    .rept 4
    asr r25
    ror r24
    .endr
    add departl, r24
    adc departh, r25
    ldd r26, Y + CHANNEL_SETTLED
    cpi r26, SETTLED
    breq 4f
    inc r26
    std Y + CHANNEL_SETTLED, r26
    movw r24, r30
    adiw r24, 2
    asr r25
    ror r24
    asr r25
    ror r24
4:
    ldd r30, Y + CHANNEL_MEAN
    ldd r31, Y + CHANNEL_MEAN + 1
    add r30, r24
    adc r31, r25
    std Y + CHANNEL_MEAN, r30
    std Y + CHANNEL_MEAN + 1, r31
    ldd r30, Y + CHANNEL_EARLIER
    ldd r31, Y + CHANNEL_EARLIER + 1
    sub r30, r20                ; earlier - now
    sbc r31, r21
    movw r24, r22
    add r24, r20
    adc r25, r21
    std Y + CHANNEL_EARLIER, r24
    std Y + CHANNEL_EARLIER + 1, r25
    std Y + CHANNEL_UNLIT, r20
    std Y + CHANNEL_UNLIT + 1, r21
    movw r26, r20
    mov r20, before_w
    mulsu r23, r20              ; Q0.8
    movw r24, r0
    mul r22, r20
    add r24, r1
    adc r25, zero
    movw r22, r30
    mov r20, earlier_w
    mulsu r23, r20
    sub r24, r0
    sbc r25, r1
    mul r22, r20
    sub r24, r1
    sbc r25, zero
    movw r22, r26
    add r22, r24
    adc r23, r25
    brvs 6f
    brpl meant
    clr r22
    clr r23
    rjmp meant
6:  ldi r22, 0xFF               ; beyond 15 bits
    ldi r23, 0x7F

meant:                          ; r19:r18 lit, r23:r22 unlit as meant
    mov r27, r19                ; less what the rail does
    lsr r27
    mov r26, r19
    swap r26
    cbr r26, 0xF0
    add r27, r26
    and r27, rail
    sub r18, r27
    sbc r19, zero
    movw r24, r18
    add r24, r22                ; their sum, unsigned
    adc r25, r23
    sub r18, r22                ; their difference, signed
    sbc r19, r23
    ldi r20, SG_LIGHT_CUBIC
    mul r25, r20
    ldd r20, Y + CHANNEL_SLOPE
    ldd r21, Y + CHANNEL_SLOPE + 1
    add r20, r0
    adc r21, r1
    movw r22, r24
    mulsu r21, r23              ; slope times sum: signed by unsigned
    movw r24, r0
    mul r20, r22
    mov r26, r1
    mulsu r21, r22
    sbc r25, zero
    add r26, r0
    adc r24, r1
    adc r25, zero
    mul r20, r23
    add r26, r0
    adc r24, r1
    adc r25, zero
    muls r19, r19
    .rept SG_LIGHT_SQUARE_SHIFT
    lsl r1
    .endr
    add r24, r1
    adc r25, zero
    movw r20, r24
    upper_signed r25, r24, r19, r18, r21, r20, r26
    sbrs turn, 0
    rjmp 7f
    movw r22, broughtl          ; the second of a pair: less what the sample capacitor brought
    ldi r20, lo8(SHARE_Q16)
    ldi r21, hi8(SHARE_Q16)
    upper_signed r31, r30, r23, r22, r21, r20, r26
    sub r24, r30
    sbc r25, r31
7:  brtc 1f
    in r30, 0x3D                ; what a late release missed, or the capacitor held
    in r31, 0x3E
    ldd r20, Z + 1 + PASS_MISSED
    ldd r21, Z + 2 + PASS_MISSED
    add r24, r20
    adc r25, r21
1:  movw broughtl, r18          ; for the next, with what the rail did
    add broughtl, r27
    adc broughth, zero
    clr r20                     ; the signal, 32 bits
    add r18, r24
    adc r19, r25
    brge 8f
    com r20
8:  mov r21, r20
    ldd r24, Y + CHANNEL_CYCLES
    tst r24
    breq 9f
    cpi r24, 255
    breq next
    ldd r25, Y + CHANNEL_SUM
    add r18, r25
    ldd r25, Y + CHANNEL_SUM + 1
    adc r19, r25
    ldd r25, Y + CHANNEL_SUM + 2
    adc r20, r25
    ldd r25, Y + CHANNEL_SUM + 3
    adc r21, r25
9:  std Y + CHANNEL_SUM, r18
    std Y + CHANNEL_SUM + 1, r19
    std Y + CHANNEL_SUM + 2, r20
    std Y + CHANNEL_SUM + 3, r21
    inc r24
    std Y + CHANNEL_CYCLES, r24

next:
    sbrs turn, 0
    rjmp 1f
    clr broughtl
    clr broughth
    clt
1:  inc turn
    cpi turn, 6
    breq 2f
    rjmp each
2:  .rept PASS_BYTES
    pop r0
    .endr
    movw r28, lightl
    subi r28, lo8(-LIGHT_BEFORE)
    sbci r29, hi8(-LIGHT_BEFORE)
    movw r24, departl           ; six channels depart together, noise does not
    sbrs r25, 7
    rjmp 3f
    com r25
    neg r24
    sbci r25, -1
3:  tst r25
    brne 4f
    cpi r24, DEPARTURE_MOST
    brlo 5f
4:  ldi r24, DEPARTURE_MOST
5:  mul r24, r24
    ldd r24, Y + LIGHT_MOVING
    ldd r25, Y + LIGHT_MOVING + 1
    movw r22, r24
    movw r20, r24
    .rept 4
    lsr r21
    ror r20
    .endr
    sub r24, r20
    sbc r25, r21
    add r24, r0
    adc r25, r1
    cpi r25, hi8(MOVING_MOST)
    brlo 6f
    ldi r24, lo8(MOVING_MOST)
    ldi r25, hi8(MOVING_MOST)
6:  std Y + LIGHT_MOVING, r24
    std Y + LIGHT_MOVING + 1, r25
    ldd r20, Y + LIGHT_DITHER
    subi r20, -7
    andi r20, 15
    std Y + LIGHT_DITHER, r20
    ldd r20, Y + LIGHT_STATE
    ldi r21, hi8(RESTING_BELOW)
    cpi r24, lo8(RESTING_BELOW)
    cpc r25, r21
    brsh 8f
    andi r20, 0xFF - MOVES
    rjmp 9f
8:  cpi r25, hi8(MOVING_FROM)
    brlo 7f
    sbrc r20, MOVES_BIT
    rjmp 7f
    ori r20, MOVES + BEGINS
9:  std Y + LIGHT_STATE, r20
7:  clr r1
    pop r29
    pop r28
    ret

other:                          ; r26: the channel, untouched so far
    mov r20, r26
    in r30, 0x3D
    in r31, 0x3E
    adiw r30, 1
    movw r18, r30
    std Z + PASS_DEPARTURE, departl
    std Z + PASS_DEPARTURE + 1, departh
    tst turn
    breq 3f                     ; the pass holds what came before the first
    clr r22
    clr r23
    movw r30, r18
    std Z + PASS_MISSED, r22
    std Z + PASS_MISSED + 1, r22
    brts 1f                     ; the first of this pair went the same way: its word stands
    std Z + PASS_MORE, r22
    std Z + PASS_MORE + 1, r22
1:  movw r24, r22
    sbrs turn, 0
    rjmp 2f
    movw r30, orderl            ; the first of this pair
    sbiw r30, 2
    lpm r22, Z
    movw r30, readingl
    lsl r22
    add r30, r22
    adc r31, zero
    ldd r22, Z + READING_LIT
    ldd r23, Z + READING_LIT + 1
    ldd r24, Z + READING_UNLIT
    ldd r25, Z + READING_UNLIT + 1
2:  movw r30, r18
    std Z + PASS_LIT, r22
    std Z + PASS_LIT + 1, r23
    std Z + PASS_UNLIT, r24
    std Z + PASS_UNLIT + 1, r25
3:  push r20
    movw r24, lightl
    movw r22, readingl
    clr r1
    call sg_light_meant
    pop r26
    in r30, 0x3D
    in r31, 0x3E
    ldd departl, Z + 1 + PASS_DEPARTURE
    ldd departh, Z + 2 + PASS_DEPARTURE
    movw r22, r24
    movw r30, readingl
    lsl r26
    add r30, r26
    adc r31, zero
    ldd r18, Z + READING_LIT
    ldd r19, Z + READING_LIT + 1
    to_q5 r19, r18
    set                         ; the second of the pair asks what the first held
    rjmp meant
    .size sg_light_add, . - sg_light_add

; ---- uint8_t sg_light_features(struct sg_light *light r25:r24, uint16_t *feature r23:r22)
    .section .text.sg_light_features, "ax", @progbits
    .global sg_light_features
    .type sg_light_features, @function
sg_light_features:
    push r14
    push r15
    push r16
    push r17
    push r28
    push r29
    movw r28, r24
    movw r14, r22
    clr r16                     ; flags
    ldi r17, 6
1:  ldd r25, Y + CHANNEL_CYCLES
    cpse r25, r1
    rjmp 6f
    rjmp 8f
6:
    cpi r25, 1
    brne 2f
    ldd r18, Y + CHANNEL_SUM
    ldd r19, Y + CHANNEL_SUM + 1
    ldd r20, Y + CHANNEL_SUM + 2
    ldd r21, Y + CHANNEL_SUM + 3
    or r20, r21
    brne 6f
    ldi r20, 15
    tst r19
    brmi 5f
    brne 4f
    cpi r18, LEAST_LOW
    brsh 3f
    rjmp 9f
6:  sbrs r21, 7                 ; beyond 16 bits, or negative
    rjmp 2f
9:  ldd r25, Y + CHANNEL_FLAGS
    ori r25, STARVED
    std Y + CHANNEL_FLAGS, r25
    ldi r18, LEAST_LOW
    rjmp 3f
2:  movw r24, r28               ; several cycles, or beyond 16 bits
    call sg_light_feature
    rjmp 7f
3:  mov r19, r18
    clr r18
    ldi r20, 7
    tst r19
    brmi 5f
4:  dec r20
    lsl r18
    rol r19
    brpl 4b
5:  mov r22, r19                ; fraction: bits 8..1
    lsr r22
    ror r18
    andi r19, 0x7E
    ldi r30, lo8(sg_light_log2_table)
    ldi r31, hi8(sg_light_log2_table)
    add r30, r19
    adc r31, r1
    lpm r24, Z+
    lpm r25, Z+
    lpm r22, Z
    sub r22, r24
    mul r22, r18
    sbrc r0, 7
    inc r1
    mov r22, r1
    clr r1
    add r24, r22
    adc r25, r1
    swap r20
    add r25, r20
    ldd r18, Y + CHANNEL_UNIT
    ldd r19, Y + CHANNEL_UNIT + 1
    add r24, r18
    adc r25, r19
    sbc r20, r20                ; carry and sign of the unit agree, or the sum is beyond 16 bits
    lsl r19
    sbc r19, r19
    cp r20, r19
    breq 7f
    mov r24, r20
    mov r25, r20
7:  movw r30, r14
    st Z, r24
    std Z + 1, r25
    std Y + CHANNEL_CYCLES, r1
8:  ldd r25, Y + CHANNEL_FLAGS
    or r16, r25
    ldi r24, 2
    add r14, r24
    adc r15, r1
    adiw r28, CHANNEL_BYTES
    dec r17
    breq 9f
    rjmp 1b
9:  mov r24, r16
    pop r29
    pop r28
    pop r17
    pop r16
    pop r15
    pop r14
    ret
    .size sg_light_features, . - sg_light_features

#endif
