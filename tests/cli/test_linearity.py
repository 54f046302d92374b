# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of linearity: finds curves past a drifting eye and ambient light; refuses bad light."""

import numpy as np
import pytest
from bent_sensor import CARRIED, FIRST, FULL, SECOND, BentSensor

from sparsegaze import curvefit, linearity
from sparsegaze.errors import CalibrationError, DisconnectedError
from sparsegaze.wire import lib

BEND = np.array([0.020, -0.015, 0.05, 0.0, -0.04, 0.01])

TOLD_US = 7_000_000  # settling, the dark, two seconds: long before all rounds are through


def drift(t_us):
    """An eye that drifts a degree a second to and fro, and jumps a third of a degree 1.6 times a second."""
    t = t_us * 1e-6
    jump = 0.33 * (int(t * 1.6) * 7919 % 5 - 2) / 2
    return (abs((t % 4.0) - 2.0) + jump, 0.5 * np.sin(1.3 * t))


def unchanged(device):
    """Curves, exposures and settings are as they were."""
    assert device.curves == (0,) * 6 and device.zero_q2 == 0
    assert device.automatic and device.sensing["repeats"] == 1
    assert device.stream[-1] == (False, False, False)


@pytest.mark.parametrize("wander", [None, drift], ids=["resting eye", "drifting eye"])
@pytest.mark.parametrize("ambient", [0.0, 4.0], ids=["dark", "bright"])
def test_finds_every_curve_and_takes_the_shift_away(wander, ambient):
    device = BentSensor(BEND, wander=wander, ambient=lambda t_us: ambient, frame_us=1999)
    done = linearity.run(device)
    assert done.kept and np.abs(done.curve - BEND).max() < 0.004
    assert np.abs(np.array(device.curves) / 1024 - done.curve).max() < 1e-9
    # Of codes that add up so to a quarter of them, to first order.
    wanted = BEND * (done.codes * (1 + 2 * ambient / FULL)) / 1024 * 0.75 / np.log(2)
    wanted[SECOND] /= 1 - CARRIED * done.codes[FIRST] / done.codes[SECOND]  # what is their own bends no less
    assert np.abs(done.before - wanted).max() < 0.25 * np.abs(wanted).max()
    assert np.abs(done.after).max() < 0.003 < np.abs(done.before).max()
    assert device.automatic and device.stream[-1] == (False, False, False)


class Paced(BentSensor):
    """Its frames come as fast as its settings say."""

    def settings(self, **wanted):
        now = super().settings(**wanted)
        self.frame_us = now.frame_period_us
        return now


SLOW = [{"rate_hz": 60, "power": "low"}, {"repeats": 16}]


@pytest.mark.parametrize("slow", SLOW, ids=["60Hz", "mean of 16"])
def test_a_board_that_is_set_to_sense_slowly_is_measured_fast_and_stays_slow(slow):
    device = Paced(BEND)
    device.settings(**slow)
    before = dict(device.sensing)
    done = linearity.run(device)
    assert done.kept and np.abs(done.curve - BEND).max() < 0.004
    assert device.sensing == before


@pytest.mark.parametrize("zero", [-2.0, 2.0])
def test_a_converter_whose_zero_is_off_is_not_taken_for_curvature(zero):
    device = BentSensor(BEND, wander=drift, zero=zero, frame_us=1999)
    found = linearity.run(device)
    assert found.kept and np.abs(found.curve - BEND).max() < 0.005
    # In the dark an unlit code stops at 0: what is below is missing from our light.
    assert found.zero == pytest.approx(min(zero, 0.0), abs=0.3) == device.zero_q2 / 4
    assert np.abs(found.after).max() < 0.004 < np.abs(found.before).max()
    again = linearity.run(device)
    assert again.zero == pytest.approx(found.zero, abs=0.3) and np.abs(again.curve - BEND).max() < 0.005


def test_a_zero_that_was_found_in_the_dark_stays_in_the_light():
    device = BentSensor(BEND, zero=-2.0, ambient=lambda t_us: 4.0, frame_us=1999)
    device.curve(zero_codes=-2.0)
    found = linearity.run(device)
    assert found.zero == -2.0 and np.abs(found.curve - BEND).max() < 0.005


def test_starts_from_the_curve_in_force_and_is_then_content():
    device = BentSensor(BEND, frame_us=1999)
    device.curve(BEND)
    done = linearity.run(device)
    assert np.abs(done.curve - BEND).max() < 0.004 and np.abs(done.before).max() < 0.003


def test_blinks_do_not_count():
    blinks = [(t, t + 240_000) for t in range(3_000_000, 30_000_000, 3_100_000)]
    done = linearity.run(BentSensor(BEND, wander=drift, blinks=blinks, frame_us=1999))
    assert np.abs(done.curve - BEND).max() < 0.004


def test_a_step_in_the_light_is_refused_and_nothing_changed():
    device = BentSensor(BEND, ambient=lambda t_us: 0.5 if t_us < 8_000_000 else 4.0, frame_us=1999)
    with pytest.raises(CalibrationError, match="not steady: it moved by"):
        linearity.run(device)
    unchanged(device)


def test_a_light_that_comes_when_exposures_are_found_is_told_as_unsteady():
    device = BentSensor(BEND, ambient=lambda t_us: 0.5 if t_us < 5_000_000 else 60.0, frame_us=1999)
    with pytest.raises(CalibrationError, match="not steady: it moved by"):
        linearity.run(device)
    assert device.t_us < 2_000_000 + TOLD_US
    unchanged(device)


def test_a_light_that_flickers_slowly_is_refused():
    device = BentSensor(BEND, ambient=lambda t_us: 2.0 + 2.0 * np.sin(t_us * 1e-6 * 9.0), frame_us=1999)
    with pytest.raises(CalibrationError, match="not steady"):
        linearity.run(device)
    unchanged(device)


@pytest.mark.parametrize("around", [0.0, 0.6], ids=["dark", "more from outside than ours"])
def test_too_weak_a_light_is_refused_at_once_and_names_the_sensors(around):
    device = BentSensor(BEND, light=0.03, ambient=lambda t_us: around, frame_us=1999)
    began = device.t_us
    with pytest.raises(CalibrationError, match="too little light.* sensor 5 .*of 1023 codes") as caught:
        linearity.run(device)
    assert "white paper" in caught.value.remedy and device.t_us - began < TOLD_US
    unchanged(device)


@pytest.mark.parametrize(
    "around, wave", [(60.0, 0.0), (60.0, 5.0), (800.0, 0.0)], ids=["sun", "a head that turns", "full always"]
)
def test_light_from_outside_is_told_as_such_at_once(around, wave):
    device = BentSensor(BEND, ambient=lambda t_us: around + wave * np.sin(t_us * 5e-6), frame_us=1999)
    device.exposures, began = (160,) * 6, device.t_us
    with pytest.raises(CalibrationError, match="too much light from outside: sensor 0") as caught:
        linearity.run(device)
    assert "shade" in caught.value.remedy and device.t_us - began < TOLD_US
    unchanged(device)


def test_an_eye_that_never_rests_is_refused():
    rng = np.random.default_rng(1)
    places = rng.uniform(-20, 20, (4000, 2))
    device = BentSensor(BEND, wander=lambda t_us: places[t_us // 60_000 % 4000], frame_us=1999)
    with pytest.raises(CalibrationError, match="could be compared"):
        linearity.run(device)
    unchanged(device)


@pytest.mark.parametrize("bit, word", [(lib.SG_FAULT_OPEN, "open"), (lib.SG_FAULT_SHORT, "shorted")])
def test_a_dead_sensor_is_refused_by_name(bit, word):
    device = BentSensor(BEND, fault=(0, 0, 0, bit, 0, 0))
    with pytest.raises(CalibrationError, match=f"sensor 3 is {word}"):
        linearity.run(device)
    assert device.stream == []


def test_settings_and_held_exposures_are_given_back():
    device = BentSensor(BEND, frame_us=1999)
    device.settings(repeats=4)
    device.exposure(us=[50] * 6)
    linearity.run(device)
    assert device.sensing["repeats"] == 4 and not device.automatic and device.exposures == (800,) * 6


class Watched(BentSensor):
    """Writes down when curves were stored: `sets`, (t_us, curves)."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.sets = []

    def curve(self, curve=None, zero_codes=None):
        now = super().curve(curve, zero_codes)
        if curve is not None or zero_codes is not None:
            self.sets.append((self.t_us, now.curve_q10))
        return now


def test_curves_that_are_no_better_are_never_stored(monkeypatch):
    device = Watched(BEND, frame_us=1999)
    honest = curvefit.fit

    def wrong(holds, curve, zero, dark, before, wanted):
        wanted = None if wanted is None else (-BEND, wanted[1])
        return honest(holds, curve, zero, dark, before, wanted)._replace(curve=-BEND)

    monkeypatch.setattr(curvefit, "fit", wrong)
    done = linearity.run(device)
    assert not done.kept and device.sets == [] and device.curves == (0,) * 6
    assert np.sqrt(np.mean(done.after**2)) > 1.5 * np.sqrt(np.mean(done.before**2))


def test_curves_are_stored_once_other_exposures_agree_and_a_pulled_cable_leaves_the_old_ones():
    device = Watched(BEND, frame_us=1999)
    linearity.run(device)
    [(stored_us, found)] = device.sets
    took_us = (linearity.ROUNDS + linearity.VERIFY_ROUNDS) * 2 * len(linearity.FRACTIONS) * linearity.HOLD_US
    assert stored_us - 2_000_000 > took_us and np.abs(np.array(found) / 1024 - BEND).max() < 0.004
    for pulled_us in (stored_us - 6_000_000, stored_us - 100_000):
        device = Watched(BEND, frame_us=1999, unplug_us=pulled_us)
        with pytest.raises(DisconnectedError):
            linearity.run(device)
        assert device.sets == [] and device.curves == (0,) * 6


class Stores(BentSensor):
    """Keeps in EEPROM whether exposures are automatic, as PROTOCOL.md's P13 says: `stored`."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.stored, self.set_us = True, None

    def exposure(self, us=None, auto=None, limit_us=None):
        if self.unplug_us is not None and self.t_us >= self.unplug_us:
            raise DisconnectedError("/dev/fake is gone", "check the cable")
        if self.set_us is not None and self.t_us - self.set_us > 2_000_000:
            self.stored = False
        if us is not None:
            self.set_us = self.t_us
        elif auto is not None:
            self.stored, self.set_us = auto, None
        return super().exposure(us, auto, limit_us)


@pytest.mark.parametrize("after_s", [1, 5, 12, 25])
def test_a_pulled_cable_leaves_exposures_automatic(after_s):
    device = Stores(BEND, frame_us=1999)
    device.unplug_us = device.t_us + after_s * 1_000_000
    with pytest.raises(DisconnectedError):
        linearity.run(device)
    assert device.stored


class Fickle(Watched):
    """Its parts change when a curve is stored: what was found is none of theirs."""

    def curve(self, curve=None, zero_codes=None):
        if curve is not None:
            self.bend = -2 * BEND
        return super().curve(curve, zero_codes)


def test_the_old_curves_come_back_if_the_device_s_own_features_disagree():
    device = Fickle(BEND, frame_us=1999)
    done = linearity.run(device)
    assert not done.kept and len(device.sets) == 2 and device.curves == (0,) * 6
    assert done.curve == pytest.approx(np.zeros(6)) and device.automatic


class Gone(BentSensor):
    """Answers no status once it streams: the cable is pulled right after the light was found unsteady."""

    def status(self):
        if self.stream:
            raise DisconnectedError("/dev/fake is gone", "check the cable")
        return super().status()


def test_what_went_wrong_first_is_what_is_told():
    device = Gone(BEND, light=0.03, frame_us=1999)
    with pytest.raises(CalibrationError, match="too little light"):
        linearity.run(device)


def test_without_leakage_or_light_around_the_curves_tell_the_zero():
    device = BentSensor(BEND, zero=-2.0, leakage=(0.0,) * 6, frame_us=1999)
    found = linearity.run(device)
    assert found.kept and -3.0 <= found.zero <= -1.25 and np.abs(found.curve - BEND).max() < 0.006


def test_the_command_reports_percent_and_octaves(command, command_json, monkeypatch):
    device = BentSensor(BEND, frame_us=1999)
    monkeypatch.setattr("sparsegaze.device.Device", lambda port, *_: device)
    code, data, _ = command_json("linearity", "PORT")
    assert code == 0 and data["kept"] and not data["calibrate_again"]
    assert np.abs(np.array(data["shift_percent_after"])).max() < 0.3
    assert data["shift_percent_before"][2] == pytest.approx(100 * (2 ** data["shift_octaves_before"][2] - 1))
    code, out, err = command("linearity", "PORT")
    assert code == 0 and "octaves" in out and "the curves are stored" in out
    assert "alternating the exposures: 100 %" in err


def test_a_model_made_with_other_curves_has_to_be_made_again(command, monkeypatch):
    from fake_device import linear_model

    device = BentSensor(BEND, frame_us=1999, model=linear_model())
    monkeypatch.setattr("sparsegaze.device.Device", lambda port, *_: device)
    assert "run `sparsegaze calibrate PORT` again" in command("linearity", "PORT")[1]
