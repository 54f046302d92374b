# SPDX-License-Identifier: Apache-2.0
"""trustfit.py: what lies on the surface of features is trusted, what leaves it within all ranges is not.

Features are a smooth function of gaze, made up here; no eye and no person.
"""

from dataclasses import replace

import numpy as np
import pytest

from sparsegaze import trustfit
from sparsegaze.errors import CalibrationError
from sparsegaze.model import quantise
from sparsegaze.trust import sigma_deg

NOISE = 25.0
OFFSET, GAIN = np.full(6, 20000), np.full(6, 2000)  # s over 8,386 feature steps


def surface(gaze):
    """Features [n, 6] of gazes [n, 2], between 21,000 and 27,500."""
    turn = np.arange(6) * np.pi / 3
    along = gaze @ np.array([np.cos(turn), np.sin(turn)])
    return 24000 + 2500 * np.sin(along / 18) + 500 * np.cos(gaze[:, :1] * gaze[:, 1:] / 300 + turn)


def frames(rng, targets, each):
    """(features, gaze, label), `each` frames at every target [k, 2], with noise and a drift per fixation."""
    label = np.repeat(np.arange(len(targets)), each)
    gaze = targets[label]
    drift = rng.normal(0, NOISE, (len(targets), 1)) * np.ones(6)
    return surface(gaze) + drift[label] + rng.normal(0, NOISE, (len(label), 6)), gaze, label


def judged(trust, features, gaze):
    s, clamped = quantise(np.rint(features), OFFSET, GAIN)
    return trust.judge(s, np.rint(gaze * 128).astype(np.int64), clamped)


@pytest.fixture(scope="module")
def learnt():
    """Trust of 120 fixations, and the generator of what comes after."""
    rng = np.random.default_rng(1)
    features, gaze, label = frames(rng, rng.uniform(-20, 20, (120, 2)), 20)
    sigma = 0.3 + 0.001 * gaze[:, 0] ** 2
    return trustfit.learn(features, gaze, sigma, OFFSET, GAIN, np.full(6, NOISE), label), rng


def test_new_gazes_on_the_surface_are_trusted(learnt):
    trust, rng = learnt
    features, gaze, _ = frames(rng, rng.uniform(-19, 19, (200, 2)), 5)
    outside, doubt, _ = judged(trust, features, gaze)
    print(f"refused {outside.mean():.4f}, doubt {np.quantile(doubt, [0.5, 0.99]) / 256}")
    assert outside.mean() < 0.01


@pytest.mark.parametrize("channels, steps",
                         [((0,), 1500), ((2, 3), 1500), ((0, 2, 4), 600), ((1, 3, 5), 600)])
def test_what_leaves_the_surface_inside_the_box_is_refused(learnt, channels, steps):
    trust, rng = learnt
    features, gaze, _ = frames(rng, rng.uniform(-15, 15, (200, 2)), 3)
    features[:, channels] -= steps
    assert not quantise(np.rint(features), OFFSET, GAIN)[1].any()
    outside, _, code = judged(trust, features, gaze)
    assert outside.mean() > 0.95 and (code[outside] == 255).all()


def test_ranges_alone_let_pass_what_the_expectation_refuses(learnt):
    trust, rng = learnt
    features, gaze, _ = frames(rng, rng.uniform(-15, 15, (200, 2)), 3)
    features[:, 0] -= 1000
    ranges, whole = (judged(one, features, gaze)[0].mean() for one in (replace(trust, limit=65535), trust))
    print(f"refused by ranges alone {ranges:.2f}, with doubt {whole:.2f}")
    assert ranges < 0.2 and whole > 0.9


def test_one_guard_alone_stays_below_the_limit_and_is_refused_where_its_range_ends(learnt):
    # Pupils drift along one direction and gaze stays right: it takes a second guard, or the end of the range.
    trust, rng = learnt
    assert 127**2 < trust.limit < 2 * 127**2
    features, gaze, _ = frames(rng, rng.uniform(-15, 15, (200, 2)), 3)
    assert (trust.row[0] == trust.row[0, 0]).all()  # what all fixations share in `frames`
    for steps, refused in ((150, False), (600, True)):
        assert (judged(trust, features - steps, gaze)[0].mean() > 0.95) == refused


def test_sigma_of_the_grid_is_the_one_that_was_given(learnt):
    trust, _ = learnt
    gaze = np.array([[0.0, 0.0], [10.0, 5.0], [-18.0, -12.0]])
    _, doubt, code = judged(trust, surface(gaze), gaze)
    base = sigma_deg(code - (doubt * trust.sigma_gain >> 12))
    np.testing.assert_allclose(base, 0.3 + 0.001 * gaze[:, 0] ** 2, rtol=0.08)


def test_sigma_doubles_from_no_doubt_to_the_limit(learnt):
    trust, _ = learnt
    assert trust.limit * trust.sigma_gain / 4096 == pytest.approx(16, rel=0.15)


def test_targets_far_apart_widen_the_limit():
    # A grid that bends between few targets is doubted where nobody looked during the calibration.
    limits = []
    for count in (16, 200):
        rng = np.random.default_rng(3)
        features, gaze, label = frames(rng, rng.uniform(-20, 20, (count, 2)), 12)
        made = trustfit.learn(features, gaze, np.ones(len(gaze)), OFFSET, GAIN, np.full(6, NOISE), label)
        limits.append(made.limit)
    assert limits[0] > limits[1] == trustfit.LIMIT_LEAST * 256


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_few_channels_have_at_least_one_guard_that_fits_the_format(channels):
    rng = np.random.default_rng(4)
    features, gaze, label = frames(rng, rng.uniform(-20, 20, (60, 2)), 8)
    parts = features[:, :channels], gaze, np.ones(len(gaze))
    made = trustfit.learn(*parts, OFFSET[:channels], GAIN[:channels], np.full(channels, NOISE), label)
    assert 1 <= made.guards <= max(1, channels - 2) and len(made.pack(channels)[0]) == 128


def test_all_targets_on_a_line_still_make_a_grid():
    rng = np.random.default_rng(5)
    line = np.column_stack([np.linspace(-20, 20, 40), np.zeros(40)])
    features, gaze, label = frames(rng, line, 10)
    made = trustfit.learn(features, gaze, np.ones(len(gaze)), OFFSET, GAIN, np.full(6, NOISE), label)
    assert min(made.sigma.shape) >= 2 and judged(made, features, gaze)[0].mean() < 0.01


def test_three_frames_are_too_few():
    with pytest.raises(CalibrationError, match="3 frames"):
        trustfit.learn(np.ones((3, 6)), np.ones((3, 2)), np.ones(3), OFFSET, GAIN, np.ones(6))
