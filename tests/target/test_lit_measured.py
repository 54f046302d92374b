# SPDX-License-Identifier: Apache-2.0
"""Lights as the virtual Nano counts them on its pins, beside what eye safety and power assume."""

from pathlib import Path

import numpy as np
import pytest
from conftest import random_model

from sparsegaze import power, timing
from sparsegaze.device import Device
from sparsegaze.errors import DeviceError
from sparsegaze.headset import load_headset
from sparsegaze.timing import Timing
from sparsegaze.transport import open_link
from sparsegaze.wiring import PHASES

BOOT_S = 2.2  # bootloader, and a second of darkness after its watchdog
SECONDS = 0.5
SOURCE = Path(__file__).parent / "lit_app.c"
HEADSETS = {"leds": "led2gaze", "photodiodes": "nextgaze_nano"}
MOST = 65535


@pytest.fixture
def lit(port_with, virtual_nano, repo_root):
    """Factory: what is counted while the port does as asked; lit(wiring, **asked) -> (headset,
    duty [emitter], counters). storm: bytes arrive back to back all the while; log: file for the moments of
    pins.
    """

    def run(wiring="leds", storm=False, seconds=SECONDS, hang=False, log=None, **asked):
        settings = dict(FIRST=MOST, SECOND=MOST, PERIOD=15984, FRAME=0, REPEATS=1, PROBE=255, SLEEP=0)
        settings.update({name.upper(): value for name, value in asked.items()})
        settings["WIRING"] = int(wiring != "leds")
        flags = [f"-DASK_{name}={value}{'UL' if name == 'FRAME' else ''}" for name, value in settings.items()]
        path = repo_root / "headsets" / (HEADSETS[wiring] + ".toml")
        elf = port_with(SOURCE, *flags, *(["-DASK_HANG"] if hang else []))
        nano = virtual_nano(headset=path, map=False, unpaced=True, app=elf)
        link = open_link(nano.port)
        link.sleep(BOOT_S)
        nano.control.counters_clear()
        nano.control.frames(log)
        began = nano.control.time().cycle
        end = link.now() + seconds
        while link.now() < end:
            if storm:
                link.write(bytes(range(1, 201)))
            link.sleep(0.002)
        counted = nano.control.counters()
        nano.control.frames(None)
        counted["cycles"] = nano.control.time().cycle - began
        link.close()
        headset = load_headset(path)
        duty = [counted[f"lit_cycles_{i}"] / counted["cycles"] for i in range(len(headset.emitters))]
        return headset, duty, counted

    return run


@pytest.mark.parametrize("wiring", ["leds", "photodiodes"])
def test_lights_at_the_longest_exposures_are_those_that_eye_safety_assumes(lit, wiring):
    headset, duty, counted = lit(wiring)
    assumed = Timing().emitter_duty(headset)
    print("lit", duty, "assumed", assumed[0], "longest pulse, cycles", counted["longest_pulse_cycles"])
    for measured, most in zip(duty, assumed):
        assert 0.95 * most < measured <= most
    assert counted["most_lit"] == (4 if wiring == "leds" else 1)
    assert counted["longest_pulse_cycles"] <= Timing().lit_cycles(timing.LATE_CYCLES)


@pytest.mark.parametrize(
    "asked",
    [
        dict(period=31986),
        dict(period=20016, first=1500, second=1234),
        dict(first=1, second=1),
        dict(first=1, second=MOST),
        dict(first=MOST, second=1),
        dict(repeats=16),
        dict(probe=3),
        dict(period=31986, probe=0),
        dict(storm=True),
        dict(storm=True, period=31986, repeats=4, frame=200_000),
    ],
    ids=lambda asked: ",".join("%s=%s" % item for item in asked.items()),
)
def test_nothing_that_is_asked_for_lights_longer_than_eye_safety_assumes(lit, asked):
    headset, duty, counted = lit(**asked)
    late = timing.LATE_CYCLES if asked.get("storm") else 0
    if "probe" in asked:
        share = timing.PHASES * max(t.phase_duty(late) for t in (Timing(), Timing(timing.SLOT_CYCLES_MAX)))
        most = [share * (i == asked["probe"]) for i in range(6)]
        assert counted["most_lit"] == 1
    else:
        longest = max((Timing(), Timing(timing.SLOT_CYCLES_MAX)), key=lambda t: t.phase_duty(late))
        most = longest.emitter_duty(headset, late)
    assert all(measured <= bound for measured, bound in zip(duty, most)), (duty, most)
    assert max(duty) > 0.1 * max(most), "something was lit"
    assert counted["longest_pulse_cycles"] <= Timing(timing.SLOT_CYCLES_MAX).lit_cycles(timing.LATE_CYCLES)


def test_a_program_that_hangs_while_lit_is_dark_before_eye_safety_says_and_stays_so_for_its_lockout(lit):
    _, duty, counted = lit(hang=True, seconds=8.0)
    watchdog = timing.WATCHDOG_MS * 1e-3 * timing.CPU_HZ
    print("longest pulse", counted["longest_pulse_cycles"] / 16e3, "ms, lit", duty)
    assert 0.9 * watchdog < counted["longest_pulse_cycles"] <= (1 + timing.WATCHDOG_SPREAD) * watchdog
    assert counted["most_lit"] == 4 and counted["wdt_resets"] >= 4
    # 400 good cycles, a hang, a second of darkness, and again
    good, hung, dark = 400 * 15984, watchdog, timing.LOCKOUT_MS * 1e-3 * timing.CPU_HZ
    most = (good / 3 + hung) / (good + hung + dark)
    assert 0.8 * most < max(duty) < 1.1 * most


@pytest.mark.parametrize("wiring", ["leds", "photodiodes"])
def test_the_firmware_senses_in_the_phases_of_headset_files(lit, wiring, tmp_path):
    log = tmp_path / "moments.csv"
    lit(wiring, log=log, seconds=0.01, first=1000, second=1000)
    phases, sampled, lights = [], [], 0
    for row in log.read_text().splitlines():
        what, _, value = row.split(",")[0].partition(":")
        if what == "adc" and lights and int(value) < 6:
            sampled.append(int(value))
        elif what == "lit" and int(value, 0) != lights:
            if lights and sampled:
                phases.append((tuple(sampled), tuple(i for i in range(6) if lights >> i & 1)))
            lights, sampled = int(value, 0), []
    assert len(phases) > 20
    start = phases.index(PHASES[wiring][0])
    for k, phase in enumerate(phases[start:-1]):
        assert phase == PHASES[wiring][k % 3]


def test_it_sleeps_only_when_it_is_told_to(lit):
    _, duty, counted = lit(frame=64_000, sleep=1)
    low = Timing(frame_cycles=64_000).phase_duty() * 12
    assert sum(duty) == pytest.approx(low, rel=0.05)
    assert counted["asleep_cycles"] > 0.6 * counted["cycles"], "this application computes nothing"
    _, _, awake = lit(frame=64_000, sleep=0)
    assert awake["asleep_cycles"] == 0


@pytest.mark.parametrize("setting, rate_hz", [("250 Hz, low power", 250), ("60 Hz, low power", 60)])
def test_the_shipped_firmware_draws_in_low_power_what_the_budget_says(board, repo_root, setting, rate_hz):
    headset = load_headset(repo_root / "headsets" / "led2gaze.toml")
    stated = next(one for one in power.budgets(headset) if one.setting == setting)
    nano, device = board(models={0: random_model(30).image})
    assert device.settings(rate_hz=rate_hz, power="low").rate_hz == rate_hz
    device.set_stream(gaze=True)
    device.link.sleep(0.5)
    nano.control.counters_clear()
    began = nano.control.time().cycle
    device.link.sleep(1.0)
    counted, cycles = nano.control.counters(), nano.control.time().cycle - began
    # Charge from the drivers: the pins' and the rail's drop make it some per cent less than 20 mA each; where
    # optics are bright, exposures and so the lights are shorter.
    emitter_mw = counted["led_charge_nc"] * 1e-9 / (cycles / timing.CPU_HZ) * 5.0 * 1e3
    assert 0.8 * stated.emitter_mw < emitter_mw <= stated.emitter_mw
    asleep = counted["asleep_cycles"] / cycles
    drawn = 5.0 * (asleep * power.IDLE_MA + (1 - asleep) * power.ACTIVE_MA + power.CONVERTER_MA)
    print(setting, "asleep", asleep, "mcu", drawn, stated.mcu_mw, "emitters", emitter_mw, stated.emitter_mw)
    assert drawn == pytest.approx(stated.mcu_mw, rel=0.1)


def test_no_storm_of_commands_lights_longer_than_eye_safety_assumes(virtual_nano, firmware_hex, repo_root):
    """The shipped firmware, told everything it understands about light and time, again and again."""
    headset = load_headset(repo_root / "headsets" / "led2gaze.toml")
    nano, rng = virtual_nano(map=False, unpaced=True, app=firmware_hex), np.random.default_rng(5)
    with Device(nano.port) as device:
        device.link.sleep(1.5)
        nano.control.counters_clear()
        began, asked, refused = nano.control.time().cycle, 0, 0
        device.set_stream(raw=True, gaze=True, counts=True)
        while asked < 150:
            kind = rng.integers(4)
            try:
                if kind == 0:
                    device.exposure(us=rng.choice([0.0, 4.0, 50.0, 103.0, 158.0, 4000.0], 6))
                elif kind == 1:
                    device.exposure(auto=True)
                elif kind == 2:
                    device.probe(int(rng.integers(6)))
                else:
                    device.settings(
                        rate_hz=int(rng.choice([0, 50, 200, 400, 700])),
                        repeats=int(rng.choice([1, 2, 4, 16])),
                        power=str(rng.choice(["normal", "low"])),
                    )
            except (DeviceError, ValueError):
                refused += 1
            asked += 1
        counted = nano.control.counters()
        cycles = nano.control.time().cycle - began
    duty = [counted[f"lit_cycles_{i}"] / cycles for i in range(6)]
    print(asked, "asked", refused, "refused", cycles / 16e6, "s, lit", duty, counted["longest_pulse_cycles"])
    assert refused < asked / 2 and counted["wdt_resets"] <= 1
    assert counted["longest_pulse_cycles"] <= Timing(timing.SLOT_CYCLES_MAX).lit_cycles(timing.LATE_CYCLES)
    settings = Timing(), Timing(timing.SLOT_CYCLES_MAX)
    most = max(one.emitter_duty(headset, timing.LATE_CYCLES).max() for one in settings)
    assert 0.02 < min(duty) and max(duty) <= most
