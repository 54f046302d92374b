# SPDX-License-Identifier: Apache-2.0
"""What a command says and where: results on stdout, everything else on stderr.

With --json stdout carries exactly one JSON object, whatever happens. Only the command line uses this module.
"""

import contextlib
import json
import sys
import time

STAGES = {
    "write": "writing",
    "verify": "reading back",
    "targets": "targets",
    "fit": "fitting the model",
    "exposures": "waiting for the exposures to settle",
    "recentre": "look at the dot",
    "linearity": "alternating the exposures",
    "probe": "lighting one LED at a time",
    "press reset": "press the board's reset button now",
}


class Console:
    """Output of one command. as_json: --json was given."""

    def __init__(self, as_json=False):
        self.as_json = as_json

    def result(self, data, *lines):
        """The command's one result: `data` (a dict) as JSON, or else the given lines of text."""
        if self.as_json:
            from .calibrate import plain

            sys.stdout.write(json.dumps(plain(data), allow_nan=False) + "\n")
        else:
            for line in lines:
                sys.stdout.write(f"{line}\n")
        sys.stdout.flush()

    def note(self, text):
        """One line on stderr."""
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()

    def warn(self, text):
        """A line on stderr that says it is a warning."""
        self.note(f"sparsegaze: warning: {' '.join(str(text).split())}")

    @contextlib.contextmanager
    def progress(self):
        """Yields a callback (stage, done, total): a bar on a terminal, else a line per quarter; on stderr."""
        if sys.stderr.isatty():
            with self._bar() as step:
                yield step
        else:
            yield _Quarters(self.note)

    @contextlib.contextmanager
    def _bar(self):
        from rich.console import Console as RichConsole
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        tasks = {}
        with Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            console=RichConsole(stderr=True),
        ) as bars:

            def step(stage, done, total):
                if stage not in tasks:
                    for other in tasks.values():
                        bars.update(other, total=1, completed=1)
                        bars.stop_task(other)
                    tasks[stage] = bars.add_task(STAGES.get(stage, stage), total=None)
                bars.update(tasks[stage], completed=done, total=total or None)

            yield step

    def live(self):
        """A line on stderr that is written over; call it with a text as often as you like."""
        return _Live()


class _Quarters:
    def __init__(self, note):
        self._note, self._stage, self._said = note, None, -1

    def __call__(self, stage, done, total):
        quarter = int(4 * done / total) if total else 0
        if stage != self._stage or quarter < self._said:
            self._stage, self._said = stage, -1
            if stage in ("exposures", "press reset") or quarter == 0:
                self._note(STAGES.get(stage, stage))
                self._said = 0
        if quarter > self._said:
            self._said = quarter
            self._note(f"{STAGES.get(stage, stage)}: {100 * done / total:.0f} %")


class _Live:
    EVERY_S = 0.1

    def __init__(self):
        self._tty, self._last, self._width = sys.stderr.isatty(), 0.0, 0

    def __call__(self, text):
        if self._tty and time.monotonic() - self._last >= self.EVERY_S:
            self._last = time.monotonic()
            sys.stderr.write("\r" + text.ljust(self._width))
            sys.stderr.flush()
            self._width = len(text)

    @property
    def due(self):
        """True when the next text would be shown."""
        return self._tty and time.monotonic() - self._last >= self.EVERY_S

    def end(self):
        """Leave the line."""
        if self._width:
            sys.stderr.write("\n")
            self._width = 0


def table(head, rows):
    """Lines of a plain aligned table: head (names), rows (sequences); numbers to the right."""
    cells = [[str(name) for name in head]] + [[_cell(value) for value in row] for row in rows]
    right = [
        all(isinstance(row[i], (int, float)) or row[i] is None for row in rows) and bool(rows)
        for i in range(len(head))
    ]
    width = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return [
        "  ".join(cell.rjust(w) if r else cell.ljust(w) for cell, w, r in zip(row, width, right)).rstrip()
        for row in cells
    ]


def pairs(items):
    """Lines "name  value" of (name, value) pairs, aligned."""
    items = list(items)
    width = max(len(name) for name, _ in items)
    return [f"{name.ljust(width)}  {_cell(value)}" for name, value in items]


def _cell(value):
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "-" if value != value else f"{value:.3f}"
    return str(value)
