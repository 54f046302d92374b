# SPDX-License-Identifier: Apache-2.0
"""The simulated person: latency, main sequence, fixation, pupil, blinks, and the log of where the eye was."""

import math

import pytest

from board import Board, firmware


def truth(seed=1, seconds=1.0, targets=(), commands=(), **keys):
    """Rows (us, az, el, pupil, lid, target az, target el) of a run.

    `commands` may begin with "power off": the person lives on, and much faster without the chip.
    """
    with Board(app=firmware("echo"), seed=seed, **keys) as board:
        path = board.folder / "truth.csv"
        board.command(f"truth {path}")
        for line in commands:
            board.command(line)
        for at, az, el in targets:
            board.command(f"target {at} {az} {el}")
        board.run(int(seconds * 1e6))
        board.command("truth off")
        return [[float(word) for word in line.split(",")] for line in path.read_text().splitlines()[1:]]


def rms(values):
    """About the mean."""
    mean = sum(values) / len(values)
    return math.sqrt(sum((v - mean) ** 2 for v in values) / len(values))


def test_a_row_every_millisecond():
    rows = truth(seconds=0.5)
    assert [row[0] for row in rows] == [1000 * k for k in range(501)]


@pytest.mark.parametrize("amplitude", [2, 10, 20])
def test_saccade_starts_after_the_latency_and_lasts_as_the_main_sequence_says(amplitude):
    rows = truth(targets=[(100000, amplitude, 0)], commands=["motion 0"])
    azimuth = [row[1] for row in rows]
    start = next(k for k, az in enumerate(azimuth) if az > 0) - 1
    end = next(k for k, az in enumerate(azimuth) if az >= amplitude - 1e-9)
    assert 140 <= start - 100 <= 260
    assert abs(end - start - (21 + 2.2 * amplitude)) <= 2
    steps = [b - a for a, b in zip(azimuth, azimuth[1:])]
    assert min(steps) >= -1e-9                                          # smooth: no overshoot
    peak = max(steps) * 1000                            # deg/s; minimum jerk: 1.875 times the mean
    assert peak == pytest.approx(1.875 * amplitude / (21 + 2.2 * amplitude) * 1000, rel=0.02)
    assert rows[150][5] == amplitude and rows[50][5] == 0               # target columns


def test_latency_varies_around_200_ms():
    latencies = []
    for seed in range(1, 31):
        azimuth = [row[1] for row in truth(seed, 0.4, [(0, 10, 0)], ["motion 0"])]
        latencies.append(next(k for k, az in enumerate(azimuth) if az > 0) - 1)
    assert abs(sum(latencies) / 30 - 200) < 15 and len(set(latencies)) > 5


def test_fixation_bias_is_per_target_and_of_the_stated_size():
    targets = [(k * 600000, 5 * (k % 3), -5 * (k % 2)) for k in range(60)]
    rows = truth(4, 36.0, targets)
    bias = []
    for at, az, el in targets:
        part = [row for row in rows if at + 400000 <= row[0] < at + 600000]
        bias += [sum(r[1] for r in part) / len(part) - az, sum(r[2] for r in part) / len(part) - el]
    assert 0.25 < size(bias) < 0.42                                     # 0.3, drift and microsaccades on top


def size(values):
    """Root mean square about zero, not about the mean."""
    return math.sqrt(sum(v * v for v in values) / len(values))


def autocorrelation(seconds, time_s):
    """Of noise through two equal first-order stages."""
    return (1 + seconds / time_s) * math.exp(-seconds / time_s)


PUPIL_RMS_MM = math.hypot(0.3, 0.15)                                    # slow drift and hippus: physics.toml


def test_pupil_is_as_far_from_its_mean_at_the_start_as_ever_after_in_200_seeds():
    first, later, change = [], [], []
    for seed in range(200):
        rows = truth(seed, 8.0, commands=["power off"], pupil_mean_mm=4.25)
        first.append(rows[0][3] - 4.25)
        later.append(rows[8000][3] - 4.25)
        change += [rows[k + 1000][3] - rows[k][3] for k in range(0, 7000, 1000)]
    assert size(first) == pytest.approx(PUPIL_RMS_MM, rel=0.1)
    assert size(later) == pytest.approx(PUPIL_RMS_MM, rel=0.1)
    # Within a second it is hippus that moves: both parts have their own size, not only their sum.
    expected = math.sqrt(2 * 0.15 ** 2 * (1 - autocorrelation(1, 0.25))
                         + 2 * 0.3 ** 2 * (1 - autocorrelation(1, 10)))
    assert size(change) == pytest.approx(expected, rel=0.1)


def windows(rows, axis, length=500):
    """Deviations from its own mean within each half second."""
    for start in range(0, len(rows) - length + 1, length):
        part = [row[axis] for row in rows[start:start + length]]
        mean = sum(part) / length
        yield [value - mean for value in part]


@pytest.mark.parametrize("stated", [0.1, 0.2])
def test_drift_alone_within_half_a_second_has_the_stated_rms_about_the_window_s_mean(stated):
    rows = truth(5, 400.0, commands=["power off", "set microsaccades 0"],
                 constants={"eye.fixation_drift_deg": stated})
    for axis in (1, 2):
        within = [v for part in windows(rows, axis) for v in part]
        assert size(within) == pytest.approx(stated, rel=0.05)
        speed = [(b[axis] - a[axis]) * 1000 for a, b in zip(rows, rows[1:])]
        assert 10 * stated < size(speed) < 20 * stated                  # deg/s: a drift, not a tremor
        steps = [b - a for a, b in zip(speed, speed[1:])]
        assert size(steps) < 0.25 * size(speed)                         # smooth from tick to tick


def test_drift_is_under_way_from_the_first_moment_on():
    first = [v for seed in range(200) for v in truth(
        seed, 0.002, commands=["power off", "set microsaccades 0"])[0][1:3]]
    assert 0.13 < size(first) < 0.175                                   # 0.1515 over all time


def test_microsaccades_come_on_top_of_drift():
    rows = {on: truth(5, 200.0, commands=["power off", f"set microsaccades {on}"]) for on in (0, 1)}
    micro = [[b[axis] - a[axis] for a, b in zip(rows[0], rows[1])] for axis in (1, 2)]
    assert all(0.07 < size(part) < 0.13 for part in micro)
    within = [v for part in windows(rows[1], 1) for v in part]
    assert 0.1 < size(within) < 0.15


def test_blinks_come_15_a_minute_and_last_240_ms():
    rows = truth(2, 600.0, commands=["power off"])
    pupil = [row[3] for row in rows]
    assert max(abs(b - a) for a, b in zip(pupil, pupil[1:])) < 0.02     # mm in a millisecond
    lid = [row[4] for row in rows]
    closed = [k for k in range(1, len(lid)) if lid[k] < 0.01 <= lid[k - 1]]
    assert 120 <= len(closed) <= 180
    k = closed[0]
    start = max(j for j in range(k - 100, k) if lid[j] == 1)
    end = next(j for j in range(k, k + 300) if lid[j] == 1)
    assert abs(end - start - 240) <= 3                                  # 70 + 20 + 150 ms


def test_pupil_differs_between_people_and_can_be_set():
    means = [sum(r[3] for r in truth(seed, 0.1)) / 101 for seed in range(1, 13)]
    assert 0.3 < rms(means) < 1.4 and all(2 < m < 6.3 for m in means)
    assert truth(1, 0.1, commands=["motion 0"], pupil_mean_mm=4.25)[-1][3] == pytest.approx(4.25)


def test_follow_0_puts_the_eye_exactly_on_the_target():
    rows = truth(targets=[(300000, 8, -3)], commands=["follow 0", "motion 0"])
    assert rows[299][1:3] == [0, 0] and rows[300][1:3] == [8, -3]


def test_lids_can_be_forced_and_targets_cleared():
    rows = truth(seconds=1.0, targets=[(800000, 8, -3)],
                 commands=["motion 0", "set lid 0.25"])
    assert {row[4] for row in rows} == {0.25}
    rows = truth(seconds=1.0, commands=["target 500000 8 3", "targets clear"])
    assert all(row[5] == 0 for row in rows)


def test_truth_does_not_depend_on_the_program_that_runs():
    with Board(app=firmware("stream"), seed=3) as board:
        board.command("target 0 5 5")
        board.run(700000)
        one = board.command("state")
    with Board(app=firmware("interrupts"), seed=3) as board:
        board.command("target 0 5 5")
        for _ in range(7):
            board.run(100000)
        assert board.command("state")[1:] == one[1:]
