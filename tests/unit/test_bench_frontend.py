# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the front end: its study against closed forms, its bars can fail, its report has its
keys."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

BITS = {
    "method",
    "adc_khz",
    "exposure_us",
    "photocurrent_na",
    "random_bits",
    "static_bits",
    "feasible_at_1khz",
}


@pytest.fixture(scope="module")
def bench(bench_modules):
    """The benchmark's modules as attributes."""
    return bench_modules(
        run="bench_frontend",
        judge="frontend_judge",
        methods="frontend_methods",
        node="frontend_node",
        patterns="frontend_patterns",
        physics="frontend_physics",
        picture="frontend_picture",
        static="frontend_static",
    )


def method(bench, name):
    return next(one for one in bench.node.METHODS if one.name == name)


# -- laws ----------------------------------------------------------------------------------------------------


def test_the_junctions_charge_is_the_integral_of_its_capacitance(bench):
    reverse = np.linspace(-0.4, 5.0, 200_001)
    summed = np.concatenate(
        [
            [0.0],
            np.cumsum(
                (reverse[1:] - reverse[:-1]) * bench.physics.junction_pf((reverse[1:] + reverse[:-1]) / 2)
            ),
        ]
    )
    charge = bench.physics.junction_pc(reverse)
    assert charge - charge[0] == pytest.approx(summed, abs=1e-6)
    assert bench.physics.junction_pf(0.0) == 40.0 and bench.physics.junction_pc(0.0) == 0.0


@pytest.mark.parametrize("name", ["rail", "cathode_5v", "zero_bias", "comparator_bandgap"])
def test_swing_is_the_inverse_of_charge(bench, name):
    node = bench.node.Node(method(bench, name))
    volts = np.linspace(0, 0.5, 50)
    assert node.swing(node.charge(volts)) == pytest.approx(volts, abs=2e-6)
    slope = (node.charge(volts + 1e-4) - node.charge(volts - 1e-4)) / 2e-4
    assert node.capacitance(volts) == pytest.approx(slope, rel=1e-5)


def test_the_node_of_the_rail_is_nearly_linear_and_has_the_stated_capacitance(bench):
    node = bench.node.Node(bench.node.RAIL)
    assert node.capacitance(0.0) == pytest.approx(45, abs=1.0)
    assert node.capacitance(1.1) == pytest.approx(50, abs=1.5)


def test_an_inl_curve_is_a_drawn_curve_of_magnitude_one_with_ends_at_zero(bench):
    for seed in range(5):
        curve = bench.physics.inl_curve(np.random.default_rng(seed))
        x = np.linspace(0, 1, 65)
        assert np.abs(curve(x)).max() == pytest.approx(1.0)
        assert curve(np.array([0.0, 1.0])) == pytest.approx([0, 0], abs=1e-9)


def test_noise_of_the_converter_grows_with_its_clock_as_the_constants_say(bench):
    assert bench.physics.worse(125) == bench.physics.worse(200) == 1.0
    assert bench.physics.worse(1000) == pytest.approx(2.25)
    assert bench.physics.adc_noise_lsb(125) == pytest.approx(np.hypot(0.7, 1 / np.sqrt(12)))
    assert bench.physics.conversion_us(250) == 52.0


def test_bits_are_those_of_an_ideal_converter(bench):
    rng = np.random.default_rng(1)
    reading = 1.0 + rng.random(200_000) * 0.01
    quantised = np.round(reading * 2**9) / 2**9  # a full scale of 1: nine bits
    assert bench.physics.bits((quantised - reading).std()) == pytest.approx(9.0, abs=0.02)
    assert bench.physics.bits(np.nan) == 0


# -- methods -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["cathode_5v", "anode_supply", "zero_bias", "rail", "rail_ground", "rail_x4", "comparator_divider"],
)
@pytest.mark.parametrize("light", [(200, 0), (75, 0), (200, 2000)])
def test_monte_carlo_and_closed_form_agree(bench, name, light):
    """4000 draws: standard error of a spread 1.1 %; first order leaves about as much."""
    for adc_khz, exposure_us in ((250, 16), (1000, 64)):
        at = method(bench, name), adc_khz, exposure_us, *light
        closed = bench.methods.closed_form(*at)
        if np.isnan(closed):
            continue
        drawn = bench.methods.monte_carlo(*at, np.random.default_rng(3))
        assert drawn == pytest.approx(closed, rel=0.06)


def test_the_closed_form_of_the_chosen_point_by_hand(bench):
    """200 nA for 131 us are 26.2 pC on some 47 pF: one LSB is 0.19 %, the converter 0.86 of it, the light
    0.07 %."""
    closed = bench.methods.closed_form(bench.node.RAIL, 250, 131, 200, 0)
    lsb_pc = 1.1 / 1024 * 47
    light = 5e-3 / 2.0 / np.sqrt(13.1)
    assert closed == pytest.approx(np.hypot(0.86 * lsb_pc / 26.2, light), rel=0.06)


def test_the_papers_reading_loses_by_the_references_and_the_ripple(bench):
    bits = {
        name: float(bench.physics.bits(bench.methods.closed_form(method(bench, name), 250, 131, 200, 0)))
        for name in ("cathode_5v", "anode_supply", "zero_bias", "rail")
    }
    assert bits["rail"] > bits["anode_supply"] + 1.0 > bits["cathode_5v"] + 1.0
    assert bits["rail"] > bits["zero_bias"] + 1.0


def test_the_cathode_against_the_small_reference_cannot_be_read_at_this_rate(bench):
    cathode = method(bench, "cathode_1v1")
    assert np.isnan(bench.methods.closed_form(cathode, 250, 159, 200, 0))
    assert np.isfinite(bench.methods.closed_form(cathode, 250, 300, 600, 0))


def test_more_ambient_light_than_fits_is_no_reading(bench):
    assert np.isfinite(bench.methods.closed_form(bench.node.RAIL, 250, 16, 200, 2000))
    assert np.isnan(bench.methods.closed_form(bench.node.RAIL, 250, 64, 200, 2000))


def test_reading_again_averages_the_converter_only(bench):
    once, four = (
        bench.methods.closed_form(method(bench, name), 250, 131, 200, 0) for name in ("rail", "rail_x4")
    )
    assert 0.5 * once < four < 0.7 * once


def test_exposures_at_a_thousand_frames_are_those_of_the_slots(bench):
    """18 slots of 55.5 us: two of them for the first of a pair, three for the second."""
    first, second = bench.methods.longest_us(bench.node.RAIL, 250)
    assert first == pytest.approx(2000 / 18 - 7.5) and second == pytest.approx(3000 / 18 - 7.5)
    assert bench.methods.longest_us(bench.node.RAIL, 125) == (0, 0)
    assert bench.methods.longest_us(method(bench, "rail_ground"), 250) == (0, 0)
    assert max(bench.methods.longest_us(method(bench, "rail_x4"), 250)) == 0
    assert max(bench.methods.longest_us(method(bench, "comparator_divider"), 0)) < 80


@pytest.mark.parametrize("exposure_us", [64, 131])
def test_self_calibration_removes_what_it_can(bench, exposure_us):
    raw, after = bench.static.error(method(bench, "rail_ground"), 250, exposure_us, 200, 0, 5)
    assert raw > 0.05 and after < 0.003  # gain and bandgap go; what INL bends more than once stays
    raw, after = bench.static.error(method(bench, "rail_any"), 250, exposure_us, 200, 0, 5)
    assert after > 0.03  # the memory of the channel before does not


def test_without_errors_of_parts_nothing_static_is_left(bench):
    part = bench.static.boards(5)[0]
    perfect = SimpleNamespace(
        **{
            **vars(part),
            "junction": 1.0,
            "extra": 1.0,
            "offset_lsb": 0.0,
            "gain": 1.0,
            "bandgap": 1.0,
            "inl": lambda x: 0.0 * x,
        }
    )
    raw, after = bench.static.one_part(method(bench, "rail_ground"), 250, 131, 200, 0, perfect)
    assert abs(raw) < 1e-6 and after < 1e-3


# -- patterns ------------------------------------------------------------------------------------------------


def test_every_pattern_senses_every_channel_once_and_fits(bench):
    for name, phases in bench.patterns.PAIRS.items():
        assert sorted(sensor for phase in phases for sensor in phase) == list(range(6)), name
        most = bench.patterns.longest_us(name)
        assert most.min() > 30 and most.max() < 260
    chosen = bench.patterns.longest_us(bench.patterns.CHOSEN)
    assert chosen[[5, 1, 2]] == pytest.approx(103.6, abs=0.1) and chosen[[0, 4, 3]] == pytest.approx(
        159.2, abs=0.1
    )


def test_a_pattern_collects_from_those_that_emit(bench):
    response = np.arange(36.0).reshape(1, 6, 6)
    one = np.ones(6)
    scale = 200 / 8.01755e-6
    found = bench.patterns.collected(response, bench.patterns.CHOSEN, one, one) / scale
    assert found[0, 5] == pytest.approx(response[0, 5, 1:5].sum())
    assert found[0, 2] == pytest.approx(response[0, 2, [0, 1, 4, 5]].sum())
    dim = bench.patterns.collected(response, bench.patterns.CHOSEN, 2 * one, 0.5 * one) / scale
    assert dim == pytest.approx(found)


def test_automatic_exposure_keeps_the_swing_at_its_goal_and_below_its_most(bench):
    rng = np.random.default_rng(2)
    current = np.exp(rng.normal(np.log(400), 0.6, (50, 6)))
    exposure = bench.patterns.exposures(current, np.full(6, 1e4))
    node = bench.node.Node(bench.node.RAIL)
    swing = node.swing(current * exposure * 1e-3)
    assert swing.max() <= bench.patterns.MOST_V + 1e-6
    assert (bench.patterns.exposures(current, np.full(6, 50.0)) <= 50.0).all()


# -- report --------------------------------------------------------------------------------------------------


def test_the_study_is_reported_with_the_issues_keys_and_a_picture(bench, tmp_path, capsys):
    assert bench.run.main(["--quick", "--only", "methods", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "frontend.json").read_text())
    assert all(BITS <= set(row) for row in report["bits"])
    assert {row["method"] for row in report["bits"]} == {one.name for one in bench.node.METHODS}
    chosen = [row for row in report["bits"] if row["chosen"]]
    assert chosen and all(
        row["feasible_at_1khz"] for row in chosen if row["photocurrent_na"] == 200 and not row["ambient_na"]
    )
    assert (tmp_path / "frontend.png").read_bytes()[:4] == b"\x89PNG"
    assert "met" in capsys.readouterr().out


def test_methods_that_disagree_with_their_closed_form_miss_the_bar(bench, tmp_path, monkeypatch, capsys):
    """Negative control: noise of the converter forgotten in the closed form."""
    real = bench.physics.adc_noise_lsb
    monkeypatch.setattr(bench.methods.physics, "adc_noise_lsb", lambda adc_khz: 0.3 * real(adc_khz))
    monkeypatch.setattr(bench.methods, "EXPOSURES_US", (64, 131))
    assert bench.run.main(["--quick", "--only", "methods", "--out", str(tmp_path)]) == 1
    assert "bar missed: bits" in capsys.readouterr().err


def test_another_pattern_than_the_best_misses_the_bar(bench):
    rows = [
        {"pattern": "a", "chosen": False, "s2s_mean_deg": 0.2},
        {"pattern": "b", "chosen": True, "s2s_mean_deg": 0.3},
    ]
    assert [bar["met"] for bar in bench.judge.bars({"patterns": rows})] == [False]
    assert [bar["met"] for bar in bench.judge.bars({"patterns": rows[1:]})] == [True]


def test_bad_words_are_refused(bench, capsys):
    for words in (["--only", "nothing"], ["--seeds", "0"]):
        with pytest.raises(SystemExit):
            bench.run.main(words)
