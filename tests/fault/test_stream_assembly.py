# SPDX-License-Identifier: Apache-2.0
"""Stream packets put together: gaps, wraps, missing parts, restarts; and the clock fitted from pings."""

import numpy as np
import pytest

from sparsegaze import wire
from sparsegaze.clock import Clock, Unwrap
from sparsegaze.device import Frame
from sparsegaze.stream import Assembler
from sparsegaze.wire import lib

PERIOD_US = 999


def packet(kind, seq, t_us):
    struct = {lib.SG_MSG_RAW: "struct sg_raw", lib.SG_MSG_GAZE: "struct sg_gaze",
              lib.SG_MSG_COUNTS: "struct sg_counts"}[kind]
    return wire.Packet(kind, seq & 0xFFFF, wire.body(struct, t_us=t_us & 0xFFFFFFFF))


def assembled(packets, bits=lib.SG_STREAM_RAW | lib.SG_STREAM_GAZE, keep=1000, near=lambda t: t):
    frames = Assembler(Frame, keep, near)
    frames.expect(bits)
    for i, item in enumerate(packets):
        frames.take(item, float(i))
    return frames, list(frames.drain())


def both(seq, t_us):
    return [packet(lib.SG_MSG_RAW, seq, t_us), packet(lib.SG_MSG_GAZE, seq, t_us)]


def test_parts_of_one_number_become_one_frame_as_soon_as_the_last_arrives():
    frames, done = assembled(both(5, 100) + both(6, 3700))
    assert [(frame.seq, frame.t_us, frame.host_time) for frame in done] == [(5, 100, 1.0), (6, 3700, 3.0)]
    assert all(frame.raw and frame.gaze and frame.counts is None for frame in done)
    assert (frames.lost, frames.incomplete, frames.restarts) == (0, 0, 0)


def test_a_gap_in_the_numbers_is_lost_frames_across_the_wrap_of_sixteen_bits():
    frames, done = assembled(both(65534, 0) + both(65535, PERIOD_US) + both(2, 4 * PERIOD_US))
    assert [frame.seq for frame in done] == [65534, 65535, 65538]
    assert frames.lost == 2


@pytest.mark.parametrize("gap", [3, 30_000, 32_768, 40_000, 65_535, 65_536, 65_537, 500_000])
@pytest.mark.parametrize("period_us", [999, 3840])
def test_a_gap_longer_than_the_numbers_go_round_is_counted_by_device_time(gap, period_us):
    times = [0, 1, 2, 2 + gap, 3 + gap]
    frames, done = assembled([item for k in times for item in both(k, k * period_us + (k % 3) * 20)])
    assert [frame.seq for frame in done] == times and frames.lost == gap - 1
    assert frames.restarts == 0 and np.all(np.diff([frame.t_us for frame in done]) > 0)


def test_device_time_wraps_after_71_minutes_and_goes_on():
    start = 2 ** 32 - PERIOD_US // 2
    _, done = assembled(both(1, start) + both(2, start + PERIOD_US))
    assert done[1].t_us - done[0].t_us == PERIOD_US and done[1].t_us > 2 ** 32


def test_a_missing_part_makes_an_incomplete_frame_not_a_lost_one():
    second, third = both(2, PERIOD_US), both(3, 2 * PERIOD_US)
    frames, done = assembled(both(1, 0) + second[:1] + third[1:] + both(4, 3 * PERIOD_US))
    assert [frame.seq for frame in done] == [1, 2, 3, 4]
    assert done[1].gaze is None and done[2].raw is None
    assert (frames.lost, frames.incomplete) == (0, 2)


def test_a_doubled_packet_does_not_make_a_second_frame():
    frames, done = assembled(both(1, 0) + both(2, PERIOD_US) + both(2, PERIOD_US) + both(3, 2 * PERIOD_US))
    assert [frame.seq for frame in done] == [1, 2, 3] and frames.lost == 0


def test_a_restart_of_the_device_is_counted_and_time_never_runs_backwards():
    before, after = both(500, 500 * PERIOD_US), both(0, 10) + both(1, 10 + PERIOD_US)
    frames, done = assembled(before + after + both(3, 10 + 3 * PERIOD_US))
    assert frames.restarts == 1 and frames.lost == 1
    assert [frame.seq for frame in done] == [500, 501, 502, 504]
    assert np.all(np.diff([frame.t_us for frame in done]) > 0)
    assert done[3].t_us - done[1].t_us == 3 * PERIOD_US


def test_undrained_frames_are_bounded_and_counted_as_lost():
    frames, done = assembled([item for i in range(20) for item in both(i, i * PERIOD_US)], keep=8)
    assert [frame.seq for frame in done] == list(range(12, 20)) and frames.lost == 12


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_unwrapping_follows_any_steps_below_half_the_range(bits):
    rng = np.random.default_rng(bits)
    steps = rng.integers(-(1 << bits - 1) + 1, 1 << bits - 1, 2000)
    true = np.cumsum(steps) + 12345
    unwrap = Unwrap(bits)
    offset = unwrap(int(true[0]) % (1 << bits)) - int(true[0])
    assert [unwrap(int(value) % (1 << bits)) - offset for value in true[1:]] == true[1:].tolist()


def pings(clock, n, offset_s, drift, jitter_s, start_us=0, every_s=1.0, seed=1):
    rng = np.random.default_rng(seed)
    for i in range(n):
        device_s = start_us * 1e-6 + i * every_s
        host = offset_s + (1 + drift) * device_s
        there, back = 50e-6 + rng.exponential(jitter_s, 2)
        clock.add(host - there, host + 100e-6 + back, int(device_s * 1e6) & 0xFFFFFFFF,
                  int(device_s * 1e6 + 100) & 0xFFFFFFFF)


def test_clock_finds_one_percent_of_drift_under_jitter_of_a_millisecond():
    clock = Clock()
    pings(clock, 60, 1000.0, -0.0093, 1e-3)
    assert abs(clock.drift + 0.0093) < 20e-6
    assert abs(clock.to_host(30e6) - (1000.0 + 30 * (1 - 0.0093))) < 0.5e-3
    assert abs(clock.to_device(clock.to_host(12345678.0)) - 12345678.0) < 1e-3


def test_clock_over_the_wrap_of_device_time_and_one_frame_there():
    clock = Clock()
    start = 2 ** 32 - 5_000_000
    pings(clock, 10, 50.0, 0.004, 1e-5, start_us=start)
    assert abs(clock.drift - 0.004) < 20e-6
    frame_us = clock.unwrap((start + 9_000_000) & 0xFFFFFFFF)
    assert frame_us == start + 9_000_000
    assert abs(clock.to_host(frame_us) - (50.0 + 1.004 * (start + 9_000_000) * 1e-6)) < 1e-3


def test_clock_does_not_take_the_scatter_of_a_short_burst_for_drift():
    clock = Clock()
    pings(clock, 8, 7.0, 0.0, 5e-3, every_s=1e-3)
    assert clock.drift == 0.0 and abs(clock.to_host(0) - 7.0) < 10e-3


def test_clock_before_the_first_ping_says_that_it_does_not_know():
    clock = Clock()
    assert clock.to_host(1) is None and clock.to_device(1.0) is None and clock.offset_s is None
