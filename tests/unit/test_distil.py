# SPDX-License-Identifier: Apache-2.0
"""distil.py, rounding.py, fixations.py: device models against their processes; recordings good and bad."""

import warnings

import numpy as np
import pytest

from sparsegaze import distil as module
from sparsegaze import fixations as fixations_module
from sparsegaze import choose, process, rounding
from sparsegaze.distil import distil
from sparsegaze.errors import CalibrationError, ModelError, RecordingError
from sparsegaze.fit import fit_recording
from sparsegaze.fixations import TARGETS_NEEDED, fixations
from sparsegaze.gp import GaussianProcess
from sparsegaze.metrics import frame_errors_deg
from sparsegaze.model import FLAG_OUT_OF_RANGE, FLAG_VALID, emulate, kernel_q16, weighed
from sparsegaze.reach import reach
from sparsegaze.recording import Recording

FRAME_NOISE = 10.0  # feature steps rms


class Eye:
    """Six smooth channels: level - pupil's dark bump + a bright ring; `ring` is its height."""

    def __init__(self, seed, ring=0.03):
        rng = np.random.default_rng(seed)
        angle = np.deg2rad(60 * np.arange(6) + rng.normal(0, 4, 6))
        self.place = np.stack([24 * np.cos(angle), 21 * np.sin(angle)], 1)
        self.depth, self.width = 0.5 + 0.04 * rng.normal(size=6), 18 + rng.normal(size=6)
        self.level, self.ring = rng.uniform(44000, 47500, 6), ring

    def features(self, gaze_deg, rng=None, noise=FRAME_NOISE):
        r = np.sqrt(((gaze_deg[:, None] - self.place) ** 2).sum(-1))
        light = 1 - self.depth * np.exp(-(r**2) / (2 * self.width**2))
        light += self.ring * np.exp(-((r - 30) ** 2) / (2 * 4.0**2))
        features = self.level + 4096 * np.log2(light)
        if rng is not None:
            features = features + noise * rng.standard_normal(features.shape)
        return np.rint(features)

    def recording(self, seed=0, targets=100, frames=10, bias=0.3, ring=None):
        rng = np.random.default_rng([7, seed])
        side = int(round(np.sqrt(targets)))
        grid = np.linspace(-22, 22, side)
        target = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
        rng.shuffle(target)
        gaze = np.repeat(target + bias * rng.standard_normal(target.shape), frames, axis=0)
        t_us = np.arange(len(gaze)) * 3600 + np.repeat(np.arange(len(target)), frames) * 500_000
        return Recording(
            t_us, self.features(gaze, rng), np.repeat(target, frames, axis=0), np.ones(len(gaze))
        )


def errors(model, eye, seed=99, reach=19.0):
    rng = np.random.default_rng(seed)
    gaze = rng.uniform(-reach, reach, (2000, 2))
    az, el, flags = model.predict(eye.features(gaze, rng).astype(np.uint16))
    return frame_errors_deg(az, el, *gaze.T), flags


@pytest.fixture
def quick(monkeypatch):
    """Few inputs and steps, for tests that do not ask how good the model is."""
    for name, value in (("FIRST_STEPS", 5), ("LATER_STEPS", 2), ("POLISH_STEPS", 8), ("POINTS", 1500)):
        monkeypatch.setattr(module, name, value)


@pytest.fixture(scope="module")
def fitted():
    eye = Eye(0)
    return eye, fit_recording(eye.recording(), n_vectors=64)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_device_is_within_0_02_deg_rms_of_the_process_on_smooth_data(seed):
    # The set of the notes: a 17 x 17 grid, one noisy reading each; the process learns its noise itself.
    eye, rng = Eye(seed, ring=0.05), np.random.default_rng(seed)
    grid = np.linspace(-20, 20, 17)
    gaze = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    features = eye.features(gaze, rng)
    gp = GaussianProcess.fit(features, gaze, mean="constant")
    model, report = distil(gp, features, gaze, 64, noise=np.full(6, FRAME_NOISE))
    query = eye.features(rng.uniform(-19, 19, (2000, 2)), rng)
    az, el, flags = model.predict(query.astype(np.uint16))
    miss = np.hypot(*(np.stack([az, el], 1) - gp.predict(query)).T)
    assert np.sqrt(np.mean(miss**2)) < 0.02 and miss.max() < 0.15
    assert report.rms_deg < 0.03 and np.mean(flags == FLAG_VALID) > 0.995


def test_a_recording_becomes_a_model_as_good_as_its_process(fitted):
    eye, result = fitted
    device, flags = errors(result.model, eye)
    assert np.mean(flags == FLAG_VALID) > 0.995
    rng = np.random.default_rng(99)
    gaze = rng.uniform(-19, 19, (2000, 2))
    full = frame_errors_deg(*result.gp.predict(eye.features(gaze, rng)).T, *gaze.T)
    assert abs(device.mean() - full.mean()) < 0.01 and device.mean() < 0.35
    assert result.model.vectors == 64 and result.report.distil.rms_deg < 0.02


def test_more_vectors_come_closer(fitted, quick):
    eye, result = fitted
    recording = eye.recording()
    rms = [distil(result.gp, recording.features, recording.target_deg, n)[1].rms_deg for n in (8, 16, 32)]
    rms.append(result.report.distil.rms_deg)
    assert rms[0] > 1.3 * rms[1] > 1.69 * rms[2] and rms[2] > 1.3 * rms[3]


def test_report_states_what_the_image_holds(fitted):
    result = fitted[1]
    report, model = result.report.distil, result.model
    weights = model.weights / 2.0**model.weight_frac_bits
    assert (report.n_vectors, report.weight_frac_bits) == (model.vectors, model.weight_frac_bits)
    assert report.weight_range_deg == (weights.min(), weights.max())
    assert report.reach_deg[1] == 2.0 ** (23 - 8 - model.weight_frac_bits)


def accumulator(model, s):
    return (model.bias + s @ model.trend.T >> 4) + weighed(kernel_q16(s, model.centres), model.weights)


def within(model, rng, count=100_000):
    """Inputs all over the guards' parallelepiped, its corners included, as far as they lie in the box."""
    trust = model.trust
    rows, low, high = trust.row.astype(float), 16.0 * trust.low, 16.0 * trust.high
    rest = np.linalg.svd(rows)[2][len(rows) :]
    part = rng.random((count, 6))
    part[: count // 2] = part[: count // 2] < 0.5
    ends = np.c_[np.r_[low, np.full(len(rest), -3000.0)], np.r_[high, np.full(len(rest), 7000.0)]]
    s = np.rint(np.linalg.solve(np.vstack([rows, rest]), (ends[:, 0] + part * np.diff(ends).T).T).T).astype(
        int
    )
    return s[((s >= 0) & (s <= 4095)).all(axis=1)]


def test_the_sum_cannot_wrap_on_any_input_that_is_not_flagged_and_the_bound_is_not_idle(fitted):
    model, report = fitted[1].model, fitted[1].report.distil
    assert report.reach_deg[0] < report.reach_deg[1]
    s = within(model, np.random.default_rng(0))
    worst = np.abs(accumulator(model, s)).max() / 2.0 ** (8 + model.weight_frac_bits)
    assert len(s) > 1000 and worst < report.reach_deg[0] < 10 * worst


def test_reach_stops_when_it_has_proven_enough(fitted):
    model = fitted[1].model
    parts = model.weights, model.trend, model.bias, model.centres, model.trust
    best = reach(*parts)
    assert best <= reach(*parts, 2.0 * best) <= 2.0 * best


def test_the_error_bound_holds_against_real_numbers_and_is_not_idle(fitted):
    model, rng = fitted[1].model, np.random.default_rng(3)
    s = np.vstack([within(model, rng, 20_000)[:2000], rng.integers(0, 4096, (2000, 6))])
    half2 = np.sum(model.centres.astype(float) ** 2, axis=1) + 31
    t = np.sum(s.astype(float) ** 2, axis=1)[:, None] / 32 + 256 * np.floor(half2 / 32) - s @ model.centres.T
    lost = 255.0 / 256.0 * (model.weights & 255).sum(axis=0)
    real = (model.bias + s @ model.trend.T) / 16 + np.exp(-t / 2**16) @ model.weights * 256 - lost / 2
    q7 = np.floor(accumulator(model, s) / 2.0 ** (model.weight_frac_bits + 1) + 0.5)
    worst = np.abs(q7 / 128 - real / 2.0 ** (model.weight_frac_bits + 8)).max()
    assert worst <= rounding.error_bound_deg(model) < 20 * worst
    assert fitted[1].report.distil.error_bound_deg == rounding.error_bound_deg(model)


def test_same_seed_same_image_and_the_order_of_rows_is_irrelevant(fitted, quick):
    recording = fitted[0].recording()
    first = fit_recording(recording, 32)
    assert fit_recording(recording, 32).model.image == first.model.image
    shuffled = recording.select(np.random.default_rng(1).permutation(len(recording)))
    assert fit_recording(shuffled, 32).model.image == first.model.image
    assert fit_recording(recording, 32, seed=1).model.image != first.model.image


def test_closed_lids_slip_and_dark_are_flagged(fitted):
    eye, result = fitted
    rng = np.random.default_rng(5)
    gaze = rng.uniform(-20, 20, (500, 2))
    open_eye = eye.features(gaze, rng)
    lids = 0.5 * open_eye + 0.5 * (eye.level + 900)  # brighter skin in front, gaze hardly matters
    for bad in (
        lids,
        open_eye + 1500,
        open_eye - 1500,
        np.zeros_like(open_eye),
        np.full_like(open_eye, 65535),
    ):
        flags = emulate(result.model, np.clip(bad, 0, 65535).astype(np.uint16))[2]
        assert np.mean(flags == FLAG_OUT_OF_RANGE) > 0.9


def test_every_ordinary_frame_up_to_the_calibrated_edge_passes(fitted):
    _, flags = errors(fitted[1].model, fitted[0], reach=22.0)
    assert np.mean(flags == FLAG_VALID) >= 0.995


def test_a_constant_channel_is_dropped_with_a_warning_and_ignored_by_the_device(quick):
    eye = Eye(1)
    recording = eye.recording()
    recording.features[:, 4] = 777
    with pytest.warns(UserWarning, match="s4"):
        result = fit_recording(recording, 32)
    assert result.report.dropped_channels == (4,) and result.model.gain_q12[4] == 0
    assert result.model.channels == 6  # a dropped channel keeps its place: the board still has six
    gaze = np.random.default_rng(0).uniform(-19, 19, (500, 2))
    features = eye.features(gaze, np.random.default_rng(1)).astype(np.uint16)
    answers = []
    for value in (0, 777, 65535):
        features[:, 4] = value
        answers.append(result.model.predict(features))
    np.testing.assert_array_equal(answers[0], answers[2])
    assert np.mean(answers[1][2] == FLAG_VALID) > 0.99
    assert frame_errors_deg(answers[0][0], answers[0][1], *gaze.T).mean() < 0.6


def test_one_fixation_100_sigma_off_is_left_out_and_named(fitted, quick):
    recording = fitted[0].recording()
    first = (recording.target_deg == recording.target_deg[0]).all(axis=1)
    recording.target_deg[first] = np.clip(-recording.target_deg[0] + [9.0, -7.0], -22, 22)
    result = fit_recording(recording, 32)
    assert len(result.report.outliers) >= 1
    np.testing.assert_allclose(result.report.outliers[0], recording.target_deg[0])
    assert errors(result.model, fitted[0])[0].mean() < 0.4


def test_a_recording_that_does_not_depend_on_its_targets_warns_and_an_ordinary_one_does_not(quick):
    recording = Eye(0).recording(targets=49)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fit_recording(recording, n_vectors=8).report.loo_rms_deg < process.LOO_DOUBTFUL_DEG
    places, label = np.unique(recording.target_deg, axis=0, return_inverse=True)
    recording.target_deg = np.random.default_rng(0).permutation(places)[label.reshape(-1)]
    with pytest.warns(UserWarning, match="says little about where the eye looked"):
        assert fit_recording(recording, n_vectors=8).report.loo_rms_deg > process.LOO_DOUBTFUL_DEG


@pytest.mark.parametrize("seed", [0, 1])
def test_half_or_twice_the_assumed_bias_of_the_eye_changes_the_held_out_error_by_less_than_3_percent(
    seed, quick, monkeypatch
):
    eye, gaze = Eye(seed), np.random.default_rng(seed).uniform(-19, 19, (2000, 2))
    features = eye.features(gaze, np.random.default_rng(10 + seed))
    recording = eye.recording(seed, bias=0.4)
    mean, scales = [], []
    for bias_deg in (0.15, 0.3, 0.6):
        monkeypatch.setattr(fixations_module, "BIAS_DEG", bias_deg)
        scales.append(fixations(recording).noise_scale().mean())
        gp = fit_recording(recording, n_vectors=8).gp
        mean.append(frame_errors_deg(*gp.predict(features).T, *gaze.T).mean())
    assert scales[0] > scales[1] > scales[2]  # it does reach the fit
    assert max(mean) < 1.03 * min(mean) and max(mean) < 0.4


def test_unmarked_blinks_within_fixations_are_left_out(fitted, quick):
    eye, clean = fitted
    recording = eye.recording()
    start = np.arange(0, len(recording), 20)
    for i in range(2):
        recording.features[start + i] = np.rint(0.3 * recording.features[start + i] + 0.7 * (eye.level + 800))
    result = fit_recording(recording, 32)
    assert result.report.rejected_frames >= 2 * len(start)
    assert errors(result.model, eye)[0].mean() < errors(clean.model, eye)[0].mean() + 0.02


def test_nan_in_rows_that_are_not_valid_and_closed_eyes_there_change_nothing(fitted, quick):
    recording = fitted[0].recording()
    n = len(recording)
    longer = Recording(
        np.r_[recording.t_us, recording.t_us],
        np.vstack([recording.features, 0 * recording.features]),
        np.vstack([recording.target_deg, np.full((n, 2), np.nan)]),
        np.r_[recording.valid, np.zeros(n)],
    )
    assert fit_recording(longer, 32).model.image == fit_recording(recording, 32).model.image


@pytest.mark.parametrize("targets", [0, 1, 4])
def test_fewer_targets_than_needed_are_refused_with_the_number(targets):
    recording = Eye(0).recording()
    places = np.unique(recording.target_deg, axis=0)[:targets]
    keep = (recording.target_deg[:, None] == places).all(-1).any(-1)
    with pytest.raises(RecordingError) as caught:
        fit_recording(recording.select(keep))
    assert str(TARGETS_NEEDED) in caught.value.remedy and f"{targets} targets" in caught.value.message


@pytest.mark.filterwarnings("ignore:targets that are left out")  # few of them, or few channels
@pytest.mark.parametrize("each", [1, 3])
def test_nine_points_are_enough_for_a_finite_model(each, quick):
    recording = Eye(0).recording(targets=9, frames=each)
    result = fit_recording(recording, 32)
    az, el, _ = result.model.predict(recording.features)
    assert np.abs(np.stack([az, el], 1) - recording.target_deg).max() < 15


def test_one_row_per_target_and_a_pursuit_are_recordings_too(quick):
    eye, rng = Eye(2), np.random.default_rng(0)
    gaze = rng.uniform(-22, 22, (300, 2))
    single = Recording(np.arange(300) * 10**6, eye.features(gaze, rng), gaze, np.ones(300))
    assert errors(fit_recording(single, 32).model, eye)[0].mean() < 0.35
    time = np.arange(12_000) * 12_000
    path = 22 * np.stack([np.sin(time / 2.9e6), np.sin(time / 20.7e6)], 1)
    pursuit = Recording(time, eye.features(path, rng), path, np.ones(len(time)))
    found = fixations(pursuit)
    assert np.abs(found.target_deg - found.target[found.label]).max() < 1.0
    assert errors(fit_recording(pursuit, 32).model, eye, reach=15.0)[0].mean() < 0.35


def test_channels_of_very_different_scale(quick):
    eye = Eye(3)
    shrink = np.array([1.0, 0.1, 1.0, 0.02, 0.5, 1.0])

    def squeeze(features):
        return np.rint(eye.level + (features - eye.level) * shrink)

    recording = eye.recording()
    recording.features = squeeze(recording.features).astype(np.uint16)
    model = fit_recording(recording, 32).model
    rng = np.random.default_rng(3)
    gaze = rng.uniform(-19, 19, (1000, 2))
    az, el, _ = model.predict(squeeze(eye.features(gaze, rng)).astype(np.uint16))
    assert frame_errors_deg(az, el, *gaze.T).mean() < 0.7


@pytest.mark.filterwarnings("ignore:targets that are left out")  # few of them, or few channels
@pytest.mark.parametrize("d", [2, 3, 5])
def test_fewer_channels_than_six(d, quick):
    recording = Eye(0).recording()
    recording.features = recording.features[:, :d]
    result = fit_recording(recording, n_vectors=32)
    assert result.model.channels == d
    az, el, flags = result.model.predict(recording.features)
    assert np.isfinite(az).all() and np.mean(flags == FLAG_VALID) > 0.99


def test_impossible_vector_counts_are_refused(fitted):
    recording = fitted[0].recording()
    for n in (0, choose.ROOM + 1):
        with pytest.raises(ModelError, match=str(n)):
            distil(fitted[1].gp, recording.features, recording.target_deg, n)
    with pytest.raises(CalibrationError):
        distil(fitted[1].gp, recording.features[:1], recording.target_deg[:1])


def test_the_largest_model_that_fits_a_slot(fitted, quick):
    recording = fitted[0].recording()
    model, report = distil(fitted[1].gp, recording.features, recording.target_deg, choose.ROOM)
    assert model.vectors == choose.ROOM and len(model.image) <= choose.NANO_SLOT_BYTES
    assert report.rms_deg < 0.1


def test_no_warning_on_ordinary_data(quick):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_recording(Eye(4).recording(), 32)
