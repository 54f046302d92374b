// SPDX-License-Identifier: Apache-2.0
; sg_gp_loop.c for AVR with a multiplier, bit-identical to it. Formats in sg_gp_loop.h.
;
; Every value of sg_gp_loop lives in a register but S2, half of s4, and s5: these it reads from *sum once per
; record.

#if defined(__AVR__) && !defined(SG_GP_PORTABLE)

#define s0l r2
#define s0h r3
#define s1l r4
#define s1h r5
#define s2l r6
#define s2h r7
#define s3l r8
#define s3h r9
#define s4l r10
#define zero r11
#define az0 r12
#define az1 r13
#define az2 r14
#define az3 r15
#define t0 r16                  /* T, 20.4, 24 bits; then fraction Q0.10; then k Q0.16 */
#define t1 r17
#define t2 r18
#define byte r19                /* c, a byte of drop, high byte of a weight */
#define carry2 r20              /* bits 16..23 of drop * fraction */
#define left r21
#define savedl r22
#define el0 r24
#define el1 r25
#define el2 r26
#define el3 r27

#define SUM_S2 8
#define SUM_S4H 21
#define SUM_S5L 22
#define SUM_S5H 23

; T -= c * s for the next centre of the record: u8 * u8.4, both halves of s in registers
.macro channel load, low, high
    \load byte, Z+
    mul \low, byte
    sub t0, r0
    sbc t1, r1
    sbc t2, zero
    mul \high, byte
    sub t1, r0
    sbc t2, r1
.endm

; acc += weight * k: s16 * u16 into 32 bits modulo 2^32
.macro weigh load, a0, a1, a2, a3
    \load t2, Z+
    \load byte, Z+
    mul t2, t0
    add \a0, r0
    adc \a1, r1
    adc \a2, zero
    adc \a3, zero
    mul t2, t1
    add \a1, r0
    adc \a2, r1
    adc \a3, zero
    mulsu byte, t0
    sbc \a3, zero               ; carry is the product's sign
    add \a1, r0
    adc \a2, r1
    adc \a3, zero
    mulsu byte, t1
    add \a2, r0
    adc \a3, r1
.endm

.macro loop load
1:
    \load t0, Z+
    \load t1, Z+
    \load t2, Z+
    ldd r0, Y+SUM_S2
    add t0, r0
    ldd r0, Y+SUM_S2+1
    adc t1, r0
    ldd r0, Y+SUM_S2+2
    adc t2, r0
    channel \load, s0l, s0h
    channel \load, s1l, s1h
    channel \load, s2l, s2h
    channel \load, s3l, s3h
    ldd carry2, Y+SUM_S4H
    channel \load, s4l, carry2
    \load byte, Z+
    ldd r0, Y+SUM_S5L
    mul r0, byte
    sub t0, r0
    sbc t1, r1
    sbc t2, zero
    ldd r0, Y+SUM_S5H
    mul r0, byte
    sub t1, r0
    sbc t2, r1

    cpi t2, 0x10                ; T < 2^20 and not negative, in one comparison
    brlo 3f
    tst t2
    brmi 2f
    adiw r30, 4                 ; too far: k = 0
    rjmp 4f
2:
    clr t0                      ; closer than the point itself (rounding of S2, or a reduced half_c2): T = 0
    clr t1
    clr t2
3:
    movw savedl, r30
    mov r30, t1
    mov r31, t2
    andi r30, 0xFC              ; 4 * (T >> 10)
    subi r30, lo8(-(sg_gp_exp_table))
    sbci r31, hi8(-(sg_gp_exp_table))
    andi t1, 3                  ; fraction Q0.10
    lpm byte, Z+                ; drop Q10.6
    mul byte, t0
    mov t2, r1
    mul byte, t1
    add t2, r0
    mov carry2, r1
    adc carry2, zero
    lpm byte, Z+
    mul byte, t0
    add t2, r0
    adc carry2, r1
    mul byte, t1
    add carry2, r0
    adc r1, zero                ; r1:carry2 = drop * fraction >> 16
    lpm t0, Z+                  ; level Q0.16
    lpm t1, Z
    sub t0, carry2
    sbc t1, r1
    movw r30, savedl
    weigh \load, az0, az1, az2, az3
    weigh \load, el0, el1, el2, el3
4:
    dec left
    breq 5f
    rjmp 1b
5:
.endm

; void sg_gp_loop(struct sg_gp_sum *sum r25:r24, const uint8_t *record r23:r22, uint8_t n r20,
;                 uint8_t space r18)
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
    clr zero
    mov left, r20
    movw r30, r22
    movw r28, r24
    ldd az0, Y+0
    ldd az1, Y+1
    ldd az2, Y+2
    ldd az3, Y+3
    ldd el0, Y+4
    ldd el1, Y+5
    ldd el2, Y+6
    ldd el3, Y+7
    ldd s0l, Y+12
    ldd s0h, Y+13
    ldd s1l, Y+14
    ldd s1h, Y+15
    ldd s2l, Y+16
    ldd s2h, Y+17
    ldd s3l, Y+18
    ldd s3h, Y+19
    ldd s4l, Y+20
    cpi r18, 1                  ; SG_ROM_FLASH
    brne from_memory
    rjmp from_flash
from_memory:
    loop ld
    rjmp done
from_flash:
    loop lpm
done:
    std Y+0, az0
    std Y+1, az1
    std Y+2, az2
    std Y+3, az3
    std Y+4, el0
    std Y+5, el1
    std Y+6, el2
    std Y+7, el3
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

; void sg_gp_trend(struct sg_gp_sum *sum r25:r24, const uint8_t *trend r23:r22, uint8_t space r20)
#define acc0 r18
#define acc1 r19
#define acc2 r20
#define acc3 r21
#define low r22
#define high r23
#define factor r24
#define count r25
#define SUM_S 12

; acc = acc + trend * s over six channels; X walks s, Z walks trend
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
    mul low, factor
    add acc1, r0
    adc acc2, r1
    adc acc3, zero
    mul high, factor
    add acc2, r0
    adc acc3, r1
    \load factor, Z+
    mul low, factor
    add acc2, r0
    adc acc3, r1
    mul high, factor
    add acc3, r0
    \load factor, Z+
    mul low, factor
    add acc3, r0
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
    std Y+\at, acc0
    std Y+\at+1, acc1
    std Y+\at+2, acc2
    std Y+\at+3, acc3
.endm

    .section .text.sg_gp_trend, "ax", @progbits
    .global sg_gp_trend
    .type sg_gp_trend, @function
sg_gp_trend:
    push zero
    push r28
    push r29
    clr zero
    movw r28, r24
    movw r30, r22
    bst r20, 0                  ; T: SG_ROM_FLASH
    output 0
    output 4
    pop r29
    pop r28
    pop zero
    clr r1
    ret
    .size sg_gp_trend, . - sg_gp_trend

; int32_t sg_gp_project(const struct sg_gp_sum *sum r25:r24, const uint8_t *row r23:r22, uint8_t space r20)
#define sum0 r22                /* 24 bits hold it */
#define sum1 r23
#define sum2 r24
#define part r21

.macro project load
1:
    \load r20, Z+
    ld part, X+
    mulsu r20, part
    sbc sum2, r18               ; carry is the product's sign
    add sum0, r0
    adc sum1, r1
    adc sum2, r18
    ld part, X+
    mulsu r20, part
    add sum1, r0
    adc sum2, r1
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
    clr r18
    clr sum0
    clr sum1
    clr sum2
    ldi count, 6
    sbrs r20, 0
    rjmp 2f
    project lpm
    rjmp 3f
2:
    project ld
3:
    clr r1
    clr r25
    sbrc sum2, 7
    com r25
    ret
    .size sg_gp_project, . - sg_gp_project

#endif
