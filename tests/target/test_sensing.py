# SPDX-License-Identifier: Apache-2.0
"""The sensing engine as the LEDs show it: exact exposures, a steady clock, lights that go out."""

import csv

import pytest

from conftest import collect, random_model
from scope import CYCLES_PER_US, EMIT, LEDS, SLOT_US, Scope
from sparsegaze import wire
from sparsegaze.transport import open_link
from sparsegaze.wire import Status, lib

SLOT_CYCLES = SLOT_US * CYCLES_PER_US
FRAME_CYCLES = LEDS * SLOT_CYCLES
JITTER_CYCLES_MAX = 20 * CYCLES_PER_US


def loaded(device):
    """What to call between events: requests in, answers and all three streams out, and inference."""
    device.set_stream(raw=True, gaze=True, counts=True)
    count = [0]

    def load():
        count[0] += 1
        if count[0] % 3 == 0:
            device.link.write(wire.encode(lib.SG_MSG_STATUS, count[0]))

    return load


@pytest.mark.parametrize("exposure_us", [16, 33.25, 100.5, 304])
def test_exposure_is_what_was_asked_for_to_the_cycle_under_load(board, exposure_us):
    """Serial traffic both ways and inference move the release, never the exposure: its jitter is 0 cycles."""
    nano, device = board(models={0: random_model(64).image})
    device.exposure(us=[exposure_us] * LEDS)
    load = loaded(device)
    device.link.sleep(0.0073)
    slots = Scope(nano, device.link).slots(120, [exposure_us] * LEDS, load)
    assert {slot.sample - slot.release for slot in slots} == {int(exposure_us * CYCLES_PER_US)}
    settle = [slot.release - slot.lit for slot in slots]
    print(f"{len(slots)} exposures of {exposure_us} us exact; lit {min(settle)}..{max(settle)} cycles before")
    assert 4 * CYCLES_PER_US <= min(settle) and max(settle) <= 6 * CYCLES_PER_US
    assert device.status().late_slots == 0


def test_each_led_has_its_own_exposure_and_the_device_reports_it_exactly(board):
    nano, device = board()
    asked = [16, 57.75, 100, 150.25, 222, 304]
    device.exposure(us=asked)
    device.set_stream(counts=True)
    device.link.sleep(0.01)
    slots = Scope(nano, device.link).slots(12, asked)
    found = {(slot.led, (slot.sample - slot.release) / CYCLES_PER_US) for slot in slots}
    assert found == set(enumerate(asked))
    frames = collect(device, 20)
    assert {frame.counts.exposure_us_q2 for frame in frames[10:]} == {tuple(int(4 * us) for us in asked)}


def test_frame_clock_is_steady_and_timestamps_follow_it(board, tmp_path):
    """Slots do not drift: the first release moves by interrupt latency only."""
    nano, device = board(models={0: random_model(64).image})
    device.exposure(us=[304] * LEDS)
    device.set_stream(raw=True, gaze=True)
    device.link.sleep(0.01)
    path = tmp_path / "frames.csv"
    nano.control.frames(path)
    device.link.sleep(1.0)
    nano.control.frames(None)
    with open(path, newline="") as file:
        releases = [int(row[1]) for row in csv.reader(file) if row[0] == "release"]
    late = [(release - releases[0]) - k * FRAME_CYCLES for k, release in enumerate(releases)]
    print(f"{len(late)} frames of {FRAME_CYCLES} cycles, first release within {max(late) - min(late)} cycles")
    assert len(late) > 250 and max(late) - min(late) <= JITTER_CYCLES_MAX
    frames = collect(device, 250)[20:]
    off = [(frame.t_us - frames[0].t_us) - 3840 * (frame.seq - frames[0].seq) for frame in frames]
    assert max(off) - min(off) <= JITTER_CYCLES_MAX / CYCLES_PER_US
    # Six mid-exposures 640 us apart: the last sample is 2.5 slots and half an exposure after their mean.
    assert all(abs(frame.raw.span_us - 1752) <= 12 for frame in frames)
    assert device.lost == 0 and device.status().late_slots == 0


def test_timestamps_are_the_mean_of_the_mid_exposures(board, tmp_path):
    """Against the cycles at which the LEDs were really released and sampled, over a wrap of the timer."""
    nano, device = board()
    exposure_us = [16, 304, 50, 200, 100, 150]
    device.exposure(us=exposure_us)
    device.set_stream(raw=True)
    slots = Scope(nano, device.link).slots(13 * LEDS, exposure_us)
    slots = slots[next(k for k, slot in enumerate(slots) if slot.led == 0):]
    frames = {frame.t_us: frame.raw for frame in collect(device, 40)}
    means = [sum((s.release + s.sample) / 2 for s in slots[k:k + LEDS]) / LEDS / CYCLES_PER_US
             for k in range(0, len(slots) - LEDS + 1, LEDS)]
    # Device time began with the application: a ping says when, well enough to tell the frames apart.
    began = device.link.now() * 1e6 - device.ping().tx_us
    offsets = []
    for k, mean in enumerate(means):
        raw = frames[min(frames, key=lambda t_us: abs(mean - began - t_us))]
        offsets.append(mean - raw.t_us)
        assert abs(slots[LEDS * k + 5].sample / CYCLES_PER_US - mean - raw.span_us) <= 1
    assert len(means) >= 12 and max(offsets) - min(offsets) <= 1 and abs(offsets[0] - began) < 1000


def test_emitters_are_lit_at_most_half_of_any_frame_at_the_longest_exposure(board):
    nano, device = board(models={0: random_model(64).image})
    high = device.hello.exposure_max_us
    assert device.exposure(us=[16383] * LEDS).exposure_us == (high,) * LEDS
    load = loaded(device)
    slots = Scope(nano, device.link).slots(20 * LEDS, [high] * LEDS, load)
    lit = [slot.dark - slot.lit for slot in slots]
    worst = max(sum(lit[k:k + LEDS]) for k in range(len(lit) - LEDS + 1))
    print(f"lit at most {max(lit)} of {SLOT_CYCLES} cycles, {100 * worst / FRAME_CYCLES:.2f} % of a frame")
    assert max(lit) <= SLOT_CYCLES // 2 and worst <= FRAME_CYCLES // 2


def test_lights_go_out_in_the_cycle_after_the_sample_under_load(board):
    """All four codes are of one charge: what still fell on the cathode between would be in three of them."""
    nano, device = board(models={0: random_model(64).image})
    device.exposure(us=[150] * LEDS)
    load = loaded(device)
    slots = Scope(nano, device.link).slots(120, [150] * LEDS, load)
    after = [slot.dark - slot.sample for slot in slots]
    print(f"lights out {min(after)}..{max(after)} cycles after the sample")
    assert set(after) == {1}


@pytest.mark.parametrize("bad", ["HANG_LOOP", "HANG_LIT"])
def test_a_hang_ends_in_the_dark_within_130_ms_and_is_reported_as_watchdog(
        virtual_nano, any_map, port_with, repo_root, tmp_path, bad):
    elf = port_with(repo_root / "tests" / "target" / "bad_app.c", f"-DBAD={bad}")
    nano = virtual_nano(map=any_map, unpaced=True, person=1, app=elf, state_dir=tmp_path / "state")
    link = open_link(nano.port)
    scope = Scope(nano, link)
    frames = tmp_path / "frames.csv"
    resets = nano.control.counters()["wdt_resets"]

    def reset_again():
        return nano.control.counters()["wdt_resets"] > resets

    # Optiboot ends its listening by a watchdog reset of its own; that starts the application.
    scope.until(reset_again, 500, 3_000_000)
    resets += 1
    nano.control.frames(frames)
    link.sleep(0.42)                        # the hundredth frame is at 0.38 s
    assert not reset_again()
    lit = [node.since for node in map(scope.node, range(LEDS)) if node.drive == EMIT]
    scope.until(reset_again, 100, 200_000)
    end = nano.control.time().cycle
    nano.control.frames(None)
    with open(frames, newline="") as file:
        hung = [int(row[1]) for row in csv.reader(file) if row[0] == "sample"][99]
    if bad == "HANG_LIT":
        assert len(lit) == 5 and abs(min(lit) - hung) < FRAME_CYCLES   # hung with the lights on
        hung = min(lit)
    assert 100_000 * CYCLES_PER_US < end - hung <= 130_000 * CYCLES_PER_US
    still_lit = [node for node in map(scope.node, range(LEDS)) if node.drive == EMIT]
    assert all(node.since > end - 200 * CYCLES_PER_US for node in still_lit)

    link.sleep(0.1)                         # started again
    assert report(link).reset_cause == lib.SG_RESET_WATCHDOG
    link.close()


def report(link):
    """What bad_app.c answers to anything said to it."""
    decoder, answers, stop = wire.Decoder(), [], link.now() + 0.1
    link.write(b"\0")
    while not answers and link.now() < stop:
        answers = decoder.feed(link.read(256, 0.01))
    return wire.parse(Status, answers[0].body)


def run_bad_app(virtual_nano, any_map, port_with, repo_root, bad):
    elf = port_with(repo_root / "tests" / "target" / "bad_app.c", f"-DBAD={bad}")
    nano = virtual_nano(map=any_map, unpaced=True, person=1, app=elf)
    link = open_link(nano.port)
    link.sleep(2.0)
    return nano, link


def test_exposures_stay_exact_and_late_slots_are_counted_when_interrupts_are_blocked(
        virtual_nano, any_map, port_with, repo_root):
    nano, link = run_bad_app(virtual_nano, any_map, port_with, repo_root, "BLOCK")
    before = report(link)
    slots = Scope(nano, link).slots(40 * LEDS, [100] * LEDS, skip_us=0)
    after = report(link)
    assert {slot.sample - slot.release for slot in slots} == {1600}
    lost = [b.lit - a.lit - SLOT_CYCLES for a, b in zip(slots, slots[1:])]
    assert max(lost) > 100 * CYCLES_PER_US      # the blocking was seen
    assert after.late_slots > before.late_slots and after.frames - before.frames >= 35
    link.close()


def test_frames_that_come_while_the_main_loop_works_are_counted_late(
        virtual_nano, any_map, port_with, repo_root):
    _, link = run_bad_app(virtual_nano, any_map, port_with, repo_root, "SLOW")
    before = report(link)
    link.sleep(1.0)
    after = report(link)
    assert 255 <= after.frames - before.frames <= 266       # sensing does not wait
    assert after.late_frames - before.late_frames >= 200 and after.late_slots == before.late_slots
    assert after.reset_cause == before.reset_cause          # slow is not dead
    link.close()
