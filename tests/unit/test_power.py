# SPDX-License-Identifier: Apache-2.0
"""Electrical budgets, by hand and against each other."""

import json
from dataclasses import replace

import pytest

from sparsegaze import power
from sparsegaze.headset import load_headset
from sparsegaze.timing import Timing


@pytest.fixture(scope="module")
def led2gaze(repo_root):
    return load_headset(repo_root / "headsets" / "led2gaze.toml")


@pytest.fixture(scope="module")
def drawn(led2gaze):
    return {one.setting: one for one in power.budgets(led2gaze)}


def test_the_default_setting_by_hand(drawn):
    # Lit 2,696 of a phase's 5,328 cycles: four LEDs of 20 mA from 5 V. 9.2 + 0.3 mA. 3.2 V over 330 ohm.
    one = drawn["default"]
    assert one.lit == pytest.approx(4 * 2696 / 5328)
    assert one.emitter_mw == pytest.approx(4 * 2696 / 5328 * 100, rel=1e-9)
    assert one.mcu_mw == pytest.approx(47.5)
    assert one.rail_mw == pytest.approx(48.48 + 0.1, rel=1e-3)
    assert one.total_mw == pytest.approx(one.emitter_mw + one.mcu_mw + one.rail_mw)
    assert one.front_end_mw == pytest.approx(one.emitter_mw + one.rail_mw)


def test_four_times_the_papers_rate_for_less_than_its_power(drawn):
    assert drawn["default"].rate_hz >= 1000 and drawn["default"].total_mw < power.PAPER_LED_MW / 2


def test_a_pause_between_frames_saves_light_and_sleep_saves_the_rest(drawn):
    default, low = drawn["default"], drawn["250 Hz, low power"]
    assert low.emitter_mw == pytest.approx(default.emitter_mw * low.rate_hz / default.rate_hz)
    assert low.mcu_mw < 0.7 * default.mcu_mw
    assert low.total_mw < 0.5 * default.total_mw
    assert drawn["60 Hz, low power"].total_mw < low.total_mw


def test_a_slower_rate_alone_saves_nothing(drawn):
    # Without low power the time is filled with cycles: 4 of 15,984 cycles make a frame of 250 Hz.
    default, slow = drawn["default"], drawn["250 Hz, 4 cycles"]
    assert slow.rate_hz == pytest.approx(16e6 / (4 * 15984)) and slow.lit == pytest.approx(default.lit)
    assert slow.total_mw == pytest.approx(default.total_mw)


def test_asleep_all_the_time_it_draws_what_the_data_sheet_calls_idle(led2gaze):
    seldom = power.budget(led2gaze, "once an hour", Timing(frame_cycles=3600 * 16_000_000), True)
    assert seldom.mcu_mw == pytest.approx(5 * (2.7 + 0.3), rel=1e-4) and seldom.emitter_mw < 1e-3
    never = power.budget(led2gaze, "no time to sleep", Timing(), True)
    assert never.mcu_mw == pytest.approx(47.5)


def test_without_a_board_nothing_is_drawn_by_rail_and_divider(led2gaze):
    bare = replace(led2gaze, board={})
    assert power.budget(bare, "optics", Timing(), False).rail_mw == 0


def test_all_settings_as_json(led2gaze):
    rows = [one.report() for one in power.budgets(led2gaze)]
    assert json.loads(json.dumps(rows, allow_nan=False))[0]["total_mw"] == pytest.approx(298.5, abs=0.5)
