# SPDX-License-Identifier: Apache-2.0
"""Training of float networks: gradients, determinism, what is refused, and how well small ones do."""
import warnings

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from threadpoolctl import threadpool_limits

from mlp_models import synthetic_set
from sparsegaze import mlp_train
from sparsegaze.errors import CalibrationError
from sparsegaze.gp import GaussianProcess


def waves(n=120, d=3, seed=0):
    """Features [n, d] and two smooth targets."""
    x = np.random.default_rng(seed).uniform(1000, 3000, (n, d))
    s = (x - 2000) / 1000
    return x, np.column_stack([10 * np.tanh(2 * s[:, 0]) + s[:, 1] ** 2, 5 * s[:, 0] * s[:, -1]])


def same(a, b):
    """Whether two networks are equal to the bit."""
    return a.held_out_rms == b.held_out_rms and all(
        np.array_equal(v, w) for one, two in zip(a.layers, b.layers) for v, w in zip(one, two))


@pytest.mark.parametrize("widths", [(), (4,), (5, 3), (3, 4, 2, 3)], ids=str)
def test_gradient_is_that_of_the_cost(widths):
    rng = np.random.default_rng(1)
    shapes = list(zip([*widths, 2], [3, *widths]))
    flat = rng.normal(0, 0.7, sum(r * c + r for r, c in shapes))
    h, t = rng.normal(0, 1, (20, 3)), rng.normal(0, 1, (20, 2))
    _, gradient = mlp_train._cost(flat, shapes, h, t, 0.01)
    numeric = approx_fprime(flat, lambda f: mlp_train._cost(f, shapes, h, t, 0.01)[0], 1e-7)
    assert np.allclose(gradient, numeric, atol=2e-6 * np.abs(gradient).max())


def test_result_is_the_same_whatever_the_order_of_the_rows_and_the_number_of_threads():
    x, y = waves()
    held = np.arange(len(x)) % 5 == 0
    order = np.random.default_rng(5).permutation(len(x))
    first = mlp_train.train(x, y, (6,), steps=60, seed=3)
    assert same(first, mlp_train.train(x[order], y[order], (6,), steps=60, seed=3))
    with threadpool_limits(2):
        assert same(first, mlp_train.train(x, y, (6,), steps=60, seed=3))
    assert not same(first, mlp_train.train(x, y, (6,), steps=60, seed=4))
    given = mlp_train.train(x, y, (6,), steps=60, held_out=held)
    assert same(given, mlp_train.train(x[order], y[order], (6,), steps=60, held_out=held[order]))


def test_distilled_network_is_the_same_whatever_the_order_of_the_rows():
    x, y = waves(60)
    gp = GaussianProcess.fit(x, y, mean="constant", restarts=0)
    order = np.random.default_rng(5).permutation(len(x))
    options = {"widths": (4,), "points": 200, "steps": 40, "restarts": 1}
    assert same(mlp_train.distil(gp, x, y, **options), mlp_train.distil(gp, x[order], y[order], **options))


def test_no_hidden_layer_is_least_squares():
    x, y = waves()
    held = np.zeros(len(x), bool)
    network = mlp_train.train(x, y, (), restarts=1, decay=0.0, held_out=held)
    design = np.column_stack([x, np.ones(len(x))])
    assert np.allclose(network.predict(x), design @ np.linalg.lstsq(design, y, rcond=None)[0], atol=1e-4)


def test_held_out_rows_stop_the_training_and_do_not_steer_it():
    x, y = waves()
    held = np.arange(len(x)) % 4 == 0
    wrong = y.copy()
    wrong[held] = np.random.default_rng(0).permutation(wrong[held])
    network = mlp_train.train(x, wrong, (12,), restarts=1, held_out=held)
    assert network.held_out_rms > 3                             # what cannot be learnt is not
    longer = mlp_train.train(x, y, (12,), restarts=1, held_out=held)
    assert longer.held_out_rms < 0.5


def test_affine_changes_of_the_features_change_nothing():
    x, y = waves()
    network = mlp_train.train(x, y, (5,), restarts=1, steps=30)
    other = mlp_train.train(x * 7.0 + 100.0, y, (5,), restarts=1, steps=30)
    assert np.allclose(network.predict(x), other.predict(x * 7.0 + 100.0), atol=1e-5)


def test_a_constant_channel_is_dropped_with_a_warning():
    x, y = waves()
    x[:, 1] = 1234.0
    with pytest.warns(UserWarning, match="constant channel dropped: s1"):
        network = mlp_train.train(x, y, (4,), restarts=1, steps=30)
    moved = x.copy()
    moved[:, 1] += 500
    assert np.array_equal(network.predict(x), network.predict(moved))


def test_a_channel_that_is_a_sum_of_others_is_no_new_direction():
    x, y = waves()
    doubled = np.column_stack([x, x[:, 0] + x[:, 1]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        network = mlp_train.train(doubled, y, (4,), restarts=1, steps=30)
    assert network.whiten.shape == (4, 3) and np.isfinite(network.predict(doubled)).all()


X, Y = waves(20)
BAD = {
    "shapes": ((X, Y[:-1]), {}, "do not fit"),
    "nine inputs": ((np.tile(X, 3), Y), {}, "9 inputs"),
    "nine outputs": ((X, np.tile(Y, 5)[:, :9]), {}, "9 outputs"),
    "five layers": ((X, Y, (4,) * 5), {}, "hidden layers"),
    "a layer too wide": ((X, Y, (65,)), {}, "hidden layers"),
    "an empty layer": ((X, Y, (0,)), {}, "hidden layers"),
    "nan": ((np.where(X == X[3, 1], np.nan, X), Y), {}, "nan"),
    "infinity": ((X, np.where(Y == Y[3, 1], np.inf, Y)), {}, "nan or infinity"),
    "three rows": ((X[:3], Y[:3]), {}, "3 rows"),
    "nothing changes": ((np.ones_like(X), Y), {}, "no channel changes"),
    "everything held out": ((X, Y), {"held_out": np.ones(20, bool)}, "no rows"),
    "no steps": ((X, Y), {"steps": 0}, "no training"),
}


@pytest.mark.parametrize("case", BAD)
def test_refused_with_a_message_and_a_remedy(case):
    args, options, message = BAD[case]
    with pytest.raises(CalibrationError, match=message) as caught:
        mlp_train.train(*args, **options)
    assert caught.value.remedy


def test_refused_by_distil():
    with pytest.raises(CalibrationError, match="do not do"):
        mlp_train.distil(None, X, Y[:5])


def test_distilled_from_a_process_it_is_closer_to_it_than_trained_on_the_samples():
    features, gaze, test, truth = synthetic_set(0)
    gp = GaussianProcess.fit(features, gaze, mean="constant")
    full = gp.predict(test.astype(float))

    def miss(network):
        return np.sqrt(np.mean(np.sum((network.predict(test) - full) ** 2, axis=1)))

    direct = mlp_train.train(features, gaze, (16, 16), restarts=2)
    distilled = mlp_train.distil(gp, features, gaze, (16, 16), points=2000, noise=1.5, restarts=1)
    print(f"rms distance to the full process, 6-16-16-2: trained on 289 samples {miss(direct):.3f} deg, "
          f"distilled {miss(distilled):.3f} deg; error to the truth of the process "
          f"{np.hypot(*(full - truth).T).mean():.3f}, of the distilled network "
          f"{np.hypot(*(distilled.predict(test) - truth).T).mean():.3f} deg")
    assert miss(distilled) < 0.1 and miss(distilled) < miss(direct)
