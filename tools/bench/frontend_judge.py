# SPDX-License-Identifier: Apache-2.0
"""Which bars the front end meets."""

import sys

BITS_APART = 0.25  # closed form against Monte Carlo of 500 draws: 5 standard errors


def bars(report):
    """[{name, value, limit, met, kind}] of what was measured; kind: bar, or aim, which is wished for."""
    rows = []

    def most(name, value, limit, kind="bar"):
        met = value is not None and value <= limit
        rows.append({"name": name, "value": value, "limit": f"<= {limit:g}", "met": bool(met), "kind": kind})

    def least(name, value, limit, kind="bar"):
        met = value is not None and value >= limit
        rows.append({"name": name, "value": value, "limit": f">= {limit:g}", "met": bool(met), "kind": kind})

    if "bits" in report:
        most("bits: closed form and Monte Carlo apart", report["bits_apart"], BITS_APART)
        chosen = [row for row in report["bits"] if row["chosen"] and row["feasible_at_1khz"]]
        least("bits: rows of the chosen point", len(chosen), 1)
    if report.get("patterns"):
        best = report["patterns"][0]
        most("patterns: chosen over best, RMS-S2S", _chosen(report)["s2s_mean_deg"] / best["s2s_mean_deg"], 1.0)
    return rows


def _chosen(report):
    return next(row for row in report["patterns"] if row["chosen"])


def tell(report, folder):
    """Print the bars. Returns the exit code."""
    missed = []
    for one in report["bars"]:
        word = "met" if one["met"] else "MISSED" if one["kind"] == "bar" else "short"
        value = "none" if one["value"] is None else f"{one['value']:.4g}"
        print(f"  {word:6} {one['name']:58} {value:>10}   {one['kind']} {one['limit']}")
        if word == "MISSED":
            missed.append(one)
    print(f"{folder}/frontend.json and frontend.png written, {report['seconds']:.0f} s")
    for one in missed:
        value = "none" if one["value"] is None else f"{one['value']:.4g}"
        print(f"bench-frontend: bar missed: {one['name']} is {value}, needs {one['limit']}", file=sys.stderr)
    return 1 if missed else 0
