# SPDX-License-Identifier: Apache-2.0
"""Settings: rate and its limit, repeats, power, lights, exposures' limits, curves, probes; what is kept."""

import itertools

import numpy as np
import pytest

from conftest import collect, costly_model, exchange, random_model
from sparsegaze import choose, wire
from sparsegaze.errors import DeviceError
from sparsegaze.wire import lib

CPU_HZ = 16_000_000
SETTINGS = dict(op=lib.SG_SETTINGS_SET, rate_hz=0, repeats=1, wiring=0, power=0, rolling=0, lights=1)
STREAMS = [dict(zip(("raw", "gaze", "counts"), bits)) for bits in itertools.product((False, True), repeat=3)]


def hertz_of(frames):
    """Frames a second of device time."""
    return 1e6 * (frames[-1].seq - frames[0].seq) / (frames[-1].t_us - frames[0].t_us)


def settled(device, n):
    """n stream frames in a row, once boot and the change of settings are over (with all their requests)."""
    device.link.sleep(0.3)
    begin_us, frames = device.status().t_us + 300_000, []
    for frame in device.frames():
        if frame.t_us > begin_us:
            frames.append(frame)
        if len(frames) == n:
            break
    assert [b.seq - a.seq for a, b in zip(frames, frames[1:])] == [1] * (n - 1)
    return frames


def calm(device):
    """No slot was given up, no packet lost on the way out."""
    status = device.status()
    assert (status.late_slots, status.tx_dropped, status.rx_overrun) == (0, 0, 0)
    return status


def test_by_default_frames_come_as_fast_as_can_be(board):
    _, device = board(models={0: random_model(15).image})
    device.set_stream(gaze=True)
    now = device.settings()
    assert (now.rate_hz, now.rate_limit_hz, now.period_us, now.frame_period_us) == (0, 1001, 999, 999)
    assert (now.repeats, now.wiring, now.power, now.rolling, now.lights) == (1, 0, 0, 0, 1)
    frames = settled(device, 300)
    assert {b.t_us - a.t_us for a, b in zip(frames, frames[1:])} <= {998, 999, 1000}
    calm(device)


@pytest.mark.parametrize("rate_hz", [16, 60, 250, 500, 777, 1000])
def test_the_rate_asked_for_is_the_rate_of_the_frames(board, rate_hz):
    _, device = board(models={0: random_model(15).image})
    now = device.settings(rate_hz=rate_hz)
    # A timer cycle more or less in each of 18 slots is what there is to choose from.
    assert now.frame_hz == pytest.approx(rate_hz, rel=2e-3) and now.rate_limit_hz == 1001
    assert now.frame_period_us == pytest.approx(1e6 / rate_hz, rel=2e-3)
    assert 999 <= now.period_us <= 1998
    device.set_stream(gaze=True)
    frames = settled(device, max(20, rate_hz // 4))
    assert hertz_of(frames) == pytest.approx(rate_hz, rel=2e-3)
    assert device.hello.frame_period_us == 999 and calm(device).frames > 0


@pytest.mark.parametrize("repeats", [2, 4, 8, 16])
def test_a_frame_of_several_cycles_takes_as_long_as_they_do(board, repeats):
    _, device = board(models={0: random_model(20).image})
    device.set_stream(raw=True, gaze=True)
    now = device.settings(repeats=repeats)
    assert now.frame_hz == pytest.approx(now.rate_limit_hz, abs=1)
    assert now.frame_period_us == pytest.approx(repeats * now.period_us, abs=4 + repeats)
    frames = settled(device, 40)
    assert hertz_of(frames) == pytest.approx(now.frame_hz, abs=1)
    # From the mean of all samples to the last one: half a frame, about.
    assert frames[-1].raw.span_us == pytest.approx(now.frame_period_us / 2, rel=0.2)
    calm(device)


def test_slower_frames_have_more_cycles_without_a_gap_and_with_low_power_dark_between_them(board):
    """Ambient light that flickers is followed from cycle to cycle, which a gap would end."""
    _, device = board()
    device.set_stream(raw=True)
    normal = device.settings(rate_hz=250)
    assert normal.period_us <= 1340 and normal.repeats == 1     # three cycles or four, as the stream allows
    spans = {frame.raw.span_us for frame in settled(device, 30)}
    assert min(spans) > 1500                        # half of the four cycles
    low = device.settings(power="low")
    assert low.period_us == 999 and low.frame_period_us == 4000 and low.power == lib.SG_POWER_LOW
    frames = settled(device, 30)
    assert max(frame.raw.span_us for frame in frames) < 600
    assert hertz_of(frames) == pytest.approx(250, rel=2e-3)
    calm(device)


def test_a_rate_between_is_exposed_longer(board):
    _, device = board()
    short = device.exposure(us=[1000] * 6).exposure_us
    assert device.settings(rate_hz=600).period_us == pytest.approx(1666, abs=2)
    now = device.exposure(us=[1000] * 6).exposure_us
    assert all(b > 1.5 * a for a, b in zip(short, now))
    assert 250 < max(now) <= device.hello.exposure_max_us


@pytest.mark.parametrize("rate_hz", [1001, 500, 250, 125, 60])
def test_flicker_is_rejected_at_any_rate(board, rate_hz):
    nano, device = board()
    nano.control.motion(False)
    device.settings(rate_hz=rate_hz)
    device.set_stream(raw=True)
    spread = {}
    for flicker in (0.0, 0.5):
        nano.control.ambient(100.0, flicker, 100)
        device.link.sleep(1.0)
        features = np.array([frame.raw.feature for frame in settled(device, 60)], float)
        spread[flicker] = features.std(axis=0)
    print(rate_hz, spread)
    # A feature is 4096 steps an octave; 50 nA of amplitude on some 120 of signal are 2000 of them.
    assert (spread[0.5] < spread[0.0] + 60).all()


LOW = [(0, 1), (0, 2), (0, 16), (990, 1), (900, 1), (860, 1), (850, 1), (450, 2)]


@pytest.mark.parametrize("rate_hz, repeats", LOW)
def test_what_low_power_says_of_its_rate_is_what_it_does(board, rate_hz, repeats):
    """No pause shorter than the port makes one: longer cycles instead, none shorter than its conversions.

    Slots are whole cycles: up to 20 us a frame less than the estimate, which the answer tells.
    """
    _, device = board(models={0: random_model(16).image})
    device.set_stream(gaze=True)
    now = device.settings(power="low", rate_hz=rate_hz, repeats=repeats)
    estimate_us = 1007 + 999 * (repeats - 1)
    assert now.rate_limit_hz == 1_000_000 // estimate_us and now.most_hz >= int(now.frame_hz)
    wanted_us = max(estimate_us, 1e6 / rate_hz if rate_hz else 0)
    assert now.period_us >= 999 and wanted_us - 20 <= now.frame_period_us <= wanted_us + 1
    settled(device, 20)
    late = device.status().late_frames
    assert hertz_of(settled(device, 200)) == pytest.approx(now.frame_hz, rel=1e-3)
    if repeats == 1:
        assert device.status().late_frames - late <= 20         # of some 500, by the requests


def test_low_power_sleeps_and_is_dark_between_frames(board):
    nano, device = board()
    device.exposure(us=[100] * 6)
    spent = {}
    for power in ("normal", "low"):
        device.settings(rate_hz=100, power=power)
        device.link.sleep(0.1)
        nano.control.counters_clear()
        device.link.sleep(1.0)
        spent[power] = nano.control.counters()
    assert spent["normal"]["asleep_cycles"] == 0 and spent["low"]["asleep_cycles"] > 0.7 * CPU_HZ
    assert 0 < spent["low"]["lit_cycles_0"] <= 1.05 * spent["normal"]["lit_cycles_0"]


@pytest.mark.parametrize("field, value", [
    ("rate_hz", 1), ("rate_hz", 15), ("repeats", 0), ("repeats", 3), ("repeats", 17), ("repeats", 32),
    ("wiring", 2), ("power", 2), ("rolling", 1), ("lights", 2), ("op", 2)])
def test_settings_that_do_not_exist_are_refused_and_change_nothing(board, field, value):
    _, device = board()
    before = device.settings()
    packets = exchange(device, wire.encode(lib.SG_MSG_SETTINGS, 4, wire.body("struct sg_settings",
                                                                             **SETTINGS | {field: value})))
    assert [(p.type, p.seq) for p in packets] == [(lib.SG_MSG_ERROR, 4)]
    assert wire.parse_error(packets[0].body) == (lib.SG_E_ARG, lib.SG_MSG_SETTINGS)
    assert device.settings() == before


def test_a_rate_beyond_the_limit_is_the_limit(board):
    _, device = board(models={0: random_model(100).image})
    device.set_stream(gaze=True)
    now = device.settings(rate_hz=1000)
    assert 450 < now.rate_limit_hz < 650 and now.frame_hz == pytest.approx(now.rate_limit_hz, rel=3e-3)
    assert hertz_of(settled(device, 80)) == pytest.approx(now.frame_hz, rel=0.01)
    calm(device)


def test_the_limit_follows_the_streams_and_the_line_and_the_wish_is_kept(board):
    _, device = board(models={0: random_model(64).image})
    device.settings(rate_hz=900)
    limit = {}
    for streams in ({}, {"gaze": True}, {"raw": True, "gaze": True},
                    {"raw": True, "gaze": True, "counts": True}):
        device.set_stream(**streams)
        now = device.settings()
        limit[len(streams)] = now.rate_limit_hz
        assert now.frame_hz == pytest.approx(min(900, now.rate_limit_hz), rel=3e-3)
    assert limit[0] > limit[1] > limit[2] > limit[3] > 300
    device.set_baud(500_000)
    assert device.settings().rate_limit_hz <= min(limit[3], 430)
    before = device.status().tx_dropped
    settled(device, 200)
    assert device.status().tx_dropped - before <= 3         # the requests take the line, too


@pytest.mark.parametrize("vectors", [1, 15, 16, 24, 64, 91])
def test_the_rates_that_the_host_foretells_are_the_device_s_own(board, vectors):
    _, device = board(models={0: random_model(vectors).image})
    streams = [{}, {"features": True}, {"features": True, "counts": True}]
    for recentred, repeats, more in itertools.product((False, True), (1, 4), streams):
        device.recentre((1.0, 0.0)) if recentred else device.recentre(clear=True)
        device.set_stream(gaze=True, raw="features" in more, counts="counts" in more)
        limit = device.settings(rate_hz=0, repeats=repeats).rate_limit_hz
        assert choose.rate_limit_hz(vectors, recentred=recentred, repeats=repeats, **more) == limit


@pytest.mark.parametrize("vectors", [0, 1, 20, 64])
def test_no_frame_is_late_with_any_model_streams_and_repeats(board, vectors):
    """The estimate of the work of a frame is above what it takes, and not far above."""
    models = {0: costly_model([42000] * 6, vectors).image} if vectors else None
    nano, device = board(models=models)
    for streams in STREAMS:
        device.set_stream(**streams)
        for repeats in (1, 4) if vectors in (0, 64) else (1,):
            now = device.settings(rate_hz=0, repeats=repeats)
            device.link.sleep(0.5)
            device.link.flush_input()
            nano.control.markers_clear()
            device.link.sleep(0.25)
            work = nano.control.markers()["5"]
            room = 16 * (now.frame_period_us - (repeats - 1) * now.period_us)
            print(f"{vectors} vectors, {streams}, {repeats} repeats: {work.mean:.0f} (most {work.most:.0f}) "
                  f"of {room} cycles, limit {now.rate_limit_hz} Hz")
            assert work.mean <= room
            if any(streams.values()):
                settled(device, 100)            # and none is lost
    calm(device)


def test_settings_exposures_limits_and_curves_survive_a_power_cycle(board):
    nano, device = board()
    wanted = device.settings(rate_hz=123, repeats=2, power="low", lights=False)
    curve = device.curve([0.01, -0.02, 0.03, 0.0, -0.125, 0.124]).curve_q10
    assert curve == (10, -20, 31, 0, -128, 127)
    device.settings(lights=True)
    wanted = device.settings()
    device.exposure(limit_us=[50, 40, 30, 20, 25, 60])
    held = device.exposure(us=[11, 22, 33, 44, 55, 66])
    device.link.sleep(3.0)
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    assert device.settings() == wanted and device.curve().curve_q10 == curve
    now = device.exposure()
    assert not now.automatic and now.exposure_us == pytest.approx(held.exposure_us, rel=0.05, abs=2.5)
    device.exposure(auto=True)
    device.link.sleep(1.0)
    now = device.exposure()
    assert now.automatic
    assert all(us <= limit + 2.5 for us, limit in zip(now.exposure_us, (50, 40, 30, 20, 25, 60)))


def test_lights_that_are_off_stay_off_through_a_power_cycle_and_every_frame_says_so(board):
    nano, device = board()
    device.settings(lights=False)
    device.link.sleep(1.0)
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    nano.control.counters_clear()
    device.set_stream(raw=True, gaze=True)
    for frame in settled(device, 100):
        assert frame.raw.flags & frame.gaze.flags & lib.SG_FLAG_FAULT and not frame.gaze.valid
    assert device.status().alarms == ("lights-off",)
    counters = nano.control.counters()
    assert all(counters[f"lit_cycles_{i}"] == 0 for i in range(6))
    device.settings(lights=True)
    device.link.sleep(0.1)
    assert device.status().alarms == ()
    assert not any(frame.raw.flags & lib.SG_FLAG_FAULT for frame in settled(device, 50))
    assert all(nano.control.counters()[f"lit_cycles_{i}"] for i in range(6))


def test_a_probe_lights_one_emitter_alone_and_all_is_as_before_afterwards(board):
    nano, device = board()
    before = device.exposure(us=[100] * 6)
    device.set_stream(raw=True)
    seen = collect(device, 20)
    next_sampled = {5: 0, 1: 4, 2: 3}           # what the emitter's 5 V on the sample capacitor would spoil
    for emitter in range(6):
        nano.control.counters_clear()
        found = device.probe(emitter)
        counters = nano.control.counters()
        lit = [counters[f"lit_cycles_{i}"] for i in range(6)]
        assert max(lit) == lit[emitter] and found.emitter == emitter
        blind = {emitter, next_sampled.get(emitter, emitter)}
        assert {i for i in range(6) if found.feature[i] == 0} == blind
    seen = [frame for frame in collect(device, 400)]
    gaps = [b.seq - a.seq for a, b in zip(seen, seen[1:])]
    assert gaps[-100:] == [1] * 100
    assert device.exposure() == before


def test_probes_are_refused_in_the_dark_and_one_at_a_time(board):
    _, device = board()
    asked = wire.encode(lib.SG_MSG_PROBE, 1, b"\1") + wire.encode(lib.SG_MSG_PROBE, 2, b"\2")
    packets = exchange(device, asked)
    answers = sorted((packet.seq, packet.type) for packet in packets)
    assert answers == [(1, lib.SG_MSG_PROBE | lib.SG_REPLY), (2, lib.SG_MSG_ERROR)]
    assert wire.parse_error(packets[0].body) == (lib.SG_E_BUSY, lib.SG_MSG_PROBE)
    device.settings(lights=False)
    with pytest.raises(DeviceError) as caught:
        device.probe(0)
    assert caught.value.code == lib.SG_E_STATE


def test_trying_many_exposures_does_not_wear_the_store(board):
    _, device = board()
    device.link.sleep(3.0)
    written = device.status().eeprom_writes
    for k in range(40):
        device.exposure(us=[20 + k] * 6)
        device.link.sleep(0.04)
    assert device.status().eeprom_writes == written
    device.link.sleep(4.0)
    assert device.status().eeprom_writes == written + 1


def test_a_host_that_says_the_same_for_ever_does_not_wear_the_store(board):
    """What is stored already is not written, not even the sequence number; the answers stay the same."""
    nano, device = board(models={0: random_model(15).image})
    said = {
        "settings": lambda: device.settings(rate_hz=250, repeats=2),
        "curve": lambda: device.curve([0.01] * 6, -1.5),
        "recentre": lambda: device.recentre((1.5, -2.0)),
        "limit": lambda: device.exposure(limit_us=[200] * 6).automatic,
        "automatic": lambda: device.exposure(auto=True).automatic,
        "read": lambda: (device.settings(), device.exposure().op),
    }
    first = {name: say() for name, say in said.items()}
    device.link.sleep(2.0)
    before = device.status().eeprom_writes, nano.control.counters()["eeprom_writes"]
    for _ in range(20):
        device.link.sleep(0.03)
        assert {name: say() for name, say in said.items()} == first
    device.link.sleep(3.0)
    assert (device.status().eeprom_writes, nano.control.counters()["eeprom_writes"]) == before
    device.exposure(us=[50] * 6)
    device.link.sleep(3.0)
    held = device.status().eeprom_writes, nano.control.counters()["eeprom_writes"]
    assert held[0] == before[0] + 1 and held[1] > before[1]
    for say in (lambda: device.exposure(us=[50] * 6), lambda: device.exposure(auto=False)):
        say()
        device.link.sleep(3.0)
    assert (device.status().eeprom_writes, nano.control.counters()["eeprom_writes"]) == held


@pytest.mark.parametrize("change", [
    lambda device: device.settings(lights=False), lambda device: device.curve([0.02] * 6),
    lambda device: device.curve(zero_codes=-2), lambda device: device.recentre((0.5, 0.0)),
    lambda device: device.recentre(clear=True), lambda device: device.exposure(limit_us=[20] * 6),
    lambda device: device.exposure(auto=False)], ids=range(7))
def test_what_differs_is_stored_at_once_and_so_is_what_is_taken_back(board, change):
    def stored():
        exposure = device.exposure()
        return (device.settings(), device.curve(), device.recentre(), exposure.op,
                min(exposure.exposure_us) > 25)

    nano, device = board(models={0: random_model(15).image})
    device.recentre((1.5, -2.0))
    device.link.sleep(1.0)
    before = stored()
    written = device.status().eeprom_writes
    change(device)
    device.link.sleep(0.5)
    assert device.status().eeprom_writes == written + 1
    # Away and back before the store is done: what was there stays whole.
    changed = stored()
    device.settings(repeats=4)
    device.link.sleep(0.02)
    device.settings(repeats=1)
    device.link.sleep(0.5)
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    device.link.sleep(1.0)
    assert stored() == changed != before


def test_an_unrelated_change_never_forgets_a_rate_above_the_limit(board):
    _, device = board(models={0: random_model(64).image})
    device.set_stream(gaze=True)
    limit = device.settings().rate_limit_hz
    assert limit < 900
    device.settings(rate_hz=900)
    assert device.settings(lights=False).rate_hz == device.settings(power="low").rate_hz == 900
    before = device.settings()
    device.settings(rate_hz=100, repeats=4)
    assert device.settings_back(before) == before._replace(op=lib.SG_SETTINGS_SET) and before.frame_hz < 900
    device.settings(power="normal", lights=True)
    device.set_stream()                 # without a packet to send it gets closer
    assert limit < device.settings().frame_hz <= 900
    device.settings(rate_hz=0)
    assert device.settings(repeats=2).rate_hz == 0
