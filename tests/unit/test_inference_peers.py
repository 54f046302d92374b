# SPDX-License-Identifier: Apache-2.0
"""The peers' bench: float C on a simulated ATmega328P answers what numpy answers, what does not fit is told
apart, settings are chosen on the calibration alone. The libraries themselves are not needed here."""

import sys
from pathlib import Path

import numpy as np
import pytest

BENCH = Path(__file__).resolve().parents[2] / "tools" / "bench"
sys.path.insert(0, str(BENCH))
try:
    import inference_peers
    from peers import avr_program, candidate, float_gp, polynomial, training
finally:
    sys.path.remove(str(BENCH))

LENGTH = np.full(6, 150.0)


def smooth_set(seed=0, side=17, points=2000):
    """Six channels of ten bits: (features, gaze_deg) of a grid in +-20 deg, and of points in +-19 deg.

    Offset + Gaussian bump + bright ring + 1.5 LSB of noise, each channel with its own place and size.
    """
    rng = np.random.default_rng(seed)
    angle = np.deg2rad(60.0 * np.arange(6))
    place = 20 * np.column_stack([np.cos(angle), np.sin(angle)])
    base, bump, ring = rng.uniform(100, 200, 6), rng.uniform(300, 450, 6), rng.uniform(60, 120, 6)
    wide, radius = rng.uniform(13, 17, 6), rng.uniform(18, 22, 6)
    axis = np.linspace(-20, 20, side)
    made = []
    for gaze in (np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2), rng.uniform(-19, 19, (points, 2))):
        away = np.linalg.norm(gaze[:, None] - place, axis=2)
        level = base + bump * np.exp(-0.5 * (away / wide) ** 2)
        level += ring * np.exp(-0.5 * ((away - radius) / 4) ** 2)
        count = np.rint(level + rng.normal(0, 1.5, level.shape))
        made += [np.clip(count, 0, 1023).astype(np.uint16), gaze]
    return made


@pytest.fixture(scope="module")
def data():
    return smooth_set(points=60)


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    assert not avr_program.missing()
    return tmp_path_factory.mktemp("peers")


def model(data, n, kind="inducing"):
    return float_gp.fit(data[0], data[1], n, LENGTH, 15.0, 0.2, kind)


@pytest.mark.parametrize("kind", ["subset", "inducing"])
def test_naive_float_c_answers_what_float32_in_numpy_does(data, workdir, kind):
    gp = model(data, 32, kind)
    figures = avr_program.measure(avr_program.Program({"peer.c": gp.source()}), data[2], workdir / kind)
    assert figures.fits and figures.reason == ""
    assert len(figures.rows) == len(data[2])
    assert np.abs(figures.gaze_deg - gp.predict(data[2])).max() < 1e-3
    assert 150_000 < figures.cycles_min < figures.cycles_max < 190_000  # 32 calls of exp() at 2,271
    assert 3000 < figures.flash < 5000 and 60 < figures.ram < 300


def test_weights_for_the_whole_calibration_beat_those_of_the_subset(data):
    subset, inducing = (model(data, 48, kind).predict(data[2]) - data[3] for kind in ("subset", "inducing"))
    assert np.hypot(*inducing.T).mean() < np.hypot(*subset.T).mean() < 5


def test_every_sample_a_centre_is_the_full_process(data):
    rows = slice(None, None, 7)
    x, y = data[0][rows], data[1][rows]
    gp = float_gp.fit(x, y, len(x), LENGTH, 15.0, 0.2, "subset")
    scaled = (x - x.mean(axis=0)) / LENGTH
    cov = 15.0**2 * float_gp.kernel(scaled, scaled) + 0.2**2 * np.eye(len(x))
    cross = 15.0**2 * float_gp.kernel((data[2] - x.mean(axis=0)) / LENGTH, scaled)
    exact = cross @ np.linalg.solve(cov, y - y.mean(axis=0)) + y.mean(axis=0)
    assert np.abs(gp.predict(data[2]) - exact).max() < 0.01


def test_a_polynomial_on_the_chip_answers_what_numpy_does(data, workdir):
    origin, gain = data[0].mean(axis=0), 1 / data[0].std(axis=0)
    fitted = polynomial.Polynomial.fit(data[0], data[1], 3, 1e-6, origin, gain)
    assert len(fitted.terms) == 84
    program = avr_program.Program({"peer.c": fitted.source()})
    figures = avr_program.measure(program, data[2], workdir / "poly")
    assert figures.fits
    assert np.abs(figures.gaze_deg - fitted.predict(data[2])).max() < 1e-3


def test_a_polynomial_finds_the_polynomial_it_is_given():
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, (200, 3))
    gaze = np.column_stack([1 + 2 * x[:, 0] * x[:, 1], x[:, 2] ** 2 - x[:, 0]])
    found = polynomial.Polynomial.fit(x, gaze, 2, 0.0, np.zeros(3), np.ones(3)).terms
    assert found[()] == pytest.approx([1, 0], abs=1e-9)
    assert found[(0, 1)] == pytest.approx([2, 0], abs=1e-9)
    assert found[(2, 2)] == pytest.approx([0, 1], abs=1e-9)


GREEDY = """#include "peer.h"
static volatile uint8_t kept[{bytes}];
void peer_predict(const uint16_t *feature, float *gaze_deg)
{{
    kept[feature[0] % {bytes}] = 1;
    gaze_deg[0] = feature[0];
    gaze_deg[1] = kept[0];
}}
"""
LONG = """#include <avr/pgmspace.h>
#include "peer.h"
static const uint8_t table[31000] PROGMEM = { 1, 2, 3 };
void peer_predict(const uint16_t *feature, float *gaze_deg)
{
    gaze_deg[0] = pgm_read_byte(&table[feature[0]]);
    gaze_deg[1] = feature[1];
}
"""


def test_a_peer_that_leaves_four_bytes_of_sram_fits(data, workdir):
    program = avr_program.Program({"peer.c": GREEDY.format(bytes=1000)})
    stack = avr_program.measure(program, data[2], workdir / "modest").ram - 1000
    program = avr_program.Program({"peer.c": GREEDY.format(bytes=2044 - stack)})
    figures = avr_program.measure(program, data[2], workdir / "tight")
    assert figures.fits and figures.ram == 2044


@pytest.mark.parametrize("wanted", [2040, 3000])
def test_a_peer_of_too_much_sram_is_measured_on_a_larger_chip_and_does_not_fit(data, workdir, wanted):
    program = avr_program.Program({"peer.c": GREEDY.format(bytes=wanted)})
    figures = avr_program.measure(program, data[2], workdir / f"greedy{wanted}")
    assert not figures.fits
    assert f"{figures.ram} bytes of SRAM, 2048 are there" in figures.reason
    assert figures.ram > wanted and figures.cycles_max > 0
    assert (figures.gaze_deg[:, 0] == data[2][:, 0]).all()


def test_a_peer_of_too_much_flash_does_not_fit(data, workdir):
    figures = avr_program.measure(avr_program.Program({"peer.c": LONG}), data[2], workdir / "long")
    assert not figures.fits
    assert figures.reason == f"{figures.flash} bytes of flash, 30720 are there"


def test_a_row_of_a_peer_that_does_not_compile_says_why(data, workdir):
    peer = candidate.Candidate("broken", "1", "a setting", {"peer.c": "no C at all"}, (), np.zeros((60, 2)))
    row = inference_peers._measure_one("set", peer, data[2], data[3], data[3], workdir / "broken")
    assert row["fits"] is False and row["cycles"] is None
    assert row["note"].startswith("a setting; avr-gcc: ") and "error" in row["note"]


def test_a_row_takes_its_errors_from_the_chip(data, workdir):
    gp = model(data, 8)
    wrong = np.zeros((60, 2))  # what the PC is said to have answered must not get into the figures
    peer = candidate.Candidate("naive", "-", "eight", {"peer.c": gp.source()}, (), wrong)
    row = inference_peers._measure_one("set", peer, data[2], data[3], gp.predict(data[2]), workdir / "eight")
    assert row["rms_to_gp_deg"] < 1e-3 < row["truth_mean_deg"]
    assert row["fits"] is True and row["cycles_min"] <= row["cycles"] and row["dataset"] == "set"


def test_what_the_runner_says_is_read():
    said = "section 0: 2 100 120\nuntouched 1900\n" + np.float32([1, 2, 3, 4]).tobytes().hex() + "\n"
    run = avr_program.parse(said, 2, 2048)
    assert (run.cycles_min, run.cycles_max, run.ram) == (100, 120, 148)
    assert run.gaze_deg.tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    "said", ["", "section 0: 1 100 120\nuntouched 1900\n00", "untouched 3\n" + "00" * 16, "section 0: x\n\n"]
)
def test_a_run_that_ended_early_is_an_error(said):
    with pytest.raises(avr_program.PeerError):
        avr_program.parse(said, 2, 2048)


def test_candidates_survive_the_way_between_the_two_environments(tmp_path):
    made = candidate.Candidate("a", "1", "n", {"peer.c": "x"}, ("/i",), np.eye(2))
    candidate.write([made, candidate.Candidate("b", "2", "m")], tmp_path / "out.json")
    first, second = candidate.read(tmp_path / "out.json")
    assert (first.name, first.sources, first.include) == ("a", {"peer.c": "x"}, ["/i"])
    assert (first.predicted == np.eye(2)).all() and second.predicted is None and second.sources == {}


def test_c_constants_are_the_float_they_were_made_of():
    for value in (0.0, -3.0, 1e-30, 1 / 3, 123456.789, 1e20):
        text = candidate.c_float(value)
        assert text.endswith("f") and ("." in text or "e" in text)
        assert np.float32(text[:-1]) == np.float32(value)


def row(cycles, error, dataset="set"):
    return {"dataset": dataset, "cycles": cycles, "truth_mean_deg": error}


FRONTIER = [row(5000, 0.5), row(9000, 0.2), row(100, 0.01, "another set")]


@pytest.mark.parametrize(
    ("peer", "expected"),
    [
        (row(300_000, 0.21), True),
        (row(9000, 0.2), False),
        (row(9001, 0.2), True),
        (row(4999, 3.0), False),
        (row(300_000, 0.19), False),
        (row(6000, 0.4), False),
        (row(None, None), True),
    ],
)
def test_dominated_asks_for_speed_and_error_on_the_same_data(peer, expected):
    assert inference_peers.dominated(peer, FRONTIER) is expected


def test_without_the_peers_environment_the_table_says_so(data, workdir, monkeypatch):
    monkeypatch.setattr(inference_peers, "PYTHON", workdir / "none")
    rows = inference_peers.measure("set", data[:2], data[2:], data[3], data[3], workdir / "absent")
    assert [r["fits"] for r in rows] == [False] and "setup_bench.sh" in rows[0]["note"]


@pytest.fixture(scope="module")
def calibration(data):
    """60 targets of 10 frames each, and 300 more rows between them."""
    rng = np.random.default_rng(5)
    target = np.repeat(data[3], 10, axis=0)
    frames = np.repeat(data[2], 10, axis=0) + rng.normal(0, 2, (600, 6))
    spread = frames[::2] + 1, target[::2] + rng.uniform(-0.1, 0.1, (300, 2))
    return training.Calibration(frames, target, spread)


def test_frames_of_a_target_that_is_left_out_train_nobody(calibration):
    seen = []

    def make(x, y):
        seen.append((x, y))
        return lambda q: np.zeros((len(q), 2))

    assert set(calibration.sets) == {"frames", "means", "spread"}
    for name in calibration.sets:
        seen.clear()
        calibration.error(make, name)
        assert len(seen) == training.FOLDS
        for fold, (_, y) in enumerate(seen):
            left_out = calibration.target_deg[calibration.fold_of_group[calibration.group] == fold]
            apart = np.linalg.norm(y[:, None] - np.unique(left_out, axis=0), axis=2)
            assert apart.min() > 0.15, "a row as near as augmentation moves it"
            assert len(y) >= len(calibration.sets[name][0]) // 2


def test_the_error_is_that_of_single_frames_of_targets_left_out(calibration):
    perfect = calibration.error(lambda x, y: lambda q: calibration.target_deg[_rows(calibration, q)], "means")
    assert perfect == 0.0
    nothing = calibration.error(lambda x, y: lambda q: np.zeros((len(q), 2)), "means")
    assert nothing == pytest.approx(np.hypot(*calibration.target_deg.T).mean())


def _rows(calibration, features):
    return [int(np.flatnonzero((calibration.features == f).all(axis=1))[0]) for f in features]


def test_the_choice_with_the_least_error_is_taken(calibration):
    def make(x, y, shift):
        return lambda q: calibration.target_deg[_rows(calibration, q)] + shift - (len(x) < 100) / 4

    name, (shift,) = calibration.best(make, [(3.0,), (0.25,), (-1.0,)])
    assert (name, shift) == ("means", 0.25)


def test_a_calibration_of_single_samples_has_no_means(data):
    assert set(training.Calibration(data[0], data[1]).sets) == {"frames"}


def test_thinning_takes_as_many_rows_of_each_group():
    group = np.repeat([0, 1, 2], [500, 30, 3])
    kept = training.evenly(group, 63, np.random.default_rng(0))
    assert np.bincount(group[kept]).tolist() == [30, 30, 3]
    assert len(np.unique(kept)) == 63 and (np.diff(kept) > 0).all()


def test_scikit_learns_likelihood_is_told_in_degrees(data):
    """A Gaussian of the targets themselves, whatever unit scikit-learn was given."""
    c = training.Calibration(data[0][::3], data[1][::3])
    gp = training.SklearnGP.learn(c, "frames")
    x, y = c.features / gp.length, c.target_deg - c.middle_deg
    cov = gp.signal_deg**2 * float_gp.kernel(x, x) + gp.noise_deg**2 * np.eye(len(x))
    _, logdet = np.linalg.slogdet(cov)
    exact = -0.5 * np.sum(y * np.linalg.solve(cov, y)) - logdet - len(x) * np.log(2 * np.pi)
    assert gp.rows == len(x) and gp.lml == pytest.approx(exact, rel=1e-4)
