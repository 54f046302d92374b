# SPDX-License-Identifier: Apache-2.0
"""How good is the gaze that the device computes: held-out targets, error, precision, loss, bit identity.

Definitions. A frame is *settled* from settle_s after its target's onset to the next onset. Settled frames
whose gaze has SG_FLAG_VALID count for the error; all other settled frames (blinks, out of range, saturated,
no gaze) are data loss. Error of a frame: angle between the unit vectors of gaze and target. accuracy_deg,
rms_s2s_deg, std_deg, bcea are ETDQualitizer's, per target, averaged over targets.
"""

import os
import tempfile
from dataclasses import dataclass, field
from typing import Optional

import numpy as np

from . import metrics, replay, session, targets
from .gazefile import GazeCsv


@dataclass
class Validation:
    """What a validation measured; arrays over all frames of `run` (session.Run), n in all.

    settled, counted   bool [n]: see the module; counted = settled with a valid gaze
    error_deg          float64 [n], NaN where not counted
    true_deg           float64 [n, 2], where the simulated eye really looked, or None
    model              DeviceModel in use, or None; model_crc as the frames state it
    compared, differing   device gaze frames held against the host core, and how many differ in any bit
    """

    run: session.Run
    settled: np.ndarray
    counted: np.ndarray
    error_deg: np.ndarray
    model: object
    compared: int
    differing: int
    true_deg: Optional[np.ndarray] = None
    exposure_changes: int = 0
    notes: list = field(default_factory=list)

    @property
    def bit_identical(self):
        """True when every gaze frame equals what the host core computes from its raw frame."""
        return self.compared > 0 and self.differing == 0

    def error_of(self, gaze_deg, against_deg=None):
        """metrics.FrameError of any gaze [n, 2] over the counted frames; against_deg [n, 2] or the targets.

        For example the float64 process on the same samples: error_of(gp.predict(run.frames["features"])).
        """
        against = self.run.target_deg if against_deg is None else against_deg
        rows = self.counted
        return metrics.frame_error(gaze_deg[rows, 0], gaze_deg[rows, 1], against[rows, 0], against[rows, 1])

    def per_target(self):
        """One dict per target: target, mean gaze, error, accuracy, precision, loss; degrees, percent."""
        gaze = np.where(self.counted[:, None], self.run.gaze_deg, np.nan)
        table = []
        for k, (azimuth, elevation) in enumerate(self.run.plan.target_deg[: len(self.run.onset_us)]):
            rows = (self.run.target_index == k) & self.settled
            az, el = gaze[rows].T
            have = np.isfinite(az)
            accuracy = metrics.accuracy_deg(az, el, azimuth, elevation)[0]
            table.append(
                {
                    "target_az_deg": float(azimuth),
                    "target_el_deg": float(elevation),
                    "gaze_az_deg": float(az[have].mean()) if have.any() else np.nan,
                    "gaze_el_deg": float(el[have].mean()) if have.any() else np.nan,
                    "mean_deg": float(self.error_deg[rows][have].mean()) if have.any() else np.nan,
                    "accuracy_deg": accuracy,
                    "rms_s2s_deg": metrics.rms_s2s_deg(az, el),
                    "std_deg": metrics.std_deg(az, el),
                    "bcea_deg2": metrics.bcea_deg2(az, el),
                    "data_loss_percent": metrics.data_loss_percent(az, el),
                    "frames": int(rows.sum()),
                }
            )
        return table

    def report(self):
        """Everything as one dict of plain numbers: accuracy, stream, targets."""
        run, table = self.run, self.per_target()
        error = self.error_of(run.gaze_deg)

        def over_targets(key):
            values = np.array([row[key] for row in table], float)
            return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan

        settled = int(self.settled.sum())
        accuracy = {
            "mean_deg": error.mean_deg,
            "median_deg": error.median_deg,
            "p95_deg": error.p95_deg,
            "frames": error.frames,
            "accuracy_deg": over_targets("accuracy_deg"),
            "rms_s2s_deg": over_targets("rms_s2s_deg"),
            "std_deg": over_targets("std_deg"),
            "bcea_deg2": over_targets("bcea_deg2"),
            "data_loss_percent": 100.0 * (settled - error.frames) / settled if settled else 100.0,
        }
        if self.true_deg is not None:
            accuracy["to_true_gaze_mean_deg"] = self.error_of(run.gaze_deg, self.true_deg).mean_deg
            accuracy["true_gaze_to_target_mean_deg"] = self.error_of(self.true_deg).mean_deg
        inside = run.target_index >= 0
        gaze = int(np.sum(run.frames["has_gaze"]))
        return {
            "targets": len(table),
            "accuracy": accuracy,
            "stream": {
                "seconds": run.seconds,
                "frames": int(inside.sum()),
                "gaze_frames": gaze,
                "rate_hz": run.rate_hz,
                "lost": run.lost,
                "torn": run.torn,
                "bad_crc": run.bad,
                "bit_identical": self.bit_identical,
                "compared": self.compared,
                "differing": self.differing,
                "exposure_changes": self.exposure_changes,
                "infer_us_mean": (
                    float(run.frames["infer_us"][run.frames["has_gaze"]].mean()) if gaze else None
                ),
            },
            "model_crc": self.model.crc if self.model is not None else None,
            "notes": list(self.notes) + list(run.notes),
        }


def run(
    port, n_targets=25, seed=0, avoid_deg=None, screen=None, window=None, csv=None, truth=True, progress=None
):
    """Validate the device behind `port` (a name) and return a Validation.

    n_targets   held-out targets, one second each
    seed        of the target plan; avoid_deg [m, 2] calibration targets to keep away from (default: those of
                the plan that `calibrate` shows with this seed)
    screen      see screen.py; None chooses: the simulated person of a virtual Nano, else a window (window:
                dict of arguments of WindowScreen)
    csv         path: the whole stream is kept there; truth: also ask a virtual Nano where the eye really
                looked
    Raises PortError, NoDeviceError, CalibrationError (no model in the device, no frames).
    """
    from .device import Device
    from .screen import screen_for

    with Device(port) as device:
        shown = screen_for(device, **(window or {})) if screen is None else screen
        try:
            plan = targets.validation_plan(n_targets, seed, reach_deg=shown.reach_deg(), avoid_deg=avoid_deg)
            return measure(device, shown, plan, csv, truth, progress)
        finally:
            if screen is None:
                shown.close()


def measure(device, screen, plan, csv=None, truth=True, progress=None):
    """Validate an open device with a given plan on a given screen. Returns Validation; see `run`."""
    from .errors import CalibrationError
    from .model import DeviceModel
    from .wire import lib

    if device.model_info().active == lib.SG_SLOT_NONE:
        port = getattr(device, "port", "PORT")
        raise CalibrationError("the device has no model", f"run `sparsegaze calibrate {port}`")
    model = DeviceModel(device.read_model())
    control = getattr(screen, "control", None) if truth else None
    writer = None if csv is None else GazeCsv(csv, {"plan": plan.name, "model_crc": f"0x{model.crc:08X}"})
    path = None
    try:
        if control is not None:
            handle, path = tempfile.mkstemp(prefix="sparsegaze-truth-", suffix=".csv")
            os.close(handle)
            control.truth(path)
        done = session.run(
            device, screen, plan, gaze=True, progress=progress, on_frame=writer.add if writer else None
        )
        true_deg = None
        if control is not None:
            control.truth(None)
            true_deg = read_truth(path, done.frames["t_us"] - done.offset_us)
    finally:
        if writer is not None:
            writer.close()
        if path is not None:
            _forget(control, path)
    return evaluate(done, model, true_deg)


def evaluate(done, model, true_deg=None):
    """Validation of a finished session.Run made with gaze=True and model (DeviceModel or None)."""
    from ._core import lib

    frames = done.frames
    gaze_valid = frames["has_gaze"] & ((frames["gaze_flags"] & lib.SG_FLAG_VALID) != 0)
    settled = done.settled
    counted = settled & gaze_valid
    error = np.full(len(frames), np.nan)
    gaze, target = done.gaze_deg[counted], done.target_deg[counted]
    error[counted] = metrics.frame_errors_deg(gaze[:, 0], gaze[:, 1], target[:, 0], target[:, 1])
    host = replay.infer(model, frames["features"], frames["raw_flags"], frames["recentre"])
    have = frames["has_gaze"]
    same = (host.q7 == frames["gaze_q7"]).all(axis=1) & (host.flags == frames["gaze_flags"])
    same &= host.sigma_log2_q4 == frames["gaze_sigma"]
    if model is not None:
        same &= frames["model_crc"] == model.crc
    changes = int(np.sum((frames["raw_flags"] & lib.SG_FLAG_EXPOSURE) != 0))
    faulty = int(np.sum((frames["raw_flags"][settled] & lib.SG_FLAG_FAULT) != 0))
    notes = [f"{faulty} settled frames had a fault: `sparsegaze status` names it"] if faulty else []
    compared, differing = int(have.sum()), int(np.sum(have & ~same))
    return Validation(done, settled, counted, error, model, compared, differing, true_deg, changes, notes)


def read_truth(path, virtual_us):
    """Where the simulated eye looked at the virtual times [n] (us): float64 [n, 2], NaN outside the file."""
    rows = []
    with open(path, encoding="ascii", errors="replace") as file:
        for line in file:
            cells = line.split(",")
            try:
                rows.append([float(cell) for cell in cells[:3]])
            except ValueError:
                continue  # header
    table = np.array([row for row in rows if len(row) == 3], float).reshape(-1, 3)
    if len(table) < 2:
        return np.full((len(virtual_us), 2), np.nan)
    at = np.asarray(virtual_us, float)
    return np.column_stack([np.interp(at, table[:, 0], table[:, i], np.nan, np.nan) for i in (1, 2)])


def picture(validation, path, title="held-out targets"):
    """Draw gaze against targets and the histogram of the error as PNG. Needs the extra `pictures`."""
    from .errors import SparsegazeError

    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError:
        raise SparsegazeError(
            "drawing needs matplotlib", 'install it: pip install "sparsegaze[pictures]"'
        ) from None
    rows = validation.counted
    gaze, plan, report = validation.run.gaze_deg[rows], validation.run.plan.target_deg, validation.report()
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 5.2), constrained_layout=True)
    left.plot(gaze[:, 0], gaze[:, 1], ".", ms=1.5, alpha=0.25, color="#3b6ea5", label="gaze, per frame")
    for row in validation.per_target():
        left.plot(
            [row["target_az_deg"], row["gaze_az_deg"]],
            [row["target_el_deg"], row["gaze_el_deg"]],
            "-",
            color="#c8553d",
            lw=1,
        )
    left.plot(plan[:, 0], plan[:, 1], "+", ms=9, mew=1.6, color="black", label="target")
    left.set(xlabel="azimuth (deg, + right)", ylabel="elevation (deg, + up)", title=title, aspect="equal")
    left.legend(loc="upper right", fontsize=8)
    right.hist(validation.error_deg[rows], bins=60, color="#3b6ea5")
    accuracy = report["accuracy"]
    for key, style in (("mean_deg", "-"), ("median_deg", "--"), ("p95_deg", ":")):
        right.axvline(accuracy[key], ls=style, color="#c8553d", label=f"{key[:-4]} {accuracy[key]:.2f} deg")
    right.set(
        xlabel="error to the target, per frame (deg)",
        ylabel="frames",
        title=f"{accuracy['frames']} frames, data loss {accuracy['data_loss_percent']:.1f} %",
    )
    right.legend(fontsize=9)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise SparsegazeError(
            f"cannot write {path}: {error.strerror}", "choose another place with --png"
        ) from None
    finally:
        pyplot.close(figure)


def _forget(control, path):
    try:
        control.truth(None)
    except Exception:  # the virtual Nano is gone: its file is closed with it
        pass
    try:
        os.unlink(path)
    except OSError:
        pass
