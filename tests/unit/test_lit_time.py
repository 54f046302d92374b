# SPDX-License-Identifier: Apache-2.0
"""When lights are on: by the slots, and by the same constants as the firmware's."""

import re

import pytest

from sparsegaze import timing
from sparsegaze.headset import load_headset
from sparsegaze.timing import Timing


@pytest.fixture(scope="module")
def port(repo_root):
    """Text of the ATmega328P's port."""
    folder = repo_root / "firmware" / "ports" / "avr328p"
    return "\n".join(path.read_text() for path in sorted(folder.glob("*.[ch]")))


def stated(port, name):
    """Value of an enumerator of the firmware."""
    found = re.findall(r"^\s*%s = ([0-9 +*]+)," % name, port, re.M)
    assert len(found) == 1, "%s is stated %d times in the firmware" % (name, len(found))
    return sum(int(a) * int(b or 1) for a, b in re.findall(r"(\d+)(?: \* (\d+))?", found[0]))


@pytest.mark.parametrize(
    "name, value",
    [
        ("SLOTS", timing.PHASES * timing.SLOTS_A_PHASE),
        ("SLOT_CYCLES_MIN", timing.SLOT_CYCLES),
        ("SLOT_CYCLES_MAX", timing.SLOT_CYCLES_MAX),
        ("EXPOSURE_LESS_CYCLES", timing.EXPOSURE_LESS_CYCLES),
        ("LIGHTS_AHEAD_CYCLES", timing.LIGHTS_AHEAD_CYCLES),
        ("LOCKOUT_MS", timing.LOCKOUT_MS),
        ("CYCLES_PER_US", timing.CPU_HZ / 1e6),
    ],
)
def test_the_firmware_is_built_with_what_eye_safety_is_computed_from(port, name, value):
    assert stated(port, name) == value


def test_the_watchdog_is_set_to_what_eye_safety_is_computed_from(port):
    # Named after the data sheet's "typical 0.125 s", which is 16,384 periods of 128 kHz.
    assert re.findall(r"wdt_enable\(WDTO_(\d+)MS\)", port).count("120") == 1
    assert timing.WATCHDOG_MS == 16384 / 128


def test_the_longest_lights_by_the_slots():
    # At 888 cycles: 120 before the earlier release; the second sensor exposed for 3 slots less 120; then 32.
    one = Timing()
    assert one.longest_exposures == (2 * 888 - 120, 3 * 888 - 120)
    assert one.lit_cycles() == 120 + 3 * 888 - 120 + 32
    assert one.period_cycles == 15984 and one.rate_hz == pytest.approx(1001.0, abs=0.01)
    assert one.phase_duty() == pytest.approx(2696 / 15984)


def test_short_exposures_light_until_the_second_sample():
    one = Timing(exposure_cycles=(64, 64))
    assert one.lit_cycles() == 120 + 64 + 888 + 32, "the first is released a slot before the second"
    assert Timing(exposure_cycles=(64, 2000)).lit_cycles() == 120 + 2000 + 32
    assert Timing(exposure_cycles=(1000, 64)).lit_cycles() == 120 + 1000 + 888 + 32


def test_no_exposure_lights_longer_than_the_cap():
    assert Timing(exposure_cycles=(65535, 65535)).lit_cycles() == Timing().lit_cycles()


def test_pauses_and_repeats_count():
    quarter = Timing(frame_cycles=64000)
    assert quarter.rate_hz == 250 and quarter.phase_duty() == pytest.approx(2696 / 64000)
    four = Timing(repeats=4, frame_cycles=64000)
    assert four.rate_hz == pytest.approx(250) and four.phase_duty() == pytest.approx(4 * 2696 / 64000)
    assert Timing(repeats=8, frame_cycles=64000).frame_period_cycles == 8 * 15984, "no shorter than cycles"


def test_each_emitter_is_lit_in_two_of_three_phases_of_the_default_headset(repo_root):
    leds = load_headset(repo_root / "headsets" / "led2gaze.toml")
    assert timing.lights(leds).sum(0).tolist() == [2] * 6
    assert Timing().emitter_duty(leds) == pytest.approx([2 * 2696 / 15984] * 6)
    diodes = load_headset(repo_root / "headsets" / "nextgaze_nano.toml")
    assert timing.lights(diodes).astype(int).tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
