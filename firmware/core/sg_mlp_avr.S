; SPDX-License-Identifier: Apache-2.0
; sg_mlp_loop.c for AVR with a multiplier, bit-identical to it. Formats in sg_mlp_loop.h and sg_mlp.h.
;
; Four rows at a time (at the end perhaps two), so that an activation is loaded once for all of them; their z
; stay in registers. No branch depends on data: clamps and signs are masks, so every input takes equally long.

#if defined(__AVR__) && !defined(SG_MLP_PORTABLE)

/* z of rows 0 to 3: r2 r3 r4, r6 r7 r5, r8 r9 r10, r12 r13 r11; the two low bytes are a pair */
#define al r14                  /* an activation; then the place in the image, saved */
#define ah r15
#define wl r16                  /* a weight; then a row's scale */
#define wh r17
#define zero r18
#define left r19                /* columns left; then odds and ends */
#define v0 r20                  /* the row being finished */
#define v1 r21
#define v2 r22
#define sign r23                /* 255 if it is negative */
#define outl r24
#define outh r25

#define RUN_CORRECTION 0
#define RUN_SATURATED 3
#define RUN_COLUMNS 4
#define RUN_ROWS 5
#define RUN_KIND 6
#define RUN_SPACE 7
#define RUN_IN 8
#define WIDE 0                  /* bits of kind */
#define OUTPUT 1

; z += product with the next weight of 2 bytes
.macro multiply2 load, z0, z1, z2
    \load wl, Z+
    \load wh, Z+
    mul wh, al
    add \z0, r0
    adc \z1, r1
    adc \z2, zero
    mul wl, ah
    add \z0, r0
    adc \z1, r1
    adc \z2, zero
    mul wh, ah
    add \z1, r0
    adc \z2, r1
.endm

; the same of 1 byte: the product's low byte is dropped before the sum
.macro multiply1 load, z0, z1, z2
    \load wl, Z+
    mul wl, al
    mov wh, r1
    mul wl, ah
    add r0, wh
    adc r1, zero                ; cannot carry: the product has 24 bits
    add \z0, r0
    adc \z1, r1
    adc \z2, zero
.endm

; z = bias - correction, which is in v
.macro begin load, z0, z1, z2
    \load \z0, Z+
    \load \z1, Z+
    \load \z2, Z+
    sub \z0, v0
    sbc \z1, v1
    sbc \z2, v2
.endm

.macro finish load, z0, z1, z2
    movw v0, \z0
    mov v2, \z2
    \load wl, Z+
    \load wh, Z+
    rcall finish_row
.endm

.macro group
    ldd v0, Y+RUN_CORRECTION
    ldd v1, Y+RUN_CORRECTION+1
    ldd v2, Y+RUN_CORRECTION+2
    ldd left, Y+RUN_COLUMNS
    ldd r26, Y+RUN_IN
    ldd r27, Y+RUN_IN+1
.endm

.macro layer load, multiply
1:
    group
    ldd wl, Y+RUN_ROWS
    subi wl, 4
    brcc 6f
    rjmp 3f
6:
    std Y+RUN_ROWS, wl
    begin \load, r2, r3, r4
    begin \load, r6, r7, r5
    begin \load, r8, r9, r10
    begin \load, r12, r13, r11
2:
    ld al, X+
    ld ah, X+
    \multiply \load, r2, r3, r4
    \multiply \load, r6, r7, r5
    \multiply \load, r8, r9, r10
    \multiply \load, r12, r13, r11
    dec left
    brne 2b
    finish \load, r2, r3, r4
    finish \load, r6, r7, r5
    finish \load, r8, r9, r10
    finish \load, r12, r13, r11
    rjmp 1b
3:
    cpi wl, -2
    brne 5f
    begin \load, r2, r3, r4
    begin \load, r6, r7, r5
4:
    ld al, X+
    ld ah, X+
    \multiply \load, r2, r3, r4
    \multiply \load, r6, r7, r5
    dec left
    brne 4b
    finish \load, r2, r3, r4
    finish \load, r6, r7, r5
5:
    rjmp layer_end
.endm

; const uint8_t *sg_mlp_layer(struct sg_mlp_run *run r25:r24, const uint8_t *layer r23:r22,
;                             uint16_t *out r21:r20)
    .section .text.sg_mlp_layer, "ax", @progbits
    .global sg_mlp_layer
    .type sg_mlp_layer, @function
sg_mlp_layer:
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
    movw r28, r24
    movw r30, r22
    movw outl, r20
    ldd r16, Y+RUN_SPACE
    bst r16, 0                  ; T: SG_ROM_FLASH
    ldd r16, Y+RUN_KIND

    ; S = sum of activations, L = that of their low bytes: 128 S - (L >> 1) or S >> 1 is the correction
    group
    clr v0
    clr v1
    clr v2
    sbrc r16, WIDE
    rjmp sum_wide
1:
    ld r0, X+
    ld r1, X+
    add v0, r0
    adc v1, r1
    adc v2, zero
    dec left
    brne 1b
    lsr v2
    ror v1
    ror v0
    rjmp 2f
sum_wide:
    clr r2
    clr r3
1:
    ld r0, X+
    ld r1, X+
    add v0, r0
    adc v1, r1
    adc v2, zero
    add r2, r0
    adc r3, zero
    dec left
    brne 1b
    lsr v2
    ror v1
    ror v0
    ror left                    ; left is 0
    mov v2, v1
    mov v1, v0
    mov v0, left
    lsr r3
    ror r2
    sub v0, r2
    sbc v1, r3
    sbc v2, zero
2:
    std Y+RUN_CORRECTION, v0
    std Y+RUN_CORRECTION+1, v1
    std Y+RUN_CORRECTION+2, v2

    sbrs r16, WIDE
    rjmp narrow
    brts wide_from_flash
    rjmp wide_from_memory
wide_from_flash:
    layer lpm, multiply2
wide_from_memory:
    layer ld, multiply2
narrow:
    brts narrow_from_flash
    rjmp narrow_from_memory
narrow_from_flash:
    layer lpm, multiply1
narrow_from_memory:
    layer ld, multiply1

layer_end:
    movw r24, r30
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

; A row's z in v and its scale in w, to one word at out, which moves on. Keeps r2..r13 and Z.
finish_row:
    movw al, r30
    mov sign, v2
    lsl sign
    sbc sign, sign
    eor v0, sign
    eor v1, sign
    eor v2, sign
    sub v0, sign
    sbc v1, sign
    sbc v2, sign
    ; q = (|z| * scale + 128) >> 8 = r31:r30:r27:r26; the byte below is in left
    ldi left, 128
    mul v0, wl
    add left, r0
    mov r26, r1
    adc r26, zero
    mul v1, wl
    add r26, r0
    mov r27, r1
    adc r27, zero
    mul v2, wl
    add r27, r0
    mov r30, r1
    adc r30, zero
    mul v0, wh
    add r26, r0
    adc r27, r1
    adc r30, zero
    clr r31
    adc r31, zero
    mul v1, wh
    add r27, r0
    adc r30, r1
    adc r31, zero
    mul v2, wh
    add r30, r0
    adc r31, r1
    ldd left, Y+RUN_KIND
    sbrc left, OUTPUT
    rjmp finish_output

    ; u = min(q, 65535) = r27:r26
    or r30, r31
    cp zero, r30
    sbc r30, r30                ; 255 if q has more than 16 bits
    or r26, r30
    or r27, r30
    mov r30, r27
    clr r31
    lsl r30
    rol r31
    subi r30, lo8(-(sg_mlp_tanh_table))
    sbci r31, hi8(-(sg_mlp_tanh_table))
    lpm v0, Z+
    lpm v1, Z+
    lpm wl, Z+
    lpm wh, Z
    sub wl, v0
    sbc wh, v1
    mul wl, r26
    lsl r0                      ; the half: bit 7 of the low byte
    mov v2, r1
    adc v2, zero                ; at most 255: r1 is at most 254
    mul wh, r26
    add r0, v2
    adc r1, zero
    add v0, r0
    adc v1, r1
    eor v0, sign
    eor v1, sign
    sub v0, sign
    sbc v1, sign
    subi v1, 0x80
    movw r26, outl
    st X+, v0
    st X+, v1
    movw outl, r26
    movw r30, al
    ret

finish_output:
    ; y = min((q + 128) >> 8, 32767) = r30:r27
    ldi left, 128
    add r26, left
    adc r27, zero
    adc r30, zero
    adc r31, zero
    and left, r30
    or left, r31
    cp zero, left
    sbc left, left              ; 255 if it saturates
    or r27, left
    or r30, left
    andi r30, 0x7F
    eor r27, sign
    eor r30, sign
    sub r27, sign
    sbc r30, sign
    mov v0, r27
    mov v1, r30
    movw r26, outl
    st X+, v0
    st X+, v1
    movw outl, r26
    ldd v0, Y+RUN_SATURATED
    or v0, left
    std Y+RUN_SATURATED, v0
    movw r30, al
    ret
    .size sg_mlp_layer, . - sg_mlp_layer

; uint8_t sg_mlp_scale(const uint16_t *input r25:r24, uint16_t *out r23:r22, const uint8_t *scale r21:r20,
;                      uint8_t n r18, uint8_t space r16)
#define xl r20                  /* input, then difference */
#define xh r21
#define none r22
#define seen r24
#define mask r25
#define gl r16
#define gh r17
#define p1 r14                  /* product; its lowest byte is not needed */
#define p2 r15
#define p3 r19

.macro scale_inputs load
1:
    ld xl, X+
    ld xh, X+
    \load gl, Z+
    \load gh, Z+
    sub xl, gl
    sbc xh, gh
    sbc mask, mask              ; 255 if below the offset
    or seen, mask
    com mask
    and xl, mask
    and xh, mask
    \load gl, Z+
    \load gh, Z+
    mul xl, gl
    mov p1, r1
    mul xh, gh
    mov p2, r0
    mov p3, r1
    mul xl, gh
    add p1, r0
    adc p2, r1
    adc p3, none
    mul xh, gl
    add p1, r0
    adc p2, r1
    adc p3, none
    cp none, p3
    sbc mask, mask              ; 255 if above 65535
    or seen, mask
    or p1, mask
    or p2, mask
    st Y+, p1
    st Y+, p2
    dec r18
    brne 1b
.endm

    .section .text.sg_mlp_scale, "ax", @progbits
    .global sg_mlp_scale
    .type sg_mlp_scale, @function
sg_mlp_scale:
    push r14
    push r15
    push r16
    push r17
    push r28
    push r29
    movw r26, r24
    movw r28, r22
    movw r30, r20
    clr none
    clr seen
    sbrs r16, 0
    rjmp 2f
    scale_inputs lpm
    rjmp 3f
2:
    scale_inputs ld
3:
    clr r1
    pop r29
    pop r28
    pop r17
    pop r16
    pop r15
    pop r14
    ret
    .size sg_mlp_scale, . - sg_mlp_scale

#endif
