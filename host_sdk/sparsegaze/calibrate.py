# SPDX-License-Identifier: Apache-2.0
"""The whole calibration: targets -> recording -> Gaussian process -> device model -> upload -> validation."""

import json
import os
from dataclasses import dataclass
from typing import Optional

from . import capture, probe, targets, validate
from .errors import CalibrationError, PortError, SparsegazeError

RECORDING, MODEL, REPORT = "recording.csv", "model.sgm", "report.json"
LOOK_S = 0.5  # to look back at the centre


@dataclass
class Calibration:
    """capture (capture.Capture), fit (fit.FitResult), upload (store.UploadReport or None), validation (or
    None), folder (where recording, model and report are kept, or None), seen (who saw whom, float64 [6, 6] of
    probe.measure, or None).
    """

    capture: capture.Capture
    fit: object
    upload: Optional[object]
    validation: Optional[validate.Validation]
    folder: Optional[str]
    seen: Optional[object] = None

    def report(self):
        """Everything as one dict of plain values."""
        chosen, model = self.capture.selection, self.fit.model
        out = {
            "n_targets": chosen.n_targets,
            "used_targets": chosen.used_targets,
            "frames": {"valid": int(chosen.valid.sum()), **chosen.counts()},
            "recording_lost": self.capture.run.lost,
            "n_vectors": model.vectors,
            "fit": plain(self.fit.report),
            "crc_host": model.crc,
            "notes": list(self.capture.run.notes),
            "probe": self.seen,
        }
        if self.upload is not None:
            # The upload gives the model its generation, which the checksum covers.
            out.update(upload=plain(self.upload), crc_host=self.upload.crc)
        if self.validation is not None:
            measured = self.validation.report()
            out.update(
                accuracy=measured["accuracy"],
                stream=measured["stream"],
                crc_device=measured["model_crc"],
                validation_targets=measured["targets"],
                data_loss_percent=measured["accuracy"]["data_loss_percent"],
            )
            out["notes"] += measured["notes"]
        if self.folder:
            out["files"] = {name: os.path.join(self.folder, name) for name in (RECORDING, MODEL, REPORT)}
        return out


def run(
    port,
    n_targets=120,
    vectors=None,
    seed=0,
    n_validation=25,
    folder=None,
    upload=True,
    screen=None,
    window=None,
    csv=None,
    truth=True,
    progress=None,
    rate_hz=None,
):
    """Calibrate the device behind `port` and return a Calibration.

    port          port name
    n_targets     calibration targets, about one second each; vectors: of the device model, None: the fewest
                  that do
    seed          of the target plans; n_validation: held-out targets afterwards, 0 for none
    folder        where recording.csv, model.sgm and report.json are kept, made if missing; None keeps nothing
    upload        False stops after the fit
    screen        see screen.py; None chooses (window: dict of arguments of WindowScreen)
    csv           path for the stream of the validation; truth: see validate.run
    progress      called as progress(stage, done, total)
    rate_hz       that the Nano is to reach with the gaze streamed: as many vectors as leave it the time
    The recording is on disk from the first target on, and stays when anything after it fails.
    Raises PortError, NoDeviceError, CalibrationError, RecordingError, FlashError.
    """
    from . import choose, store
    from .device import Device
    from .fit import fit_recording
    from .screen import screen_for
    from .transport import open_link

    choose.most_vectors(None, vectors, rate_hz)  # refused before anybody has looked at a target
    with open_link(port) as link:
        device = Device(link)
        _make(folder)
        shown = screen_for(device, **(window or {})) if screen is None else screen
        try:
            plan = targets.calibration_plan(n_targets, seed, reach_deg=shown.reach_deg())
            path = os.path.join(folder, RECORDING) if folder else None
            meta = {
                "device": device.hello.board_text,
                "firmware": device.hello.firmware_text,
                "plan_seed": seed,
            }
            taken = capture.run(device, shown, plan, path, meta, progress)
            try:
                capture.check(taken)
                seen = _who_sees_whom(device, shown)
                fitted = fit_recording(
                    taken.recording, n_vectors=vectors, progress=progress, rate_hz=rate_hz
                )
                if folder:
                    fitted.model.save(os.path.join(folder, MODEL))
                done = Calibration(taken, fitted, None, None, folder, seen)
                if upload:
                    done.upload = store.upload(link, fitted.model, progress)
                    if folder:
                        fitted.model.with_generation(done.upload.generation).save(os.path.join(folder, MODEL))
                    if n_validation:
                        held_out = targets.validation_plan(
                            n_validation, seed, reach_deg=shown.reach_deg(), avoid_deg=plan.target_deg
                        )
                        done.validation = validate.measure(
                            Device(link), shown, held_out, csv, truth, progress
                        )
                _write_report(done)
                return done
            except SparsegazeError as error:
                if path and path not in error.message:
                    error.remedy = f"{error.remedy}; the recording is kept in {path}".lstrip("; ")
                raise
        finally:
            if screen is None:
                shown.close()


def _who_sees_whom(device, shown):
    """The probe that later ones are compared with, of an eye that looks ahead; None: this board has none."""
    try:
        shown.look((0.0, 0.0), device.status().t_us)
        device.link.sleep(LOOK_S)
        return probe.measure(device)
    except PortError:
        raise
    except SparsegazeError:
        return None


def plain(value):
    """Reports (named tuples, dataclasses, numpy) as what JSON knows; NaN and infinities become None."""
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if hasattr(value, "__dataclass_fields__"):
        return {
            name: plain(getattr(value, name))
            for name in value.__dataclass_fields__
            if not name.startswith("_")
        }
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def _make(folder):
    if folder:
        try:
            os.makedirs(folder, exist_ok=True)
        except OSError as error:
            raise CalibrationError(
                f"cannot make {folder}: {error.strerror}", "choose another place with --save"
            ) from None


def _write_report(done):
    if not done.folder:
        return
    path = os.path.join(done.folder, REPORT)
    try:
        with open(path + ".part", "w", encoding="utf-8") as file:
            json.dump(plain(done.report()), file, indent=1)
            file.write("\n")
        os.replace(path + ".part", path)
    except OSError as error:
        raise CalibrationError(
            f"cannot write {path}: {error.strerror}", "choose another place with --save"
        ) from None
