# SPDX-License-Identifier: Apache-2.0
"""fit_recording on recordings that are hard: each case is named, with what is expected of it."""

import warnings

import numpy as np
import pytest
from test_distil import Eye, errors
from threadpoolctl import threadpool_limits

from sparsegaze import distil as module
from sparsegaze.distil import distil
from sparsegaze.expansion import Expansion
from sparsegaze.fit import fit_recording
from sparsegaze.gp import GaussianProcess
from sparsegaze.metrics import frame_errors_deg
from sparsegaze.process import fit_process, local_noise
from sparsegaze.recording import Recording
from sparsegaze.rounding import assemble
from sparsegaze.trust import Trust

pytestmark = pytest.mark.filterwarnings("ignore:targets that are left out")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    for name, value in (("FIRST_STEPS", 5), ("LATER_STEPS", 2), ("POLISH_STEPS", 8), ("POINTS", 1200)):
        monkeypatch.setattr(module, name, value)


def singles(seed=0, count=289, reach=20.0):
    """One reading per target, as the synthetic sets have it: (Eye, Recording)."""
    eye, rng = Eye(seed, ring=0.05), np.random.default_rng(seed)
    side = np.linspace(-reach, reach, int(np.sqrt(count)))
    gaze = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    return eye, Recording(np.arange(len(gaze)) * 10**6, eye.features(gaze, rng), gaze, np.ones(len(gaze)))


@pytest.mark.parametrize("seed", [0, 1])
def test_one_reading_per_target_gives_exactly_the_plain_process_and_its_noise_is_found(seed):
    eye, recording = singles(seed)
    fitted = fit_process(recording)
    known = recording.features, recording.target_deg
    plain = GaussianProcess.fit(*known, mean=fitted.gp.mean, length_max=3.0)
    query = eye.features(np.random.default_rng(9).uniform(-19, 19, (500, 2)), np.random.default_rng(8))
    np.testing.assert_allclose(fitted.gp.predict(query), plain.predict(query), atol=1e-6)
    assert (0.7 * 10.0 < fitted.fixed.noise).all() and (fitted.fixed.noise < 1.4 * 10.0).all()


def test_a_linear_mean_is_taken_where_its_likelihood_is_worth_its_parameters_and_only_there():
    rng = np.random.default_rng(0)
    gaze = np.stack(np.meshgrid(*[np.linspace(-20, 20, 13)] * 2), -1).reshape(-1, 2)
    slope = rng.normal(0, 60, (2, 6))
    bumps = 30 * np.sin(gaze @ rng.normal(0, 1.2, (2, 6)))  # a fine structure on a strong slope
    for fine, mean in ((bumps, "linear"), (0.0, None)):
        features = np.rint(20000 + gaze @ slope + fine + rng.normal(0, 3, (169, 6)))
        fitted = fit_process(Recording(np.arange(169) * 10**6, features, gaze, np.ones(169)))
        constant = GaussianProcess.fit(features, gaze, mean="constant", length_max=3.0)
        linear = GaussianProcess.fit(features, gaze, mean="linear", length_max=3.0)
        worth = linear.lml - constant.lml > 0.5 * 12 * np.log(169)
        assert fitted.gp.mean == ("linear" if worth else "constant")
        assert mean is None or fitted.gp.mean == mean


def test_the_local_noise_of_a_smooth_surface_is_its_noise_and_of_an_exact_one_is_0():
    rng = np.random.default_rng(0)
    target = rng.uniform(-20, 20, (300, 2))
    surface = np.stack([target[:, 0] ** 2, target.prod(axis=1), 3 * target[:, 1]], axis=1)
    noise = rng.standard_normal(surface.shape) * [1.0, 2.0, 0.5]
    np.testing.assert_allclose(local_noise(surface + noise, target), [1.0, 2.0, 0.5], rtol=0.25)
    assert (local_noise(surface, target) < 1e-9).all()
    assert (local_noise(surface[:7], target[:7]) == 0).all()  # too few to say


@pytest.mark.parametrize("value", [0, 65535])
def test_a_dead_or_saturated_led_is_dropped_and_the_rest_still_tell_gaze(value):
    eye = Eye(1)
    recording = eye.recording()
    recording.features[:, 2] = value
    with pytest.warns(UserWarning, match="s2"):
        result = fit_recording(recording, 24)
    gaze = np.random.default_rng(0).uniform(-19, 19, (500, 2))
    features = eye.features(gaze, np.random.default_rng(1))
    features[:, 2] = value
    az, el, _ = result.model.predict(features.astype(np.uint16))
    assert frame_errors_deg(az, el, *gaze.T).mean() < 1.0


def test_an_led_that_saturates_half_of_the_time_is_no_reason_to_fail():
    eye = Eye(2)
    recording = eye.recording()
    recording.features[:, 3] = np.minimum(recording.features[:, 3], np.median(recording.features[:, 3]))
    result = fit_recording(recording, 32)
    assert result.report.rms_to_gp_deg < 0.5 and result.report.loo_rms_deg < 2.0


def test_all_targets_on_a_line_say_where_on_the_line_gaze_is():
    eye, rng = Eye(3), np.random.default_rng(0)
    target = np.stack([np.linspace(-20, 20, 41), np.zeros(41)], axis=1).repeat(8, axis=0)
    t_us = np.arange(len(target)) * 3600 + np.arange(41).repeat(8) * 500_000
    recording = Recording(t_us, eye.features(target, rng), target, np.ones(len(target)))
    model = fit_recording(recording, 16).model
    az, el, _ = model.predict(recording.features)
    assert np.abs(az - target[:, 0]).mean() < 0.5 and np.abs(el).max() < 0.5


def test_ten_thousand_targets_are_thinned_not_refused():
    eye, rng = Eye(4), np.random.default_rng(0)
    gaze = rng.uniform(-22, 22, (10_000, 2))
    recording = Recording(np.arange(10_000) * 10**6, eye.features(gaze, rng), gaze, np.ones(10_000))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = fit_recording(recording, 24)
    assert len(result.gp.x) <= 2000 and errors(result.model, eye)[0].mean() < 0.4


def test_more_vectors_than_the_inputs_allow_become_a_quarter_of_them():
    eye, recording = singles()
    gp = GaussianProcess.fit(recording.features, recording.target_deg, mean="constant")
    model, report = distil(
        gp, recording.features, recording.target_deg, 91, points=120, noise=np.full(6, 10.0)
    )
    assert model.vectors == report.points // 4 < 31


@pytest.mark.parametrize(
    "kernel, p", [("matern52", None), ("laplace", None), ("minkowski", 1.5), ("cosine", None)]
)
def test_processes_of_other_kernels_are_distilled_too(kernel, p):
    eye, recording = singles(count=121)
    result = fit_recording(recording, 32, kernel=kernel, p=p)
    query = eye.features(np.random.default_rng(1).uniform(-18, 18, (500, 2)), np.random.default_rng(2))
    az, el, _ = result.model.predict(query.astype(np.uint16))
    miss = np.hypot(*(np.stack([az, el], 1) - result.gp.predict(query)).T)
    # Kernels with a cusp at every sample cannot be followed by a smooth one; it must come near all the same.
    assert np.sqrt(np.mean(miss**2)) < 0.5 and result.gp.kernel.name == kernel


def test_the_image_does_not_depend_on_the_number_of_threads():
    recording = Eye(0).recording(targets=49)
    images = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            images.append(fit_recording(recording, 16).model.image)
    assert images[0] == images[1]


def test_weights_that_alternate_hugely_get_a_coarser_format_or_more_ridge_and_never_wrap():
    rng = np.random.default_rng(0)
    s = rng.integers(1000, 3000, (800, 6))
    target = np.stack([30 * np.sin(s[:, 0] / 150.0), 20 * np.cos(s[:, 1] / 150.0)], axis=1)
    centres = 125 + rng.integers(0, 4, (40, 6))  # all in one place: only huge weights can tell them apart
    ones = np.full(6, 4096), np.zeros(6, np.int64)
    assert assemble(s, target, centres, ones[1], ones[0], 1e-14, Trust()) is None
    model, reach_deg = assemble(s, target, centres, ones[1], ones[0], 1e-3, Trust())
    assert np.abs(model.weights).max() <= 32767 and reach_deg[0] < reach_deg[1]


def test_a_model_whose_weights_fit_no_format_is_refitted_with_more_ridge(monkeypatch):
    refused = []

    def picky(*args):
        if len(refused) < 2:
            refused.append(args)
            return None
        return assemble(*args)

    monkeypatch.setattr(module, "assemble", picky)
    _, recording = singles(count=81)
    result = fit_recording(recording, 8)
    assert len(refused) == 2 and result.model.vectors == 8
    assert [args[5] for args in refused] == module.RIDGES[:2]


def test_equal_centres_are_no_reason_to_fail():
    from test_expansion import problem

    start = Expansion(problem(np.random.default_rng(0)), np.full(4, 2.0), np.zeros((5, 4)))
    better = start.improved(10)
    assert np.isfinite(better.cost) and better.cost <= start.cost
