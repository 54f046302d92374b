# SPDX-License-Identifier: Apache-2.0
"""`settings`, `exposure`, `status`, `doctor PORT`: what is in force, what cannot be, what is wrong."""

from types import SimpleNamespace

import pytest
from fake_device import linear_model

from sparsegaze import faults, live
from sparsegaze.device import Frame
from sparsegaze.wire import ALARM_NAMES, FAULT_NAMES, Gaze, lib


def test_settings_shows_what_is_in_force_and_the_limit(command, command_json, fake):
    fake(linear_model(), limit_hz=788)
    code, data, _ = command_json("settings", "PORT")
    assert code == 0 and data["rate_limit_hz"] == 788 and data["n_vectors"] == 64
    assert data["repeats"] == 1 and data["wiring"] == "leds" and data["power"] == "normal"
    assert data["lights"] is True and data["rolling"] is False
    code, out, _ = command("settings", "PORT")
    assert code == 0 and "788 Hz with the model of 64 vectors" in out
    assert data["limits_hz"] == {"gaze": 788, "features": 788, "counts": 788}


def test_settings_changes_only_what_was_named_and_waits_until_it_is_stored(command_json, fake):
    device = fake(linear_model())
    device.settings(repeats=2, power="low")
    began = device.t_us
    code, data, _ = command_json("settings", "PORT", "--rate", "250")
    assert code == 0 and data["rate_hz"] == pytest.approx(250) and data["repeats"] == 2
    assert device.sensing["power"] == lib.SG_POWER_LOW and device.t_us - began > 200_000
    assert command_json("settings", "PORT", "--rate", "max", "--repeats", "1")[1]["rate_hz"] > 1000
    assert device.sensing["rate_hz"] == 0


def test_a_rate_beyond_the_limit_is_refused_by_the_limit_and_changes_nothing(command, fake):
    device = fake(linear_model(), limit_hz=788)
    device.settings(rate_hz=500)
    before = dict(device.sensing)
    code, out, err = command("settings", "PORT", "--rate", "1000")
    assert code == 1 and out == ""
    assert "1000 Hz is too fast: with a model of 64 vectors and one cycle a frame" in err
    assert "at most 788 Hz" in err
    assert "--rate 788, or fit a model with --rate 1000: 15 vectors" in err
    assert device.sensing == before


def test_as_fast_as_can_be_stays_so_when_a_rate_is_refused(command, fake):
    device = fake(limit_hz=1001)
    code, _, err = command("settings", "PORT", "--rate", "900", "--repeats", "4")
    assert code == 1 and "with no model and 4 cycles a frame this device does at most 250 Hz" in err
    assert device.sensing["rate_hz"] == 0 and device.sensing["repeats"] == 1


@pytest.mark.parametrize(
    "args, word",
    [
        (["--rate", "0"], "at least 16"),
        (["--rate", "15"], "at least 16"),
        (["--rate", "fast"], "at least 16"),
        (["--rate", "70000"], "at least 16"),
        (["--repeats", "3"], "--repeats"),
        (["--power", "turbo"], "--power"),
        (["--wiring", "cmos"], "--wiring"),
        (["--lights", "dim"], "--lights"),
        (["--rolling", "--repeats", "2"], "--repeats 1 only"),
    ],
)
def test_nonsense_is_refused_before_the_port_is_opened(command, monkeypatch, args, word):
    monkeypatch.setattr("sparsegaze.device.Device", lambda *_: pytest.fail("the port was opened"))
    code, out, err = command("settings", "PORT", *args)
    assert code == 2 and word in err


def test_rolling_that_the_firmware_refuses_is_said_with_the_reason(command, fake):
    device = fake(refuse=("rolling",))
    code, out, err = command("settings", "PORT", "--rolling")
    assert code == 1 and out == "" and "no time for three inferences" in err and "nothing was changed" in err
    assert device.sensing["rolling"] == 0


def test_a_slow_frame_is_said_to_be_the_mean_of_all_its_cycles(command, command_json, fake):
    device = fake()
    assert command_json("settings", "PORT", "--rate", "250")[1]["cycles_a_frame"] == 4
    assert "the mean of 4 cycles of 999 us" in command("settings", "PORT")[1]
    assert command_json("settings", "PORT", "--rate", "20")[1]["cycles_a_frame"] == 16
    assert command_json("settings", "PORT", "--power", "low")[1]["cycles_a_frame"] == 1
    out = command("settings", "PORT")[1]
    assert "1 cycle of 999 us, then 49001 us dark; a frame every 50000 us" in out
    assert device.sensing["repeats"] == 1


def test_what_the_firmware_refuses_is_said_with_what_it_can(command, fake):
    fake(refuse=("wiring",), limit_hz=900)
    code, _, err = command("settings", "PORT", "--wiring", "photodiodes")
    assert code == 1 and "refuses wiring photodiodes" in err and "nothing was changed" in err


def test_lights_off_shows_in_status_with_the_way_back(command, command_json, fake):
    fake()
    assert command_json("settings", "PORT", "--lights", "off")[1]["lights"] is False
    code, out, _ = command("status", "PORT")
    assert code == 1 and "lights are off by command" in out and "settings PORT --lights on" in out
    assert command_json("settings", "PORT", "--lights", "on")[0] == 0
    assert command("status", "PORT")[0] == 0


# exposure ---------------------------------------------------------------------------------------------------


def test_exposure_shows_sets_holds_limits_and_goes_back_to_automatic(command, command_json, fake):
    device = fake()
    code, data, _ = command_json("exposure", "PORT")
    assert code == 0 and data["exposure_us"] == [50.0] * 6 and data["automatic"] is True
    code, data, _ = command_json("exposure", "PORT", "--set", "40,40,55.5,60,40,40.03")
    assert code == 0 and data["exposure_us"] == [40, 40, 55.5, 60, 40, 40.0] and not data["automatic"]
    assert not data["clipped"]
    assert command_json("exposure", "PORT", "--auto", "--limit", "90")[1]["automatic"] is True
    assert device.limits == (90.0,) * 6
    assert command_json("exposure", "PORT", "--limit", "none")[0] == 0
    assert [round(16 * limit) for limit in device.limits] == [0xFFFF] * 6
    code, out, _ = command("exposure", "PORT", "--hold")
    assert code == 0 and "held" in out and not device.automatic


def test_the_limits_that_exposure_shows_are_said_to_be_the_board_s(command, fake):
    fake()
    assert "board's limits  4 to 330 us" in command("exposure", "PORT", "--limit", "90")[1]


def test_exposures_that_are_held_are_a_note_with_the_way_back(command, fake):
    device = fake(linear_model())
    for name in ("status", "doctor"):
        assert "--auto" not in command(name, "PORT")[1]
    device.exposure(us=[50] * 6)
    for name in ("status", "doctor"):
        code, out, _ = command(name, "PORT")
        assert code == 0 and "held: they do not follow the light" in out
        assert "sparsegaze exposure PORT --auto" in out, name


@pytest.mark.parametrize("rate, mark", [(0, "ok "), (500, "note"), (720, "ok "), (900, "ok ")])
def test_a_rate_set_far_below_the_limit_is_a_note(command, fake, rate, mark):
    fake(linear_model(), limit_hz=800).settings(rate_hz=rate)
    code, out, _ = command("doctor", "PORT")
    assert code == 0 and f"{mark:<9} rate: " in out
    assert ("sparsegaze settings PORT --rate max" in out) == (mark == "note")


def test_an_exposure_that_had_to_be_moved_is_said(command, fake):
    fake()
    code, out, err = command("exposure", "PORT", "--set", "1000")
    assert code == 0 and "330.00" in out and "moved the exposures" in err


@pytest.mark.parametrize(
    "args", [["--set", "10,20"], ["--set", "-5"], ["--set", "long"], ["--limit", "0"], ["--set", "nan"],
             ["--hold", "--limit", "50"], ["--auto", "--set", "50"], ["--set", "none"], ["--limit", "inf"]]
)
def test_exposures_that_make_no_sense(command, monkeypatch, args):
    monkeypatch.setattr("sparsegaze.device.Device", lambda *_: pytest.fail("the port was opened"))
    code, _, err = command("exposure", "PORT", *args)
    assert code == 2 and "sparsegaze exposure --help" in err


# faults -----------------------------------------------------------------------------------------------------

FAULTS = [
    (dict(fault=(0, 0, 0, lib.SG_FAULT_OPEN, 0, 0)), "open", "open, or fully covered", "wire to A3"),
    (dict(fault=(lib.SG_FAULT_SHORT, 0, 0, 0, 0, 0)), "short", "sensor 0 is shorted", "solder bridge at A0"),
    (dict(fault=(0, 0, lib.SG_FAULT_LOW, 0, 0, 0)), "low", "sensor 2 gets far less light", "probe PORT"),
    (dict(fault=(0, 0, 0, 0, 0, lib.SG_FAULT_HIGH)), "high", "something lies close before it", "finger"),
    (dict(alarm=lib.SG_ALARM_SUPPLY, supply_mv=4310), "supply", "4.31 V", "another USB port"),
    (dict(alarm=lib.SG_ALARM_SUPPLY, supply_mv=4810), "supply", "4 % off what it was", "another USB port"),
    (dict(alarm=lib.SG_ALARM_SUPPLY, supply_mv=0), "supply", "outside of 3.5 to 6.3 V now", "divider at A7"),
    (dict(alarm=lib.SG_ALARM_LOCKOUT), "lockout", "the watchdog had to restart", "wait a second"),
    (dict(alarm=lib.SG_ALARM_LIGHTS_OFF), "lights-off", "off by command", "--lights on"),
]


@pytest.mark.parametrize("options, name, text, remedy", FAULTS, ids=[row[1] for row in FAULTS])
def test_status_and_doctor_name_every_fault(command, command_json, fake, options, name, text, remedy):
    fake(linear_model(), **options)
    code, data, _ = command_json("status", "PORT")
    assert code == 1 and data["ok"] is False and [row["name"] for row in data["faults"]] == [name]
    for args in (["status", "PORT"], ["doctor", "PORT"]):
        code, out, _ = command(*args)
        assert code == 1 and text in out and remedy in out
    assert [row["name"] for row in command_json("info", "PORT")[1]["faults"]] == [name]


@pytest.mark.parametrize("fault, told", [
    (lib.SG_FAULT_OPEN | lib.SG_FAULT_LOW, ["open"]), (lib.SG_FAULT_SHORT | lib.SG_FAULT_HIGH, ["short"]),
    (lib.SG_FAULT_LOW, ["low"]), (lib.SG_FAULT_OPEN | lib.SG_FAULT_HIGH, ["open", "high"])])
def test_what_follows_from_a_fault_is_not_told_as_another(command_json, fake, fault, told):
    fake(linear_model(), fault=(0, fault, 0, 0, 0, 0))
    assert [row["name"] for row in command_json("status", "PORT")[1]["faults"]] == told


@pytest.mark.parametrize("volts, mark", [(4.24, "note"), (4.6, "ok "), (5.4, "ok "), (5.6, "note")])
def test_a_supply_that_was_low_from_the_start_is_worth_a_note(command, fake, volts, mark):
    fake(linear_model(), supply_mv=int(1000 * volts))
    code, out, _ = command("doctor", "PORT")
    assert code == 0 and f"{mark:<9} supply: {volts:.2f} V" in out
    assert ("another USB port" in out) == (mark == "note")


def test_every_bit_of_the_wire_has_words():
    assert set(FAULT_NAMES) == {1, 2, 4, 8} and set(FAULT_NAMES.values()) == set(faults.CHANNEL)
    assert set(ALARM_NAMES) == {1, 2, 4} and set(ALARM_NAMES.values()) == set(faults.BOARD) | {"supply"}


def test_a_board_that_is_well(command, command_json, fake):
    fake(linear_model())
    code, data, _ = command_json("status", "PORT")
    assert code == 0 and data["ok"] and data["supply_volts"] == 5.0
    code, out, _ = command("doctor", "PORT")
    assert code == 0 and "all six read" in out and "64 vectors" in out and "FAULT" not in out
    assert "no fault" in command("status", "PORT")[1]


@pytest.mark.parametrize(
    "name, text, remedy",
    [("starved", "hardly any light comes back to 4 of six", "set to leds"),
     ("saturated", "too much light for 4 of six", "shade")],
)
def test_a_board_that_sees_nothing_is_not_said_to_read(command, fake, monkeypatch, name, text, remedy):
    device, asked = fake(linear_model()), iter(range(9))
    plain = device.status()

    def status():
        k = next(asked)
        return plain._replace(frames=1000 + 300 * k, **{name: 5 + 1200 * k})

    monkeypatch.setattr(device, "status", status)
    code, out, _ = command("doctor", "PORT")
    assert code == 0 and text in out and remedy in out and "all six read" not in out


SLOW = [({}, 1.5), ({"rate_hz": 60, "power": "low"}, 4.3), ({"rate_hz": 60}, 1.5)]


@pytest.mark.parametrize("slow, waits_s", SLOW)
@pytest.mark.parametrize("name", ["status", "doctor"])
def test_slow_boards_are_given_the_time_to_look_at_every_sensor(command, fake, name, slow, waits_s):
    device = fake(linear_model())
    device.settings(**slow)
    began = device.t_us
    assert command(name, "PORT")[0] == 0
    assert waits_s <= (device.t_us - began) * 1e-6 < waits_s + 0.5


def test_many_open_sensors_point_to_the_rail_and_to_the_wiring_that_is_set(command, fake):
    fake(linear_model(), fault=(0, 1, 0, 1, 1, 1))
    code, out, _ = command("doctor", "PORT")
    assert code == 1 and "set to leds" in out and "the rail" in out and "--wiring photodiodes" in out
    fake(linear_model(), fault=(0, 1, 0, 1, 0, 0))
    assert "wiring" not in command("doctor", "PORT")[1]


@pytest.mark.parametrize("late, name", [(3, "ok "), (90, "note")])
def test_a_few_late_frames_are_ordinary_and_many_are_worth_a_slower_rate(
    command, fake, monkeypatch, late, name
):
    device = fake(linear_model(), limit_hz=800)
    told = device.status()._replace(frames=2000, late_frames=late)
    monkeypatch.setattr(device, "status", lambda: told)
    code, out, _ = command("doctor", "PORT")
    line, after = (out[out.index("rate:") - 10 :] + "\n").split("\n", 1)
    assert code == 0 and line.startswith(name) and f"frames: {late} late" in line
    assert ("sparsegaze settings PORT --rate 720" in after) == (name == "note")


def test_the_rate_in_force_is_never_said_to_be_above_the_limit(command, fake, monkeypatch):
    device = fake()
    rounded = device.settings()._replace(rate_limit_hz=929, frame_period_us=1075)    # 1075.5
    monkeypatch.setattr(device, "settings", lambda **_: rounded)
    for name in ("settings", "doctor", "info"):
        out = command(name, "PORT")[1]
        assert "930.2 Hz" in out and "at most 930" in out.replace("at most  930", "at most 930"), name


def test_doctor_of_a_port_with_nothing_behind_it_is_a_finding_not_a_crash(command):
    code, out, err = command("doctor", "/dev/no-such-port")
    assert code == 1 and "FAULT" in out and "no such port" in out and err == ""


def test_a_validation_with_faults_says_so_and_counts_them_as_loss(command_json, fake):
    fake(linear_model(), raw_flags=lambda t_us: lib.SG_FLAG_FAULT if t_us > 5_000_000 else 0)
    code, data, err = command_json("validate", "PORT", "--targets", "4")
    assert code == 0 and data["accuracy"]["data_loss_percent"] > 20
    assert "settled frames had a fault" in " ".join(data["notes"]) and "sparsegaze status" in err


def test_a_stream_of_faulty_frames_says_so(command, fake):
    fake(linear_model(), raw_flags=lambda t_us: lib.SG_FLAG_FAULT)
    code, out, _ = command("stream", "PORT", "--seconds", "1")
    assert code == 0 and "0.0 % valid" in out and "`sparsegaze status PORT` names it" in out


def test_counts_of_a_stream_are_kept_and_replay_does_not_mind(command, command_json, monkeypatch, tmp_path):
    from bent_sensor import BentSensor

    device = BentSensor(model=linear_model())
    monkeypatch.setattr("sparsegaze.device.Device", lambda port, *_: device)
    path, model = tmp_path / "gaze.csv", tmp_path / "eye.sgm"
    device.model.save(model)
    assert command_json("stream", "PORT", "--seconds", "1", "--csv", path, "--counts")[0] == 0
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    row = dict(zip(lines[0].split(","), lines[9].split(",")))
    assert 400 < int(row["lit3"]) < 900 and int(row["unlit3"]) < 10 and float(row["exposure3_us"]) == 50
    assert command_json("replay", path, "--model", model)[1]["identical"] is True
    assert command("stream", "PORT", "--counts")[0] == 2


@pytest.mark.parametrize("seconds", ["nan", "inf", "-1", "0"])
def test_a_stream_of_no_finite_length_is_refused_before_the_port_is_opened(command, monkeypatch, seconds):
    monkeypatch.setattr("sparsegaze.device.Device", lambda *_: pytest.fail("the port was opened"))
    code, _, err = command("stream", "PORT", "--seconds", seconds)
    assert code == 2 and "--seconds" in err and len(err.splitlines()) == 1


def test_a_stream_without_one_valid_gaze_says_what_to_do(command, fake):
    fake(linear_model(), raw_flags=lambda t_us: lib.SG_FLAG_STARVED)
    out = command("stream", "PORT", "--seconds", "1")[1]
    assert "0.0 % valid" in out and "no gaze was valid" in out and "sparsegaze calibrate PORT" in out
    fake(linear_model())
    assert "no gaze was valid" not in command("stream", "PORT", "--seconds", "1")[1]


@pytest.mark.parametrize(
    "flags, words",
    [
        (lib.SG_FLAG_FAULT | lib.SG_FLAG_STARVED, "a fault: see sparsegaze status"),
        (lib.SG_FLAG_SATURATED, "too much light"),
        (lib.SG_FLAG_STARVED | lib.SG_FLAG_EXPOSURE, "too little light"),
        (lib.SG_FLAG_EXPOSURE, "exposures follow the light"),
        (lib.SG_FLAG_RECOVERING, "blink, or a headset that moved"),
    ],
)
def test_the_line_of_a_stream_says_why_there_is_no_gaze(flags, words):
    tally = live.Tally()
    device = SimpleNamespace(lost=0, incomplete=0, bad=0, clock=SimpleNamespace(drift=0.0))
    tally.add(Frame(1, 1000, 0.0, None, Gaze(1000, 0, 0, 700, flags, 40), None), device)
    assert f"no valid gaze ({words})" in tally.text() and tally.valid == 0
