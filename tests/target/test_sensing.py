# SPDX-License-Identifier: Apache-2.0
"""The sensing engine as the pins show it: exact exposures, a clock without jitter, lights that go out.

On the real port with an application of the tests' own (bad_app.c), which can be told any exposure and timing.
"""

import random

import pytest

from port_app import (CYCLES_PER_US, LEDS, PAIRS, PHOTODIODE_PAIRS, SLOTS, TYPE_CYCLE, PortApp,
                      lit_windows, parse_cycle, samples)
from sparsegaze.transport import open_link
from sparsegaze.wire import lib

SLOT = 888
LIT_MOST = 3 * SLOT + 100           # cycles of a phase of 6 slots
BOOT_S = 1.2                        # Optiboot listens for a second
LOCKOUT_S = 1.0


def most(slot, pairs=PAIRS):
    """The longest exposure of each channel at a slot, cycles."""
    found = [2 * slot - 120] * LEDS
    for _, second in pairs:
        found[second] += slot
    return found


@pytest.fixture
def port_app(virtual_nano, any_map, port_with, repo_root, tmp_path):
    """Factory: port_app(bad="NOTHING", **options) -> PortApp that runs, its lights no longer locked out."""

    def start(bad="NOTHING", settle_s=BOOT_S + LOCKOUT_S + 0.1, **options):
        elf = port_with(repo_root / "tests" / "target" / "bad_app.c", f"-DBAD={bad}")
        options.setdefault("map", any_map)
        nano = virtual_nano(unpaced=True, person=1, app=elf, **options)
        link = open_link(nano.port)
        link.sleep(settle_s)
        links.append(link)
        return PortApp(nano, link, tmp_path)

    links = []
    yield start
    for link in links:
        link.close()


def taken(app, exposures, seconds=0.02):
    """Exposures in force, samples after that: those whose release was seen, or that were held."""
    took = app.expose(exposures)
    app.link.sleep(0.02)
    return took, samples(app.moments(seconds))[2 * LEDS:]


@pytest.mark.parametrize("seed", range(3))
def test_every_exposure_is_what_was_taken_to_the_cycle(port_app, seed):
    """Any exposures, any slot: each sensor floats as long as planned before its sample, lit as unlit."""
    app, rng = port_app(), random.Random(seed)
    for k in range(16):
        slot = rng.choice([SLOT, SLOT, 900, 1111, 1777])
        assert app.timing(period_cycles=SLOTS * slot).period_cycles == SLOTS * slot
        asked = [rng.choice([64, 136, m, rng.randrange(136, m + 1)]) for m in most(slot)]
        took, found = taken(app, asked)
        for a, b in zip(asked, took):
            assert abs(a - b) <= 96 or (a, b) == (64, 136)
        assert all(took[a] == asked[a] for a, _ in PAIRS)
        assert len(found) > 100
        wrong = [s for s in found if s.released is None or s.cycle - s.released != took[s.channel]]
        assert not wrong, (slot, asked, wrong[:4])
    assert app.status().late_slots == 0


def test_exposures_that_fall_into_each_others_way_move_by_a_few_per_cent_or_merge(port_app):
    app = port_app()
    for apart in (-95, -60, -48, -47, -1, 0, 1, 47, 48, 60, 95):
        asked = [1000] * LEDS
        for a, b in PAIRS:
            asked[b] = asked[a] + SLOT + apart
        took, found = taken(app, asked, 0.004)
        assert all(s.cycle - s.released == took[s.channel] for s in found)
        for a, b in PAIRS:
            moved = took[b] - (took[a] + SLOT)
            assert took[a] == asked[a] and moved in (-96, 0, 96)
            assert abs(took[b] - asked[b]) <= 0.03 * asked[b]


def test_frame_clock_has_no_jitter_at_all_under_load_both_ways(port_app):
    """Conversions are triggered by hardware: every sample is a whole number of slots after every other."""
    app = port_app()
    app.noise(True)

    def storm(seconds):
        for _ in range(round(seconds / 0.0015)):
            app.link.write(b"s" * 100)
            app.link.sleep(0.0015)

    cycles = [cycle for what, _, cycle in app.moments(0.3, storm) if what == "adc"]
    assert len(cycles) > 5000 and {b - a for a, b in zip(cycles, cycles[1:])} == {SLOT}
    app.noise(False)


def test_a_release_that_serial_bytes_delay_is_measured(port_app):
    """Bytes back to back both ways: what a reading says it was late by is what the pins did."""
    app = port_app()
    app.expose([700, 400, 900, 1300, 800, 333])
    app.link.sleep(0.02)
    app.link.write(b"c\1")
    storm = [0]

    def load(seconds):
        for _ in range(round(seconds / 0.001)):
            app.link.write(b"?" * 60)
            app.link.sleep(0.001)
            storm[0] += 1

    found = samples(app.moments(0.3, load))
    late = [took - (s.cycle - s.released) for s in found if s.released
            for took in [(700, 400, 900, 1300, 800, 333)[s.channel]]]
    print(f"{sum(x > 0 for x in late)} of {len(late)} releases late, worst {max(late)} cycles")
    assert min(late) >= 0 and max(late) < 255


@pytest.mark.parametrize("bad", ["SHORT_BLOCK"])
def test_lateness_in_the_reading_is_lateness_at_the_pin(port_app, bad):
    app = port_app(bad)
    exposure = (1500, 1000, 900, 1300, 2000, 1333)
    app.expose(exposure)
    app.link.sleep(0.02)
    app.link.write(b"c\1")
    moments = app.moments(0.6)
    stated = parse(app)[3:500]
    found = samples(moments)
    # Whole cycles, told apart by their first conversion: 12 samples each, lit before unlit of each pair.
    while found and (found[0].channel != 5 or not found[0].lit):
        found.pop(0)
    pins = [tuple(exposure[s.channel] - (s.cycle - s.released) for s in found[k:k + 12])
            for k in range(0, len(found) - 11, 12)]
    order = [(i, lit) for a, b in PAIRS for lit in (True, False) for i in (a, b)]
    told = [tuple((c.late_lit if lit else c.late_unlit)[i] for i, lit in order) for c in stated]
    late_pins = [row for row in pins if any(row)]
    late_told = [row for row in told if any(row)]
    assert len(late_pins) > 5 and late_told
    assert set(late_told) <= set(late_pins)


def parse(app):
    """Cycles that were sent meanwhile."""
    return [parse_cycle(packet.body) for packet in app.packets(0.05) if packet.type == TYPE_CYCLE]


def test_a_plan_swaps_whole(port_app):
    """While exposures change all the time, every cycle's twelve exposures are of one request."""
    app = port_app()
    asked = [[300 + 140 * k + i for i in range(LEDS)] for k in range(8)]

    def change(_):
        for exposures in asked:
            app.expose(exposures)
            app.link.sleep(0.0033)
        app.link.sleep(0.01)

    found = samples(app.moments(0, change))
    while found[0].channel != 5 or not found[0].lit:
        found.pop(0)
    seen = []
    for k in range(0, len(found) - 11, 12):
        # The requests' own bytes make releases late, never by 140 cycles.
        cycle = [next((n for n, exposures in enumerate([[1600] * LEDS, *asked])
                       if exposures[s.channel] - 139 <= s.cycle - s.released <= exposures[s.channel]), None)
                 for s in found[k:k + 12]]
        assert len(set(cycle)) == 1, cycle
        seen.append(cycle[0])
    assert sorted(set(seen)) == list(range(9)) and seen == sorted(seen)


def test_device_time_and_exposures_hold_across_many_wraps_of_the_timer(port_app):
    """Timer1 wraps every 4.1 ms; timestamps follow the samples for half a second."""
    app = port_app()
    exposure = (300, 1500, 700, 2000, 900, 1234)
    took = app.expose(exposure)
    app.link.sleep(0.02)
    app.link.write(b"c\1")
    moments = app.moments(0.5)
    cycles = parse(app)
    lit = [s for s in samples(moments) if s.lit]
    while lit[0].channel != 5:
        lit.pop(0)
    means = [sum(s.cycle - took[s.channel] / 2 for s in lit[k:k + 6]) / 6 for k in range(0, len(lit) - 5, 6)]
    period = SLOTS * SLOT
    assert len(cycles) > 400
    for a, b in zip(cycles, cycles[1:]):
        steps = round((b.t_us - a.t_us) * CYCLES_PER_US / period)
        assert steps >= 1 and abs((b.t_us - a.t_us) - steps * period / CYCLES_PER_US) <= 1
    # Device time began with the application: the offset is one constant, within rounding.
    first = means[0] / CYCLES_PER_US - cycles[0].t_us
    misses = [min(abs(mean / CYCLES_PER_US - first - c.t_us) for mean in means) for c in cycles[:450]]
    assert max(misses) <= 1.1
    # span_us: the last unlit sample is at slot 17.
    assert all(abs(c.span_us - (9.5 * SLOT + sum(took) / 12) / CYCLES_PER_US) <= 1 for c in cycles)


def test_timing_changes_begin_a_frame_and_keep_every_exposure_exact(port_app):
    app = port_app()
    took = app.expose([500, 600, 700, 800, 900, 1000])
    for timing in (dict(period_cycles=SLOTS * 1000), dict(repeats=4), dict(frame_cycles=64000, repeats=2),
                   dict(frame_cycles=16_000_000 // 100), dict(period_cycles=SLOTS * 1777), dict()):
        took_timing = app.timing(**timing)
        app.link.sleep(0.05)
        found = samples(app.moments(0.06))[2 * LEDS:]
        cycles = app.cycles(0.06)
        assert found and all(s.cycle - s.released == took[s.channel] for s in found), timing
        # Frames: `left` counts down within one seq, and every frame is whole.
        frames = {}
        for c in cycles:
            frames.setdefault(c.seq, []).append(c.left)
        whole = list(frames.values())[1:-1]
        countdown = list(range(took_timing.repeats))[::-1]
        assert whole and all(left == countdown for left in whole), (timing, frames)


@pytest.mark.parametrize("rate_hz", [1, 10, 100, 490])
def test_pauses_between_frames_are_dark_and_exact(port_app, rate_hz):
    app = port_app()
    frame = 16_000_000 // rate_hz
    took = app.timing(frame_cycles=frame, repeats=1)
    app.link.sleep(0.2)
    moments = app.moments(max(0.06, 2.5 / rate_hz))
    began = [cycle for what, value, cycle in moments if what == "adc" and value == 5][::2]
    periods = {b - a for a, b in zip(began, began[1:])}
    assert periods == {took.frame_cycles} and abs(took.frame_cycles - frame) <= 0.01 * frame
    lit = lit_windows(moments)
    assert lit and sum(end - begin for _, begin, end in lit) / (moments[-1][2] - moments[0][2]) \
        <= 1.1 * 3 * LIT_MOST / frame + 0.3 / max(1, len(began))
    assert max(end - begin for _, begin, end in lit) <= LIT_MOST


def test_sleep_is_asked_for_and_changes_no_exposure(port_app):
    app = port_app()
    took = app.expose([500, 600, 700, 800, 900, 1000])
    before = app.nano.control.counters()["asleep_cycles"]
    app.link.sleep(0.1)
    assert app.nano.control.counters()["asleep_cycles"] == before
    app.timing(sleep=1)
    app.link.sleep(0.01)
    found = samples(app.moments(0.1))[2 * LEDS:]
    asleep = app.nano.control.counters()["asleep_cycles"] - before
    print(f"asleep {100 * asleep / 1.76e6:.0f} % of the time at full rate")
    assert asleep > 0.35 * 1.76e6
    assert found and all(s.cycle - s.released == took[s.channel] for s in found)


@pytest.mark.parametrize("emitter", range(LEDS))
def test_probe_lights_one_emitter_only_and_it_does_not_sense(port_app, emitter):
    app = port_app()
    app.timing(probe=emitter)
    app.link.sleep(0.02)
    moments = app.moments(0.02)
    assert {mask for mask, _, _ in lit_windows(moments)} == {1 << emitter}
    found = samples(moments)[2 * LEDS:]
    assert emitter not in {s.channel for s in found}
    assert all(s.released is not None for s in found)
    assert {s.channel for s in found if s.lit} == set(range(LEDS)) - {emitter}


def test_photodiodes_have_emitters_on_their_own_pins(port_app, repo_root):
    app = port_app(headset=repo_root / "headsets" / "nextgaze_nano.toml", map=False)
    assert app.timing(wiring=lib.SG_WIRING_PHOTODIODES).wiring == lib.SG_WIRING_PHOTODIODES
    took = app.expose(most(SLOT, PHOTODIODE_PAIRS))
    app.link.sleep(0.02)
    moments = app.moments(0.02)
    found = samples(moments)[2 * LEDS:]
    assert all(s.cycle - s.released == took[s.channel] for s in found)
    assert {mask for mask, _, _ in lit_windows(moments)} == {1, 2, 4}
    assert {(s.mask, s.channel) for s in found if s.lit} == {
        (1 << p, i) for p in range(3) for i in PHOTODIODE_PAIRS[p]}


def test_no_request_lights_longer_or_more_than_four(port_app):
    """Exposures and periods far beyond the limits, lights on and off: 4 emitters, 3 of 6 slots."""
    app = port_app()
    for slot, exposures in ((SLOT, [65535] * LEDS), (SLOT, [0] * LEDS), (1777, [65535] * LEDS)):
        app.timing(period_cycles=SLOTS * slot if slot == SLOT else 65535)
        took = app.expose(exposures)
        assert all(64 <= t <= m for t, m in zip(took, most(slot)))
        app.link.sleep(0.02)
        moments = app.moments(0.05)
        windows = lit_windows(moments)
        assert windows and max(bin(mask).count("1") for mask, _, _ in windows) == 4
        assert max(end - begin for _, begin, end in windows) <= 3 * slot + 100
        span = moments[-1][2] - moments[0][2]
        assert sum(end - begin for _, begin, end in windows) <= 0.52 * span
    app.timing(lights=0)
    app.link.sleep(0.02)
    assert not any(what == "lit" and value for what, value, _ in app.moments(0.05))


def test_lights_are_locked_out_for_a_second_after_a_watchdog_reset(port_app):
    """A loop of hangs is dark for all but its last 120 ms: below 11 % of the time."""
    app = port_app("HANG_LOOP", settle_s=0.5)
    resets = app.nano.control.counters()["wdt_resets"]
    moments = app.moments(6.0)
    windows = lit_windows(moments)
    hangs = app.nano.control.counters()["wdt_resets"] - resets
    assert hangs >= 3
    lit = sum(end - begin for _, begin, end in windows)
    print(f"{hangs} hangs in 6 s: lit {100 * lit / (6 * 16e6):.1f} % of the time")
    assert lit < 0.5 * 0.11 * 6 * 16e6


def test_the_lockout_is_reported_and_ends(port_app):
    app = port_app("HANG_LIT", settle_s=BOOT_S)
    app.link.sleep(0.8)
    status = app.status()
    # It hung 0.4 s after its start and came back by the watchdog: locked out.
    assert status.reset_cause == lib.SG_RESET_WATCHDOG and status.alarm & lib.SG_ALARM_LOCKOUT
    assert not any(what == "lit" and value for what, value, _ in app.moments(0.05))


@pytest.mark.parametrize("bad", ["HANG_LOOP", "HANG_LIT"])
def test_a_hang_ends_in_the_dark_within_130_ms(port_app, bad):
    app = port_app(bad, settle_s=0.0)
    moments = app.moments(3.5)
    windows = lit_windows(moments)
    longest = max(windows, key=lambda w: w[2] - w[1])
    took = longest[2] - longest[1]
    print(f"longest light {took / 16000:.1f} ms")
    if bad == "HANG_LIT":
        assert 100_000 * CYCLES_PER_US < took <= 130_000 * CYCLES_PER_US
    else:
        assert took <= LIT_MOST


def test_a_stray_jump_to_the_beginning_puts_the_lights_out_first_and_for_a_second(port_app):
    """No reset: the pins stay as they are until somebody sets them, and what comes first takes 1.6 ms."""
    app = port_app("STRAY", settle_s=0.0)
    moments = app.moments(3.0)
    windows = lit_windows(moments)
    longest = max(end - begin for _, begin, end in windows)
    dark = moments[-1][2] - windows[-1][2]
    print(f"longest light {longest} cycles, then dark for {dark / 16e6:.2f} s")
    assert longest <= LIT_MOST and dark >= 16_000_000
    assert app.status().alarm & lib.SG_ALARM_LOCKOUT


def test_a_cycle_that_interrupts_were_kept_from_is_given_up_and_nothing_lights_twice(port_app):
    """250 us without interrupts: triggers are missed. Dark at once, and for a whole cycle, and counted."""
    app = port_app("BLOCK")
    before = app.status()
    moments = app.moments(1.0)
    after = app.status()
    assert after.late_slots - before.late_slots > 20
    windows = lit_windows(moments)
    span = moments[-1][2] - moments[0][2]
    for i in range(LEDS):
        assert sum(end - begin for mask, begin, end in windows if mask >> i & 1) <= 0.345 * span
    assert max(end - begin for _, begin, end in windows) <= LIT_MOST + 250 * CYCLES_PER_US


def test_cycles_that_come_while_the_main_loop_works_are_counted_late(port_app):
    app = port_app("SLOW")
    before = app.status()
    app.link.sleep(1.0)
    after = app.status()
    assert 985 <= after.frames - before.frames <= 1020          # sensing does not wait
    assert after.late_frames - before.late_frames >= 700 and after.late_slots == before.late_slots
    assert after.cycles_max > 5000 * CYCLES_PER_US * 0.8


def test_supply_is_measured_and_a_sag_raises_the_alarm(port_app):
    app = port_app()
    app.link.sleep(1.5)
    status = app.status()
    # The reference is the bandgap, 10 % part to part.
    assert 4400 <= status.supply_mv <= 5600 and not status.alarm & lib.SG_ALARM_SUPPLY
    app.nano.control.supply(4.7)
    app.link.sleep(2.2)
    assert app.status().alarm & lib.SG_ALARM_SUPPLY
    app.nano.control.supply(5.0)
    app.link.sleep(2.2)
    assert not app.status().alarm & lib.SG_ALARM_SUPPLY


def test_a_conversion_of_the_supply_is_told_as_what_the_capacitor_held(port_app):
    app = port_app()
    cycles = app.cycles(2.5)
    held = [c.held for c in cycles if c.held]
    assert 1 <= len(held) <= 4 and all(130 <= code <= 235 for code in held)
