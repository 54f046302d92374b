# SPDX-License-Identifier: Apache-2.0
"""The sensing engine as the pins show it: exposures exact to the cycle, a steady frame clock, lights that go out."""

import csv
from collections import namedtuple

import pytest

from conftest import collect, random_model
from sparsegaze import wire
from sparsegaze.transport import open_link
from sparsegaze.wire import Status, lib

CYCLES_PER_US = 16
SLOT_CYCLES = 600 * CYCLES_PER_US
FRAME_CYCLES = 6 * SLOT_CYCLES
LEDS = 6

Slot = namedtuple("Slot", "led lit release sample dark lights")     # cycles; lights: LEDs lit at the sample


def read_pins(path):
    """[(cycle, what, value)] of the pin log, in the order of time."""
    with open(path, newline="") as file:
        rows = [(int(cycle), what, int(value)) for cycle, what, value in csv.reader(file) if cycle.isdigit()]
    return sorted(rows, key=lambda row: row[0])


def lit_leds(ports):
    """LEDs whose anode is high and cathode low, both driven."""
    anodes = ports["portd"] & ports["ddrd"] & 0xFC
    cathodes = ports["ddrc"] & ~ports["portc"] & 0x3F
    return {i for i in range(LEDS) if anodes >> (2 + i) & 1 and cathodes >> i & 1}


def replay(rows):
    """Yield (cycle, what, value, ports after it, LEDs lit after it)."""
    ports = dict.fromkeys(("portc", "ddrc", "portd", "ddrd"), 0)
    for cycle, what, value in rows:
        if what == "reset":
            ports = dict.fromkeys(ports, 0)
        elif what in ports:
            ports[what] = value
        yield cycle, what, value, ports, lit_leds(ports)


def slots_of(rows):
    """Slots in the log that are whole: from the emitters' light to their dark."""
    found, lit, release, sample, led, lights = [], None, None, None, None, None
    for cycle, what, value, ports, leds in replay(rows):
        if what == "portd" and leds and lit is None:
            lit, release, sample = cycle, None, None
        elif what == "portc" and lit is not None and release is None:
            floating = [i for i in range(LEDS) if not ports["ddrc"] >> i & 1]
            assert len(floating) == 1 and value == 0     # no pull-up left on
            led, release = floating[0], cycle
        elif what == "sample" and release is not None and sample is None:
            assert value == led
            sample, lights = cycle, leds
        elif what == "portd" and not leds and lit is not None:
            if sample is not None:
                found.append(Slot(led, lit, release, sample, cycle, lights))
            lit = None
    return found


def watch(nano, device, tmp_path, seconds):
    path = tmp_path / "pins.csv"
    nano.control.command(f"pins on {path}")
    device.link.sleep(seconds)
    nano.control.command("pins off")
    return read_pins(path)


@pytest.mark.parametrize("exposure_us", [24, 33.25, 100.5, 280])
def test_exposure_is_what_was_asked_for_to_the_cycle_under_load(board, tmp_path, exposure_us):
    """Serial traffic both ways and inference move the release, never the exposure: its jitter is 0 cycles."""
    nano, device = board(models={0: random_model(64).image})
    device.exposure(us=[exposure_us] * LEDS)
    device.set_stream(raw=True, gaze=True, counts=True)
    device.link.sleep(0.01)
    path = tmp_path / "pins.csv"
    nano.control.command(f"pins on {path}")
    for k in range(40):
        device.link.write(wire.encode(lib.SG_MSG_STATUS, k))
        device.link.sleep(0.0037)
    nano.control.command("pins off")
    slots = slots_of(read_pins(path))
    assert len(slots) > 200 and {slot.led for slot in slots} == set(range(LEDS))
    assert {slot.sample - slot.release for slot in slots} == {int(exposure_us * CYCLES_PER_US)}
    for slot in slots:
        assert slot.lights == set(range(LEDS)) - {slot.led}
        assert 4 * CYCLES_PER_US <= slot.release - slot.lit <= 7 * CYCLES_PER_US
    leds = [slot.led for slot in slots]
    assert all((b - a) % LEDS == 1 for a, b in zip(leds, leds[1:]))


def test_each_led_has_its_own_exposure_and_the_device_reports_it_exactly(board, tmp_path):
    nano, device = board()
    asked = [24, 57.75, 100, 150.25, 222, 280]
    device.exposure(us=asked)
    device.set_stream(counts=True)
    device.link.sleep(0.01)
    slots = slots_of(watch(nano, device, tmp_path, 0.1))
    assert {(slot.led, (slot.sample - slot.release) / CYCLES_PER_US) for slot in slots} == set(enumerate(asked))
    frames = collect(device, 20)
    assert {frame.counts.exposure_us_q2 for frame in frames[10:]} == {tuple(int(4 * us) for us in asked)}


def test_frame_clock_is_steady_and_timestamps_follow_it(board, tmp_path):
    """Slots do not drift: the release moves by interrupt latency only, and t_us by less than a microsecond a frame."""
    nano, device = board(models={0: random_model(64).image})
    device.exposure(us=[280] * LEDS)
    device.set_stream(raw=True, gaze=True)
    rows = watch(nano, device, tmp_path, 1.0)
    releases = [slot.release for slot in slots_of(rows) if slot.led == 0]
    late = [(release - releases[0]) - k * FRAME_CYCLES for k, release in enumerate(releases)]
    print(f"release jitter over {len(late)} frames: {max(late) - min(late)} cycles")
    assert len(late) > 250 and max(late) - min(late) <= 20 * CYCLES_PER_US
    frames = collect(device, 250)[20:]
    off = [(frame.t_us - frames[0].t_us) - 3600 * (frame.seq - frames[0].seq) for frame in frames]
    assert max(off) - min(off) <= 12
    # Six mid-exposures 600 us apart: the last sample is 2.5 slots and half an exposure after their mean.
    assert {abs(frame.raw.span_us - 1640) <= 12 for frame in frames} == {True}
    assert device.lost == 0 and device.status().late_slots == 0


def test_emitters_are_lit_at_most_half_of_any_frame_at_the_longest_exposure(board, tmp_path):
    nano, device = board(models={0: random_model(64).image})
    device.exposure(us=[16383] * LEDS)
    device.set_stream(raw=True, gaze=True)
    device.link.sleep(0.01)
    spans, since = [], None
    for cycle, _, _, _, leds in replay(watch(nano, device, tmp_path, 0.2)):
        if leds and since is None:
            since = cycle
        elif not leds and since is not None:
            spans.append((since, cycle))
            since = None
    assert len(spans) > 300 and max(b - a for a, b in spans) < SLOT_CYCLES // 2
    worst = 0
    for start, _ in spans[:-6]:
        worst = max(worst, sum(min(b, start + FRAME_CYCLES) - a for a, b in spans if start <= a < start + FRAME_CYCLES))
    print(f"lit at most {100 * worst / FRAME_CYCLES:.2f} % of a frame")
    assert worst <= FRAME_CYCLES // 2


def test_lights_are_out_right_after_the_sample(board, tmp_path):
    nano, device = board(models={0: random_model(64).image})
    device.set_stream(raw=True, gaze=True, counts=True)
    slots = slots_of(watch(nano, device, tmp_path, 0.3))
    latest = max(slot.dark - slot.sample for slot in slots)
    print(f"lights out at most {latest / CYCLES_PER_US:.2f} us after the sample")
    assert 0 < min(slot.dark - slot.sample for slot in slots) and latest <= 12 * CYCLES_PER_US


@pytest.mark.parametrize("flags", [[], ["-DHANG_LIT"]], ids=["main_loop", "everything_while_lit"])
def test_a_hang_ends_in_the_dark_within_130_ms_and_is_reported_as_watchdog(virtual_nano, any_map, port_with, repo_root, tmp_path, flags):
    elf = port_with(repo_root / "tests" / "target" / "hang.c", *flags)
    nano = virtual_nano(map=any_map, unpaced=True, person=1, app=elf, state_dir=tmp_path / "state")
    link = open_link(nano.port)
    link.sleep(1.0)                         # the bootloader is still listening
    path = tmp_path / "pins.csv"
    nano.control.command(f"pins on {path}")
    link.sleep(1.5)                         # started, hung, reset, and so on for ever
    nano.control.command("pins off")
    rows = read_pins(path)
    resets = [cycle for cycle, what, _ in rows if what == "reset"]
    assert len(resets) >= 2 and nano.control.counters()["wdt_resets"] >= 2
    for start, reset in zip(resets, resets[1:]):
        run = [row for row in rows if start <= row[0] <= reset]
        samples = [cycle for cycle, what, _ in run if what == "sample"]
        assert len(samples) > 100           # it sensed before it hung
        # The 100th frame's last sample is when the main loop took its last turn.
        hung = samples[2 * 6 * 100 - 1] if len(samples) >= 2 * 6 * 100 else samples[-1]
        assert reset - hung <= 130_000 * CYCLES_PER_US
    *_, (_, what, _, _, leds) = replay([row for row in rows if row[0] <= resets[-1]])
    assert what == "reset" and leds == set()

    link.write(b"\0")
    decoder, answers, end = wire.Decoder(), [], link.now() + 1.0
    while not answers and link.now() < end:
        answers = decoder.feed(link.read(256, 0.01))
        link.write(b"\0")
    status = wire.parse(Status, answers[0].body)
    assert status.reset_cause == lib.SG_RESET_WATCHDOG
    link.close()


def test_reset_cause_is_told_apart(board):
    nano, device = board()
    assert device.status().reset_cause == lib.SG_RESET_EXTERNAL     # opening the port reset it
    device.reboot()
    assert device.status().reset_cause == lib.SG_RESET_WATCHDOG
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    assert device.status().reset_cause == lib.SG_RESET_POWER
    device.link.reset()
    device.connect()
    status = device.status()
    assert status.reset_cause == lib.SG_RESET_EXTERNAL


def test_boots_are_counted_through_power_cycles(board):
    nano, device = board()
    assert device.status().boot_count == 1
    device.link.sleep(0.5)
    for expected in (2, 3):
        nano.control.power(False)
        nano.control.power(True)
        device.connect()
        assert device.status().boot_count == expected
        device.link.sleep(0.5)
    assert device.status().eeprom_writes == 1


def test_exposures_start_from_the_stored_ones(board):
    nano, device = board()
    device.exposure(us=[40, 50, 60, 70, 80, 90])
    device.link.sleep(0.5)
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    assert device.exposure().exposure_us == (40, 50, 60, 70, 80, 90) and not device.exposure().automatic
