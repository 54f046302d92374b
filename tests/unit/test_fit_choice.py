# SPDX-License-Identifier: Apache-2.0
"""choose.py and what `sparsegaze fit` reports: how many vectors, what they cost, how good they are."""

import json

import numpy as np
import pytest
from budget import read
from test_distil import Eye

from sparsegaze import choose, cli
from sparsegaze import distil as module
from sparsegaze.cli_gaze import VECTORS
from sparsegaze.distil import distil, fit_recording
from sparsegaze.errors import ModelError
from sparsegaze.gp import GaussianProcess
from sparsegaze.model import DeviceModel


@pytest.fixture(scope="module")
def eye():
    return Eye(0)


@pytest.fixture
def quick(monkeypatch):
    for name, value in (("FIRST_STEPS", 5), ("LATER_STEPS", 2), ("POLISH_STEPS", 8), ("POINTS", 1500)):
        monkeypatch.setattr(module, name, value)


def test_the_cycles_that_are_stated_lie_between_those_of_the_prediction_and_of_the_whole_step():
    budget = read("atmega328p")  # of models with 64 vectors
    least, most = (budget[name]["cycles_max"] for name in ("sg_gp_predict", "sg_track_infer"))
    assert least <= choose.cycles(64) <= most


def test_the_command_line_takes_as_many_vectors_as_a_slot_holds_beside_any_grid():
    assert VECTORS.max == choose.ROOM


@pytest.mark.parametrize("vectors", [1, 24, 90])
def test_a_budget_holds_as_many_vectors_as_cost_no_more(vectors):
    cost = choose.cycles(vectors)
    assert choose.most_vectors(cost) == vectors == choose.most_vectors(cost + int(choose.CYCLES_EACH) - 1)
    assert choose.most_vectors(cost, vectors) == vectors


def test_a_budget_that_is_too_small_states_the_least():
    with pytest.raises(ModelError) as caught:
        choose.most_vectors(choose.cycles(1) - 1)
    assert str(choose.cycles(1)) in caught.value.remedy
    with pytest.raises(ModelError) as caught:
        choose.most_vectors(choose.cycles(30) - 1, 30)
    assert str(choose.cycles(30)) in caught.value.remedy and "30 vectors" in caught.value.message


def test_the_aim_is_what_five_percent_of_the_error_allow_and_never_above_the_ceiling():
    assert choose.aim_deg(10.0) == choose.AIM_DEG
    error = 0.1
    assert np.hypot(error, choose.aim_deg(error)) == pytest.approx(1.05 * error)
    assert choose.aim_deg(0.3, budget_cycles=9000) == choose.FINE_DEG


def test_the_fewest_vectors_that_meet_the_aim_are_found(eye):
    rng = np.random.default_rng(0)
    gaze = np.stack(np.meshgrid(*[np.linspace(-20, 20, 13)] * 2), -1).reshape(-1, 2)
    features = eye.features(gaze, rng)
    gp = GaussianProcess.fit(features, gaze, mean="constant")
    counts = []
    for aim in (0.3, 0.1):
        model, report = distil(gp, features, gaze, 64, noise=np.full(6, 10.0), points=2000, aim_deg=aim)
        assert report.rms_deg <= aim
        counts.append(model.vectors)
        half, coarse = distil(gp, features, gaze, model.vectors // 2, noise=np.full(6, 10.0), points=2000)
        assert coarse.rms_deg > aim
    assert counts[0] < counts[1] < 64


def test_an_aim_out_of_reach_takes_all_the_vectors_there_are(eye, quick):
    recording = eye.recording(targets=81)
    rng = np.random.default_rng(0)
    gp = GaussianProcess.fit(recording.features[::10] + rng.normal(0, 1, (81, 6)), recording.target_deg[::10])
    model, report = distil(gp, recording.features, recording.target_deg, 20, aim_deg=1e-6)
    assert model.vectors == 20 and report.rms_deg > 1e-6


def test_progress_goes_from_0_to_all_and_never_back(eye, quick):
    told = []
    fit_recording(eye.recording(targets=49), progress=lambda *step: told.append(step))
    assert {stage for stage, _, _ in told} == {"fit"} and {total for _, _, total in told} == {100}
    done = [d for _, d, _ in told]
    assert done[0] == 0 and done[-1] == 100 and len(done) > 5 and done == sorted(done)


@pytest.fixture
def run(tmp_path, eye, quick, capsys):
    """run(*args) of fit: (exit code, stdout, stderr)."""
    eye.recording(targets=49, frames=30).write(tmp_path / "eye.csv")

    def command(*args):
        code = cli.run(["fit", str(tmp_path / "eye.csv"), *map(str, args)])
        return code, *capsys.readouterr()

    return command


def test_fit_json_states_process_model_formats_bound_distance_and_cost(run, tmp_path):
    code, out, err = run("-o", tmp_path / "eye.sgm", "--vectors", 12, "--json")
    assert code == 0, err
    data, model = json.loads(out), DeviceModel.load(tmp_path / "eye.sgm")
    assert data["n_vectors"] == 12 == model.vectors and data["crc"] == model.crc
    assert data["bytes"] == len(model.image) and data["cycles"] == choose.cycles(12)
    assert data["kernel"]["kernel"] == "rbf" and data["n_full"] == data["kernel"]["rows"] > 100
    assert 0 < data["leave_one_out"]["mean_deg"] < data["leave_one_out"]["rms_deg"] < 3
    assert data["condition"] > 1 and data["jitter"] >= 0 and np.isfinite(data["lml"])
    assert 0 < data["rms_to_gp_deg"] < data["max_to_gp_deg"] and data["held_out_rows"] >= 0
    assert (
        2.0**-8 < data["error_bound_deg"] < 2
        and data["formats"]["reach_deg"] < data["formats"]["accumulator_deg"]
    )
    assert f"2^-{model.weight_frac_bits} deg" in data["formats"]["weights"] and data["warnings"] == []


def test_fit_within_a_budget_and_with_another_kernel(run, tmp_path):
    budget = choose.cycles(9) + 3
    _, out, _ = run("-o", tmp_path / "eye.sgm", "--budget-cycles", budget, "--kernel", "matern52", "--json")
    data = json.loads(out)
    assert data["n_vectors"] == 9 and data["cycles"] <= budget and data["kernel"]["kernel"] == "matern52"


def test_fit_for_people_names_what_matters(run, tmp_path):
    said = run("-o", tmp_path / "eye.sgm", "--vectors", 8)[1]
    for word in ("49 targets", "8 vectors", "cycles on the Nano", "rms", "proven", "condition"):
        assert word in said


def test_fit_with_a_measure_that_is_no_covariance_says_so_to_people(run, tmp_path):
    said = run("-o", tmp_path / "eye.sgm", "--vectors", 4, "--kernel", "minkowski", "--p", 3)[1]
    assert "gives no covariance in 3 or more channels" in said


@pytest.mark.parametrize(
    "args, named",
    [
        (["--budget-cycles", 100], f"--budget-cycles {choose.cycles(1)}"),
        (["--kernel", "minkowski"], "give p"),
        (["--kernel", "rbf", "--p", 2], "no order p"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(run, tmp_path, args, named):
    code, out, err = run("-o", tmp_path / "eye.sgm", *args)
    assert code == 1 and not (tmp_path / "eye.sgm").exists() and out == ""
    assert named in err.splitlines()[-1] and "Traceback" not in err


def test_fit_help_has_an_example(run):
    code, said, _ = run("--help")
    assert code == 0 and "Example:" in said and "sparsegaze fit eye.csv" in said and "--budget-cycles" in said
