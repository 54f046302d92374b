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
from sparsegaze.distil import distil
from sparsegaze.errors import ModelError
from sparsegaze.fit import fit_recording
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


def test_a_rate_takes_the_most_vectors_that_reach_it_and_one_more_would_not():
    for rate in (560, 700, 900, 1000, 1001):
        n = choose.vectors_at(rate)
        assert 1 <= n < choose.ROOM and choose.rate_limit_hz(n) >= rate > choose.rate_limit_hz(n + 1)
    assert choose.vectors_at(1000) == choose.most_vectors(rate_hz=1000) == 15
    assert choose.vectors_at(16) == choose.ROOM and choose.most_vectors(rate_hz=16) == choose.MOST
    assert choose.most_vectors(rate_hz=700, n_vectors=7) == 7
    cost = choose.cycles(9)
    assert choose.most_vectors(cost, rate_hz=700) == 9 and choose.most_vectors(10 * cost, rate_hz=1000) == 15
    for slower in ({"features": True}, {"recentred": True}, {"repeats": 2}):
        assert choose.rate_limit_hz(15, **slower) < choose.rate_limit_hz(15)
    with_features = choose.rate_limit_hz(15, features=True)
    assert choose.rate_limit_hz(15, features=True, counts=True) < with_features


@pytest.mark.parametrize(
    "wish, words",
    [
        ({"rate_hz": 2000}, "2000 Hz is too fast: the device does 1001 Hz at most: "
                            "ask for --rate 1001 at most, which it reaches with up to 15 vectors"),
        ({"rate_hz": 1000, "n_vectors": 24}, "1000 Hz is too fast: 24 vectors do 916 Hz at most: "
                                             "ask for --rate 916 at most, or --vectors 15"),
    ],
)  # fmt: skip
def test_a_rate_out_of_reach_names_the_highest_there_is(wish, words):
    with pytest.raises(ModelError) as caught:
        choose.most_vectors(**wish)
    assert str(caught.value) == words


def test_the_aim_is_what_five_percent_of_the_error_allow_and_never_above_the_ceiling():
    assert choose.aim_deg(10.0) == choose.AIM_DEG
    error = 0.1
    assert np.hypot(error, choose.aim_deg(error)) == pytest.approx(1.05 * error)
    assert choose.aim_deg(0.3, budget_cycles=9000) == choose.aim_deg(0.3, rate_hz=900) == choose.FINE_DEG


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


def test_fit_for_a_rate_takes_the_vectors_that_reach_it_and_says_what_to_expect(run, tmp_path):
    _, out, _ = run("-o", tmp_path / "eye.sgm", "--rate", 1000, "--json")
    data = json.loads(out)
    assert data["n_vectors"] == 15 and data["rates_hz"]["gaze"] >= 1000 > data["rates_hz"]["recentred"]
    mean = data["leave_one_out"]["mean_deg"]
    assert data["predicted_deg"] == pytest.approx(np.hypot(mean, data["rms_to_gp_deg"])) and mean > 0
    said = run("-o", tmp_path / "eye.sgm", "--rate", 1000)[1]
    line = next(line for line in said.splitlines() if line.startswith("foreseen"))
    assert f"{data['predicted_deg']:.2f} deg in the mean" in line
    assert "up to 1001 Hz; 964 after a recentring" in line


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
        (["--rate", 1002], "1002 Hz is too fast: the device does 1001 Hz at most"),
        (["--rate", 1000, "--vectors", 24], "or --vectors 15"),
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
    assert "--rate HZ" in said and "Gazes a second" in said and "fit eye.csv --rate 1000" in said


@pytest.mark.parametrize("rate", ["0", "15", "fast", "65536"])
def test_a_rate_that_is_none_is_refused_by_the_range(run, tmp_path, rate):
    code, out, err = run("-o", tmp_path / "eye.sgm", "--rate", rate)
    assert code == 2 and out == "" and "--rate" in err and len(err.splitlines()) == 1
