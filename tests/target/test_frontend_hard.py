# SPDX-License-Identifier: Apache-2.0
"""The front end's hard cases: light, exposure, time, commands. The whole firmware in the virtual Nano, with a
model of the simulated person who wears it: a gaze that is called valid is never wild.
"""

import shutil

import numpy as np
import pytest

from sparsegaze import wire
from sparsegaze.device import Device
from sparsegaze.mapfile import write_map
from sparsegaze.timing import LATE_CYCLES, Timing
from sparsegaze.wire import lib
from worn import CYCLES_PER_US, LIGHT, PERSON, PLACES, Worn, calibrated, flags, gazes, jitter

FIELD = ((0, 0), (-12, -12), (12, -12), (-12, 12), (12, 12))
PULSE_CYCLES = Timing().lit_cycles(LATE_CYCLES)      # what eye safety assumes at full rate, whatever comes


@pytest.fixture
def worn(virtual_nano, firmware_elf, tmp_path_factory, tmp_path):
    """Factory: worn(**options of VirtualNano) -> Worn, calibrated."""
    devices = []

    def start(**options):
        state = tmp_path / "state"
        shutil.copytree(calibrated(tmp_path_factory.getbasetemp(), firmware_elf), state, dirs_exist_ok=True)
        nano = virtual_nano(person=PERSON, unpaced=True, app=firmware_elf, state_dir=state, **options)
        devices.append(Device(nano.port))
        return Worn(nano, devices[-1])

    yield start
    for device in devices:
        device.close()


def nothing_lost(before, after, frames=()):
    """Between two Status, and in the numbers of `frames`. A late frame is late, not lost: printed."""
    print({name: getattr(after, name) - getattr(before, name)
           for name in ("late_frames", "late_slots", "tx_dropped", "rx_overrun", "rx_bad", "frames")})
    assert (np.diff([frame.seq for frame in frames]) == 1).all()
    assert after.late_slots == before.late_slots and after.tx_dropped == before.tx_dropped


# -- light ---------------------------------------------------------------------------------------------------


def test_in_pitch_dark_the_gaze_is_right_at_full_rate(worn):
    """No light but the headset's own; what every other case here is measured against."""
    one = worn(ambient="dark")
    one.settle()
    for place in PLACES:
        one.look(place)
        one.settle(0.1)
        before = one.device.status()
        frames = one.run(0.25)
        one.good(frames, f"at {place}", 0.995)
        period = np.diff([frame.t_us for frame in frames])
        print(f"{1e6 / period.mean():.1f} Hz, {period.min()} .. {period.max()} us")
        assert not (flags(frames) & (LIGHT | lib.SG_FLAG_FAULT)).any()
        nothing_lost(before, one.device.status(), frames)
        assert 1e6 / period.mean() >= 1000


def test_without_any_light_at_all_it_is_starved_and_no_gaze(worn):
    """A headset in its case, or before nothing: LEDs are alive and nothing comes back."""
    one = worn(map=False)
    one.settle(1.0)
    frames = one.run(0.1)
    assert (flags(frames) & lib.SG_FLAG_STARVED).all() and not (flags(frames) & lib.SG_FLAG_VALID).any()
    status = one.device.status()
    print(status.exposure_us, status.faults)
    assert min(status.exposure_us) >= 85 and status.starved > 0


def test_in_full_sun_nothing_saturates_after_five_frames_and_the_gaze_stays(worn):
    """The sun through the gap at the face, ten times our own light, all at once; four cycles a frame."""
    one = worn()
    one.device.settings(rate_hz=250, repeats=4)
    one.settle()
    dark = one.good(one.run(0.5), "dark", 0.99)
    one.control.set("ambient", "sun_gap")
    frames = one.run(1.2)
    one.never_wild(frames, "sun")
    saturated = np.flatnonzero(flags(frames) & lib.SG_FLAG_SATURATED)
    print(f"saturated frames {saturated}, exposures {one.device.exposure().exposure_us}")
    assert len(saturated) <= 5 and saturated.max(initial=0) <= 5
    sun = one.good(frames[100:], "sun, settled", 0.95, 3 * 1.5)
    # Straight ahead the dark's error is nearly noise alone, 0.12 deg, and the sun's noise 0.7. Three times
    # the error over the field is the bar: a figure of tools/bench/bench_frontend.py.
    assert sun <= dark + 0.8
    one.control.set("ambient", "dark")
    one.settle()
    one.good(one.run(0.2), "dark again", 0.99)


@pytest.mark.parametrize("na", [20_000, 1_000_000])
def test_light_that_no_exposure_is_short_enough_for_is_flagged(worn, na):
    """Ten times the sun through the gap, and the sun on the die."""
    one = worn()
    one.settle()
    one.control.ambient(na)
    frames = one.run(0.3)
    one.never_wild(frames, f"{na} nA")
    odd = LIGHT | lib.SG_FLAG_OUT_OF_RANGE | lib.SG_FLAG_FAULT
    assert ((flags(frames[50:]) & odd) != 0).mean() > 0.5
    if na > 100_000:
        assert not (flags(frames[5:]) & lib.SG_FLAG_VALID).any()
    one.control.set("ambient", "dark")
    one.settle(1.3)     # a supply measured in the flood may be a false alarm until the next, a second later
    one.good(one.run(0.2), "dark again", 0.99)


def uneven_map(path, brighter=2, times=10.0):
    """A map whose one LED emits and senses ten times as strongly as the rest."""
    gaze = np.linspace(-25, 25, 11)
    elevation, azimuth = np.meshgrid(gaze, gaze, indexing="ij")
    gain = np.ones(6)
    gain[brighter] = times
    angle = 2 * np.pi * np.arange(6) / 6
    slope = 0.012 * np.column_stack([np.cos(angle), np.sin(angle)])
    shape = np.exp(slope[:, 0] * azimuth[..., None] + slope[:, 1] * elevation[..., None])
    smooth = 1e-6 * shape[..., None] * gain[:, None] * gain
    lid = np.array([0.0, 1.0])
    write_map(path, pupil_mm=[3.5], lid_opening=lid, slip_mm=([0], [0], [0]), elevation_deg=gaze,
              azimuth_deg=gaze, smooth=np.broadcast_to(smooth, (1, 1, 1, 1, 2, *smooth.shape)),
              glint_lid_opening=lid, glint_elevation_deg=[-25, 25], glint_azimuth_deg=[-25, 25],
              glint=np.zeros((1, 1, 1, 2, 2, 2, 6, 6)))
    return str(path)


def test_one_led_ten_times_brighter_than_the_rest_has_its_own_exposure(worn, tmp_path):
    brighter = 2
    one = worn(map=uneven_map(tmp_path / "uneven.sgmap", brighter))
    one.settle(1.0)
    frames = one.run(0.1, counts=True)
    exposure = np.array(one.device.exposure().exposure_us)
    lit = np.array([frame.counts.lit_code for frame in frames if frame.counts]).mean(axis=0)
    others = [k for k in range(6) if k != brighter]
    print(f"exposures {exposure}, codes {lit.round()}")
    assert not (flags(frames) & LIGHT).any()
    assert exposure[brighter] < 0.5 * exposure[others].max() and exposure[brighter] == exposure.min()
    assert lit.max() < 1000 and lit[brighter] > 200 and lit.min() > 20


@pytest.mark.parametrize("repeats, least, times", [(4, (0.95, 0.99), 1.1), (1, (0.1, 0.9), 1.2)])
def test_a_step_of_a_thousand_in_the_middle_of_an_exposure(worn, repeats, least, times):
    """20 up, 20 down at cycles that no exposure knows: few saturated frames, then the new level's error.

    least   share of valid frames, in 2 uA and in 2 nA. At a cycle a frame the sunlight's noise is 1 deg RMS:
            what moves by it faster than an eye is not called a gaze (0.2 to 0.65 of them are).
    """
    one = worn()
    one.device.settings(repeats=repeats)
    low, high, frame_us = 2.0, 2000.0, 1000 * repeats
    gap_us = 40_000 + 60 * frame_us
    rng = np.random.default_rng(1)
    one.control.ambient(low)
    one.settle()
    moment, steps = one.now_us() + 200_000, []
    for _ in range(20):
        for na in (high, low):
            moment += gap_us + int(rng.integers(0, 1000))
            one.control.set_at(moment * CYCLES_PER_US + int(rng.integers(0, 16)), "ambient_na", na)
            steps.append((moment, na))
    frames = one.run((moment - one.now_us() + gap_us) * 1e-6)
    one.never_wild(frames, "steps")
    moments, error = one.times(frames), one.error(frames)
    saturated = (flags(frames) & lib.SG_FLAG_SATURATED) != 0
    for name, level, share in (("up", high, least[0]), ("down", low, least[1])):
        after = [moments - step for step, na in steps if na == level]
        most = max(saturated[(since >= 0) & (since < gap_us - 5000)].sum() for since in after)
        soon, later = (np.concatenate([error[(since >= begin) & (since < end)] for since in after])
                       for begin, end in ((10.5 * frame_us, 30 * frame_us), (40 * frame_us, gap_us - 5000)))
        shares = np.isfinite(soon).mean(), np.isfinite(later).mean()
        means = [np.nanmean(part) if np.isfinite(part).any() else np.inf for part in (soon, later)]
        print(f"{name}: at most {most} saturated; after 10 frames, after 40: {means} deg, valid {shares}")
        assert most <= 5
        assert min(shares) > share and means[0] <= times * means[1]


@pytest.mark.parametrize("rate_hz, repeats, hz", [
    (0, 1, 100.0), (0, 1, 120.0), (0, 1, 100.1), (500, 1, 100.0), (250, 1, 120.0),
    (250, 4, 120.0), (250, 4, 100.0), (100, 1, 101.0), (100, 4, 100.3), (60, 1, 120.5)])
def test_flicker_and_its_beat_with_the_frame_rate(worn, rate_hz, repeats, hz):
    """50 % deep, of the signal's size, against the same light that does not flicker, over five places.

    The bar of 1.2 is the benchmark's, over 25 places of five persons (1.11 at 4 cycles a frame). Here, with one
    person, five places and 630 frames, 0.96 to 1.21 times were seen at 250 Hz and below: held to 1.25.

    rate_hz     0: the full one. At 1000 and 500 Hz with one cycle a frame it is 1.2 to 1.4 times (crests make
                exposures 1.15 to 1.3 times shorter, interpolated codes bear 1.3 times a mean's noise), and
                up to 15 % of the gazes move faster than an eye and are not VALID.
    """
    one = worn()
    one.device.settings(rate_hz=rate_hz, repeats=repeats)
    errors = []
    for depth in (0.0, 0.5):
        one.control.ambient(200.0, depth, hz)
        one.settle(0.6)
        each = []
        for place in FIELD:
            one.look(place)
            one.settle(0.1 if rate_hz in (0, 250, 500) else 0.6)
            frames = one.run(0.2 if rate_hz == 0 else 0.5)
            one.never_wild(frames, f"{depth} deep at {place}")
            assert not (flags(frames) & lib.SG_FLAG_SATURATED).any()
            found = one.error(frames)
            each.append((np.nanmean(found), np.isfinite(found).mean()))
        error, share = np.mean(each, axis=0)
        errors.append(error)
        print(np.round(each, 2).tolist())
        assert share >= (0.95 if repeats > 1 else 0.8)
    print(f"{rate_hz or 'full'} Hz, {hz} Hz: {errors[1]:.3f} deg, steady {errors[0]:.3f}")
    assert errors[1] <= (1.5 if rate_hz in (0, 500) else 1.25) * errors[0]


# -- exposure ------------------------------------------------------------------------------------------------


def test_exposures_at_their_lower_limit_are_readings_or_starved(worn):
    one = worn()
    one.settle()
    one.device.exposure(us=[0] * 6)
    one.settle(0.05)
    frames = one.run(0.3)
    least = np.array(one.device.exposure().exposure_us)
    print(f"exposures {least}")
    # The first of a pair at the limit; its second where a late release still comes before the sample.
    assert (least >= 4.0).all() and (least <= 13.0).all() and least[[1, 2, 5]] == pytest.approx(4.0, abs=0.5)
    assert not (flags(frames) & lib.SG_FLAG_SATURATED).any()
    one.never_wild(frames, "4 us")
    one.device.exposure(auto=True)
    one.settle()
    one.good(one.run(0.2), "automatic again", 0.99)


def test_exposures_at_their_upper_limit_are_clipped_and_saturate_with_a_flag(worn):
    one = worn(light="bright")
    one.settle()
    held = one.device.exposure(us=[4000] * 6)
    assert 95 < min(held.exposure_us) and max(held.exposure_us) <= one.device.hello.exposure_max_us
    one.settle(0.05)
    frames = one.run(0.2)
    assert (flags(frames) & lib.SG_FLAG_SATURATED).all() and not (flags(frames) & lib.SG_FLAG_VALID).any()
    one.device.exposure(auto=True)
    one.settle()
    assert not (flags(one.run(0.2)) & lib.SG_FLAG_SATURATED).any()


@pytest.mark.parametrize("share", [0.75, 0.5])
def test_an_exposure_change_alone_moves_the_gaze_by_less_than_its_noise(worn, share):
    """The board is one whose linearity has been calibrated."""
    one = worn()
    one.settle()
    chosen = np.array(one.device.exposure().exposure_us)
    one.device.exposure(us=chosen)
    one.settle(0.1)
    before = gazes(one.run(0.4))
    one.device.exposure(us=chosen * share)
    one.settle(0.1)
    after = gazes(one.run(0.4))
    moved = np.hypot(*(after.mean(axis=0) - before.mean(axis=0)))
    noise = np.hypot(*(np.sqrt(2) * jitter(before)))
    print(f"{share} of {chosen.round(1)} us: moved {moved:.3f} deg, RMS-S2S {noise:.3f} deg")
    assert moved <= noise


# -- time ----------------------------------------------------------------------------------------------------


def test_device_time_is_even_through_hundreds_of_timer_wraps(worn):
    """Timer1's 16 bits wrap every 4096 us, the byte that counts its wraps after 1.05 s: 2.2 s of frames."""
    one = worn()
    one.settle(0.2)
    t = np.array([frame.t_us for frame in one.run(2.2)])
    steps = np.diff(t)
    print(f"{len(t)} frames, steps {steps.min()} .. {steps.max()} us over {np.ptp(t) // 4096} wraps")
    assert len(t) > 2150 and np.ptp(steps) <= 1 and np.ptp(t) > 500 * 4096


def test_the_sequence_wraps_without_a_gap_and_the_clock_goes_on(worn):
    """65536 frames at full rate, most of them unheard; 16,000 wraps of Timer1 lie behind then. (Device time
    itself wraps after 71 minutes, too long for a test: the host's part in that is tested with the stream.)
    """
    one = worn()
    first = one.run(0.1)[-1]
    one.device.set_stream()
    period_us = one.device.settings().frame_period_us
    one.device.link.sleep((65536 - first.seq - 700) * 1e-6 * period_us)
    before = one.device.status()
    frames = one.run(1.0)
    seq = np.array([frame.seq for frame in frames]) & 0xFFFF
    steps = np.diff([frame.t_us for frame in frames])
    print(f"numbers {seq[0]} .. {seq[-1]}, steps {steps.min()} .. {steps.max()} us")
    assert first.seq < 2000 and seq[0] > 60_000 and seq[-1] < 5000
    assert (np.diff(seq) % 65536 == 1).all() and np.ptp(steps) <= 1
    passed = frames[-1].t_us - first.t_us
    assert abs(passed - period_us * (65536 + int(seq[-1]) - first.seq)) <= 2
    nothing_lost(before, one.device.status(), frames)
    one.good(frames, "over the wrap", 0.995)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_clock_off_by_one_per_cent_changes_nothing_in_device_time(worn, seed):
    """Either way, by the seed; mains and host keep true time."""
    one = worn(seed=seed, physics={"clock.error": 0.01})
    one.control.ambient(100.0, 0.5, 100)
    one.settle()
    before = one.device.status()
    frames = one.run(0.5)
    steps = np.diff([frame.t_us for frame in frames])
    assert np.ptp(steps) <= 1 and 1e6 / steps.mean() >= 1000
    assert one.device.bad == 0 and not (flags(frames) & LIGHT).any()
    after = one.device.status()
    nothing_lost(before, after, frames)
    assert after.rx_bad == 0 and after.rx_overrun == 0
    if seed == PERSON:
        one.good(frames, "clock off", 0.99)


# -- commands ------------------------------------------------------------------------------------------------


def test_a_command_storm_at_full_frame_rate_loses_and_delays_nothing(worn):
    """The next request as soon as the last is answered, long ones and short, while every gaze is sent."""
    one = worn()
    one.settle()
    one.device.set_stream(gaze=True)
    one.settle(0.05)
    link, before = one.device.link, one.device.status()
    one.control.counters_clear()
    requests = [(lib.SG_MSG_STATUS, b""), (lib.SG_MSG_EXPOSURE, wire.body("struct sg_exposure")),
                (lib.SG_MSG_PING, wire.body("struct sg_ping", token=7)), (lib.SG_MSG_MODEL_INFO, b""),
                (lib.SG_MSG_SETTINGS, wire.body("struct sg_settings")), (lib.SG_MSG_HELLO, b""),
                (lib.SG_MSG_CURVE, wire.body("struct sg_curve")),
                (lib.SG_MSG_INFER, wire.body("struct sg_infer")),
                (lib.SG_MSG_RECENTRE, wire.body("struct sg_recentre")),
                (lib.SG_MSG_MODEL_READ, wire.body("struct sg_model_at", length=48))]
    decoder, seen, lost, sent = wire.Decoder(), [], [], 300
    decoder.feed(link.read(4096, 0.01))                     # it begins to listen in the middle of a frame
    began_bad, arrived_us = decoder.bad, []
    for ticket in range(sent):
        kind, body = requests[ticket % len(requests)]
        written_us = one.now_us()
        link.write(wire.encode(kind, ticket, body))
        answered, patience = False, link.now() + 0.1
        while not answered and link.now() < patience:
            for packet in decoder.feed(link.read(4096, 0.001)):
                if packet.type == lib.SG_MSG_GAZE:
                    seen.append(packet.seq)
                answered |= packet.type == kind | lib.SG_REPLY and packet.seq == ticket
                if packet.type == lib.SG_MSG_PING | lib.SG_REPLY:
                    arrived_us.append(wire.parse(wire.Pong, packet.body).rx_us - written_us)
        if not answered:
            lost.append((ticket, kind))
    counted, after = one.control.counters(), one.device.status()
    gaps = np.diff(np.array(seen)) % 65536
    # However long it waited for its turn, a ping says when it came.
    print(f"pings came {min(arrived_us)} .. {max(arrived_us)} us after they were sent, by the device's clock")
    assert len(arrived_us) == sent / len(requests) and np.ptp(arrived_us) < 200
    # The receiver holds two bytes and one that comes: it has 328 cycles from a byte's end to lose none.
    print(f"a byte waited {counted['longest_rx_cycles']} cycles at most")
    assert counted["longest_rx_cycles"] <= 290
    print(f"{len(lost)} of {sent} lost {lost[:8]}; {len(seen)} gazes, {int((gaps != 1).sum())} gaps;"
          f" longest pulse {counted['longest_pulse_cycles']} of {PULSE_CYCLES} cycles")
    assert not lost and len(seen) >= sent and (gaps == 1).all() and decoder.bad == began_bad <= 1
    assert counted["longest_pulse_cycles"] <= PULSE_CYCLES
    nothing_lost(before, after)
    assert after.rx_overrun == before.rx_overrun and after.rx_bad == before.rx_bad


def test_a_flood_that_nobody_could_answer_is_survived_with_lights_within_the_cap(worn):
    """Bytes back to back, requests and rubbish, faster than any answer; afterwards all is as it was."""
    one = worn()
    one.settle()
    rng = np.random.default_rng(5)
    one.control.counters_clear()
    began, link = one.control.time().cycle, one.device.link
    one.device.set_stream(gaze=True)
    for k in range(100):
        rubbish = rng.integers(0, 256, 120, np.uint8).tobytes() + b"\0"
        link.write(wire.encode(lib.SG_MSG_STATUS, k) * 8 + rubbish)
        link.read(4096, 0.002)
    counted, cycles = one.control.counters(), one.control.time().cycle - began
    link.sleep(0.05)
    link.read(65536, 0.01)
    duty = max(counted[f"lit_cycles_{i}"] for i in range(6)) / cycles
    print(f"longest pulse {counted['longest_pulse_cycles']} of {PULSE_CYCLES} cycles, lit {duty:.3f}")
    assert counted["longest_pulse_cycles"] <= PULSE_CYCLES and 0.1 < duty <= 0.345
    one.settle()
    before = one.device.status()
    frames = one.run(0.2)
    one.good(frames, "after the flood", 0.99)
    nothing_lost(before, one.device.status(), frames)
    assert one.device.restarts == 0
