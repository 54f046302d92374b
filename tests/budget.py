# SPDX-License-Identifier: Apache-2.0
"""tests/budget.csv: what functions and sections may take, per target.

A figure above its budget fails, and so does one more than SLACK below it: then the budget is lowered, in
review, like code. A target named after its instructions has those in the column cycles_max.
"""

import csv
import pathlib

FILE = pathlib.Path(__file__).resolve().parent / "budget.csv"
COLUMNS = ("cycles_max", "stack", "flash", "ram")
SLACK = 0.05


def read(target):
    """{name: {column: int or None}} of the rows of one target."""
    with open(FILE, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["target"] == target]
    return {row["name"]: {key: int(row[key]) if row[key] else None for key in COLUMNS} for row in rows}


def judge(budget, name, column, measured, margin=0.0):
    """None, or what to change. margin: share by which another compiler than the budget's may differ."""
    allowed = budget[name][column]
    if measured > allowed * (1 + margin):
        return f"{name}: {column} {measured} is above its budget of {allowed}"
    if measured < allowed * (1 - SLACK - margin):
        return (f"{name}: {column} {measured} is better than its budget of {allowed}: "
                f"write {measured} into tests/budget.csv")
    return None


def judge_all(budget, found, margin=0.0):
    """AssertionError that lists what is wrong with the (name, column, measured) in `found`."""
    wrong = [text for text in (judge(budget, *item, margin) for item in found) if text]
    assert not wrong, "; ".join(wrong)
