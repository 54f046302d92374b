# SPDX-License-Identifier: Apache-2.0
"""Cycle counts of instructions, interrupts and Timer1, as the chip's own timer shows them."""

from board import Board, firmware

ENTRY, VECTOR_JMP, RETI = 4, 3, 4


def test_interrupt_round_trip_and_wake_from_sleep():
    with Board(app=firmware("interrupts")) as board:
        without, with_one, low, high = board.run(3000)
    assert without == 4                                         # lds 2 + sei 1 + nop 1
    assert with_one - without == ENTRY + VECTOR_JMP + RETI      # 11 on the chip, 7 in libsimavr 1.6
    # The flag rises at OCR1A + 1; out of sleep an entry takes four cycles more; LDS reads in its second
    # cycle.
    assert low + 256 * high == 1 + 4 + ENTRY + VECTOR_JMP + RETI + 1


def test_instruction_cycles_and_timer1_flags():
    with Board(app=firmware("timing")) as board:
        answer = board.run(3000)
    nothing, nop, multiply, call, stack, early, late, flags, highest, overflow = answer
    assert (nothing, nop, multiply, call, stack) == (0, 1, 2, 3 + 2 + 4, 4)
    assert early == 0 and late != 0         # set one cycle after the match
    assert flags == 1                       # SBI cleared OCF1A and left TOV1
    assert highest == 99 and overflow == 0  # CTC
