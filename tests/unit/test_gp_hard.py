# SPDX-License-Identifier: Apache-2.0
"""The hard cases of a calibration's mathematics, each with what the process must do; judged in 60 digits."""

import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from gp_reference import KERNELS, LENGTH, hyper_for, quietly, recording, reference

from sparsegaze.errors import CalibrationError
from sparsegaze.gp import GaussianProcess, Hyper

every_kernel = pytest.mark.parametrize("name, p", KERNELS)


@pytest.mark.parametrize(
    "mean, signal_deg, noise_deg",
    [("linear", 30.0, 0.3), ("constant", 30.0, 1e-3), ("constant", 1e3, 1e-6), ("zero", 30.0, 0.0)],
)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0, 1e3])
@every_kernel
def test_length_scales_from_1e_3_to_1e3_agree_with_60_digits_within_the_stated_bound(
    name, p, scale, mean, signal_deg, noise_deg
):
    features, gaze = recording(16)
    query = np.vstack([recording(4, seed=5)[0], features[:2]])
    hyper = hyper_for(name, scale, signal_deg, noise_deg)
    gp = quietly(features, gaze, mean=mean, hyper=hyper, kernel=name, p=p)
    error = np.abs(gp.predict(query) - reference(gp, query, p)).max()
    assert error <= gp.rounding_deg <= 0.01


def test_the_bound_is_not_idle():
    """Rounded to single precision the weights break the bound: it tells a wrong answer from a right one."""
    features, gaze = recording(18)
    gp = quietly(features, gaze, mean="zero", hyper=Hyper(LENGTH * 3, 30.0, 0.01))
    wrong = gp._kernel(features) @ gp.alpha.astype(np.float32)
    assert np.abs(wrong - reference(gp, features)).max() > gp.rounding_deg
    assert np.abs(gp.predict(features) - reference(gp, features)).max() <= gp.rounding_deg


@every_kernel
def test_duplicates_and_near_duplicates_of_a_dense_pursuit(name, p):
    """Frames 1e-9 to 1 steps apart with slightly different labels: noise explains them, nothing blows up."""
    features, gaze = recording(25)
    rng = np.random.default_rng(3)
    rows = np.repeat(np.arange(25), 4)
    apart = np.array([0.0, 1e-9, 1e-3, 1.0])[np.tile(np.arange(4), 25)][:, None]
    dense = features[rows] + apart * rng.standard_normal((100, 6))
    labels = gaze[rows] + 0.3 * rng.standard_normal((100, 2))
    gp = quietly(dense, labels, mean="constant", kernel=name, p=p, restarts=0)
    assert 0.15 < gp.hyper.noise_deg < 0.6 and gp.rounding_deg < 0.01
    assert np.sqrt(np.mean((gp.predict(features) - labels.reshape(25, 4, 2).mean(axis=1)) ** 2)) < 0.4


@every_kernel
def test_exact_duplicates_without_noise_take_a_jitter_that_is_reported(name, p):
    features, gaze = recording(9)
    gp = GaussianProcess.fit(
        np.repeat(features, 2, axis=0),
        np.repeat(gaze, 2, axis=0),
        mean="zero",
        hyper=hyper_for(name, 1.0, 30.0, 0.0),
        kernel=name,
        p=p,
    )
    told = gp.describe()
    assert gp.jitter > 0 and told["condition_raw"] is None and "beyond 4.5e+14" in told["condition_note"]
    assert told["jitter_deg"] == pytest.approx(30.0 * np.sqrt(gp.jitter))
    assert np.abs(gp.predict(features) - gaze).max() < 0.01
    assert np.abs(gp.predict(features) - reference(gp, features, p)).max() <= gp.rounding_deg


def test_the_condition_number_is_right_up_to_where_float64_can_tell_and_named_beyond():
    """Two samples at a distance have K = s^2 [[1, c], [c, 1]], condition (1 + c) / (1 - c).

    Figures are right to 1e-14 of themselves squared: 4 % at 4e12. A third sample is far away.
    """
    for gap, known in ((1.0, True), (1e-3, True), (1e-6, True), (3e-7, True), (1e-8, False), (0.0, False)):
        x = np.array([[0.0], [gap], [9.0]])
        y = np.array([[1.0, 1.0], [1.0, 1.0], [-1.0, -1.0]])
        gp = quietly(x, y, mean="zero", hyper=Hyper(np.ones(1), 1.0, 0.0))
        c = np.exp(-0.5 * gap**2)
        told = gp.describe()
        if known:
            expected = (1 + c) / -np.expm1(-0.5 * gap**2)
            assert gp.condition_raw == pytest.approx(expected, rel=max(1e-9, 1e-14 * expected))
            assert told["condition_raw"] == gp.condition_raw and told["condition_note"] == ""
        else:
            assert told["condition_raw"] is None and "4.5e+14" in told["condition_note"]
            assert gp.rounding_deg < 0.01 and (gp.jitter > 0 or gap > 0)


@pytest.mark.parametrize("noise_deg", [1e-2, 1e-4, 1e-6, 1e-8])
def test_condition_numbers_to_1e16_and_beyond_predict_within_the_bound(noise_deg):
    features, gaze = recording(22)
    gp = quietly(features, gaze, mean="zero", hyper=Hyper(LENGTH * 1e4, 3e2, noise_deg))
    assert gp.condition_raw > 0.9 * min(22 * (3e2 / noise_deg) ** 2, 1e15)
    query = recording(5, seed=8)[0]
    assert np.abs(gp.predict(query) - reference(gp, query)).max() <= gp.rounding_deg <= 0.01


@every_kernel
def test_the_papers_form_without_noise_learns_interpolates_and_reports(name, p):
    features, gaze = recording(60, noise_deg=0.0, step_noise=0.0)
    gp = GaussianProcess.fit(features, gaze, mean="zero", kernel=name, p=p, noise_free=True, restarts=0)
    told = gp.describe()
    assert gp.noise_free and gp.hyper.noise_deg == 0 and told["noise_free"]
    assert np.abs(gp.predict(features) - gaze).max() < max(0.01, 30 * gp.rounding_deg)
    assert gp.condition > 1 and gp.rounding_deg <= 0.01 and np.isfinite(gp.lml)
    again = GaussianProcess.fit(features, gaze, mean="zero", kernel=name, p=p, hyper=gp.hyper)
    np.testing.assert_array_equal(again.predict(features), gp.predict(features))


def test_noise_that_differs_between_samples_is_weighed():
    features, gaze = recording(40)
    scale = np.where(np.arange(40) % 2, 1e12, 1.0)
    gp = quietly(features, gaze, noise_scale=scale, mean="constant", hyper=Hyper(LENGTH, 30.0, 0.3))
    few = quietly(features[::2], gaze[::2], mean="constant", hyper=gp.hyper)
    np.testing.assert_allclose(gp.predict(features), few.predict(features), atol=0.1)
    assert np.abs(gp.predict(features) - reference(gp, features)).max() <= gp.rounding_deg


@pytest.mark.parametrize("scale", [[1.0], [-1.0] * 20, [np.nan] * 20])
def test_a_noise_scale_that_is_no_variance_is_refused(scale):
    with pytest.raises(CalibrationError, match="noise_scale"):
        GaussianProcess.fit(*recording(20), noise_scale=np.array(scale))


@every_kernel
@pytest.mark.parametrize("dead", [65535.0, 0.0])
def test_a_constant_channel_is_dropped_with_a_warning_whatever_the_kernel(name, p, dead):
    features, gaze = recording(40)
    features[:, 4] = dead
    with pytest.warns(UserWarning, match="constant channel dropped: s4"):
        gp = GaussianProcess.fit(features, gaze, mean="constant", kernel=name, p=p, restarts=0)
    rest = np.delete(features, 4, 1)
    without = GaussianProcess.fit(rest, gaze, mean="constant", kernel=name, p=p, restarts=0)
    changed = features.copy()
    changed[:, 4] = 1234.0
    np.testing.assert_allclose(gp.predict(changed), without.predict(rest), atol=1e-6)
    assert gp.describe()["length"][4] is None and np.all(gp.gradient(features)[:, :, 4] == 0)


@every_kernel
@pytest.mark.parametrize("stuck", [65535.0, 0.0])
def test_a_led_that_saturates_or_dies_on_half_of_the_rows(name, p, stuck):
    """The other five channels carry the gaze: held-out error on both halves stays small."""
    features, gaze = recording(160)
    features[:80, 2] = stuck
    held = np.r_[70:80, 150:160]
    kept = np.setdiff1d(np.arange(160), held)
    gp = quietly(features[kept], gaze[kept], mean="constant", kernel=name, p=p, restarts=0)
    error = np.linalg.norm(gp.predict(features[held]) - gaze[held], axis=1)
    limit = 8.0 if name == "cosine" else 2.5 if name in ("laplace", "canberra", "minkowski") else 1.5
    assert np.sqrt(np.mean(error**2)) < limit and gp.rounding_deg < 0.01


@pytest.mark.parametrize("name, p", [case for case in KERNELS if case[0] not in ("canberra", "cosine")])
def test_channels_of_scales_from_1e_3_to_1e6(name, p):
    features, gaze = recording(50)
    scale = np.array([1.0, 1e-3, 1e6, 1e3, 1e-2, 1e5])
    query = recording(20, seed=3)[0]
    plain = quietly(features, gaze, mean="constant", kernel=name, p=p, restarts=0)
    scaled = quietly(features * scale, gaze, mean="constant", kernel=name, p=p, restarts=0)
    np.testing.assert_allclose(scaled.predict(query * scale), plain.predict(query), atol=0.02)


def test_canberra_does_not_see_the_scale_of_a_channel_at_all():
    features, gaze = recording(40)
    scale = np.array([1.0, 1e-3, 1e6, 1e3, 1e-2, 1e5])
    hyper = Hyper(LENGTH * 1e-5, 20.0, 0.3)
    a = GaussianProcess.fit(features, gaze, mean="zero", hyper=hyper, kernel="canberra")
    b = GaussianProcess.fit(features * scale, gaze, mean="zero", hyper=hyper, kernel="canberra")
    np.testing.assert_allclose(a.predict(features), b.predict(features * scale), atol=1e-8)


@every_kernel
def test_one_outlier_of_100_sigma_is_the_worst_left_out_and_its_removal_heals(name, p):
    features, gaze = recording(60)
    clean = quietly(features, gaze, mean="constant", kernel=name, p=p, restarts=0)
    sigma = clean.loo()[1].mean()
    bad = gaze.copy()
    bad[7] += [100 * sigma, 0]
    gp = quietly(features, bad, mean="constant", kernel=name, p=p, hyper=clean.hyper)
    predicted, spread = gp.loo()
    miss = np.linalg.norm(gp.y - predicted, axis=1) / spread
    worst = int(np.argmax(miss))
    np.testing.assert_array_equal(gp.y[worst], bad[7])
    assert miss[worst] > 25
    rest = np.delete(features, 7, 0), np.delete(bad, 7, 0)
    healed = quietly(*rest, mean="constant", kernel=name, p=p, hyper=gp.hyper)
    assert np.abs(healed.predict(features) - clean.predict(features)).max() < 5 * sigma


@every_kernel
def test_two_points_are_refused_with_the_number_needed_or_joined(name, p):
    features, gaze = recording(2)
    with pytest.raises(CalibrationError, match="give at least 3"):
        GaussianProcess.fit(features, gaze, mean="constant", kernel=name, p=p)
    gp = quietly(features, gaze, mean="zero", hyper=hyper_for(name, 1.0, 30.0, 0.1), kernel=name, p=p)
    np.testing.assert_allclose(gp.predict(features), gaze, atol=0.1)
    assert np.abs(gp.predict(recording(50, seed=1)[0])).max() < 60


@every_kernel
def test_five_points_give_a_calm_answer(name, p):
    features, gaze = recording(5)
    gp = quietly(features, gaze, mean="constant", kernel=name, p=p)
    mean, std = gp.predict(recording(50, seed=2)[0], return_std=True)
    assert np.abs(mean).max() < 60 and np.isfinite(std).all() and std.min() >= 0
    with pytest.raises(CalibrationError, match="give at least 9"):
        GaussianProcess.fit(features, gaze, mean="linear", kernel=name, p=p)


def test_ten_thousand_points_keep_3000_and_predict_the_others():
    features, gaze = recording(10_000, noise_deg=0.5)
    tracemalloc.start()
    with pytest.warns(UserWarning, match="10000 samples given, 3000 of them kept"):
        gp = GaussianProcess.fit(features, gaze, mean="constant", hyper=Hyper(LENGTH, 30.0, 0.5))
    assert len(gp.x) == 3000 and gp.rows_given == 10_000
    assert tracemalloc.get_traced_memory()[1] < 8 * 3000**2 * 8  # eight matrices
    tracemalloc.reset_peak()
    mean, std = gp.predict(features), gp.predict(features[:500], return_std=True)[1]
    assert tracemalloc.get_traced_memory()[1] < 6 * 3000**2 * 8
    tracemalloc.stop()
    assert np.sqrt(np.mean((mean - gaze) ** 2)) < 0.6 and mean.shape == (10_000, 2) and std.max() < 3
    order = np.random.default_rng(0).permutation(10_000)
    few = quietly(features, gaze, mean="constant", hyper=gp.hyper, rows_max=400)
    again = quietly(features[order], gaze[order], mean="constant", hyper=gp.hyper, rows_max=400)
    np.testing.assert_array_equal(again.predict(features[:100]), few.predict(features[:100]))


@every_kernel
def test_all_targets_on_a_line(name, p):
    features, gaze = recording(50)
    gaze[:, 1] = 0.5 * gaze[:, 0] + 1.0
    gp = quietly(features, gaze, mean="constant", kernel=name, p=p, restarts=0)
    got = gp.predict(recording(50, seed=4)[0])
    np.testing.assert_allclose(got[:, 1], 0.5 * got[:, 0] + 1.0, atol=1e-4)


def test_weights_that_alternate_hugely_still_give_the_right_digits():
    """Neighbours 1 step apart with labels of +-5 deg and hardly any noise: weights 1e6 times the answer."""
    rng = np.random.default_rng(1)
    features = recording(11)[0]
    features = np.repeat(features, 2, axis=0) + np.tile([[0.0], [3.0]], (11, 6))
    gaze = rng.uniform(-5, 5, (22, 2)) + np.tile([[5.0], [-5.0]], (11, 2))
    gp = quietly(features, gaze, mean="zero", hyper=Hyper(LENGTH, 30.0, 1e-3))
    weights = gp.alpha * gp.hyper.signal_deg**2
    assert np.abs(weights).max() > 1e4 * np.abs(gaze).max()
    assert np.sum(np.diff(np.sign(weights[np.argsort(gp.x[:, 0])]), axis=0) != 0) > 22
    error = np.abs(gp.predict(features) - reference(gp, features)).max()
    assert error <= gp.rounding_deg <= 0.01


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
@every_kernel
def test_nan_infinities_and_absurd_sizes_are_refused_in_words(name, p, bad):
    features, gaze = recording(20)
    fine = quietly(features, gaze, mean="constant", kernel=name, p=p, hyper=hyper_for(name, 1.0, 30.0, 0.3))
    features[3, 1] = bad
    with pytest.raises(CalibrationError, match="nan or infinity|1e100"):
        GaussianProcess.fit(features, gaze, kernel=name, p=p)
    with pytest.raises(CalibrationError, match="nan or infinity|1e100"):
        GaussianProcess.fit(gaze + 30, features[:, :2], kernel=name, p=p)
    if not np.isfinite(bad):
        for ask in (fine.predict, fine.gradient):
            with pytest.raises(CalibrationError, match="nan or infinity"):
                ask(features)


def test_queries_of_another_width_or_outside_the_measure_are_refused():
    features, gaze = recording(30)
    hyper = hyper_for("canberra", 1.0, 30.0, 0.3)
    gp = quietly(features, gaze, mean="constant", kernel="canberra", hyper=hyper)
    with pytest.raises(CalibrationError, match="6 channels"):
        gp.predict(features[:, :5])
    with pytest.raises(CalibrationError, match="below 0"):
        gp.predict(-features)
    assert gp.predict(features[:0]).shape == (0, 2)


def test_order_and_threads_do_not_change_a_bit_whatever_the_kernel(tmp_path):
    """Another process with four threads of BLAS, the samples shuffled: the same bytes."""
    features, gaze = recording(300)
    np.savez(tmp_path / "data.npz", x=features, y=gaze)
    script = (
        "import sys, warnings, numpy as np; warnings.simplefilter('ignore')\n"
        "from sparsegaze.gp import GaussianProcess\n"
        f"data = np.load(r'{tmp_path / 'data.npz'}')\n"
        "order = np.random.default_rng(int(sys.argv[1])).permutation(300)\n"
        "for name, p in (('rbf', None), ('laplace', None), ('minkowski', 3.0)):\n"
        "    args = dict(mean='constant', kernel=name, p=p, restarts=0, learn_rows=150)\n"
        "    gp = GaussianProcess.fit(data['x'][order], data['y'][order], **args)\n"
        "    mean, std = gp.predict(data['x'], return_std=True)\n"
        "    print(mean.tobytes().hex()[:4000], std.tobytes().hex()[:2000], gp.lml)\n"
    )
    answers = []
    for seed, threads in (("1", "1"), ("2", "4")):
        env = dict(os.environ, OMP_NUM_THREADS=threads, OPENBLAS_NUM_THREADS=threads)
        command = [sys.executable, "-c", script, seed]
        answers.append(subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout)
    assert answers[0] == answers[1] and len(answers[0]) > 10_000


@every_kernel
def test_one_live_channel_and_channels_that_hardly_change(name, p):
    """One channel, all others dead: whatever the kernel can do with it, without a word of numpy's."""
    features, gaze = recording(40)
    alone = np.full((40, 6), 65535.0)
    alone[:, 3] = features[:, 3]
    gp = quietly(alone, gaze, mean="constant", kernel=name, p=p, restarts=0)
    assert gp.dropped == (0, 1, 2, 4, 5) and np.abs(gp.predict(alone)).max() < 40
    rare = features.copy()
    rare[:, 1] = 500.0
    rare[7, 1] = 501.0
    gp = quietly(rare, gaze, mean="constant", kernel=name, p=p, restarts=0)
    assert gp.dropped == () and gp.rounding_deg < 0.01 and gp.describe()["loo_rms_deg"] < 10


def test_a_channel_whose_changes_float64_cannot_square_is_as_good_as_constant():
    features, gaze = recording(30)
    features[:, 2] = 1e-200 * features[:, 2]
    with pytest.warns(UserWarning, match="constant channel dropped: s2"):
        GaussianProcess.fit(features, gaze, mean="constant", restarts=0)
