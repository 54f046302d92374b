# SPDX-License-Identifier: Apache-2.0
"""The gaze stream of a virtual Nano: reproducible in lockstep, cut off, restarted, left behind by its
reader."""

import time

import pytest
from material import make_image

from sparsegaze import store
from sparsegaze.device import Device
from sparsegaze.errors import DisconnectedError, NoDeviceError, PortError
from sparsegaze.mapfile import synthetic_map
from sparsegaze.transport import LockstepLink, SerialLink, open_link


@pytest.fixture(scope="module")
def any_map(tmp_path_factory):
    return synthetic_map(str(tmp_path_factory.mktemp("map") / "synthetic.sgmap"))


def frames_of(device, n):
    found = []
    for frame in device.frames():
        found.append(frame)
        if len(found) == n:
            return found


def test_a_lockstep_run_depends_on_its_seed_and_not_on_the_speed_of_the_host(virtual_nano, firmware_hex,
                                                                             any_map):
    def run(seed, naps):
        nano = virtual_nano(map=any_map, unpaced=True, app=firmware_hex, person=seed)
        store.upload(nano.port, make_image(1))
        time.sleep(naps)
        with Device(nano.port) as device:
            nano.control.target(nano.control.time().us + 100000, 10, -5)
            device.set_stream(raw=True, gaze=True, counts=True)
            time.sleep(naps)
            return frames_of(device, 300), device.link.now()

    first = run(1, 0.0)
    assert run(1, 0.05) == first
    assert run(2, 0.0)[0] != first[0]


def test_the_port_decides_between_real_time_and_lockstep(virtual_nano):
    unpaced, paced = virtual_nano(map=False, unpaced=True), virtual_nano(map=False)
    with open_link(unpaced.port) as one, open_link(paced.port) as other:
        assert type(one) is LockstepLink and one.lockstep
        assert type(other) is SerialLink and not other.lockstep and other.control is not None
        before = one.now()
        time.sleep(0.02)
        assert one.now() == before
        one.sleep(1e-9)                         # whoever waits sees time pass, however short the wait
        assert one.now() > before


def test_frames_carry_growing_numbers_and_times_and_none_is_lost(virtual_nano, firmware_hex, any_map):
    nano = virtual_nano(map=any_map, unpaced=True, app=firmware_hex)
    with Device(nano.port) as device:
        device.set_stream(raw=True, gaze=True)
        frames = frames_of(device, 3000)
        assert [frame.seq - frames[0].seq for frame in frames] == list(range(3000))
        period_us = device.settings().frame_period_us
        # The period is rounded to microseconds, and the mean sample time moves with the exposures.
        first_us = frames[0].t_us
        assert all(abs(frame.t_us - first_us - i * period_us) < 300 + i for i, frame in enumerate(frames))
        assert all(frame.raw.t_us == frame.gaze.t_us for frame in frames)
        assert (device.lost, device.incomplete, device.bad, device.restarts) == (0, 0, 0, 0)
        # In lockstep both clocks are the same but for their zero; listening takes slices of 32 ms.
        assert abs(device.clock.drift) < 1e-3
        assert all(-1e-3 < frame.host_time - device.clock.to_host(frame.t_us) < 42e-3
                   for frame in frames[2500:])


def test_requests_in_the_middle_of_a_stream_lose_no_frame(virtual_nano, firmware_hex, any_map):
    nano = virtual_nano(map=any_map, unpaced=True, app=firmware_hex)
    with Device(nano.port) as device:
        device.set_stream(raw=True, gaze=True)
        seen = []
        for frame in device.frames():
            seen.append(frame.seq)
            if len(seen) % 20 == 0:
                device.status()
                device.model_info()
            if len(seen) == 400:
                break
        assert seen == list(range(seen[0], seen[0] + 400)) and device.lost == 0


def test_simulator_killed_during_a_stream_is_a_disconnection(virtual_nano, firmware_hex):
    for unpaced in (True, False):
        nano = virtual_nano(map=False, unpaced=unpaced, app=firmware_hex)
        with Device(nano.port) as device:
            device.set_stream(gaze=True)
            with pytest.raises(DisconnectedError) as caught:
                for i, _ in enumerate(device.frames()):
                    if i == 10:
                        nano.kill()
            assert "gone" in caught.value.message and caught.value.remedy
        with pytest.raises(PortError):
            Device(nano.port)


def test_power_failing_or_a_reset_during_a_stream_ends_it_after_the_timeout(virtual_nano, firmware_hex):
    for trouble in (lambda nano: nano.control.power(False), lambda nano: nano.control.reset()):
        nano = virtual_nano(map=False, unpaced=True, app=firmware_hex)
        with Device(nano.port) as device:
            device.set_stream(gaze=True)
            frames_of(device, 10)
            trouble(nano)
            start = device.link.now()
            with pytest.raises(NoDeviceError, match="no frame has arrived"):
                for _ in device.frames(timeout_s=0.5):
                    pass
            assert device.link.now() - start < 1.0


def test_a_slow_reader_gets_every_frame_and_is_not_called_silent(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex)
    with Device(nano.port) as device:
        device.set_stream(raw=True, gaze=True)
        frames = device.frames(timeout_s=0.5)
        first = next(frames).seq
        device.link.sleep(3.0)
        seen = [next(frames).seq for _ in range(900)]
        assert seen == list(range(first + 1, first + 901)) and device.lost == 0


def test_leaving_the_device_turns_its_stream_off(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, auto_reset=False, app=firmware_hex)
    with Device(nano.port) as device:
        device.set_stream(raw=True, gaze=True, counts=True)
        frames_of(device, 5)
    with open_link(nano.port) as link:
        link.sleep(0.05)
        link.flush_input()
        assert link.read(1, 0.5) == b""


def test_a_streaming_board_that_opening_does_not_reset_is_joined_at_once(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, auto_reset=False, app=firmware_hex)
    link = open_link(nano.port)
    device = Device(link)
    device.set_stream(gaze=True)
    link.close()                                # without turning it off
    with Device(nano.port) as device:
        assert device.link.now() - device.link.reset_s < 0.5
        assert device.status().stream != 0


def test_a_board_left_at_the_slower_speed_is_found_there(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, auto_reset=False, app=firmware_hex)
    with Device(nano.port) as device:
        device.set_baud(500_000)
        assert device.ping().rx_us > 0
    with Device(nano.port) as device:
        assert device.link.baud == 500_000
        device.set_baud(1_000_000)
        assert device.status().frames > 0


def test_a_reboot_comes_back_and_says_that_the_watchdog_did_it(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex)
    with Device(nano.port) as device:
        boots = device.status().boot_count
        device.set_stream(gaze=True)
        device.reboot()
        status = device.status()
        assert status.boot_count == boots + 1 and status.stream == 0
        assert status.reset_text == "watchdog"
