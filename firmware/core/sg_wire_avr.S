// SPDX-License-Identifier: Apache-2.0
; sg_wire_encode_ring() of sg_wire.c for AVR with a multiplier, the same bytes.

#if defined(__AVR__) && !defined(SG_WIRE_PORTABLE)

#if __AVR_ARCH__ >= 100
#error "the registers of this core have no addresses, and the CRC is read from them"
#endif

#define group r10
#define byte r11
#define codel r12               /* where the length of the group under way will stand */
#define endl r14
#define endh r15
#define t r16
#define thirty_two r17
#define body r18                /* then the CRC and the delimiter, as they are sent */
#define AT_BODY 18
#define body_bytes r20
#define left r21
#define ringl r22
#define crcl r24
#define crch r25

; ---- X: where to write, and the place behind the delimiter at the end. Z: struct sg_head.
; r19:r18 body, r20 its bytes, r23:r22 ring, r15:r14 its end. Changed: what sg_wire_avr.h says.
; Three parts by one loop: head, body, and from the registers CRC and delimiter. T: head is done.
    .section .text.sg_wire_encode_at, "ax", @progbits
    .global sg_wire_encode_at
    .type sg_wire_encode_at, @function
sg_wire_encode_at:
    movw codel, r26
    ldi crcl, 0xFF
    ldi crch, 0xFF
    ldi thirty_two, 32
    ldi left, 5                 ; a byte in the first length's place, and the head
    clr byte
    clt
    rjmp 2f
1:  ld byte, Z+
    eor crch, byte              ; q = crch ^ crch >> 4; CRC = crcl << 8 ^ q << 12 ^ q << 5 ^ q
    mov t, crch
    swap t
    andi t, 0x0F
    eor crch, t
    mul crch, thirty_two
    eor r0, crch
    swap crch
    andi crch, 0xF0
    eor crch, r1
    eor crch, crcl
    mov crcl, r0
2:  tst byte
    brne 3f
    movw r0, r26                ; a zero holds the place of the next group's length
    movw r26, codel
    st X, group
    movw r26, r0
    movw codel, r0
    clr group
3:  st X+, byte
    inc group
    cp r26, endl
    cpc r27, endh
    brne 4f
    movw r26, ringl
4:  dec left
    brne 1b
    tst r31                     ; RAM begins at 0x100: this was the last part
    breq 6f
    brts 5f
    set
    movw r30, body
    mov left, body_bytes
    tst left
    brne 1b
5:  movw body, crcl
    clr body_bytes
    ldi r30, AT_BODY
    clr r31
    ldi left, 3
    rjmp 1b
6:  clr r1
    ret
    .size sg_wire_encode_at, . - sg_wire_encode_at

#endif
