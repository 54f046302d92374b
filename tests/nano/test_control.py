# SPDX-License-Identifier: Apache-2.0
"""VirtualNano and VirtualControl: the board of a headset file, ambient, faults, scheduled settings, tally."""

import pytest

from board import firmware
from sparsegaze import control as control_module
from sparsegaze.errors import VirtualError
from sparsegaze.virtual import SOURCE_TREE, VirtualNano


@pytest.fixture
def nano(vheadset, monkeypatch):
    monkeypatch.setenv("SPARSEGAZE_VHEADSET", str(vheadset))
    with VirtualNano(map=False, unpaced=True, app=firmware("stream"), bootloader="optiboot") as running:
        running.control.lockstep(True)
        yield running.control


def lit(control, us):
    """Lamps at every 10 us of a stretch."""
    begin = control.time().us
    seen = []
    for at in range(begin + 10, begin + us, 10):
        control.advance(at, 0)
        seen.append(control.lamps())
    return seen


def test_lamps_supply_and_tally_of_a_program_that_lights_five(nano):
    nano.advance(2500000, 0)                # past the bootloader
    nano.counters_clear()
    seen = lit(nano, 4000)
    brightest = max(seen, key=lambda lamps: len(lamps.lit))
    assert brightest.lit == (1, 2, 3, 4, 5) and min(seen, key=lambda lamps: len(lamps.lit)).lit == ()
    assert 0.09 < brightest.amperes < 0.1 and brightest.supply_volts < 5 and brightest.rail_volts > 1.8
    counters = nano.counters()
    assert counters["most_lit"] == 5 and counters["lit_cycles_0"] == 0
    assert 3000 < counters["longest_pulse_cycles"] <= counters["lit_cycles_1"] < 2 * 4500
    nano.supply(4.2)
    assert max(lit(nano, 2100), key=lambda lamps: lamps.amperes).amperes < 0.65 * brightest.amperes


def test_settings_reach_the_board_at_once_and_when_they_are_due(nano):
    nano.ambient(250, flicker=0.5, hz=120)
    nano.ambient(0)
    nano.set_at(nano.time().cycle + 1600, "supply_volts", 4.6)
    nano.set_at(nano.time().cycle + 3200, "supply_volts", 4.4)
    nano.advance(nano.time().us + 150, 0)
    assert nano.lamps().supply_volts == pytest.approx(4.6, abs=0.05)   # lit or not
    nano.set_at_clear()
    nano.advance(nano.time().us + 150, 0)
    assert nano.lamps().supply_volts == pytest.approx(4.6, abs=0.05)   # lit or not


def test_every_fault_can_be_set_and_taken_back(nano):
    for part in range(6):
        for kind in control_module.FAULTS:
            nano.fault(part, kind)
    nano.swap(0, 5)
    nano.swap(0, 5)


@pytest.mark.parametrize("call,what", [
    (lambda c: c.fault(6, "open"), "LEDs 0..5"), (lambda c: c.fault(0, "odd"), "a fault is none"),
    (lambda c: c.swap(2, 2), "two different"), (lambda c: c.supply(9), "4.2 to 5.5"),
    (lambda c: c.ambient(-1), "0 to"), (lambda c: c.ambient(1, flicker=2), "0 to 1"),
    (lambda c: c.ambient(1, hz=0), "0.1 to"), (lambda c: c.set_at(-1, "light", "dim"), "a cycle"),
    (lambda c: c.set_at(10**12, "light", "red"), "nominal, dim"),
    (lambda c: c.set("nothing", 1), "the keys are")])
def test_what_the_board_refuses_is_an_error_with_its_reason(nano, call, what):
    with pytest.raises(VirtualError, match=what):
        call(nano)


def config_of(monkeypatch, **options):
    """The configuration that a VirtualNano hands to its program."""
    from sparsegaze import virtual

    configs = []
    begin = virtual._start

    def recorded(binary, config, errors):
        configs.append(dict(line.split(" ", 1) for line in config.read_text().splitlines()))
        return begin(binary, config, errors)

    monkeypatch.setattr(virtual, "_start", recorded)
    VirtualNano(unpaced=True, **options).stop()
    return configs[0]


def headset(tmp_path, *lines):
    """The default headset with another [board]."""
    text = (SOURCE_TREE / "headsets" / "led2gaze.toml").read_text()
    head, rest = text.split("[board]", 1)
    path = tmp_path / "headset.toml"
    path.write_text("\n".join([head + "[board]", *lines, "", "[[" + rest.split("[[", 1)[1]]))
    return path


def test_board_of_the_headset_file_reaches_the_program(monkeypatch, vheadset, tmp_path):
    monkeypatch.setenv("SPARSEGAZE_VHEADSET", str(vheadset))
    path = headset(tmp_path, 'wiring = "leds"', "rail_volts = 1.9", "rail_ohm = 0.4", "rail_noise_mv = 0.7")
    config = config_of(monkeypatch, headset=path, map=False)
    assert config["wiring"] == "leds" and config["supply_pin"] == "none"
    assert [float(config[key]) for key in ("rail_volts", "rail_ohm", "rail_noise_mv")] == [1.9, 0.4, 0.7]
    path = headset(tmp_path, 'wiring = "leds"', "rail_volts = 1.8", 'supply_pin = "A7"')
    config = config_of(monkeypatch, headset=path, map=False)
    assert config["supply_pin"] == "A7" and "rail_ohm" not in config


def test_file_of_optics_only_is_wired_as_the_default(monkeypatch, vheadset, tmp_path):
    monkeypatch.setenv("SPARSEGAZE_VHEADSET", str(vheadset))
    path = headset(tmp_path, 'model = "none"')
    config = config_of(monkeypatch, headset=path, map=False)
    assert not {"wiring", "rail_volts", "supply_pin"} & set(config)


def test_a_map_makes_up_for_a_headset_file_that_is_not_there(monkeypatch, vheadset, tmp_path):
    monkeypatch.setenv("SPARSEGAZE_VHEADSET", str(vheadset))
    assert "wiring" not in config_of(monkeypatch, headset=tmp_path / "none.toml", map=False)
