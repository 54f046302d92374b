# SPDX-License-Identifier: Apache-2.0
"""Pins and phases of a headset file: what fits the firmware, and every way in which it does not."""

import re

import pytest

from sparsegaze.errors import SceneError
from sparsegaze.headset import load_headset

ENTRY = """
[[{kind}]]
name = "{name}"
position_mm = [{x}.0, -12.0, -28.0]
aim_mm = [0.0, 0.0, -11.0]
{sigma}_sigma_deg = 10.0
lens_radius_mm = 1.5
pin = "{pin}"
"""
BOARD = '[board]\nwiring = "{wiring}"\nrail_volts = 1.8\nsupply_pin = "A7"\n'
PAIRS = ((5, 0), (1, 4), (2, 3))
DIODE_PAIRS = ((0, 3), (1, 4), (2, 5))


def entry(kind, name, x, pin):
    sigma = "beam" if kind == "emitter" else "sensitivity"
    return ENTRY.format(kind=kind, name=name, x=x, pin=pin, sigma=sigma)


def phase(sense, light):
    listed = [", ".join('"%s"' % name for name in names) for names in (sense, light)]
    return "\n[[phase]]\nsense = [%s]\nlight = [%s]\n" % tuple(listed)


def leds(phases=True):
    """A headset of six LEDs as the firmware drives it, as text."""
    text = BOARD.format(wiring="leds")
    text += "".join(entry("led", "led%d" % i, 5 * i - 12, "A%d" % i) for i in range(6))
    for pair in PAIRS if phases else ():
        text += phase(["led%d" % i for i in pair], ["led%d" % i for i in range(6) if i not in pair])
    return text


def diodes():
    """A headset of six photodiodes and three emitters."""
    text = BOARD.format(wiring="photodiodes")
    text += "".join(entry("sensor", "pd%d" % i, 5 * i - 12, "A%d" % i) for i in range(6))
    text += "".join(entry("emitter", "ir%d" % i, 5 * i - 4, "D%d" % (2 + i)) for i in range(3))
    for p, pair in enumerate(DIODE_PAIRS):
        text += phase(["pd%d" % i for i in pair], ["ir%d" % p])
    return text


def load(tmp_path, text):
    path = tmp_path / "it.toml"
    path.write_text(text)
    return load_headset(path)


def test_six_leds_as_the_firmware_drives_them_are_taken(tmp_path):
    headset = load(tmp_path, leds())
    assert [one.sense for one in headset.phases] == list(PAIRS)
    assert headset.lit[0].tolist() == [False, True, True, True, True, False]


def test_six_photodiodes_with_three_emitters_are_taken_and_lit_by_one_each(tmp_path):
    headset = load(tmp_path, diodes())
    assert headset.lit.astype(int).tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]] * 2


def test_a_headset_without_phases_is_taken(tmp_path):
    assert (load(tmp_path, leds(phases=False)).lit.sum(1) == 5).all()


def test_a_headset_without_wiring_may_have_any_free_pins(tmp_path):
    text = leds().replace('wiring = "leds"\n', "").replace('pin = "A3"', 'pin = "D9"')
    assert load(tmp_path, text).sensors[3].pin == "D9"


@pytest.mark.parametrize(
    "text, says",
    [
        (leds().replace('"A3"', '"A2"'), "led2 and led3 are both on pin A2"),
        (leds().replace('supply_pin = "A7"', 'supply_pin = "A4"'), "led4 and supply_pin are both on pin A4"),
        (leds().replace('supply_pin = "A7"', 'supply_pin = "A6"'), "measures the supply on A7"),
        (leds().replace('"A3"', '"D3"'), 'led3 is on pin D3, where wiring "leds" has A3'),
        (leds().replace('"A3"', '"A6"'), "led3 is on pin A6"),
        (leds().replace('"A3"', '"D0"'), "no free pin 'D0'"),
        (leds().replace('"A3"', '"A9"'), "no free pin 'A9'"),
        (leds().replace('"A3"', '"a3"'), "no free pin 'a3'"),
        (leds().replace('pin = "A3"\n', ""), "led3 has no pin"),
        (leds().replace('"A1"', '"Ax"').replace('"A2"', '"A1"').replace('"Ax"', '"A2"'), "led1 is on pin A2"),
        (leds().replace('"leds"', '"ledz"'), "there is no wiring 'ledz'"),
        (leds().replace('"leds"', "[]"), "there is no wiring []"),
        (leds().replace('"leds"', '"photodiodes"'), "is of [[sensor]]s and [[emitter]]s"),
        (diodes().replace('"photodiodes"', '"leds"'), "is of [[led]]s alone"),
        (diodes().replace('"D3"', '"D5"'), 'ir1 is on pin D5, where wiring "photodiodes" has D3'),
        (diodes().replace('"D2"', '"A0"'), "pd0 and ir0 are both on pin A0"),
        (diodes() + entry("emitter", "ir3", 12, "D5"), "has 3 emitters, not 4"),
        (leds(False) + entry("led", "led6", 20, "D9"), "has 6 sensors, not 7"),
        (leds().replace("rail_volts = 1.8\n", ""), "rail_volts is missing"),
        (leds().replace("rail_volts = 1.8", "rail_volts = 25"), "rail_volts = 25"),
        (leds().replace("rail_volts = 1.8", "rail_volts = nan"), "rail_volts = nan"),
        (leds().replace("rail_volts = 1.8", 'rail_volts = "2.5"'), "rail_volts"),
        (leds().replace('light = ["led1"', 'light = ["led9"'), "no emitter led9"),
        (leds().replace('sense = ["led5"', 'sense = ["led9"'), "no sensor led9"),
        (diodes().replace('sense = ["pd0"', 'sense = ["ir0"'), "no sensor ir0"),
        (leds().replace('light = ["led1"', 'light = ["led5"'), "led5 is lit while it senses"),
        (leds().replace('light = ["led1"', 'light = ["led2"'), "names led2 twice"),
        (leds().replace('sense = ["led5"', 'sense = ["led1"').replace('light = ["led1", ', "light = ["),
         "led1 senses already in phase 0"),
        (leds(False) + phase(["led0"], ["led%d" % i for i in range(1, 6)]), "5 emitters are lit at once"),
        (leds(False) + phase(["led0", "led5"], ["led1"]), "led1 senses in no phase"),
        (leds(False) + "".join(phase(["led%d" % i], ["led%d" % ((i + 1) % 6)]) for i in range(6)),
         "not the phases of the firmware"),
        (leds().replace('"led5", "led0"', '"led0", "led5"'), "not the phases of the firmware"),
        (leds().replace('light = ["led1", ', "light = ["), "not the phases of the firmware"),
        (leds(False) + '[[phase]]\nsense = []\nlight = ["led1"]\n', "sense is not a list of names"),
        (leds(False) + '[[phase]]\nsense = ["led0"]\n', "light is not a list of names"),
        (leds(False) + '[[phase]]\nsense = ["led0"]\nlight = [1]\n', "light is not a list of names"),
        (leds(False) + phase(["led0"], ["led1"]) + "dark = 1\n", "there is no key dark"),
        (leds(False) + "[phase]\nsense = 1\n", "phase must be written [[phase]]"),
    ],
)  # fmt: skip
def test_what_the_firmware_cannot_drive_is_one_error_that_names_it(tmp_path, text, says):
    with pytest.raises(SceneError, match=re.escape(says)) as caught:
        load(tmp_path, text)
    assert caught.value.message.startswith("it.toml") and caught.value.remedy
