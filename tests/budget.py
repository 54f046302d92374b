# SPDX-License-Identifier: Apache-2.0
"""tests/budget.csv: what functions and sections may take, per target.

A figure above its budget fails, and so does one more than SLACK below it: then the budget is lowered, in
review, like code. A target named after its instructions has those in the column cycles_max.

With BUDGET_WRITE=1 in the environment the tests that judge write the file anew instead, for that review:
BUDGET_WRITE=1 .venv/bin/python -m pytest tests/unit/test_core_budget.py
"""

import csv
import os
import pathlib

FILE = pathlib.Path(__file__).resolve().parent / "budget.csv"
COLUMNS = ("cycles_max", "stack", "flash", "ram")
SLACK = 0.05


def read(target):
    """{name: {column: int or None}} of the rows of one target."""
    with open(FILE, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["target"] == target]
    return {row["name"]: {key: int(row[key]) if row[key] else None for key in COLUMNS} for row in rows}


def write(target, found):
    """Put the (name, column, measured) in `found` into the file, each name a row of this target."""
    with open(FILE, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for name, column, measured in found:
        row = next((row for row in rows if (row["name"], row["target"]) == (name, target)), None)
        if row is None:
            row = dict.fromkeys(COLUMNS, "") | {"name": name, "target": target}
            rows.append(row)
        row[column] = measured
    with open(FILE, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ("name", "target", *COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def judge(budget, name, column, measured, margin=0.0):
    """None, or what to change. margin: share by which another compiler than the budget's may differ."""
    allowed = budget[name][column]
    if measured > allowed * (1 + margin):
        return f"{name}: {column} {measured} is above its budget of {allowed}"
    if measured < allowed * (1 - SLACK - margin):
        return (f"{name}: {column} {measured} is better than its budget of {allowed}: "
                f"write {measured} into tests/budget.csv")
    return None


def judge_all(target, found, margin=0.0):
    """AssertionError that lists what is wrong with the (name, column, measured) in `found`."""
    if os.environ.get("BUDGET_WRITE") == "1":
        write(target, found)
    budget = read(target)
    wrong = [text for text in (judge(budget, *item, margin) for item in found) if text]
    assert not wrong, "; ".join(wrong)
