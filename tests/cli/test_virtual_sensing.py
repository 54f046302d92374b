# SPDX-License-Identifier: Apache-2.0
"""Settings, self-calibration, probes and faults on a virtual Nano with the real headset's light."""

import numpy as np
import pytest

from sparsegaze import probe
from sparsegaze.device import Device
from sparsegaze.sensing import EXPOSURE_REST_S, wait_stored

pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module")
def nano(firmware_hex):
    """An unpaced virtual Nano with the firmware and no model; simulated person 1."""
    from sparsegaze.virtual import VirtualNano

    with VirtualNano(person=1, unpaced=True, app=firmware_hex) as running:
        yield running


@pytest.fixture(scope="module")
def kept(nano, tmp_path_factory):
    """The matrix of the good board, in a file."""
    with Device(nano.port) as device:
        device.link.sleep(1.0)
        matrix = probe.measure(device)
    path = tmp_path_factory.mktemp("kept") / "probe.json"
    probe.save(path, matrix)
    return path


def test_settings_are_in_force_at_once_and_survive_a_restart(command_json, nano):
    code, data, _ = command_json("settings", nano.port)
    assert code == 0 and data["rate_hz"] == pytest.approx(data["rate_limit_hz"], rel=0.01)
    assert data["rate_hz"] > 900
    assert data["limits_hz"]["gaze"] >= data["limits_hz"]["features"] >= data["limits_hz"]["counts"] >= 250
    code, data, _ = command_json("settings", nano.port, "--rate", "250", "--repeats", "2")
    assert code == 0 and data["rate_hz"] == pytest.approx(250, rel=0.01) and data["repeats"] == 2
    code, data, _ = command_json("settings", nano.port)     # opening the port restarts the board
    assert data["rate_hz"] == pytest.approx(250, rel=0.01) and data["repeats"] == 2
    code, data, _ = command_json("stream", nano.port, "--seconds", "1")
    assert data["rate_hz"] == pytest.approx(250, rel=0.01) and data["lost"] == 0
    assert command_json("settings", nano.port, "--rate", "max", "--repeats", "1")[0] == 0


def test_a_rate_that_the_board_cannot_reach_is_refused_by_its_limit(command, command_json, nano):
    limit = command_json("settings", nano.port)[1]["limits_hz"]["gaze"]
    code, out, err = command("settings", nano.port, "--rate", str(limit + 100))
    assert code == 1 and f"at most {limit} Hz" in err
    assert command_json("settings", nano.port)[1]["rate_hz"] == pytest.approx(limit, rel=0.01)


def test_only_low_power_lights_less_at_a_lower_rate(nano):
    """As power.py says: in normal power a frame of 250 Hz is the mean of four cycles."""
    def lit(**wanted):
        device.settings(**wanted)
        device.link.sleep(0.3)
        nano.control.counters_clear()
        began = nano.control.time().cycle
        device.link.sleep(0.5)
        return nano.control.counters()["lit_cycles_0"] / (nano.control.time().cycle - began)

    with Device(nano.port) as device:
        device.exposure(us=[100.0] * 6)
        try:
            fastest, slow = lit(rate_hz=0), lit(rate_hz=250)
            low = lit(rate_hz=250, power="low")
        finally:
            written = device.status().eeprom_writes
            device.settings(rate_hz=0, power="normal")
            device.exposure(auto=True)
            device.link.sleep(EXPOSURE_REST_S)      # what is stored is what the next to open the port gets
            wait_stored(device, written)
    assert fastest > 0.2 and slow == pytest.approx(fastest, rel=0.02)
    assert low == pytest.approx(fastest / 4, rel=0.05)


def test_exposures_set_here_are_there_after_a_restart(command_json, nano):
    code, data, _ = command_json("exposure", nano.port, "--set", "60,50,40,60,50,40")
    assert code == 0 and not data["automatic"]
    code, data, _ = command_json("exposure", nano.port)
    assert data["exposure_us"] == pytest.approx([60, 50, 40, 60, 50, 40], rel=0.05) and not data["automatic"]
    assert command_json("exposure", nano.port, "--auto")[1]["automatic"]


def test_a_good_board_is_well_and_all_leds_are_in_their_places(command, nano, kept):
    code, out, _ = command("status", nano.port)
    assert code == 0 and "no fault" in out
    assert command("doctor", nano.port)[0] == 0
    for reference in (["--reference", kept], []):
        code, out, _ = command("probe", nano.port, *reference)
        assert code == 0 and "all six LEDs are where they belong" in out


@pytest.mark.parametrize("one, other", [(1, 4), (0, 5), (2, 3), (0, 3)])
def test_swapped_leds_are_named_by_either_reference(command, nano, kept, one, other):
    nano.control.swap(one, other)
    try:
        for reference in (["--reference", kept], []):
            code, out, _ = command("probe", nano.port, *reference)
            assert code == 1 and f"LED {one} and LED {other} are in each other's places" in out
    finally:
        nano.control.swap(one, other)


@pytest.mark.parametrize("kind, word", [("open", "sensor 1 is open"), ("short", "sensor 1 is shorted")])
def test_a_broken_led_is_named_and_linearity_refuses_by_it(command, nano, kind, word):
    nano.control.fault(1, kind)
    try:
        for name in ("status", "doctor", "probe"):
            code, out, _ = command(name, nano.port)
            assert code == 1 and word in out, name
        code, _, err = command("linearity", nano.port)
        assert code == 1 and word in err
    finally:
        nano.control.fault(1, "none")


def test_a_supply_that_sags_is_named_with_its_voltage(command, virtual_nano, firmware_hex):
    nano = virtual_nano(person=1, unpaced=True, app=firmware_hex, auto_reset=False)
    assert command("status", nano.port)[0] == 0     # and the board has seen what it starts from
    nano.control.supply(4.3)
    code, out, _ = command("status", nano.port)
    assert code == 1 and "the supply voltage, 4." in out and "another USB port" in out
    nano.control.supply(5.0)
    assert command("status", nano.port)[0] == 0


def test_lights_off_stay_off_over_a_restart_until_switched_on(command, nano):
    assert command("settings", nano.port, "--lights", "off")[0] == 0
    code, out, _ = command("status", nano.port)
    assert code == 1 and "lights are off by command" in out
    assert nano.control.lamps().lit == ()
    assert command("settings", nano.port, "--lights", "on")[0] == 0


@pytest.mark.parametrize("ambient_na", [0, 200], ids=["dark", "bright"])
def test_linearity_takes_the_shift_away_before_a_living_eye(
    command_json, virtual_nano, firmware_hex, ambient_na
):
    """Person 3's board: its reference is 4 % off, its converter's zero at -2 codes."""
    nano = virtual_nano(person=3, unpaced=True, app=firmware_hex)
    nano.control.ambient(ambient_na)
    code, data, _ = command_json("linearity", nano.port)
    assert code == 0 and data["kept"]
    shifts = (np.array(data[f"shift_octaves_{when}"]) for when in ("before", "after"))
    before, after = (np.sqrt(np.mean(shift**2)) for shift in shifts)
    assert before > 0.012 and after < 0.6 * before
    # In the dark the zero shows; in the light it does not matter and is left alone.
    assert data["zero_codes"] == pytest.approx(0.0 if ambient_na else -2.0, abs=0.8)
    with Device(nano.port) as device:       # which restarts the board
        stored = device.curve()
        assert stored.curve == pytest.approx(data["curve"], abs=1e-6)
        assert stored.zero_codes == data["zero_codes"] and device.exposure().automatic
        assert device.settings().frame_hz > 900


def test_linearity_in_a_light_that_moves_is_refused_and_nothing_stored(command, nano):
    with Device(nano.port) as device:
        before = device.curve()
        now = nano.control.time()
    for second in range(3, 14, 2):
        nano.control.set_at(now.cycle + second * 16_000_000, "ambient_na", 300 if second % 4 == 3 else 0)
    try:
        code, out, err = command("linearity", nano.port)
        assert code == 1 and "not steady" in err
    finally:
        nano.control.set_at_clear()
        nano.control.ambient(0, 0.0, 50.0)
    with Device(nano.port) as device:
        assert device.curve() == before
