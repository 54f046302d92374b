# SPDX-License-Identifier: Apache-2.0
"""Runs of targets: recording while it happens, waiting for exposures, interruptions, validation, recentre."""

import numpy as np
import pytest
from fake_device import FRAME_US, FakeDevice, linear_model

from sparsegaze import capture, recentre, session, targets, validate
from sparsegaze.errors import CalibrationError, DisconnectedError, RecordingError
from sparsegaze.recording import Recording
from sparsegaze.wire import lib


@pytest.fixture(scope="module")
def plan():
    return targets.calibration_plan(12)


def test_a_recording_holds_the_plan_with_settling_marked(tmp_path, plan):
    device = FakeDevice()
    taken = capture.run(device, device.screen, plan, tmp_path / "new" / "eye.csv", {"who": "nobody"})
    read = Recording.read(tmp_path / "new" / "eye.csv")
    assert np.array_equal(read.features, taken.recording.features) and np.array_equal(
        read.valid, taken.recording.valid
    )
    assert read.meta["who"] == "nobody" and read.meta["used_targets"] == "12"
    assert len(read) == pytest.approx(12 * 1e6 / FRAME_US, abs=2)
    assert 0.45 < read.valid.mean() < 0.51
    assert len(np.unique(read.target_deg, axis=0)) == 12
    assert device.stream[-1] == (False, False, False)


def test_valid_frames_show_the_eye_on_its_target(plan):
    device = FakeDevice(noise=0)
    run = capture.run(device, device.screen, plan)
    for target in np.unique(run.recording.target_deg[run.recording.valid], axis=0):
        rows = run.recording.valid & (run.recording.target_deg == target).all(axis=1)
        assert len(np.unique(run.recording.features[rows], axis=0)) == 1


@pytest.mark.parametrize(
    "fault, error",
    [({"interrupt_us": 8_000_000}, KeyboardInterrupt), ({"unplug_us": 8_000_000}, DisconnectedError)],
)
def test_a_run_cut_short_leaves_a_complete_file_of_the_targets_so_far(tmp_path, plan, fault, error):
    device = FakeDevice(**fault)
    with pytest.raises(error):
        capture.run(device, device.screen, plan, tmp_path / "eye.csv")
    text = (tmp_path / "eye.csv").read_text()
    assert text.endswith("\n") and "# interrupted: during target 6 of 12" in text
    read = Recording.read(tmp_path / "eye.csv")
    # 2 s + 0.5 s of calm + 0.3 s of lead: five whole targets fit before 8 s.
    assert len(np.unique(read.target_deg[read.valid], axis=0)) == 5
    assert read.valid.sum() > 5 * 120


def test_rows_of_a_target_are_on_disk_before_the_next_target_is_over(tmp_path, plan):
    seen = []

    class Watching(FakeDevice):
        def frames(self, timeout_s=2.0):
            for frame in super().frames(timeout_s):
                path = tmp_path / "eye.csv"
                seen.append(
                    sum(not line.startswith("#") for line in path.read_text().splitlines()) - 1
                    if path.exists() and frame.seq % 50 == 0
                    else 0
                )
                yield frame

    device = Watching()
    capture.run(device, device.screen, plan, tmp_path / "eye.csv")
    grown = np.maximum.accumulate(seen)
    times = np.arange(len(grown)) * FRAME_US * 1e-6
    for at in (4.0, 7.0, 10.0):
        assert grown[times <= at][-1] >= (at - 0.8 - 1 - 0.3) * 1e6 / FRAME_US - 2


def test_a_file_that_cannot_be_written_is_reported_before_anything_is_shown(tmp_path, plan):
    device = FakeDevice()
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError) as caught:
        capture.run(device, device.screen, plan, tmp_path / "file" / "eye.csv")
    assert "choose another place" in caught.value.remedy and device.stream == []


def test_targets_begin_only_after_the_exposures_are_calm(plan):
    device = FakeDevice(raw_flags=lambda t: lib.SG_FLAG_EXPOSURE if t < 4_000_000 else 0)
    run = session.run(device, device.screen, plan)
    assert run.onset_us[0] >= 4_000_000 + session.CALM_S * 1e6
    assert run.notes == []


def test_exposures_that_never_come_to_rest_do_not_stop_a_calibration(plan):
    device = FakeDevice(raw_flags=lambda t: lib.SG_FLAG_EXPOSURE if t % 100_000 < 5_000 else 0)
    run = session.run(device, device.screen, plan)
    assert run.onset_us[0] - 2_000_000 < (session.CALM_LIMIT_S + 1) * 1e6
    assert "exposures" in run.notes[0]


@pytest.mark.parametrize("flag, word", [(lib.SG_FLAG_SATURATED, "much"), (lib.SG_FLAG_STARVED, "little")])
def test_an_led_that_reads_nothing_stops_a_calibration_with_a_remedy(plan, flag, word):
    device = FakeDevice(raw_flags=lambda t: flag)
    with pytest.raises(CalibrationError) as caught:
        session.run(device, device.screen, plan)
    assert f"too {word} light" in caught.value.message and caught.value.remedy


def test_too_few_usable_targets_name_the_cause_and_keep_the_recording(tmp_path, plan):
    device = FakeDevice(raw_flags=lambda t: lib.SG_FLAG_STARVED if t > 6_000_000 else 0)
    taken = capture.run(device, device.screen, plan, tmp_path / "eye.csv")
    with pytest.raises(CalibrationError) as caught:
        capture.check(taken)
    assert str(tmp_path / "eye.csv") in caught.value.message and "starved" in caught.value.remedy
    assert (tmp_path / "eye.csv").exists()


def test_enough_usable_targets_pass(plan):
    device = FakeDevice()
    capture.check(capture.run(device, device.screen, plan))


@pytest.fixture(scope="module")
def held_out():
    return targets.validation_plan(6)


def test_a_perfect_device_validates_as_bit_identical_and_exact(held_out):
    device = FakeDevice(linear_model(), noise=4)
    done = validate.measure(device, device.screen, held_out)
    report = done.report()
    assert done.bit_identical and report["stream"]["compared"] == len(done.run.frames) > 1600
    assert report["accuracy"]["mean_deg"] < 0.15 and report["accuracy"]["data_loss_percent"] == 0.0
    assert (
        report["stream"]["rate_hz"] == pytest.approx(1e6 / FRAME_US, rel=1e-3)
        and report["stream"]["lost"] == 0
    )
    assert len(done.per_target()) == 6


def test_an_error_of_two_degrees_is_measured_as_two_degrees(held_out):
    device = FakeDevice(linear_model(), noise=0, shift_deg=(0.0, 2.0))
    report = validate.measure(device, device.screen, held_out).report()
    for key in ("mean_deg", "median_deg", "p95_deg", "accuracy_deg"):
        assert report["accuracy"][key] == pytest.approx(2.0, abs=0.02)
    assert report["accuracy"]["rms_s2s_deg"] == pytest.approx(0.0, abs=0.01)


def test_one_wrong_bit_in_one_gaze_frame_is_found(held_out):
    wrong = 1500
    device = FakeDevice(
        linear_model(),
        spoil=lambda seq, gaze: (
            gaze._replace(azimuth_deg_q7=gaze.azimuth_deg_q7 ^ 1) if seq == wrong else gaze
        ),
    )
    done = validate.measure(device, device.screen, held_out)
    assert done.differing == 1 and not done.bit_identical


def test_a_wrong_flag_in_one_gaze_frame_is_found(held_out):
    def spoil(seq, gaze):
        return gaze._replace(flags=gaze.flags | lib.SG_FLAG_STARVED) if seq == 1500 else gaze

    device = FakeDevice(linear_model(), spoil=spoil)
    assert validate.measure(device, device.screen, held_out).differing == 1


def test_frames_of_another_model_are_not_called_identical(held_out):
    device = FakeDevice(linear_model())
    run = session.run(device, device.screen, held_out, gaze=True)
    assert validate.evaluate(run, linear_model()).bit_identical
    other = validate.evaluate(run, linear_model(generation=2))
    assert other.differing == other.compared > 0


def test_a_recentre_during_the_stream_stays_bit_identical(held_out):
    device = FakeDevice(linear_model())
    run = session.run(
        device,
        device.screen,
        held_out,
        gaze=True,
        on_frame=lambda frame: device.recentre((1.5, -2.0)) if frame.seq == 1500 else None,
    )
    assert len(np.unique(run.frames["recentre"]["offset_q7"], axis=0)) == 2
    assert validate.evaluate(run, device.model).bit_identical


def test_invalid_frames_are_data_loss_and_never_error(held_out):
    device = FakeDevice(
        linear_model(),
        noise=0,
        raw_flags=lambda t: lib.SG_FLAG_STARVED if 5_000_000 < t and 400_000 < t % 1_000_000 < 650_000 else 0,
    )
    report = validate.measure(device, device.screen, held_out).report()
    assert 15 < report["accuracy"]["data_loss_percent"] < 60
    assert report["accuracy"]["mean_deg"] < 0.05


def test_lost_frames_are_counted_over_the_plan_only(held_out):
    device = FakeDevice(linear_model(), drop=[510, 1400, 1401, 1900])
    done = validate.measure(device, device.screen, held_out)
    assert done.report()["stream"]["lost"] == 3 and done.bit_identical


def test_nothing_valid_reports_total_loss_and_no_number_for_the_error(held_out):
    device = FakeDevice(linear_model(), raw_flags=lambda t: lib.SG_FLAG_STARVED if t > 4_000_000 else 0)
    report = validate.measure(device, device.screen, held_out).report()
    assert report["accuracy"]["data_loss_percent"] > 80


def test_true_gaze_is_read_at_the_time_of_each_frame(tmp_path):
    (tmp_path / "truth.csv").write_text(
        "us,az,el,pupil_mm,lid,target_az,target_el\n"
        + "".join(f"{1000 * i},{0.01 * i},{-0.02 * i},3.5,1,0,0\n" for i in range(100))
        + "99500,nonsense\n"
    )
    deg = validate.read_truth(tmp_path / "truth.csv", np.array([500, 50_250, 200_000]))
    assert np.allclose(deg[:2], [[0.005, -0.01], [0.5025, -1.005]]) and np.isnan(deg[2]).all()


def test_recentre_takes_the_shift_away_and_adds_to_the_offset_in_force():
    device = FakeDevice(linear_model(), shift_deg=(3.0, -4.0))
    device.recentre((1.0, 1.0))
    report = recentre.run(device, device.screen)
    assert report.before_deg == (1.0, 1.0)
    assert np.allclose(report.gaze_deg, (4.0, -3.0), atol=0.1)
    assert np.allclose(report.after_deg, (-3.0, 4.0), atol=0.1)
    again = recentre.run(device, device.screen)
    assert again.error_deg < 0.05


def test_recentre_returns_only_when_the_device_has_stored_it():
    device = FakeDevice(linear_model(), shift_deg=(1.0, 0.0))
    recentre.run(device, device.screen)
    assert device.stored_us is not None and device.t_us >= device.stored_us


def test_recentre_on_another_point_than_the_centre():
    device = FakeDevice(linear_model(), shift_deg=(1.0, 0.0))
    report = recentre.run(device, device.screen, (10.0, 5.0))
    assert np.allclose(report.after_deg, (-1.0, 0.0), atol=0.1)


def test_recentre_waits_for_a_blink_to_pass():
    device = FakeDevice(
        linear_model(),
        shift_deg=(2.0, 0.0),
        raw_flags=lambda t: lib.SG_FLAG_STARVED if 2_700_000 < t < 3_500_000 else 0,
    )
    assert np.allclose(recentre.run(device, device.screen).after_deg, (-2.0, 0.0), atol=0.1)


@pytest.mark.parametrize(
    "options, word",
    [
        (dict(raw_flags=lambda t: lib.SG_FLAG_STARVED), "valid gaze"),
        (dict(noise=1500.0), "wandered"),
        (dict(shift_deg=(34.0, 0.0)), "valid gaze|headset shift"),
    ],
)
def test_recentre_without_a_steady_gaze_leaves_the_offset_alone(options, word):
    device = FakeDevice(linear_model(), **options)
    device.recentre((1.0, 0.0))
    with pytest.raises(CalibrationError, match=word):
        recentre.run(device, device.screen)
    assert device.affine.offset_deg == (1.0, 0.0)


def test_recentre_without_a_model_says_so():
    device = FakeDevice()
    with pytest.raises(CalibrationError, match="no model"):
        recentre.run(device, device.screen)


WARP = ((1.10, 0.04), (-0.05, 0.92))


def test_five_points_take_most_of_a_warp_away_that_one_point_leaves():
    device = FakeDevice(linear_model(), shift_deg=(2.0, -1.0), warp=WARP)
    one = recentre.run(device, device.screen)
    assert one.after_gain == recentre.NO_GAIN and one.applied == "offset"
    five = recentre.run_points(device, device.screen, 5)
    assert five.applied == "affine" and five.before_deg == one.after_deg and len(five.points) == 5
    assert five.after_gain == device.recentre().affine.gain != recentre.NO_GAIN
    assert five.predicted_error_deg < 0.8 * five.offset_error_deg
    assert five.predicted_error_deg < five.error_deg
    again = recentre.run_points(device, device.screen, 5)
    assert again.error_deg < 0.5 * five.error_deg and again.before_gain == five.after_gain
    assert again.applied == "none" and device.recentre().affine.gain == five.after_gain


def test_points_without_a_shift_leave_all_as_it_was():
    device = FakeDevice(linear_model(), noise=0.5)
    report = recentre.run_points(device, device.screen, 5)
    assert report.applied == "none" and device.stored_us is None
    assert report.after_deg == report.before_deg and report.predicted_error_deg == report.error_deg < 0.05


def test_one_point_leaves_a_gain_in_force_alone_and_clear_takes_it_away():
    device = FakeDevice(linear_model(), shift_deg=(1.0, 1.0))
    device.recentre((0.5, 0.5), [[0.1, 0.0], [0.0, -0.1]])
    before = device.recentre().affine
    report = recentre.run(device, device.screen, (10.0, 5.0))
    assert report.before_gain == report.after_gain == before.gain
    assert recentre.run(device, device.screen, (10.0, 5.0)).error_deg < 0.05
    assert recentre.keep(device).affine.gain == recentre.NO_GAIN


def test_the_points_are_seen_through_the_correction_in_force():
    plain = FakeDevice(linear_model(), warp=WARP, noise=0.0)
    corrected = FakeDevice(linear_model(), warp=WARP, noise=0.0)
    corrected.recentre((3.0, -2.0), [[-0.05, 0.1], [0.2, 0.15]])
    found = [recentre.run_points(device, device.screen, 7) for device in (plain, corrected)]
    assert np.allclose(found[0].after_deg, found[1].after_deg, atol=0.02)
    assert np.allclose(found[0].after_gain, found[1].after_gain, atol=1.01 / 512)


def test_a_point_without_a_valid_gaze_is_left_out_and_three_are_the_least():
    def lids(t_us):         # shut long enough for the point to be given up: the second point
        return lib.SG_FLAG_STARVED if 3_200_000 < t_us < until_us else 0

    until_us = 9_500_000
    device = FakeDevice(linear_model(), shift_deg=(2.0, 0.0), raw_flags=lids)
    report = recentre.run_points(device, device.screen, 5)
    left_out = [row for row in report.points if row["gaze_deg"] is None]
    assert len(left_out) == 1 and "valid gaze" in left_out[0]["reason"] and report.applied != "none"
    assert np.allclose(report.after_deg, (-2.0, 0.0), atol=0.1)
    until_us = 2**40
    device = FakeDevice(linear_model(), shift_deg=(2.0, 0.0), raw_flags=lids)
    with pytest.raises(CalibrationError, match="only 1 of 5 points .* valid gaze"):
        recentre.run_points(device, device.screen, 5)
    assert device.recentre().affine.offset_deg == (0.0, 0.0)


def test_a_cable_pulled_between_points_is_told_as_such_and_changes_nothing():
    device = FakeDevice(linear_model(), shift_deg=(2.0, 0.0), unplug_us=5_000_000)
    with pytest.raises(DisconnectedError, match="gone"):
        recentre.run_points(device, device.screen, 5)
    assert device.affine.offset_deg == (0.0, 0.0) and device.stored_us is None


def test_a_recentre_with_gain_during_the_stream_stays_bit_identical(held_out):
    device = FakeDevice(linear_model())
    run = session.run(
        device,
        device.screen,
        held_out,
        gaze=True,
        on_frame=lambda frame: device.recentre((0.5, 1.0), [[0.05, -0.1], [0.0, 0.2]])
        if frame.seq == 1500
        else None,
    )
    assert len(np.unique(run.frames["recentre"]["gain_q9"], axis=0)) == 2
    assert validate.evaluate(run, device.model).bit_identical
