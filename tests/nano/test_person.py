# SPDX-License-Identifier: Apache-2.0
"""The simulated person: latency, main sequence, fixation, pupil, blinks, and the log of where the eye was."""

import math

import pytest

from board import Board, firmware


def truth(seed=1, seconds=1.0, targets=(), commands=(), **keys):
    """Rows (us, az, el, pupil, lid, target az, target el) of a run."""
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
    size = math.sqrt(sum(b * b for b in bias) / len(bias))
    assert 0.25 < size < 0.42                                           # 0.3, drift and microsaccades on top


def test_drift_microsaccades_pupil_and_blinks_over_two_minutes():
    rows = truth(2, 120.0)
    for axis in (1, 2):
        assert 0.08 < rms([row[axis] for row in rows]) < 0.2
    pupil = [row[3] for row in rows]
    assert 0.12 < rms(pupil) < 0.6
    assert max(abs(b - a) for a, b in zip(pupil, pupil[1:])) < 0.02     # mm in a millisecond
    lid = [row[4] for row in rows]
    closed = [k for k in range(1, len(lid)) if lid[k] < 0.01 <= lid[k - 1]]
    assert 18 <= len(closed) <= 42                                      # 15 a minute
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
