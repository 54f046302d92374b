# SPDX-License-Identifier: Apache-2.0
"""tools/report.py: the README's table is what the report says, or --check fails."""

import json
import sys

import pytest
import report as module


@pytest.fixture
def tool(monkeypatch, tmp_path, good):
    """tool(*args) runs it on tmp_path/report.json (the good report) and tmp_path/README.md; the exit code."""
    (tmp_path / "report.json").write_text(json.dumps(good))
    (tmp_path / "README.md").write_text(f"# Title\n\n{module.BEGIN}\nold\n{module.END}\n\nrest\n")

    def run(*args):
        files = ["--report", str(tmp_path / "report.json"), "--readme", str(tmp_path / "README.md")]
        monkeypatch.setattr(sys, "argv", ["report.py", *files, *args])
        return module.main()

    return run


def test_table_shows_the_figures_of_the_report(good):
    table = module.table(good)
    assert "simulated person 1" in table and "**0.70** / 0.60 / 1.50 deg" in table
    for figure in ("640.4 Hz", "18 vectors, gaze alone", "1001.0 Hz; 0", "16010, 0, 0", "64 vectors",
                   "15,900, 22,700 of 24,984 cycles"):
        assert figure in table
    assert "2.10 ms, 1.25 ms" in table
    assert {line.count("|") for line in table.splitlines()} == {4}


def test_check_fails_before_the_rewrite_passes_after_it_and_fails_for_another_report(tool, tmp_path, good):
    assert tool("--check") == 1
    assert "old" in (tmp_path / "README.md").read_text()
    assert tool() == 0
    text = (tmp_path / "README.md").read_text()
    assert text == f"# Title\n\n{module.BEGIN}\n{module.table(good)}\n{module.END}\n\nrest\n"
    assert tool("--check") == 0
    good["accuracy"]["mean_deg"] = 0.71
    (tmp_path / "report.json").write_text(json.dumps(good))
    assert tool("--check") == 1


def test_a_readme_without_markers_and_a_report_that_is_missing_are_errors(tool, tmp_path, capsys):
    (tmp_path / "README.md").write_text("# Title\n")
    assert tool() == 1 and "markers" in capsys.readouterr().err
    assert (tmp_path / "README.md").read_text() == "# Title\n"
    (tmp_path / "report.json").unlink()
    assert tool("--check") == 1 and "make demo" in capsys.readouterr().err


def test_the_simulators_table_shows_every_bar_and_whether_it_was_met(monkeypatch, tmp_path):
    figures = {
        "machine": {"cores": 2, "cpu": "some cpu", "load": 0.5},
        "speed": {"seconds": 1.6, "pairs": 30, "gazes": 1681},
        "offgrid": {"responses_per_second_core": 100000.0},
        "ring": {"peak_over_median": 2.76, "fwhm_deg": 4.4, "hard_crease_peak_over_median": 2.1},
        "bars": [
            {"name": "error", "value": 3.21e-05, "limit": "<= 0.0001", "met": True, "kind": "bar"},
            {"name": "times ours", "value": 2345.6, "limit": ">= 10000", "met": False, "kind": "aim"},
        ],
    }
    (tmp_path / "sim.json").write_text(json.dumps(figures))
    readme = tmp_path / "README.md"
    readme.write_text(f"{module.SIM_BEGIN}\n{module.SIM_END}\n{module.BEGIN}\nleft alone\n{module.END}\n")
    files = ["--report", str(tmp_path / "sim.json"), "--readme", str(readme)]
    monkeypatch.setattr(sys, "argv", ["report.py", "sim", *files])
    assert module.main() == 0
    text = readme.read_text()
    assert "| error | 3.2e-05 | bar <= 0.0001 | yes |" in text
    assert "| times ours | 2,346 | aim >= 10000 | **no** |" in text
    assert "| a response of that map, microseconds | 31.7 |" in text
    assert "left alone" in text


def test_the_front_ends_table_has_a_row_for_every_bar_and_marks_what_is_missed():
    bars = [{"name": "* rate_hz", "value": 1001.0, "limit": ">= 1000", "kind": "bar", "met": True},
            {"name": "n_vectors", "value": 24, "limit": ">= 64", "kind": "aim", "met": False},
            {"name": "s2s_deg", "value": None, "limit": "<= 0.35", "kind": "bar", "met": False}]
    table = module.frontend_table({"seeds": [2000, 2004], "bars": bars}).splitlines()
    assert len(table) == 2 + len(bars) and "2000 to 2004" in table[0]
    assert table[2] == "| \\* rate_hz | 1,001 | bar >= 1000 | yes |"
    assert table[3].endswith("| 24 | aim >= 64 | **no** |") and "| - |" in table[4]


def test_what_was_not_measured_is_no_zero_in_the_inference_table():
    lids = dict.fromkeys(("shut_flagged", "half_flagged", "narrow_flagged", "false_alarms"), 0.5)
    known = dict(coverage68=0.7, coverage95=None, **lids)
    lines = module.inference_table({"bars": [], "variance": known}).splitlines()
    assert "| 0.700, - |" in next(line for line in lines if "to the target" in line)
    unknown = dict(coverage68=None, coverage95=None, **lids)
    assert "0.000" not in module.inference_table({"bars": [], "variance": unknown})
