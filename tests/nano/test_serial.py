# SPDX-License-Identifier: Apache-2.0
"""The serial line: byte times, double buffering, overruns, mismatched speeds, opens, slow hosts."""

import os
import struct
import time

import pytest
import serial

from board import OPTIBOOT, QUIET, Board, firmware


@pytest.fixture
def board():
    with Board(app=firmware("serial"), constants=QUIET) as running:
        running.run(1000)
        yield running


def test_transmitter_is_double_buffered_and_a_byte_takes_160_cycles(board):
    board.send(b"U")
    answer = board.run(3000)
    assert answer[:2] == b"\x55\xaa"
    at_once, first, last = struct.unpack("<BHH", answer[2:])
    assert at_once                              # UDRE is back while the first byte is in the shift register
    assert 160 <= first <= 175                  # the second moves over at the first one's stop bit
    assert 320 <= last <= 335                   # TXC after the second; libsimavr counts 11 bits


def test_two_bytes_and_the_shift_register_hold_three_and_the_next_start_bit_loses_one(board):
    board.send(b"Dabc")
    assert list(board.run(5000)) == [6, 0, ord("a"), 0, ord("b"), 0, ord("c")]
    counters = board.counters()
    assert counters["uart_overruns"] == 0
    assert counters["longest_rx_cycles"] > 328      # so long did a wait; one more byte, and c would be lost
    board.send(b"Dabcdefg")
    count, *found = board.run(5000)
    # a and b wait in the FIFO; every new start bit overwrites the shift register: g is left there
    assert count == 6 and found[1::2] == [ord("a"), ord("b"), ord("g")]
    assert found[0] & 0x08                      # DOR
    assert board.counters()["uart_overruns"] == 4


def test_line_is_paced_at_the_host_speed(board):
    board.send(b"S\x00" * 200)                  # does nothing, 400 bytes
    board.run(3900)
    assert board.counters()["rx_bytes"] < 400
    board.run(200)
    assert board.counters()["rx_bytes"] == 400


@pytest.mark.parametrize("baud,fine", [(1000000, True), (970000, True), (1030000, True), (950000, False),
                                       (1050000, False), (115200, False), (500000, False)])
def test_speeds_more_than_four_percent_apart_give_garbage_both_ways(board, baud, fine):
    board.port.baudrate = baud
    board.send(b"S\x08" if fine else b"S\x08" * 20)
    answer = board.run(10000)
    counters = board.counters()
    if fine:
        assert answer == bytes(range(8)) and counters["rx_garbage"] == counters["tx_garbage"] == 0
    else:
        assert counters["rx_garbage"] == 40


def test_host_at_another_speed_reads_garbage(board):
    board.send(b"S\x40")
    says = board.run(200)
    board.port.baudrate = 500000
    garbage = board.run(2000)
    assert says == bytes(range(len(says))) and len(says) + len(garbage) == 64
    assert garbage != bytes(range(len(says), 64))
    assert board.counters()["tx_garbage"] == len(garbage) > 0


def test_clock_error_counts_towards_the_mismatch():
    errors = set()
    for seed in range(1, 7):
        constants = dict(QUIET, **{"clock.error": 0.03})
        with Board(app=firmware("serial"), constants=constants, seed=seed) as board:
            board.run(1000)
            board.port.baudrate = 1025000
            board.send(b"S\x04")
            board.run(2000)
            errors.add(board.counters()["rx_garbage"] > 0)
    assert errors == {True, False}              # up to 5.5 % apart for some seeds


def test_level_interrupts_ask_again_after_reti():
    data = bytes(range(200))
    with Board(app=firmware("level"), constants=QUIET) as board:
        board.run(1000)
        answer = b""
        for at in range(0, len(data), 2):       # both arrive while interrupts are off
            board.send(data[at:at + 2])
            answer += board.run(100)
        assert answer == data
        assert board.counters()["uart_overruns"] == 0


def test_every_open_presses_reset_unless_the_trace_is_cut():
    for auto_reset in (1, 0):
        with Board(app=firmware("echo"), auto_reset=auto_reset) as board:
            assert board.run(1000) == b"R"
            for _ in range(3):
                # gone before anybody looks
                os.close(os.open(board.ready["port"], os.O_RDWR | os.O_NOCTTY))
                board.command("time")
            says = board.run(1000)
            assert board.counters()["resets"] == 1 + (4 if auto_reset else 0)
            assert says == (b"R" if auto_reset else b"")


def test_open_enters_the_bootloader_and_power_on_does_not():
    with Board(app=firmware("echo"), bootloader=OPTIBOOT, auto_reset=1) as board:
        board.port.baudrate = 115200
        board.run(400000)
        board.send(b"0 ")
        assert board.run(5000) == b"\x14\x10"   # STK_INSYNC STK_OK
        board.command("power off")
        board.command("power on")
        board.port.baudrate = 1000000
        assert board.run(5000) == b"R"


def test_what_nobody_reads_is_lost_on_close_and_not_seen_by_the_next(board):
    board.send(b"S\x40")
    board.command(f"advance {board.cycle // 16 + 2000} {board.sent}")
    board.port.close()
    board.command("time")
    board.open()
    board.command("time")
    assert board.port.read(100) == b""


def test_slow_host_loses_nothing_and_a_closed_port_costs_nothing():
    with Board(app=firmware("serial"), unpaced=0, constants=QUIET) as board:
        port = serial.Serial(board.ready["port"], 1000000, timeout=5)
        time.sleep(0.05)
        wanted = 100 * 255                      # far more than a pty holds
        for n in range(1, 101):
            port.write(b"S\xff")
            deadline = time.monotonic() + 30
            while board.counters()["tx_bytes"] < 255 * n and time.monotonic() < deadline:
                time.sleep(0.001)
        got = b""
        while len(got) < wanted:
            block = port.read(4096)
            assert block, "data was lost"
            got += block
        assert got == bytes(range(255)) * 100
        assert board.counters()["host_dropped"] == 0
        port.close()
