# SPDX-License-Identifier: Apache-2.0
"""From float networks to the device's integers: distance, proven bounds, formats chosen, what is refused."""
import dataclasses

import numpy as np
import pytest

from mlp_models import synthetic_set
from sparsegaze import mlp, mlp_round, mlp_train
from sparsegaze.errors import CalibrationError
from sparsegaze.gp import GaussianProcess
from sparsegaze.mlp import MlpModel


@pytest.fixture(scope="module", params=[0, 1, 2])
def trained(request):
    """(features, a 6-16-16-2 network, held-out features, their true gaze) of a smooth synthetic set."""
    features, gaze, test, truth = synthetic_set(request.param)
    return features, mlp_train.train(features, gaze, (16, 16), seed=request.param), test, truth


def outputs(model, features):
    """float [n, m] by the device's C."""
    return np.array(model.predict(features)[:-1]).T


def rms(a, b):
    """Rms distance of gazes [n, 2]."""
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


@pytest.mark.parametrize("weight_bytes,limit", [(2, 0.008), ("auto", 0.025), (1, 0.08)])
def test_fixed_point_stays_close_to_the_float_network(trained, weight_bytes, limit):
    features, network, test, truth = trained
    model, report = mlp_round.quantise(network, features, weight_bytes)
    y, exact = outputs(model, test), network.predict(test)
    error, float_error = (np.hypot(*(v - truth).T).mean() for v in (y, exact))
    print(f"6-16-16-2, weights of {report.weight_bytes} bytes: {report.n_bytes} bytes; on 2000 other inputs "
          f"rms {rms(y, exact):.4f}, max {np.hypot(*(y - exact).T).max():.4f} deg to the float network; mean "
          f"error to the truth {error:.4f}, of the float network {float_error:.4f} deg")
    assert rms(y, exact) < limit and error < (1.0 + limit) * float_error
    assert report.n_bytes == len(model.image) and report.weight_bytes == model.weight_bytes


@pytest.mark.parametrize("widths", [(16,), (24,), (16, 16), (12, 8)], ids=str)
def test_small_networks_distilled_from_a_process(widths):
    features, gaze, test, truth = synthetic_set(0)
    gp = GaussianProcess.fit(features, gaze, mean="constant")
    network = mlp_train.distil(gp, features, gaze, widths, points=1500, noise=1.5, restarts=1, steps=1500)
    full, exact = gp.predict(test.astype(float)), network.predict(test)
    for weight_bytes, limit in ((2, 0.008), ("auto", 0.025)):
        model, report = mlp_round.quantise(network, features, weight_bytes)
        y = outputs(model, test)
        error, full_error = (np.hypot(*(v - truth).T).mean() for v in (y, full))
        print(f"6-{'-'.join(map(str, widths))}-2, weights of {report.weight_bytes} bytes, {report.n_bytes} "
              f"bytes: rms to the process {rms(y, full):.3f} (float {rms(exact, full):.3f}), to the float "
              f"network {rms(y, exact):.4f}; error to the truth {error:.3f} deg (process {full_error:.3f})")
        assert rms(y, exact) < limit and rms(y, full) < 1.05 * rms(exact, full) + limit
    assert rms(exact, full) < 0.4


@pytest.mark.parametrize("weight_bytes", [1, 2])
def test_the_proven_bound_holds_where_it_is_measured(trained, weight_bytes):
    features, network, test, _ = trained
    model, report = mlp_round.quantise(network, features, weight_bytes)
    inside = model.predict(test)[-1] == 0
    wild = np.random.default_rng(0).integers(0, 1024, (3000, 6)).astype(np.uint16)
    for rows in (test[inside], wild):
        seen = np.abs(outputs(model, rows) - mlp_round.real_outputs(model, rows)).max(axis=0)
        here, anywhere = mlp_round.error_bound(model, rows), mlp_round.error_bound(model)
        print(f"weights of {weight_bytes} bytes: worst rounding error seen {seen} deg, proven for these "
              f"inputs {here}, for any input {anywhere}")
        assert (seen < here).all() and (here <= anywhere + 1e-12).all()
    assert report.reached < report.bound_rows <= report.bound < 1.0


def test_auto_takes_short_weights_only_where_they_cost_little(trained):
    features, network, _, _ = trained
    short, long = (mlp_round.quantise(network, features, "auto", limit=limit)[1] for limit in (9.0, 0.0))
    assert short.weight_bytes == (1, 1, 1) and long.weight_bytes == (2, 2, 2)
    between = mlp_round.quantise(network, features, "auto", limit=0.02)[1]
    assert between.rms <= 0.02 and between.n_bytes <= long.n_bytes


def test_refit_on_the_devices_own_activations_is_worth_it(trained, monkeypatch):
    features, network, test, _ = trained
    exact = network.predict(test)
    with_refit = rms(outputs(mlp_round.quantise(network, features, 1)[0], test), exact)
    monkeypatch.setattr(mlp_round, "RIDGE", 1e9)        # keeps the float weights, and rounds each for itself
    without = rms(outputs(mlp_round.quantise(network, features, 1)[0], test), exact)
    print(f"1-byte weights, rms to the float network: refitted {with_refit:.4f}, rounded {without:.4f} deg")
    assert with_refit < 0.7 * without


def test_result_is_a_pure_function_and_of_numpy_alone(trained, tmp_path):
    features, network, test, _ = trained
    model, report = mlp_round.quantise(network, features)
    again, report_again = mlp_round.quantise(network, np.random.default_rng(0).permutation(features))
    assert model.image == again.image and report == report_again
    model.save(tmp_path / "net")
    y, flags = mlp.emulate(MlpModel.load(tmp_path / "net"), test)
    assert np.array_equal(y / 128, outputs(model, test)) and np.array_equal(flags, model.predict(test)[-1])


def test_inputs_beyond_the_calibrated_range_are_flagged(trained):
    features, network, _, _ = trained
    model, _ = mlp_round.quantise(network, features)
    low, high = features.min(axis=0), features.max(axis=0)
    middle = ((low + high) // 2).astype(np.uint16)
    rows = np.tile(middle, (13, 1))
    for j in range(6):
        rows[2 * j, j] = max(int(low[j]) - int(high[j] - low[j]), 0)
        rows[2 * j + 1, j] = high[j] + (high[j] - low[j])
    assert model.predict(rows)[-1].tolist() == [mlp.FLAG_OUT_OF_RANGE] * 12 + [0]
    assert not model.predict(features.astype(np.uint16))[-1].any()


@pytest.mark.parametrize("span", [1, 3, 255, 256, 65535])
def test_features_of_any_span(span):
    rng = np.random.default_rng(span)
    x = rng.integers(0, span + 1, (200, 2)).astype(float)
    x[0], x[1] = 0, span
    y = np.column_stack([x[:, 0] / span * 20 - 10, x.sum(axis=1) / span])
    network = mlp_train.train(x, y, (4,), restarts=1, steps=200)
    model, report = mlp_round.quantise(network, x)
    assert report.rms < 0.03 and not model.predict(x)[-1].any()


def test_a_dropped_channel_has_no_gain_and_no_say():
    rng = np.random.default_rng(0)
    x = rng.uniform(100, 900, (100, 3))
    x[:, 1] = 500
    with pytest.warns(UserWarning, match="dropped"):
        network = mlp_train.train(x, x[:, ::2] / 50, (6,), restarts=1, steps=100)
    model, _ = mlp_round.quantise(network, x)
    rows = np.rint(x).astype(np.uint16)
    moved = rows.copy()
    moved[:, 1] = 60000
    assert model.gain_q8[1] == 0 and np.array_equal(model.predict(rows), model.predict(moved))


def test_a_network_of_huge_weights_is_refused():
    x = np.random.default_rng(0).uniform(0, 1000, (50, 2))
    network = mlp_train.train(x, x / 50, (3,), restarts=1, steps=20)
    huge = dataclasses.replace(network, layers=tuple((w * 1e6, b) for w, b in network.layers))
    with pytest.raises(CalibrationError, match="too large") as caught:
        mlp_round.quantise(huge, x)
    assert caught.value.remedy


@pytest.mark.parametrize("weight_bytes", [3, (2,), (2, 0), (1, 2, 1)])
def test_weight_bytes_that_do_not_fit_are_refused(weight_bytes):
    x = np.random.default_rng(0).uniform(0, 1000, (50, 2))
    network = mlp_train.train(x, x / 50, (3,), restarts=1, steps=20)
    with pytest.raises(CalibrationError, match="weight_bytes"):
        mlp_round.quantise(network, x, weight_bytes)
    with pytest.raises(CalibrationError, match="inputs"):
        mlp_round.quantise(network, x[:, :1])
