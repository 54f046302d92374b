// SPDX-License-Identifier: Apache-2.0
; sg_gp_loop.c for AVR with a multiplier, bit-identical to it. Formats in sg_gp_loop.h.
;
; Nothing here takes a time that depends on data.

#if defined(__AVR__) && !defined(SG_GP_PORTABLE)

#define SUM_S2 8
#define SUM_S 12

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

    cpi t2, 0x0C                ; T >= 12 * 2^16: k = 0, which the table says from there on
    brlo 2f                     ; as long as the instruction it jumps over
    ldi t2, 0x0C
2:
    movw r26, r30
    movw r30, t1
    andi r30, 0xFE              ; 2 * (T >> 9)
    subi r30, lo8(-(sg_gp_exp_table))
    sbci r31, hi8(-(sg_gp_exp_table))
    lsr t1
    ror t0                      ; fraction (T >> 1) & 255
    lpm t1, Z+                  ; level Q0.16
    lpm t2, Z
    fmul t2, t0                 ; carry:r1 = (level >> 8) * fraction >> 7
    sbc t2, zero
    sub t1, r1
    sbc t2, zero
    movw r30, r26
    weigh \load, az0, az1, az2
    weigh \load, el0, el1, el2
    dec left
    breq 3f
    rjmp 1b
3:
.endm

    .section .text.sg_gp_loop, "ax", @progbits
    .global sg_gp_loop
    .type sg_gp_loop, @function
sg_gp_loop:
    push r2
    push r3
    push r4
    push r5
    push r6
    push r7
    push r8
    push r9
    push r10
    push r11
    push r12
    push r13
    push r14
    push r15
    push r16
    push r17
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
    sbrc r1, 0                  ; SG_ROM_FLASH
    rjmp from_flash
    loop ld
    rjmp done
from_flash:
    loop lpm
done:
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
    pop r17
    pop r16
    pop r15
    pop r14
    pop r13
    pop r12
    pop r11
    pop r10
    pop r9
    pop r8
    pop r7
    pop r6
    pop r5
    pop r4
    pop r3
    pop r2
    ret
    .size sg_gp_loop, . - sg_gp_loop

; ---- The other loops: X walks s, Z the coefficients
#undef c
#undef zero
#define zero r27                /* set after X is done with, or none is needed */
#define low r18
#define high r19
#define factor r20
#define count r21
#define acc0 r22
#define acc1 r23
#define acc2 r24
#define acc3 r25

; void sg_gp_square(struct sg_gp_sum *sum r25:r24)
    .section .text.sg_gp_square, "ax", @progbits
    .global sg_gp_square
    .type sg_gp_square, @function
sg_gp_square:
    movw r30, r24
    adiw r30, SUM_S
    ldi acc0, 31
    clr acc1
    clr acc2
    clr acc3
    clr zero
    ldi count, 6
1:
    ld low, Z+
    ld high, Z+
    mul low, low
    add acc0, r0
    adc acc1, r1
    adc acc2, zero
    adc acc3, zero
    mul low, high               ; twice, below 2^13
    lsl r0
    rol r1
    add acc1, r0
    adc acc2, r1
    adc acc3, zero
    mul high, high              ; one byte
    add acc2, r0
    adc acc3, zero
    dec count
    brne 1b
    ldi count, 3                ; >> 5 is << 3 and the upper three bytes
2:
    lsl acc0
    rol acc1
    rol acc2
    rol acc3
    dec count
    brne 2b
    sbiw r30, 24 - SUM_S2
    st Z, acc1
    std Z+1, acc2
    std Z+2, acc3
    std Z+3, zero
    clr r1
    ret
    .size sg_gp_square, . - sg_gp_square

; void sg_gp_trend(struct sg_gp_sum *sum r25:r24, const uint8_t *trend r23:r22, uint8_t space r20)
#undef zero
#define zero r17
; acc = acc + trend * s over six channels
.macro sum_trend load
    movw r26, r28
    adiw r26, SUM_S
    ldi count, 6
1:
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
    dec count
    brne 1b
.endm

.macro output at
    ldd acc0, Y+\at
    ldd acc1, Y+\at+1
    ldd acc2, Y+\at+2
    ldd acc3, Y+\at+3
    brtc 2f
    sum_trend lpm
    rjmp 3f
2:
    sum_trend ld
3:
    ldi count, 4                ; >> 4 is << 4 and the upper three bytes
4:
    lsl acc0
    rol acc1
    rol acc2
    rol acc3
    dec count
    brne 4b
    std Y+\at, acc1
    std Y+\at+1, acc2
    std Y+\at+2, acc3
.endm

    .section .text.sg_gp_trend, "ax", @progbits
    .global sg_gp_trend
    .type sg_gp_trend, @function
sg_gp_trend:
    push zero
    push r28
    push r29
    clr zero
    bst r20, 0                  ; T: SG_ROM_FLASH
    movw r28, r24
    movw r30, r22
    output 0
    output 4
    pop r29
    pop r28
    pop zero
    clr r1
    ret
    .size sg_gp_trend, . - sg_gp_trend

; int16_t sg_gp_project(const struct sg_gp_sum *sum r25:r24, const uint8_t *row r23:r22, uint8_t space r20)
#undef zero
#define zero r25
.macro project load
1:
    \load factor, Z+
    ld low, X+
    mulsu factor, low
    sbc acc2, zero              ; carry is the product's sign
    add acc0, r0
    adc acc1, r1
    adc acc2, zero
    ld low, X+
    mulsu factor, low
    add acc1, r0
    adc acc2, r1
    dec count
    brne 1b
.endm

    .section .text.sg_gp_project, "ax", @progbits
    .global sg_gp_project
    .type sg_gp_project, @function
sg_gp_project:
    movw r26, r24
    adiw r26, SUM_S
    movw r30, r22
    clr zero
    clr acc0
    clr acc1
    clr acc2
    ldi count, 6
    sbrs r20, 0                 ; SG_ROM_FLASH
    rjmp 2f
    project lpm
    rjmp 3f
2:
    project ld
3:
    clr r1
    mov r25, acc2               ; bytes 1 and 2 of the sum
    mov r24, acc1
    ret
    .size sg_gp_project, . - sg_gp_project

#endif
