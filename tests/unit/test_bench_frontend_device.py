# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the front end: what it makes of a device's stream, and that every bar can be missed."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def bench(bench_modules):
    """The benchmark's modules as attributes."""
    return bench_modules(
        board="frontend_board",
        bound="frontend_bound",
        latency="frontend_latency",
        measures="frontend_measures",
        size="frontend_size",
        judge="frontend_judge",
    )


def drawn_frames(bench, target, index, noise_deg, seed=0):
    """Frames whose gaze is its target and normal noise per axis."""
    rng = np.random.default_rng(seed)
    frames = np.zeros(len(index), bench.board.FRAME)
    frames["gaze_deg"] = target + noise_deg * rng.standard_normal(target.shape)
    frames["flags"] = 1
    frames["t_us"] = frames["seq"] = np.arange(len(index))
    return frames


def test_precision_of_white_noise_is_twice_its_deviation_and_averages_to_half(bench):
    """RMS-S2S of white noise s per axis: sqrt(2) s sqrt(2) = 2 s; of means of four frames half that."""
    places = bench.board.grid_places()
    index = np.repeat(np.arange(len(places)), 400)
    target = places[index]
    found = bench.measures.judge_grid(drawn_frames(bench, target, index, 0.1), target, index)
    assert found["s2s_deg"] == pytest.approx(0.2, rel=0.02)
    assert found["s2s_250_deg"] == pytest.approx(0.1, rel=0.04)
    assert found["error_deg"] == pytest.approx(0.1 * np.sqrt(np.pi / 2), rel=0.03)
    assert found["bias_deg"] < 0.02 and found["valid"] == 1.0 and found["places"] == 25


def test_frames_that_the_device_calls_no_gaze_are_no_precision_but_loss(bench):
    places = bench.board.grid_places()
    index = np.repeat(np.arange(len(places)), 100)
    target = places[index]
    frames = drawn_frames(bench, target, index, 0.1)
    frames["gaze_deg"][::2] += 40
    frames["flags"][::2] = 4
    found = bench.measures.judge_grid(frames, target, index)
    assert found["s2s_deg"] == pytest.approx(0.2, rel=0.05) and found["valid"] == 0.5


def test_a_step_settles_when_its_error_does(bench):
    """30 steps; for 7 frames the error is five times the steady one, 3 of them saturated."""
    rng = np.random.default_rng(4)
    n, begin = 30 * 100, np.arange(0, 3000, 100)
    frames = np.zeros(n, bench.board.FRAME)
    error = np.abs(rng.normal(0.5, 0.1, n))
    since = np.arange(n) % 100
    error[since < 7] *= 5
    frames["flags"] = np.where(since < 3, 8, 1)
    error[since < 3] = np.nan
    found = bench.measures.judge_steps(frames, error, begin)
    assert found["settle_frames"] == 7 and found["saturated_frames"] == 3
    assert found["steady_deg"] == pytest.approx(0.5, rel=0.03)


def test_a_step_that_never_settles_has_no_number_of_frames(bench):
    frames = np.zeros(1000, bench.board.FRAME)
    error = np.ones(1000)
    error[np.arange(1000) % 100 >= 50] = 0.5
    assert bench.measures.judge_steps(frames, error, np.arange(0, 1000, 100))["settle_frames"] is None


def test_a_step_is_settled_when_frames_are_valid_as_often_as_later(bench):
    frames, error = np.zeros(1000, bench.board.FRAME), np.full(1000, 0.5)
    since = np.arange(1000) % 100
    error[(since < 8) & (np.arange(1000) // 100 % 5 == 0)] = np.nan     # a fifth of the steps, 8 frames long
    error[since % 25 == 24] = np.nan                                    # for ever
    assert bench.measures.judge_steps(frames, error, np.arange(0, 1000, 100))["settle_frames"] == 8


def cycle_log(begin, exposure=1600, slot=888):
    """Log rows of one sensing cycle as the virtual Nano writes them, and the instants of its six lit
    samples."""
    rows, middles = [], []
    for phase, (first, second) in enumerate(((5, 0), (1, 4), (2, 3))):
        start = begin + 6 * slot * phase
        for place, (channel, mask) in enumerate(
            [
                (15, 0),
                (first, 63 & ~(1 << first | 1 << second)),
                (second, 0),
                (15, 0),
                (first, 0),
                (second, 0),
            ]
        ):
            sample = start + place * slot
            lit = place in (1, 2)
            if channel < 6:
                rows.append((f"drive{channel}:3", sample - exposure))
                if lit:
                    middles.append(sample - exposure / 2)
            rows.append((f"adc:{channel}", sample))
            rows += [(f"lit:{mask}", start + slot - exposure - 80)] if place == 1 else []
            rows += [("lit:0", sample + 132)] if place == 2 else []
    return rows, middles


def test_latency_is_read_off_the_log_of_pins_and_bytes(bench, tmp_path):
    rows = []
    for k in range(40):
        one, middles = cycle_log(20_000 + 16_000 * k)
        rows += one
        last = max(cycle for event, cycle in one if event.startswith("adc"))
        rows.append(("delimiter", last + 9_000 + 16 * (k % 2)))
        if k == 5:
            rows.append(("delimiter", last + 12_000))  # an answer to a ping: this frame is left out
    rows.sort(key=lambda row: row[1])
    path = tmp_path / "frames.csv"
    path.write_text("event,cycle\n" + "".join(f"{event},{cycle}\n" for event, cycle in rows))
    found = bench.latency.latency(path)
    one, middles = cycle_log(0)
    span = max(cycle for event, cycle in one if event.startswith("adc")) - np.mean(middles)
    assert found["frames"] == 38
    assert found["period_cycles"] == 16_000 and found["jitter_cycles"] == 0
    assert found["latency_last_ms"] == pytest.approx(9_008 / 16_000, abs=1e-3)
    assert found["latency_last_max_ms"] == pytest.approx(9_016 / 16_000)
    assert found["latency_mean_max_ms"] == pytest.approx((span + 9_016) / 16_000)


def test_latency_beyond_a_frames_time_is_not_taken_for_the_frame_befores(bench, tmp_path):
    rows = []
    for k in range(40):
        one, _ = cycle_log(20_000 + 16_000 * k)
        rows += one + [("delimiter", max(cycle for event, cycle in one if event.startswith("adc")) + 20_000)]
    rows.sort(key=lambda row: row[1])
    path = tmp_path / "frames.csv"
    path.write_text("event,cycle\n" + "".join(f"{event},{cycle}\n" for event, cycle in rows))
    assert bench.latency.latency(path, 900)["latency_last_ms"] == pytest.approx(1.25)
    assert bench.latency.latency(path)["latency_last_ms"] == pytest.approx(0.25)


@pytest.mark.parametrize("cut", range(0, 60, 7))
def test_a_log_that_begins_within_a_cycle_is_read_from_the_next_one_on(bench, cut):
    rows = [row for k in range(4) for row in cycle_log(20_000 + 16_000 * k)[0]]
    rows.sort(key=lambda row: row[1])
    whole_mean, whole_last, _ = bench.latency.cycles_of(rows)
    mean, last, _ = bench.latency.cycles_of(rows[cut:])
    assert len(whole_mean) == 4 and 2 <= len(mean) <= 4
    assert mean == pytest.approx(whole_mean[-len(mean) :]) and last == pytest.approx(whole_last[-len(last) :])


def good_report():
    """A report that meets every bar of the device."""
    names = ("room", "bright_room", "sun_gap")
    return {
        "quick": False,
        "rate_hz": 1001.0,
        "stream_seconds": 60.0,
        "late": 0,
        "lost": 0,
        "truth_ratio": 1.01,
        "n_vectors": 30,
        "latency_mean_ms": 1.0,
        "latency_last_ms": 0.5,
        "latency_mean_max_ms": 2.0,
        "latency_last_max_ms": 1.2,
        "s2s_deg": 0.3,
        "s2s_250_deg": 0.15,
        "error_ratio": dict.fromkeys(names, 1.0),
        "error_ratio_250": dict.fromkeys(names, 1.0),
        "valid": dict.fromkeys(names, 0.9),
        "valid_250": dict.fromkeys(names, 0.9),
        "saturated_after": dict.fromkeys(names, 0),
        "saturated_after_250": dict.fromkeys(names, 0),
        **{f"{key}_in{table}": dict.fromkeys(names, 0) for key in ("late", "lost") for table in ("", "_250")},
        "step_250": {"saturated_frames": 2, "settle_frames": 6},
        "step": {"saturated_frames": 2, "settle_frames": 6},
        "exposure_shift_over_s2s": 0.4,
        "flicker_ratio": 1.1,
        "flicker_ratio_250": 1.1,
        "irradiance_w_m2": {"normal": 20.0},
        "margin": 1.2,
        "flash": {"spare": 0.12, "spare_old_loader": 0.12},
        "stack_free": 210,
        "valid_nominal": 0.99,
        "valid_flicker_250": 0.9,
        "places": 25,
    }


def test_a_good_report_meets_every_bar_and_64_vectors_are_an_aim(bench):
    bars = bench.judge.bars(good_report())
    assert all(bar["met"] for bar in bars if bar["kind"] == "bar") and len(bars) > 20
    assert [bar["name"] for bar in bars if not bar["met"]] == ["* n_vectors"]


@pytest.mark.parametrize(
    "key, value",
    [
        ("rate_hz", 999.0),
        ("late", 1),
        ("lost", 1),
        ("truth_ratio", 1.06),
        ("latency_mean_ms", 2.6),
        ("latency_last_ms", 1.6),
        ("s2s_deg", 0.36),
        ("s2s_250_deg", 0.19),
        ("exposure_shift_over_s2s", 1.1),
        ("flicker_ratio_250", 1.3),
        ("margin", 0.9),
        ("stack_free", 204),
        ("stream_seconds", 10.0),
        ("late", None),
        ("valid_nominal", 0.94),
        ("valid_flicker_250", 0.7),
        ("places", 24),
    ],
)
def test_every_bar_can_be_missed(bench, key, value):
    report = {**good_report(), key: value}
    assert sum(not bar["met"] for bar in bench.judge.bars(report) if bar["kind"] == "bar") == 1


@pytest.mark.parametrize(
    "key, part, value",
    [
        ("error_ratio_250", "room", 1.2),
        ("error_ratio_250", "sun_gap", 3.1),
        ("saturated_after_250", "room", 1),
        ("valid_250", "sun_gap", 0.7),
        ("step_250", "saturated_frames", 6),
        ("step_250", "settle_frames", None),
        ("flash", "spare", 0.09),
        ("irradiance_w_m2", "normal", 101.0),
    ],
)
def test_every_bar_of_several_can_be_missed(bench, key, part, value):
    report = good_report()
    report[key] = {**report[key], part: value}
    assert sum(not bar["met"] for bar in bench.judge.bars(report) if bar["kind"] == "bar") == 1


def test_a_missed_bar_is_named_and_the_exit_code_is_one(bench, tmp_path, capsys):
    report = {**good_report(), "rate_hz": 900.0, "seconds": 60.0, "stream_seconds": 60.0}
    report["bars"] = bench.judge.bars(report)
    assert bench.judge.tell(report, tmp_path) == 1
    said = capsys.readouterr()
    assert "bar missed: * rate_hz" in said.err
    assert "MISSED: a bar, a figure that is demanded" in said.out and "short:  an aim" in said.out


@pytest.mark.parametrize(
    "key, words", [("late_in", "share of frames late, sun_gap"), ("lost_in", "lost frames of a second")]
)
def test_late_and_lost_frames_in_the_sun_are_aims_that_can_be_short(bench, key, words):
    report = good_report()
    report[key] = {**report[key], "sun_gap": 1}
    missed = [bar for bar in bench.judge.bars(report) if not bar["met"] and bar["name"] != "* n_vectors"]
    assert len(missed) == 1 and missed[0]["name"].startswith(words) and missed[0]["kind"] == "aim"


def test_the_older_loader_s_share_is_an_aim_that_can_be_short(bench):
    report = {**good_report(), "flash": {"spare": 0.12, "spare_old_loader": 0.06}}
    missed = [bar for bar in bench.judge.bars(report) if not bar["met"]]
    assert [bar["name"] for bar in missed if "loader" in bar["name"]] == [
        "flash to spare, share, beside the older loader's 2 KiB"
    ]
    assert all(bar["kind"] == "aim" for bar in missed)


def test_the_bound_is_that_of_independent_readings(bench, monkeypatch):
    """Two channels, each telling one axis by 0.01 a degree, with 0.2 % of noise: 0.2 deg per axis."""
    slopes = np.array([[0.01, 0.0], [0.0, 0.01]])
    monkeypatch.setattr(bench.bound, "slopes", lambda *_: slopes)
    found = bench.bound.bound_deg("", (0, 0), 3.5, np.full(2, 0.002))
    assert found == pytest.approx(np.sqrt(2 * 2 * 0.2**2))


def test_size_reads_an_elf_and_refuses_what_is_none(bench, tmp_path):
    from sparsegaze.errors import SparsegazeError

    with pytest.raises(SparsegazeError, match="no 32-bit ELF"):
        (tmp_path / "x.elf").write_bytes(b"hello")
        bench.size.size(tmp_path / "x.elf")
    with pytest.raises(SparsegazeError, match="cannot read"):
        bench.size.size(tmp_path / "none.elf")


def test_size_counts_what_is_flashed(bench, firmware_elf):
    """Bytes of data records of the hex: type 00, their count the first byte."""
    rows = firmware_elf.with_suffix(".hex").read_text().split()
    flashed = sum(int(row[1:3], 16) for row in rows if row[7:9] == "00")
    found = bench.size.size(firmware_elf)
    assert found["flash"]["bytes"] == pytest.approx(flashed, abs=2)
    assert found["flash"]["spare"] == pytest.approx(1 - (flashed + 3072 + 512) / 32768, abs=1e-3)
    assert found["flash"]["spare_old_loader"] == pytest.approx(1 - (flashed + 3072 + 2048) / 32768, abs=1e-3)
    line = bench.size.words(found)
    assert "beside Optiboot (512 B)" in line and "beside the older bootloader (2048 B)" in line
    assert 0 < found["ram"]["bytes"] < 2048
