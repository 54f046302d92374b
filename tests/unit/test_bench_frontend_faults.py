# SPDX-License-Identifier: Apache-2.0
"""The benchmark's section faults: what it counts, what it calls named; each of its bars can be missed."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sparsegaze.wire import lib

TOOLS = Path(__file__).resolve().parents[2] / "tools"
VALID, FAULT = lib.SG_FLAG_VALID, lib.SG_FLAG_FAULT
AT, OFF = 1_000_000, 2_000_000


@pytest.fixture(scope="module")
def bench():
    """The benchmark's modules; its folder is on the path while they are imported."""
    sys.path.insert(0, str(TOOLS / "bench"))
    try:
        import frontend_faults
        import frontend_judge
    finally:
        sys.path.remove(str(TOOLS / "bench"))
    spec = importlib.util.spec_from_file_location("report", TOOLS / "report.py")
    report = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(report)
    return SimpleNamespace(faults=frontend_faults, judge=frontend_judge, report=report)


def frames(bench, flags=VALID, error=0.5):
    """A frame a millisecond from 0.5 s to 4 s."""
    found = np.zeros(3500, bench.faults.FOUND)
    found["us"] = 500_000 + 1000 * np.arange(len(found))
    found["flags"], found["error_deg"] = flags, error
    return found


def episode(bench, table, kind="open", **more):
    one = {"kind": kind, "channel": 1, "at_us": AT, "off_us": OFF, "named_ms": 300.0, "names": ["1 open"],
           "repeats": 1, "light": "dark", "seed": 2000, **more}
    return {**one, **bench.faults.figures(table, one)}


def test_a_wild_gaze_is_one_that_is_called_valid(bench):
    table = frames(bench)
    table["error_deg"][600:620] = 9.0           # while it is open, and flagged
    table["flags"][600:615] = FAULT
    one = episode(bench, table)
    assert one["wild"] == 5 and one["worst_deg"] == 9.0
    assert one["flag_ms"] == 100.0 and one["fault_frames"] == 15
    table["error_deg"][600:620] = 5.0           # not more than
    assert episode(bench, table)["wild"] == 0


@pytest.mark.parametrize("kind, seen", [("open", 3), ("blinks", 0)])
def test_frames_after_a_fault_count_and_those_after_the_faultless_do_not(bench, kind, seen):
    table = frames(bench)
    table["error_deg"][1600:1603] = 9.0         # 2.1 s
    assert episode(bench, table, kind)["wild"] == seen


def test_shares_of_valid_frames_before_while_and_after(bench):
    table = frames(bench)
    table["flags"][500:1500] = 0                # at .. off
    table["flags"][2300:2500] = 0               # in the second half of the last 0.4 s
    one = episode(bench, table)
    assert one["valid_before"] == 1.0 and one["valid_while"] == 0.0
    assert one["valid_after"] == pytest.approx(0.5)


def test_a_row_tells_the_median_and_the_worst_and_what_was_amiss(bench):
    table = frames(bench)
    many = [episode(bench, table, named_ms=ms) for ms in (100.0, 200.0, 900.0, None)]
    found = bench.faults.summary(many)
    (row,) = found["rows"]
    assert (row["episodes"], row["named"], row["named_ms"], row["named_ms_worst"]) == (4, 3, 200.0, 900.0)
    assert row["wild"] == 0 and row["frames"] == 4 * 2200 and row["false_alarms"] is None
    assert [one["named_ms"] for one in found["amiss"]] == [None]


def test_a_fault_flag_where_nothing_is_broken_is_a_false_alarm(bench):
    table = frames(bench)
    quiet = episode(bench, table, "blinks", named_ms=None)
    table["flags"][700] |= FAULT
    alarmed = episode(bench, table, "blinks", named_ms=None)
    found = bench.faults.summary([quiet, alarmed])
    assert found["rows"][0]["false_alarms"] == 1 and found["amiss"] == [alarmed]


@pytest.mark.parametrize("kind, due", [("open", True), ("open, second of a pair, still eye", True),
                                       ("finger", True), ("supply -6 %", True), ("supply -2 %", False),
                                       ("swapped", False), ("blinks", False)])
def test_what_status_has_to_name(bench, kind, due):
    assert bench.faults.to_name(kind) == due


def faults_bars(bench, episodes):
    return bench.judge.bars({"faults": bench.faults.summary(episodes)})


def test_every_bar_of_the_faults_can_be_missed(bench):
    table = frames(bench)
    kinds = ("open", "short", "covered", "finger", "swapped", "supply -2 %", "supply -6 %", "blinks",
             "ambient steps")
    good = [episode(bench, table, kind, repeats=repeats) for kind in kinds for repeats in (1, 4)]
    bars = faults_bars(bench, good)
    assert all(bar["met"] for bar in bars) and len(bars) == 4 * 2 + 2
    for k, kind in enumerate(kinds):
        one = {**good[2 * k], "wild": 1}
        missed = [bar["name"] for bar in faults_bars(bench, [*good[:2 * k], one, *good[2 * k + 1:]])
                  if not bar["met"]]
        assert len(missed) == 1 and "wild" in missed[0] and "default" in missed[0], kind
    unnamed = [{**good[0], "named_ms": None}, *good[1:]]
    assert [bar["name"] for bar in faults_bars(bench, unnamed) if not bar["met"]] == [
        "faults: share of those due that status names"]
    false = [*good[:-1], {**good[-1], "fault_frames": 1}]
    assert [bar["name"] for bar in faults_bars(bench, false) if not bar["met"]] == [
        "faults: false alarms where nothing is broken"]


def test_no_faults_measured_are_no_faults_met(bench):
    assert not any(bar["met"] for bar in faults_bars(bench, []))


def test_the_readme_has_a_row_for_each_kind(bench):
    table = frames(bench)
    found = bench.faults.summary([episode(bench, table), episode(bench, table, "swapped", named_ms=None)])
    (text,) = bench.report.fault_tables({"faults": found})
    lines = text.splitlines()
    assert len(lines) == 4 and "| open | 1 | 1 | 1 | 300 (300) | 1.00, 1.00, 1.00 | 0.0 | 0.5 |" in lines
    assert bench.report.fault_tables({}) == []


def test_every_channel_and_every_pair_has_its_turn(bench):
    seen, pairs = {}, set()
    for seed in range(2000, 2005):
        for k, (repeats, lights) in enumerate(bench.faults.SETTINGS):
            for j, light in enumerate(lights):
                leds, swaps, _ = bench.faults.plan(light, repeats, seed + 2 * j + k, False)
                pairs |= set(swaps)
                for kind, channel in leds:
                    seen.setdefault(kind, set()).add(channel)
    assert pairs == set(bench.faults.SWAPS)
    assert seen == {kind: set(range(6)) for kind in bench.faults.EXPECTED}
