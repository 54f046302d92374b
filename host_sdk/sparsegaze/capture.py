# SPDX-License-Identifier: Apache-2.0
"""A run of targets written into a recording file while it happens, then marked and written again whole."""

import os
from dataclasses import dataclass

import numpy as np

from . import selection, session
from .errors import CalibrationError, RecordingError
from .recording import FORMAT, Recording, RecordingWriter

LEAST_SHARE = 0.6  # of the targets that must have yielded usable frames


@dataclass
class Capture:
    """recording (Recording), selection (selection.Selection), run (session.Run), path (str or None)."""

    recording: Recording
    selection: selection.Selection
    run: session.Run
    path: str


def run(device, screen, plan, path=None, meta=None, progress=None):
    """Show the targets of `plan`, record the raw frames, mark the usable ones.

    path   file to write; rows of a target are on disk as soon as its time is over, so an interrupted run
           leaves a complete, fittable file. At the end it is replaced by one with the final marks.
    Returns Capture. Raises what session.run raises, and RecordingError when the file cannot be written.
    """
    meta = {
        "recording_format": FORMAT,
        "plan": plan.name,
        "targets": len(plan),
        "dwell_s": plan.dwell_s,
        "settle_s": plan.settle_s,
        **_sensing(device),
        **(meta or {}),
    }
    if path is None:
        return _finish(session.run(device, screen, plan, progress=progress), None, meta)
    _make_room(path)
    cut = []
    with RecordingWriter(path, 6, meta) as writer:

        def on_target(index, part):
            chosen = _select(part, provisional=True)
            rows = part.target_index >= 0
            writer.write(
                part.frames["t_us"][rows],
                part.frames["features"][rows],
                part.target_deg[rows],
                chosen.valid[rows],
            )
            writer.flush()

        try:
            whole = session.run(device, screen, plan, progress=progress, on_target=on_target, cut=cut)
        except BaseException:
            shown = int(cut[0].target_index.max()) + 1 if cut and len(cut[0].frames) else 0
            writer.comment(f"interrupted: during target {shown} of {len(plan)}")
            raise
    return _finish(whole, os.fspath(path), meta)


def check(capture, remedy=""):
    """Raise CalibrationError when too few targets yielded usable frames to calibrate with."""
    chosen, kept = capture.selection, f"; the recording is kept in {capture.path}" if capture.path else ""
    if chosen.used_targets >= max(9, LEAST_SHARE * chosen.n_targets):
        return
    counts = chosen.counts()
    causes = {
        "flagged": "readings were saturated or starved: keep sunlight away, the headset before the eye",
        "blink": "the signals kept jumping: blink between targets, hold the headset still",
        "unstable": "the signals kept jumping: blink between targets, hold the headset still",
        "inattentive": "the eye was elsewhere: look at each dot until it moves",
        "outside": "look at each dot until it moves",
    }
    worst = max(causes, key=lambda name: counts.get(name, 0) if name != "outside" else 0.5)
    raise CalibrationError(
        f"only {chosen.used_targets} of {chosen.n_targets} targets gave usable data{kept}",
        remedy or f"{causes[worst]}; then calibrate again",
    )


def _sensing(device):
    """How the device senses, for the file's head."""
    now = device.settings()
    curve = " ".join(f"{value:.4f}" for value in device.curve().curve)
    return {"repeats": now.repeats, "period_us": now.period_us, "wiring": now.wiring_text, "curve": curve}


def _finish(whole, path, meta):
    chosen = _select(whole)
    counts = chosen.counts()
    meta = {
        **meta,
        "used_targets": chosen.used_targets,
        **{f"frames_{name}": n for name, n in counts.items()},
    }
    inside = whole.target_index >= 0
    recording = Recording(
        whole.frames["t_us"][inside],
        whole.frames["features"][inside],
        whole.target_deg[inside],
        chosen.valid[inside],
        {key: str(value) for key, value in meta.items()},
    )
    if path is not None:
        recording.write(path)
    return Capture(recording, chosen, whole, path)


def _select(part, provisional=False):
    from ._core import lib

    # Not FAULT: the device compares with the calibration that it has, not with the one that is being made.
    flagged = (part.frames["raw_flags"] & (lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED)) != 0
    index, onsets, targets = part.target_index, part.onset_us, part.plan.target_deg
    if provisional and len(index):
        # Only the targets that these frames belong to: a plan shorter than that knows nothing of attention.
        shown = np.unique(index[index >= 0])
        onsets, targets = onsets[shown], targets[shown]
        index = np.where(index >= 0, np.searchsorted(shown, index), -1)
    return selection.select(
        part.frames["t_us"],
        part.frames["features"],
        flagged,
        index,
        onsets,
        targets[: len(onsets)],
        part.plan.settle_s,
    )


def _make_room(path):
    folder = os.path.dirname(os.path.abspath(path))
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot make {folder}: {error.strerror}", "choose another place for the recording"
        ) from None
