# SPDX-License-Identifier: Apache-2.0
"""Which frames are used: synthetic fixations with drift, noise, blinks, other people's gaze."""

import sys

import numpy as np
import pytest

from sparsegaze import selection, targets

FRAME_US = 3840  # see frame_period


@pytest.fixture(autouse=True, params=[3840, 999], ids=["260 Hz", "1001 Hz"])
def frame_period(request, monkeypatch):
    """Everything holds at either rate: an eye and its lids move in time, not in frames."""
    monkeypatch.setattr(sys.modules[__name__], "FRAME_US", request.param)
MIX = np.array(
    [[60, 10], [-55, 20], [15, -70], [-20, 60], [45, 45], [-40, -40]], float
)  # feature steps per degree


def centre_of(target_deg):
    linear = MIX @ np.asarray(target_deg)
    return 30000 + linear + 0.006 * linear**2 / 10


class Recorded:
    """A run of synthetic fixations: noise, slow drift of the eye, and what `spoil` does to the eye."""

    def __init__(self, plan=None, seed=0, noise=15.0, spoil=None):
        rng = np.random.default_rng(seed)
        self.plan = plan or targets.calibration_plan(40, seed)
        self.onset_us = self.plan.onsets_us(1_000_000)
        n = int(self.plan.seconds * 1e6 / FRAME_US)
        self.t_us = 1_000_000 + np.arange(n) * FRAME_US
        self.index = np.searchsorted(self.onset_us, self.t_us, side="right") - 1
        since = self.t_us - self.onset_us[self.index]
        eye = self.plan.target_deg[np.maximum(self.index - (since < 250_000), 0)].copy()
        drift = np.cumsum(rng.normal(0, 0.1 / 12 * np.sqrt(FRAME_US / 3840), (n, 2)), axis=0)
        eye += drift - drift[np.searchsorted(self.t_us, self.onset_us)][self.index]
        if spoil:
            spoil(self, eye, None)
        self.features = np.array([centre_of(e) for e in eye]) + rng.normal(0, noise, (n, 6))
        self.flagged = np.zeros(n, bool)
        self.blinking = np.zeros(n, bool)

    def blink(self, target, start_s, length_s=0.25, octaves=0.3):
        """Lids close in 60 ms, stay, open in 140 ms; changes every channel by up to `octaves`."""
        begin = self.onset_us[target] + start_s * 1e6
        since = (self.t_us - begin) * 1e-6
        shut = np.clip(np.minimum(since / 0.06, (length_s - since) / 0.14), 0, 1)
        self.features += shut[:, None] * octaves * 4096 * np.array([1, 0.8, 1.2, 0.5, -0.3, 0.9])
        self.blinking |= shut * octaves * 1.2 > 0.045  # less is a degree or two, and far below any real lid

    def select(self):
        return selection.select(
            self.t_us,
            np.clip(self.features, 0, 65535).astype(np.uint16),
            self.flagged,
            self.index,
            self.onset_us,
            self.plan.target_deg,
            self.plan.settle_s,
        )


def test_a_clean_run_keeps_nearly_every_settled_frame_and_no_other():
    run = Recorded()
    chosen = run.select()
    settled = run.t_us - run.onset_us[run.index] >= 500_000
    assert not chosen.valid[~settled].any()
    assert chosen.valid[settled].mean() > 0.97
    assert chosen.used_targets == chosen.n_targets == 40
    assert chosen.counts()["settling"] == (~settled).sum()


@pytest.mark.parametrize("start_s", [0.55, 0.7, 0.85])
@pytest.mark.parametrize("octaves", [0.15, 0.3, 1.5])
def test_a_blink_is_left_out_and_the_rest_of_its_fixation_kept(start_s, octaves):
    run = Recorded(seed=3)
    for target in range(0, 40, 4):
        run.blink(target, start_s, octaves=octaves)
    chosen = run.select()
    assert not chosen.valid[run.blinking].any()
    assert chosen.used_targets >= 38
    untouched = np.isin(run.index, np.arange(1, 40, 4)) & (run.t_us - run.onset_us[run.index] >= 500_000)
    assert chosen.valid[untouched].mean() > 0.97


def test_a_blink_begun_while_settling_and_ending_in_the_settled_part_is_found_by_its_level():
    run = Recorded(seed=4)
    run.blink(7, 0.38, 0.3)
    chosen = run.select()
    assert not chosen.valid[run.blinking].any()
    assert chosen.valid[run.index == 7].sum() > 30


def test_a_fixation_that_is_mostly_blinks_is_not_used_at_all():
    run = Recorded(seed=5)
    for start in (0.5, 0.66, 0.82):
        run.blink(9, start, 0.2, 0.5)
    chosen = run.select()
    assert not chosen.valid[run.index == 9].any()
    assert chosen.used_targets == 39


def test_saturated_and_starved_frames_are_left_out():
    run = Recorded(seed=6)
    run.flagged[run.index == 5] = True
    run.flagged[(run.index == 6) & (np.arange(len(run.t_us)) % 3 == 0)] = True
    chosen = run.select()
    assert not chosen.valid[run.flagged].any()
    assert chosen.counts()["flagged"] > 0 and chosen.used_targets == 39


def test_a_person_who_looked_elsewhere_loses_that_target_only():
    def look_away(run, eye, _):
        eye[run.index == 12] = -eye[run.index == 12] + 3.0

    run = Recorded(seed=7, spoil=look_away)
    away = np.hypot(*(run.plan.target_deg[12] * 2 - 3.0))
    assert away > 10  # else this seed proves nothing
    chosen = run.select()
    assert not chosen.valid[run.index == 12].any()
    assert chosen.counts()["inattentive"] > 100
    assert chosen.used_targets == 39


def test_microsaccades_of_a_tenth_of_a_degree_cost_nothing():
    def tremble(run, eye, _):
        since = run.t_us - run.onset_us[run.index]
        eye[(since > 700_000) & (since < 850_000)] += 0.1

    chosen = Recorded(seed=8, spoil=tremble).select()
    assert chosen.used_targets == 40
    assert chosen.valid.mean() > 0.45


def test_a_fixation_that_shifts_by_a_degree_is_kept_whole():
    def shift(run, eye, _):
        since = run.t_us - run.onset_us[run.index]
        eye[since > 760_000] += (0.8, -0.6)

    run = Recorded(seed=11, spoil=shift)
    settled = run.t_us - run.onset_us[run.index] >= 500_000
    assert run.select().valid[settled].mean() > 0.97


def test_noise_estimate_ignores_blinks_and_drift():
    run = Recorded(seed=9, noise=20.0)
    for target in range(0, 40, 2):
        run.blink(target, 0.6)
    assert np.allclose(selection.noise_of(run.features), 20.0, rtol=0.15)


def test_a_cut_run_selects_what_is_there():
    run = Recorded(seed=10)
    k = int(np.searchsorted(run.index, 20)) + 60
    chosen = selection.select(
        run.t_us[:k],
        run.features[:k].astype(np.uint16),
        run.flagged[:k],
        run.index[:k],
        run.onset_us[:21],
        run.plan.target_deg[:21],
        0.5,
    )
    assert len(chosen.valid) == k and chosen.used_targets == 20


def test_no_frames_at_all_are_no_error():
    chosen = selection.select(
        np.zeros(0),
        np.zeros((0, 6), np.uint16),
        np.zeros(0, bool),
        np.zeros(0, int),
        np.zeros(3, np.int64),
        np.zeros((3, 2)),
        0.5,
    )
    assert chosen.used_targets == 0 and len(chosen.valid) == 0
