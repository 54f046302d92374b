// SPDX-License-Identifier: Apache-2.0
; sg_gp_loop.c for AVR with a multiplier, bit-identical to it. Formats in sg_gp_loop.h.
;
; Nothing here takes a time that depends on data. No register is saved but r28 and r29 (sg_gp_avr.h).
; SG_GP_FLASH_ONLY leaves out what reads models from ordinary memory, for a build that never has one there.

#if defined(__AVR__) && !defined(SG_GP_PORTABLE)

#define SUM_S2 8
#define SUM_S 12
#define SUM_S8 24
#define EXP_WORDS 384
#define EXP_LAST 710

; body, for the memory that bit 0 of a register says (SG_ROM_FLASH)
.macro by_space space, body
#ifdef SG_GP_FLASH_ONLY
    \body lpm
#else
    sbrs \space, 0
    rjmp 98f
    \body lpm
    rjmp 99f
98:
    \body ld
99:
#endif
.endm

; ---- void sg_gp_loop(struct sg_gp_sum *sum r25:r24, const uint8_t *record r23:r22, uint8_t n r20,
;                      uint8_t space r18)
; All of it lives in registers; Z walks the records, X keeps Z while the table is read.
#define s0l r2
#define s0h r3
#define s1l r4
#define s1h r5
#define s2l r6
#define s2h r7
#define s3l r8
#define s3h r9
#define s4l r10
#define s4h r11
#define s5l r12
#define s5h r13
#define square0 r14             /* S2, 20.4 */
#define square1 r15
#define t1 r16                  /* T, 20.4, bytes 1 and 2; then k Q0.16 */
#define t2 r17
#define t0 r18                  /* T, byte 0; then fraction Q0.8; then a byte of a weight */
#define az0 r19
#define az1 r20
#define az2 r21
#define el0 r22
#define el1 r23
#define el2 r24
#define square2 r25
#define c r26                   /* XL: a centre's coordinate, while X is not in use */
#define zero r28
#define left r29

; T -= c * s for the next centre of the record: u8 * u8.4
.macro channel load, low, high
    \load c, Z+
    mul \low, c
    sub t0, r0
    sbc t1, r1
    sbc t2, zero
    mul \high, c
    sub t1, r0
    sbc t2, r1
.endm

; acc += weight * k: s16 * u16 without the product of the low bytes, into 24 bits modulo 2^24
.macro weigh load, a0, a1, a2
    \load t0, Z+
    mul t0, t2
    add \a0, r0
    adc \a1, r1
    adc \a2, zero
    \load t0, Z+
    mulsu t0, t1
    sbc \a2, zero               ; carry is the product's sign
    add \a0, r0
    adc \a1, r1
    adc \a2, zero
    mulsu t0, t2
    add \a1, r0
    adc \a2, r1
.endm

.macro loop load
1:
    mov t0, square0
    \load t1, Z+
    add t1, square1
    \load t2, Z+
    adc t2, square2
    channel \load, s0l, s0h
    channel \load, s1l, s1h
    channel \load, s2l, s2h
    channel \load, s3l, s3h
    channel \load, s4l, s4h
    channel \load, s5l, s5h

    cpi t2, EXP_WORDS >> 6
    brsh 5f
    movw r26, r30
    movw r30, t1
    lsr r31
    ror r30
    andi r30, 0xFE              ; 2 * (T >> 10)
    subi r30, lo8(-(sg_gp_exp_table))
    sbci r31, hi8(-(sg_gp_exp_table))
    lsr t1
    ror t0
    lsr t1
    ror t0                      ; fraction (T >> 2) & 255
    lpm t1, Z+                  ; level Q0.16
    lpm t2, Z
    fmul t2, t0                 ; (level >> 8) * fraction >> 6: bit 9 in the carry
    brcc 4f                     ; as long as the instruction it jumps over
    subi t2, 2
4:
    lsl r0
    rol r1                      ; bit 8 in the carry, the rest in r1
    sbc t2, zero
    sub t1, r1
    sbc t2, zero
2:
    movw r30, r26
    weigh \load, az0, az1, az2
    weigh \load, el0, el1, el2
    dec left
    breq 3f
    rjmp 1b
5:                              ; a level of one byte, which does not fall: as long as above
    movw r26, r30
    ldi r30, lo8(EXP_LAST << 2)
    ldi r31, hi8(EXP_LAST << 2)
    cp t1, r30
    cpc t2, r31
    brsh 6f                     ; as long as the instruction it jumps over
    movw r30, t1
6:
    lsr r31
    ror r30
    lsr r31
    ror r30                     ; T >> 10
    subi r30, lo8(-(sg_gp_exp_tail - EXP_WORDS))
    sbci r31, hi8(-(sg_gp_exp_tail - EXP_WORDS))
    lpm t1, Z
    ldi t2, 0
    lpm r0, Z                   ; time
    lpm r0, Z
    rjmp 2b
3:
.endm

    .section .text.sg_gp_loop, "ax", @progbits
    .global sg_gp_loop
    .type sg_gp_loop, @function
sg_gp_loop:
    push r28
    push r29
    push r24                    ; sum
    push r25
    movw r30, r22
    movw r28, r24
    mov r0, r20
    mov r1, r18
    ldd s0l, Y+SUM_S
    ldd s0h, Y+SUM_S+1
    ldd s1l, Y+SUM_S+2
    ldd s1h, Y+SUM_S+3
    ldd s2l, Y+SUM_S+4
    ldd s2h, Y+SUM_S+5
    ldd s3l, Y+SUM_S+6
    ldd s3h, Y+SUM_S+7
    ldd s4l, Y+SUM_S+8
    ldd s4h, Y+SUM_S+9
    ldd s5l, Y+SUM_S+10
    ldd s5h, Y+SUM_S+11
    ldd square0, Y+SUM_S2
    ldd square1, Y+SUM_S2+1
    ldd square2, Y+SUM_S2+2
    ldd az0, Y+0
    ldd az1, Y+1
    ldd az2, Y+2
    ldd el0, Y+4
    ldd el1, Y+5
    ldd el2, Y+6
    mov left, r0
    ldi zero, 0
    by_space r1, loop
    pop r29
    pop r28
    std Y+0, az0
    std Y+1, az1
    std Y+2, az2
    std Y+4, el0
    std Y+5, el1
    std Y+6, el2
    clr r1
    pop r29
    pop r28
    ret
    .size sg_gp_loop, . - sg_gp_loop

; ---- The other loops: X walks s, Z the coefficients
#undef c
#undef zero
#define low r18
#define high r19
#define factor r20
#define count r21
#define acc0 r22
#define acc1 r23
#define acc2 r24
#define acc3 r25

; uint8_t sg_gp_scale(struct sg_gp_sum *sum r25:r24, const uint16_t feature[6] r23:r22,
;                     const uint8_t *offset r21:r20, uint8_t space r18)
; X walks the features, Y s, Z the offsets; the gains lie 12 bytes further.
#define square0_ r12
#define square1_ r13
#define square2_ r14
#define square3_ r15
#define out r16
#define zero r17
#define gain0 r20
#define gain1 r21
#define mask r22
#define p1 r23                  /* bytes 1 to 3 of the product */
#define p2 r24
#define p3 r25
#define channels_left r11
#define whole r2                /* where the next s >> 4 goes: r3:r2 */
#define features r4             /* X meanwhile */

.macro scale load
1:
    ld low, X+
    ld high, X+
    \load gain0, Z+
    \load gain1, Z+
    sub low, gain0
    sbc high, gain1
    sbc mask, mask              ; all ones below the offset
    or out, mask
    com mask
    and low, mask
    and high, mask
    adiw r30, 10
    \load gain0, Z+
    \load gain1, Z+
    sbiw r30, 12
    mul high, gain1
    movw p2, r0
    mul low, gain0
    mov p1, r1
    mul low, gain1
    add p1, r0
    adc p2, r1
    adc p3, zero
    mul high, gain0
    add p1, r0
    adc p2, r1
    adc p3, zero
    cp zero, p3
    sbc mask, mask              ; all ones from 2^24 on
    or out, mask
    or p1, mask
    or p2, mask
    movw features, r26          ; s >> 4
    movw r26, whole
    st X+, p2
    movw whole, r26
    movw r26, features
    swap p1                     ; p2:p1 >> 4
    swap p2
    andi p1, 0x0F
    eor p1, p2
    andi p2, 0x0F
    eor p1, p2
    st Y+, p1
    st Y+, p2
    mul p1, p1
    add square0_, r0
    adc square1_, r1
    adc square2_, zero
    adc square3_, zero
    mul p1, p2                  ; twice, below 2^13
    lsl r0
    rol r1
    add square1_, r0
    adc square2_, r1
    adc square3_, zero
    mul p2, p2                  ; one byte
    add square2_, r0
    adc square3_, zero
    dec channels_left
    brne 1b
.endm

    .section .text.sg_gp_scale, "ax", @progbits
    .global sg_gp_scale
    .type sg_gp_scale, @function
sg_gp_scale:
    push r28
    push r29
    bst r18, 0                  ; T: SG_ROM_FLASH
    movw r26, r22
    movw r28, r24
    adiw r28, SUM_S
    adiw r24, SUM_S8
    movw whole, r24
    movw r30, r20
    clr zero
    clr out
    ldi mask, 6
    mov channels_left, mask
    ldi mask, 31
    mov square0_, mask
    clr square1_
    clr square2_
    clr square3_
#ifndef SG_GP_FLASH_ONLY
    brts 2f
    scale ld
    rjmp 3f
2:
#endif
    scale lpm
3:
    ldi mask, 3                 ; >> 5 is << 3 and the upper three bytes
4:
    lsl square0_
    rol square1_
    rol square2_
    rol square3_
    dec mask
    brne 4b
    sbiw r28, SUM_S8 - SUM_S2   ; Y is behind s
    st Y, square1_
    std Y+1, square2_
    std Y+2, square3_
    std Y+3, zero
    mov r24, out
    andi r24, 4                 ; SG_GP_OUT_OF_RANGE
    clr r1
    pop r29
    pop r28
    ret
    .size sg_gp_scale, . - sg_gp_scale
#undef zero

; void sg_gp_trend(struct sg_gp_sum *sum r25:r24, const uint8_t *bias r23:r22, uint8_t space r20)
; Elevation's bias waits in its accumulator while azimuth is done.
#define zero r17
; acc = acc + trend * s for one channel: s16 * u12
.macro slope load
    ld low, X+
    ld high, X+
    \load factor, Z+
    mul low, factor
    add acc0, r0
    adc acc1, r1
    adc acc2, zero
    adc acc3, zero
    mul high, factor
    add acc1, r0
    adc acc2, r1
    adc acc3, zero
    \load factor, Z+
    mulsu factor, low
    sbc acc3, zero              ; carry is the product's sign
    add acc1, r0
    adc acc2, r1
    adc acc3, zero
    mulsu factor, high
    add acc2, r0
    adc acc3, r1
.endm

.macro output load, at
    movw r26, r28
    adiw r26, SUM_S
    ldi count, 6
2:
    slope \load
    dec count
    brne 2b
    ldi count, 4                ; >> 4 is << 4 and the upper three bytes
1:
    lsl acc0
    rol acc1
    rol acc2
    rol acc3
    dec count
    brne 1b
    std Y+\at, acc1
    std Y+\at+1, acc2
    std Y+\at+2, acc3
.endm

.macro outputs load
    \load acc0, Z+
    \load acc1, Z+
    \load acc2, Z+
    \load acc3, Z+
    \load r0, Z+
    \load r1, Z+
    std Y+4, r0
    std Y+5, r1
    \load r0, Z+
    \load r1, Z+
    std Y+6, r0
    std Y+7, r1
    output \load, 0
    ldd acc0, Y+4
    ldd acc1, Y+5
    ldd acc2, Y+6
    ldd acc3, Y+7
    output \load, 4
.endm

    .section .text.sg_gp_trend, "ax", @progbits
    .global sg_gp_trend
    .type sg_gp_trend, @function
sg_gp_trend:
    push r28
    push r29
    clr zero
    movw r28, r24
    movw r30, r22
    by_space r20, outputs
    pop r29
    pop r28
    clr r1
    ret
    .size sg_gp_trend, . - sg_gp_trend

; uint8_t sg_gp_round(const struct sg_gp_sum *sum r25:r24, uint8_t weight_frac_bits r22, int16_t deg_q7[2] r21:r20)
#undef zero
#undef mask
#undef out
#define bits r22
#define shifts r23
#define mask r24
#define out r25
    .section .text.sg_gp_round, "ax", @progbits
    .global sg_gp_round
    .type sg_gp_round, @function
sg_gp_round:
    movw r26, r20
    movw r30, r24
    clr out
    ldi r18, 2                  ; azimuth, elevation
    mov r1, r18
3:
    ld r18, Z
    ldd r19, Z+1
    ldd r20, Z+2
    adiw r30, 4
    mov r21, r20                ; sign
    lsl r21
    sbc r21, r21
    mov shifts, bits
1:
    cpi shifts, 9               ; Q.(bits + 8) to Q.17
    brsh 2f
    lsl r18
    rol r19
    rol r20
    rol r21
    inc shifts
    rjmp 1b
2:
    subi r19, -2                ; (r21:r20:r19 + 2) >> 2
    sbci r20, -1
    sbci r21, -1
    asr r21
    ror r20
    ror r19
    asr r21
    ror r20
    ror r19
    mov mask, r20               ; does the sign of 16 bits tell all of it?
    lsl mask
    sbc mask, mask
    eor mask, r21
    neg mask
    sbc mask, mask              ; all ones if not
    or out, mask
    lsl r21                     ; then 0x7FFF, or 0x8000 when negative
    sbc r21, r21
    com r21
    ldi r18, 0x80
    eor r18, r21
    eor r21, r19
    and r21, mask
    eor r19, r21
    eor r18, r20
    and r18, mask
    eor r20, r18
    st X+, r19
    st X+, r20
    dec r1                      ; ends as zero, as the compiler wants it
    brne 3b
    mov r24, out
    andi r24, 4                 ; SG_GP_OUT_OF_RANGE
    ret
    .size sg_gp_round, . - sg_gp_round
#undef out

; void sg_gp_find(const int16_t deg_q7[2] r25:r24, const uint8_t *origin r23:r22, uint8_t space r20,
;                 struct sg_gp_place *place r19:r18)
; X walks the angles, Z the grid's description, Y is the place.
#define from0 r4                /* origins: azimuth, elevation */
#define from1 r5
#define from2 r6
#define from3 r7
#define scale0 r8
#define scale1 r9
#define wide r10
#define tall r11
#define grid0 r12
#define grid1 r13
.macro description load
    \load from0, Z+
    \load from1, Z+
    \load from2, Z+
    \load from3, Z+
    adiw r30, 2
    \load scale0, Z+
    \load scale1, Z+
    \load wide, Z+
    \load tall, Z+
.endm

; cell and fraction of one axis; r18 to r20 are lost
.macro along low_, high_, scale_, nodes_, cell, fraction
    ld r18, X+
    ld r19, X+
    cp r18, \low_
    cpc r19, \high_
    ldi r20, 0xFF
    brge 1f                     ; as long as the instruction it jumps over
    ldi r20, 0
1:
    sub r18, \low_
    sbc r19, \high_
    and r18, r20
    and r19, r20
    mul r18, \scale_
    mov r18, r1
    mul r19, \scale_
    mov \cell, r1
    add r18, r0
    brcc 2f                     ; as long as the instruction it jumps over
    inc \cell
2:
    mov \fraction, r18
    lsr \fraction
    mov r18, \nodes_            ; the last cell
    subi r18, 2
    cp r18, \cell
    sbc r20, r20                ; all ones beyond it
    or \fraction, r20
    andi \fraction, 0x7F
    eor r18, \cell
    and r18, r20
    eor \cell, r18
.endm

    .section .text.sg_gp_find, "ax", @progbits
    .global sg_gp_find
    .type sg_gp_find, @function
sg_gp_find:
    push r28
    push r29
    movw r26, r24
    movw r28, r18
    movw r30, r22
    movw grid0, r22
    by_space r20, description
    along from0, from1, scale0, wide, r22, r23
    along from2, from3, scale1, tall, r24, r25
    mul r23, r25                ; shares
    lsl r0
    rol r1                      ; r1: of the far corner
    std Y+7, r1
    sub r25, r1
    std Y+6, r25
    ldi r18, 128
    sub r18, r23
    sub r18, r25
    std Y+4, r18
    sub r23, r1
    std Y+5, r23
    mul r24, wide               ; node = elevation * wide + azimuth
    movw r18, r0
    ldi r25, 0
    add r18, r22
    adc r19, r25
    movw r20, r18               ; five bytes each
    lsl r20
    rol r21
    lsl r20
    rol r21
    add r18, r20
    adc r19, r21
    add r18, grid0
    adc r19, grid1
    subi r18, -80               ; SG_GP_GRID_FROM
    sbci r19, -1
    std Y+0, r18
    std Y+1, r19
    ldi r20, 5
    mul wide, r20
    add r18, r0
    adc r19, r1
    std Y+2, r18
    std Y+3, r19
    clr r1
    pop r29
    pop r28
    ret
    .size sg_gp_find, . - sg_gp_find

; void sg_gp_judge(const struct sg_gp_sum *sum r25:r24, const struct sg_gp_place *place r23:r22,
;                  const uint8_t *guard r21:r20, uint8_t space r18, struct sg_gp_opinion *opinion r17:r16)
; Y holds s >> 4, X the guard, Z what is read.
#undef zero
#define zero r14
#define doubt0 r12
#define doubt1 r13
#define node0 r2                /* pairs r3:r2 and r5:r4: the nodes' byte of this guard */
#define node1 r4
#define share0 r6
#define share1 r7
#define share2 r8
#define share3 r9
#define guards_left r10
#define seen r11
#define value r20
#define part r21

.macro corners load, node, first, second
    movw r30, \node
    \load value, Z
    mul value, \first
    add low, r0
    adc high, r1
    adiw r30, 5
    \load value, Z
    mul value, \second
    add low, r0
    adc high, r1
.endm

; acc2:acc1 += row * (s >> 4) for one channel
.macro project load, at
    \load value, Z+
    ldd low, Y+\at
    mulsu value, low
    add acc1, r0
    adc acc2, r1
.endm

.macro guard load
1:
    movw r30, r26               ; base and range later
    adiw r30, 6
    clr acc1
    clr acc2
    project \load, 0
    project \load, 1
    project \load, 2
    project \load, 3
    project \load, 4
    project \load, 5
    movw r30, r26               ; acc2:acc1 is the projection
    \load acc0, Z+
    \load acc3, Z+              ; base
    \load low, Z+
    \load high, Z+
    cp acc1, low                ; below low?
    cpc acc2, high
    ldi value, 0
    brge 3f                     ; as long as the instruction it jumps over
    ldi value, 4
3:
    or seen, value
    \load low, Z+
    \load high, Z+
    cp low, acc1                ; above high?
    cpc high, acc2
    ldi value, 0
    brge 4f
    ldi value, 4
4:
    or seen, value
    adiw r26, 12
    sub acc1, acc0
    sbc acc2, acc3
    clr low
    clr high
    corners \load, node0, share0, share1
    corners \load, node1, share2, share3
    sec
    adc node0, zero
    adc r3, zero
    sec
    adc node1, zero
    adc r5, zero
    swap low                    ; high:low >> 4
    swap high
    andi low, 0x0F
    eor low, high
    andi high, 0x0F
    eor low, high
    sub acc1, low
    sbc acc2, high
    mov value, acc2             ; magnitude
    lsl value
    sbc value, value
    eor acc1, value
    eor acc2, value
    sub acc1, value
    sbc acc2, value
    cpi acc1, 128               ; at most 127
    cpc acc2, zero
    sbc value, value
    and acc1, value
    com value
    andi value, 127
    or acc1, value
    mul acc1, acc1
    add doubt0, r0
    adc doubt1, r1
    dec guards_left
    breq 5f
    rjmp 1b
5:
.endm

; the nodes' next byte, which is sigma's, into high
.macro sigma load
    clr low
    clr high
    corners \load, node0, share0, share1
    corners \load, node1, share2, share3
    lsl low
    rol high
.endm

.macro judged load
    guard \load
    sigma \load
.endm

    .section .text.sg_gp_judge, "ax", @progbits
    .global sg_gp_judge
    .type sg_gp_judge, @function
sg_gp_judge:
    push r28
    push r29
    movw r30, r22
    ld r2, Z
    ldd r3, Z+1
    ldd r4, Z+2
    ldd r5, Z+3
    ldd share0, Z+4
    ldd share1, Z+5
    ldd share2, Z+6
    ldd share3, Z+7
    movw r28, r24
    adiw r28, SUM_S8
    movw r26, r20
    clr zero
    clr seen
    clr doubt0
    clr doubt1
    ldi value, 4
    mov guards_left, value
    by_space r18, judged
    movw r30, r16
    st Z, doubt0
    std Z+1, doubt1
    std Z+2, high
    std Z+3, seen
    clr r1
    pop r29
    pop r28
    ret
    .size sg_gp_judge, . - sg_gp_judge

#endif
